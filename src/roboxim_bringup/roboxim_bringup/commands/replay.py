"""Execute a recorded episode again and name the first tick that differs."""

from __future__ import annotations

import os
from pathlib import Path

import click

from roboxim_bringup.attach import attach_options, join_run


@click.command()
@click.argument("bags", type=click.Path(exists=True, path_type=Path), nargs=-1, required=True)
@click.option("--namespace", default="", help="Namespace of the graph, e.g. /w0.")
@attach_options
def command(bags: tuple[Path, ...], namespace: str, run_id: str | None, domain: int | None) -> None:
    """Re-create a bag's scene in a running graph, execute its actions, and compare every tick.

    Judges the replay too. The exit code is 1 when a tick differs; the first one is named.
    """
    join_run(run_id, domain)
    from roboxim_core.errors import ErrorCode, SimError
    from roboxim_eval.ports import SimClient, TaskClient
    from roboxim_recorder.bag import BagReader
    from roboxim_recorder.check import list_bags
    from roboxim_recorder.replay import replay
    from roboxim_ros.clients import Clients
    from roboxim_ros.host import NodeHost

    paths = [bag for given in bags for bag in ([given] if given.is_file() else list_bags(given))]
    diverged = 0
    name = f"_replay_{os.getpid()}"
    with NodeHost() as host, Clients(name, context=host.context, namespace=namespace) as clients:
        sim, tasks = SimClient(clients), TaskClient(clients)
        for path in paths:
            reader = BagReader(path)
            verdicts = []

            def judge(state, reader=reader, verdicts=verdicts) -> None:  # type: ignore[no-untyped-def]
                first = not verdicts
                verdicts.append(tasks.start(state.episode_id, reader.info.task, state) if first else tasks.judge(state))

            with click.progressbar(length=len(reader), label=reader.info.episode_id, file=_stderr()) as bar:

                def on_tick(state, judge=judge, bar=bar) -> None:  # type: ignore[no-untyped-def]
                    judge(state)
                    bar.update(1)

                report = replay(reader, sim, on_tick=on_tick)
            outcome = "success" if verdicts[-1].success else f"no success ({verdicts[-1].reason or 'unfinished'})"
            if report.same:
                click.echo(f"{path}: {report.ticks} of {report.ticks} ticks are the same, bit for bit; {outcome}")
            else:
                diverged += 1
                click.echo(
                    f"{path}: diverges at tick {report.diverged_at}: {report.difference} "
                    f"(recorded {report.recorded_hash}, replayed {report.replayed_hash})"
                )
    if diverged:
        raise SimError(f"{diverged} of {len(paths)} episodes diverged from their recording", ErrorCode.DIVERGED)


def _stderr():  # type: ignore[no-untyped-def]
    import sys

    return sys.stderr
