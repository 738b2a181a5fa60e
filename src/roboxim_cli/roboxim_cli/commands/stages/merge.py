"""Join the shards of a run that several machines ran."""

from __future__ import annotations

from pathlib import Path

import click

from roboxim_cli import strict
from roboxim_cli.options import option
from roboxim_core.errors import counted


@strict.command(begins="merging")
@click.argument("shards", type=click.Path(path_type=Path), nargs=-1, required=True, metavar="SHARD...")
@option("out", required=True, help="Folder of the whole run.")
@click.option("--partial", is_flag=True, help="Merge although episodes are missing; the run's command adds them.")
def command(out: Path, shards: tuple[Path, ...], partial: bool) -> None:
    r"""Join the folders of a run's shards into OUT, as if one command had run all episodes.

    \b
    roboxim generate --episodes 900 --out runs/demos-1 --shard 1/3     # on three machines: 1/3, 2/3, 3/3
    roboxim merge runs/demos-1 runs/demos-2 runs/demos-3 --out runs/demos

    Folders of another configuration are refused, and so are missing episodes and different recordings of one episode.
    An episode that several folders have is taken once. OUT gets everything or stays as it was; the shards stay too.
    Folders of evaluations are merged policy by policy, and the reports written anew.
    """
    from roboxim_cli.printer import EventPrinter
    from roboxim_runs.storage.merging import merge_shards

    with EventPrinter() as printer:
        merged = merge_shards(out, shards, partial=partial, on_event=printer)
    for run in merged:
        notes = [f"from {counted(run.shards, 'folder')}"]
        if run.doubles:
            notes.append(f"{run.doubles} found in several")
        if run.missing:
            notes.append(f"{len(run.missing)} missing")
        click.echo(f"{out / run.name}: {counted(run.episodes, 'episode')} ({', '.join(notes)})")
