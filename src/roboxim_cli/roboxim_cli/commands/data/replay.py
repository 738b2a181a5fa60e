"""Execute a recorded episode again and name the first tick that differs."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import click

from roboxim_bringup.attach import attach_options, join_run
from roboxim_cli import strict


@strict.command()
@click.argument("bags", type=click.Path(exists=True, path_type=Path), nargs=-1, required=True)
@click.option("--namespace", default="", help="Namespace of the graph, e.g. /w0.")
@attach_options
def command(bags: tuple[Path, ...], namespace: str, run_id: str | None, domain: int | None) -> None:
    """Re-create a bag's scene in a running graph, execute its actions, and compare every tick.

    The command also judges the replay. The exit code is 1 when a tick differs; the output names the first such tick.
    """
    join_run(run_id, domain)
    from roboxim_core.errors import ErrorCode, SimError
    from roboxim_recorder.run_bags import list_bags
    from roboxim_ros.clients import Clients
    from roboxim_ros.host import NodeHost

    paths = [bag for given in bags for bag in ([given] if given.is_file() else list_bags(given))]
    name = f"_replay_{os.getpid()}"
    with NodeHost() as host, Clients(name, context=host.context, namespace=namespace) as clients:
        diverged = [path for path in paths if not _is_same(path, clients)]
    if diverged:
        raise SimError(f"{len(diverged)} of {len(paths)} episodes diverged from their recording", ErrorCode.DIVERGED)


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
