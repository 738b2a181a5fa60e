"""End a run."""

from __future__ import annotations

import contextlib
import os
import signal
import time

import click

from roboxim_bringup.attach import run_option
from roboxim_cli import strict

GRACE_S = 60.0


@strict.command()
@run_option
@click.option("--all", "every", is_flag=True, help="End all runs of this user, instead of one.")
def command(run_id: str | None, every: bool) -> None:
    """End a run. The command signals the run's first process, which ends the others."""
    from roboxim_core.errors import ConfigError
    from roboxim_ros.runs import find_run, live_runs

    if every and run_id is not None:
        raise ConfigError(f"--all ends every run, not '{run_id}' alone; leave out --all or --run")
    for run in live_runs() if every else [find_run(run_id)]:
        pids = run.live_pids
        if not pids:
            continue  # it has ended meanwhile, e.g. with the run before
        _signal(pids[0], signal.SIGTERM)
        deadline = time.monotonic() + GRACE_S
        while run.live_pids and time.monotonic() < deadline:
            if pids[0] not in run.live_pids:
                for pid in run.live_pids:
                    _signal(pid, signal.SIGTERM)
            time.sleep(0.1)
        for pid in run.live_pids:
            _signal(pid, signal.SIGKILL)
        click.echo(f"ended run {run.id}")


def _signal(pid: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):  # it has ended meanwhile
        os.kill(pid, number)
