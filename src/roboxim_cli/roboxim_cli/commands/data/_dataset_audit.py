"""Find faults that spoil training data."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from roboxim_cli import strict
from roboxim_cli.options import Place, option

if TYPE_CHECKING:
    from roboxim_datasets.audit import AuditResult

SHOWN = 3
"""Findings of a check that are printed; the report has more."""
PATH = click.Path(path_type=Path)


def _list_checks(context: click.Context, _: click.Parameter, value: bool) -> None:
    """Print the checks and end."""
    if not value or context.resilient_parsing:
        return
    from roboxim_datasets.audit import AUDIT_CHECKS

    for name, check in sorted(((n, AUDIT_CHECKS[n]) for n in AUDIT_CHECKS), key=lambda item: (item[1].order, item[0])):
        click.echo(f"{name}: {check.title}")
        click.echo(f"  threshold: {check.threshold}")
        click.echo(f"  needs: {check.needs}")
    context.exit()


@strict.command("audit")
@click.argument("path", type=Place())
@click.option(
    "--bags", multiple=True, type=Place(), help="Bags of a dataset's episodes, for ground truth; may be repeated."
)
@click.option("--check", "checks", multiple=True, metavar="NAME", help="Make this check only; may be repeated.")
@option("out", help="Folder of the report; default: PATH-audit.")
@click.option("--replay", is_flag=True, help="Also execute the bags' actions again.")
@click.option("--no-render", is_flag=True, help="Leave out the checks that need a renderer.")
@option("episodes", type=click.IntRange(0), default=0, show_default="all", help="Audit the first episodes only.")
@click.option(
    "--list", is_flag=True, is_eager=True, expose_value=False, callback=_list_checks, help="List the checks and exit."
)
def command(
    path: Path | str, no_render: bool, out: Path | None, bags: tuple[Path | str, ...], **options: Any
) -> None:  # fmt: skip
    r"""Find faults that spoil training data, in bags or in a dataset of any format, RoboXim's or another's.

    \b
    roboxim dataset audit runs/demos
    roboxim dataset audit runs/demos-rlds --bags runs/demos

    PATH and --bags may be URLs. Checks that need ground truth need bags. The report is PATH-audit/report.html, with
    audit.json beside it. The exit code is 1 when a fault was found or an episode cannot be read.
    """
    from roboxim_cli.printer import EventPrinter
    from roboxim_core.errors import ConfigError
    from roboxim_datasets.audit.report import summary_line
    from roboxim_runs.datasets.audit import AuditConfig, audit_dataset
    from roboxim_runs.storage.store import is_url, local_sources

    if is_url(path) and out is None:
        raise ConfigError(f"the audit of {path} needs a folder of this machine for its report: give --out")
    with EventPrinter() as printer, local_sources([path, *bags]) as (local, *local_bags):
        config = AuditConfig(render=not no_render, bags=tuple(local_bags), **options)
        audited = audit_dataset(local, out, config, on_event=printer)
    _print_checks(audited.result)
    click.echo(f"{summary_line(audited.result)}: {audited.page}")
    if not audited.result.clean:
        raise SystemExit(1)


def _print_checks(result: AuditResult) -> None:
    """Print the findings, then the checks that could not be made, by reason."""
    from roboxim_datasets.audit.report import STATUS

    unchecked: dict[str, list[str]] = {}
    for check in result.checks:
        if check.findings:
            faulty = f" ({len(check.faulty_episodes)} of {check.checked} episodes)" if check.faults else ""
            click.echo(f"{STATUS[check.status]}: {check.title}{faulty}")
        for finding in check.findings[:SHOWN]:
            click.echo(f"  {', '.join(finding.episodes) or 'the dataset'}: {finding.text}")
        if len(check.findings) > SHOWN:
            click.echo(f"  and {len(check.findings) - SHOWN} more")
        for why in check.unchecked if not check.checked else ():
            unchecked.setdefault(why, []).append(check.name)
    for why, names in unchecked.items():
        click.echo(f"{STATUS['unchecked']}: {', '.join(names)}\n  {why}")
    for name, why in result.unreadable.items():
        click.echo(f"cannot be read: {name}\n  {why}")
