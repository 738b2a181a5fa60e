"""Find faults that spoil training data."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from roboxim_cli import strict
from roboxim_cli.options import ABSENT_IS_ZERO, Place, option

if TYPE_CHECKING:
    from roboxim_datasets.audit import AuditResult

SHOWN = 3
"""Findings of a check that are printed; the report has more."""


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


@strict.command("audit", begins="auditing")
@click.argument("path", type=Place())
@click.option(
    "--bags",
    multiple=True,
    type=Place(),
    help="Bags of a dataset's episodes: every value is compared with what their export gives, and they are the ground "
    "truth of the other checks; may be repeated.",
)
@click.option("--against", type=Place(), help="Another dataset of the same episodes: every value is compared with it.")
@click.option("--check", "checks", multiple=True, metavar="NAME", help="Make this check only; may be repeated.")
@option("out", help="Folder of the report; default: none is written.")
@click.option("--replay", is_flag=True, help="Also execute the bags' actions again.")
@click.option("--no-render", is_flag=True, help="Leave out the checks that need a renderer.")
@option("episodes", **ABSENT_IS_ZERO, show_default="all", help="Audit the first episodes only.")
@click.option(
    "--list", is_flag=True, is_eager=True, expose_value=False, callback=_list_checks, help="List the checks and exit."
)
def command(
    path: Path | str,
    no_render: bool,
    out: Path | None,
    bags: tuple[Path | str, ...],
    against: Path | str | None,
    **options: Any,
) -> None:  # fmt: skip
    r"""Find faults that spoil training data, in bags or in a dataset of any format, RoboXim's or another's.

    \b
    roboxim dataset audit runs/demos
    roboxim dataset audit runs/demos-rlds --bags runs/demos

    PATH, --bags and --against may be URLs. Checks that need ground truth need bags. With --out the report is
    OUT/report.html, with audit.json beside it; without, nothing is written. The exit code is 1
    when a fault was found or an episode cannot be read.
    """
    from roboxim_cli.printer import EventPrinter
    from roboxim_datasets.audit.report import summary_line
    from roboxim_runs.datasets.audit import AuditConfig, audit_dataset
    from roboxim_runs.storage.store import local_sources

    with EventPrinter() as printer, local_sources([path, *bags, *([against] if against else [])]) as (local, *others):
        config = AuditConfig(render=not no_render, bags=tuple(others[: len(bags)]), **options)
        if against:
            config = replace(config, against=others[-1])
        audited = audit_dataset(local, out, config, on_event=printer)
    _print_checks(audited.result)
    click.echo(summary_line(audited.result) + (f": {audited.page}" if audited.page else ""))
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
