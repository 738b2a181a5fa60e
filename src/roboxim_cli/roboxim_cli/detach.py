"""Commands that keep running: ``roboxim up --detach`` in a new session, and servers until they are told to stop."""

from __future__ import annotations

import os
import secrets
import signal
import subprocess
import sys
import threading
import time

import click

from roboxim_bringup.process import describe_exit
from roboxim_core.errors import ConfigError, RoboximError, UnavailableError

READY_S = 300.0


def start_detached(run_id: str | None) -> None:
    """Start this process's command without ``--detach`` and return when its graph is up.

    Args:
        run_id: Name of the run; none: a new one.

    Raises:
        ConfigError: When a run of this name is alive.
        RoboximError: When the graph could not start, with the end of its log.
    """
    from roboxim_core.user_folders import runtime_dir
    from roboxim_ros.runs import live_runs

    if any(run.id == run_id for run in live_runs()):  # it writes into the log
        raise ConfigError(f"a run named '{run_id}' is alive already; choose another --id, or end it with roboxim down")
    name = run_id or f"up-{secrets.token_hex(2)}"
    arguments = [word for word in sys.argv[1:] if word != "--detach"]
    if run_id is None:
        arguments += ["--id", name]
    log = runtime_dir() / f"{name}.log"
    with open(log, "wb") as output:
        process = subprocess.Popen(
            [sys.executable, "-m", "roboxim_cli", *arguments],
            env={**os.environ, "PYTHONUNBUFFERED": "1"},
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
            start_new_session=True,
        )
    deadline = time.monotonic() + READY_S
    try:
        while f"run {name} is up" not in log.read_text():
            if process.poll() is not None:
                tail = "\n".join(log.read_text().splitlines()[-20:])
                raise RoboximError(f"the graph could not start ({describe_exit(process.returncode)}):\n{tail}")
            if time.monotonic() > deadline:
                raise UnavailableError(f"the graph is not up after {READY_S:g} s; see {log}")
            time.sleep(0.05)
    except BaseException:
        process.terminate()
        raise
    click.echo(f"run {name} is up; its log: {log}\nend it with: roboxim down --run {name}")


def stop_event() -> threading.Event:
    """Return an event that Ctrl-C and SIGTERM set from now on, instead of ending the process."""
    stop = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop.set())
    return stop
