"""Execute a recorded episode again and name the first tick that differs."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import click

from roboxim_bringup.attach import attach_options, join_run
from roboxim_cli import strict
from roboxim_cli.options import ABSENT_IS_ZERO, option
from roboxim_core.whole_files import write_whole


@strict.command(begins="replaying")
@click.argument("sources", type=click.Path(exists=True, path_type=Path), nargs=-1, required=True)
@click.option("--namespace", default="", help="Namespace of the graph, e.g. /w0, for bags.")
@click.option(
    "--bags", type=click.Path(exists=True, path_type=Path), multiple=True,
    help="Runs or bags that a dataset was exported from; default: the runs beside it and above it. May be repeated.",
)  # fmt: skip
@option("episodes", **ABSENT_IS_ZERO, show_default="all", help="Episodes of a dataset, spread evenly.")
@click.option("--labels/--no-labels", default=True, show_default=True, help="Also execute a dataset's labels alone.")
@option("workers", default=1, help="Processes, for datasets.")
@click.option("--format", "kind", default="", help="Format of a dataset; default: found from its files.")
@option("out", help="JSON file to write every episode and tick of a dataset to.")
@attach_options
def command(sources: tuple[Path, ...], namespace: str, run_id: str | None, domain: int | None, **gate: Any) -> None:
    r"""Execute recorded actions again: bags in a running graph, tick by tick, or a dataset in the simulator.

    \b
    roboxim replay runs/demos/episodes/demo-0-00000-0    # needs a graph: roboxim up
    roboxim replay runs/demos-rlds --episodes 20         # needs none

    A bag must repeat bit for bit; the output names the first tick that differs. Of a dataset's successes, all must
    remain if its actions are end-effector actions at the recorded rate, otherwise 95 %; the labels must retain those of
    the episodes without noise. The exit code is 1 if not.
    """
    datasets = [source for source in sources if not _has_bags(source)]
    if datasets:
        for dataset in datasets:
            replay_dataset(dataset, **gate)
        sources = tuple(source for source in sources if source not in datasets)
        if not sources:
            return
    join_run(run_id, domain)
    from roboxim_core.errors import ErrorCode, SimError
    from roboxim_recorder.run_bags import list_bags
    from roboxim_ros.clients import Clients
    from roboxim_ros.host import NodeHost

    paths = [bag for given in sources for bag in ([given] if given.is_file() else list_bags(given))]
    name = f"_replay_{os.getpid()}"
    with NodeHost() as host, Clients(name, context=host.context, namespace=namespace) as clients:
        diverged = [path for path in paths if not _is_same(path, clients)]
    if diverged:
        raise SimError(f"{len(diverged)} of {len(paths)} episodes diverged from their recording", ErrorCode.DIVERGED)


def _has_bags(path: Path) -> bool:
    """Tell whether a path is a bag, a folder of bags or a run, or anything that is no dataset."""
    from roboxim_core.errors import ConfigError
    from roboxim_core.plain_data.results_log import RUN_FILE
    from roboxim_datasets.formats import open_dataset

    if path.suffix == ".mcap" or any(path.glob("*.mcap")) or (path / RUN_FILE).exists():
        return True
    try:
        open_dataset(path)
    except ConfigError:
        return True
    return False


def replay_dataset(
    dataset: Path, *, bags: tuple[Path, ...], episodes: int, labels: bool, workers: int, kind: str, out: Path | None
) -> None:
    """Execute the actions of a dataset, print what of its successes remains, and end with code 1 if too little.

    Args:
        dataset: The dataset.
        bags: Runs or bags that it was exported from; none: those beside it.
        episodes: Number of episodes; 0: all.
        labels: Whether to execute the labels alone, too.
        workers: Processes.
        kind: Its format; empty: found from its files.
        out: JSON file of every episode and tick.
    """
    from roboxim_cli.printer import EventPrinter
    from roboxim_runs.datasets.replay_gate import replay_dataset as execute

    with EventPrinter() as printer:
        report = execute(
            dataset, bags, format=kind, episodes=episodes, labels=labels, workers=workers, on_event=printer
        )
    for line in report.lines:
        click.echo(line)
    if out is not None:
        write_whole(out, report.to_json())
    if report.refusal:
        sys.exit(1)


def _is_same(path: Path, clients: Any) -> bool:
    """Replay one bag and print the outcome; return whether every bit is the same."""
    from roboxim_core.models.library import ModelLibrary
    from roboxim_core.verdicts import Verdict
    from roboxim_eval.ports import SimClient, TaskClient
    from roboxim_recorder.bag import BagReader
    from roboxim_recorder.replay import replay

    reader, tasks = BagReader(path), TaskClient(clients)
    verdict = Verdict()

    with click.progressbar(length=len(reader), label=reader.info.episode_id, file=sys.stderr) as bar:

        def judge(state: Any) -> None:
            nonlocal verdict
            starts = state.seq == 0
            verdict = tasks.start(state.episode_id, reader.info.task, state) if starts else tasks.judge(state)
            bar.update(1)

        report = replay(reader, SimClient(clients), on_tick=judge)
    if report.same:
        outcome = "success" if verdict.success else f"no success ({verdict.reason or 'unfinished'})"
        click.echo(f"{path}: {report.ticks} of {report.ticks} ticks are the same, bit for bit; {outcome}")
    else:
        click.echo(
            f"{path}: diverges at tick {report.diverged_at}: {report.difference} "
            f"(recorded {report.recorded_hash}, replayed {report.replayed_hash})"
        )
        if changed := ModelLibrary().changed(reader.info.models):
            click.echo(f"  changed since the recording: the files of {', '.join(changed)}")
    return report.same
