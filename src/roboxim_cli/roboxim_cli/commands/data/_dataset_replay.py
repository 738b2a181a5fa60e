"""``roboxim dataset replay``: execute the actions of a dataset again."""

from __future__ import annotations

import sys
from pathlib import Path

import click

from roboxim_cli import strict
from roboxim_cli.options import option
from roboxim_core.whole_files import write_whole


@strict.command("replay", old={"--json": "--out"})
@click.argument("dataset", type=click.Path(exists=True, path_type=Path))
@click.argument("bags", type=click.Path(exists=True, path_type=Path), nargs=-1)
@click.option("--episodes", type=click.IntRange(0), default=0, help="Replay so many, spread evenly; default: all.")
@click.option("--labels/--no-labels", default=True, show_default=True, help="Also execute the labels alone.")
@click.option("--workers", type=click.IntRange(1), default=1, show_default=True, help="Processes.")
@click.option("--format", "kind", default="", help="Format of the dataset; default: found from its files.")
@option("out", help="JSON file to write every episode and tick to.")
def command(
    dataset: Path, bags: tuple[Path, ...], episodes: int, labels: bool, workers: int, kind: str, out: Path | None
) -> None:
    """Execute the actions of a dataset in the simulator, and report what of its successes remains.

    Each episode starts from the scene of its bag. BAGS are the runs or bags that the dataset was exported from; by
    default the runs beside the dataset and beside the folders above it are searched.

    The executed actions must retain all successes if they are end-effector actions at the recorded rate, otherwise
    95 %. The labels must do so for the episodes without noise. The exit code is 1 if they do not.
    """
    from roboxim_cli.printer import EventPrinter
    from roboxim_runs.datasets.replay_gate import replay_dataset

    with EventPrinter() as printer:
        report = replay_dataset(
            dataset, bags, format=kind, episodes=episodes, labels=labels, workers=workers, on_event=printer
        )
    for line in report.lines:
        click.echo(line)
    if out is not None:
        write_whole(out, report.to_json())
    if report.refusal:
        sys.exit(1)
