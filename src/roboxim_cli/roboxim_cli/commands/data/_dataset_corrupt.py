"""Plant a fault in a copy of bags or of a dataset."""

from __future__ import annotations

from pathlib import Path

import click

from roboxim_cli import strict
from roboxim_cli.options import option

PATH = click.Path(path_type=Path)


def _list_faults(context: click.Context, _: click.Parameter, value: bool) -> None:
    """Print the faults and end."""
    if not value or context.resilient_parsing:
        return
    from roboxim_runs.datasets.corruption import fault_kinds

    for kind in fault_kinds().values():
        where = " and ".join(["bags"] * kind.bags + ["datasets"] * kind.datasets)
        click.echo(f"{kind.name}: {kind.title} ({where}; found by {kind.found_by})")
    context.exit()


@strict.command("corrupt", begins="planting faults")
@click.argument("source", type=PATH)
@option("out", required=True, help="Folder of the copy.")
@click.option("--fault", required=True, metavar="NAME", help="Fault to plant; --list lists them.")
@click.option(
    "--share", type=click.FloatRange(0, 1, min_open=True), default=0.1, show_default=True, help="Share of the episodes."
)
@option("seed", help="Seed of the choice of episodes and of the plants.")
@click.option(
    "--list", is_flag=True, is_eager=True, expose_value=False, callback=_list_faults, help="List the faults and exit."
)
def command(source: Path, out: Path, fault: str, share: float, seed: int) -> None:
    r"""Copy bags or a dataset and plant a fault in some of the episodes. The source stays as it is.

    \b
    roboxim dataset corrupt runs/demos --out runs/demos-late --fault continues_after_done --share 0.1

    OUT-planted.json lists what was planted and the check that must find it.
    """
    from roboxim_cli.printer import EventPrinter
    from roboxim_runs.datasets.corruption import corrupt

    with EventPrinter() as printer:
        made = corrupt(source, out, fault, share, seed=seed, on_event=printer)
    for name, text in list(made.planted.items())[:5]:
        click.echo(f"{name}: {text}")
    if len(made.planted) > 5:
        click.echo(f"and {len(made.planted) - 5} more")
    if made.refused:
        one = len(made.refused) == 1
        click.echo(f"{len(made.refused)} {'episode does' if one else 'episodes do'} not allow this fault")
    click.echo(f"{made.path}: {len(made.planted)} planted; {made.listing} lists them")
