"""List runs: how far they are, how fast, and how they ended."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from roboxim_cli import strict
from roboxim_cli.options import print_json
from roboxim_core.plain_data.tables import aligned

if TYPE_CHECKING:
    from roboxim_ros.runs import Run
    from roboxim_runs.storage.state import RunState


@strict.command()
@click.argument("folders", type=click.Path(path_type=Path), nargs=-1, metavar="[FOLDER]...")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(folders: tuple[Path, ...], as_json: bool) -> None:
    r"""List the runs that are alive on this machine, or the runs in FOLDER and below, alive or not.

    \b
    roboxim runs
    roboxim runs runs/demos-shards

    Runs in a folder may be on any machine and any executor; the folder says how far they are. Each has a file
    events.jsonl with one JSON object a line, which grows during the run.
    """
    if folders:
        _list_folders(folders, as_json)
    else:
        _list_live(as_json)


def _list_live(as_json: bool) -> None:
    from roboxim_ros.runs import live_runs

    runs = live_runs()
    if as_json:
        print_json(runs)
        return
    if not runs:
        click.echo("no run is alive; start one with: roboxim up")
        return
    rows = [("RUN", "KIND", "DOMAIN", "NETWORK", "PROCESSES", "STARTED (UTC)", "NAMESPACES", "PROGRESS")]
    for run in runs:
        network = "this user" if run.transport == "user" else "open"
        names = " ".join(name or "/" for name in run.namespaces)
        started = run.started.removesuffix("+00:00")
        rows.append(
            (run.id, run.kind, str(run.domain), network, str(len(run.live_pids)), started, names, _progress(run))
        )
    click.echo("\n".join(aligned(rows)))


def _progress(run: Run) -> str:
    """Return how far a live run is, in words."""
    from roboxim_core.errors import ConfigError
    from roboxim_runs.storage.state import find_runs

    if not run.folder:
        return "-"
    try:
        found = find_runs([Path(run.folder)])
    except ConfigError:  # nothing is written yet
        return f"starting in {run.folder}"
    now = [state for state in found if state.state == "running"] or found
    return f"{', '.join(_count(state) + _pace(state) for state in now)} in {run.folder}"


def _count(state: RunState) -> str:
    return f"{state.done} of {state.total}" if state.total else str(state.done)


def _pace(state: RunState) -> str:
    from roboxim_runs.pace import duration_text, rate_text

    if state.per_second is None:
        return ""
    left = f", {duration_text(state.left_s)} left" if state.left_s is not None else ""
    return f" ({rate_text(state.per_second)}{left})"


def _list_folders(folders: Sequence[Path], as_json: bool) -> None:
    from roboxim_runs.pace import duration_text
    from roboxim_runs.storage.state import find_runs

    found = find_runs(folders)
    if as_json:
        print_json(found)
        return
    rows = [("FOLDER", "KIND", "SHARD", "STATE", "EPISODES", "EXECUTOR", "HOST", "LAST EVENT")]
    for state in found:
        quiet = "-" if state.quiet_s is None else f"{duration_text(max(0.0, state.quiet_s))} ago"
        rows.append(
            (
                state.folder, state.kind, state.shard or "-", state.state, _count(state) + _pace(state),
                state.executor or "-", state.host or "-", quiet,
            )
        )  # fmt: skip
    click.echo("\n".join(aligned(rows)))
    for state in found:
        if state.message:
            click.echo(f"{state.folder}: {state.message}")
