"""Servers of an experiment's checkpoints, for policies that run in their own environment.

A trainer's ``serve`` command runs while a checkpoint is evaluated. If something answers at its address before it
starts, the evaluation is refused, since it would measure another model.
"""

from __future__ import annotations

import contextlib
import ipaddress
import os
import shlex
import signal
import socket
import subprocess
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from roboxim_bringup.process import describe_exit
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_runs.events import OnEvent, Reporter
from roboxim_runs.executors import Cancellation, Executor
from roboxim_runs.training.commands import last_lines, started

START_S = 900.0
"""Longest time until a server answers: large models are loaded, and compiled [s]."""
POLL_S = 0.2
"""Period at which a starting server is polled [s]."""
END_S = 20.0
"""Time for a server to end by itself [s]."""
CONNECT_S = 2.0
"""Longest time of a connection attempt [s]."""


@dataclass(frozen=True, kw_only=True)
class Server:
    """A server of a checkpoint."""

    words: tuple[str, ...]
    """Its command."""
    url: str
    """Where it answers, e.g. ``ws://127.0.0.1:8000``."""

    @property
    def address(self) -> tuple[str, int]:
        """Host and port.

        Raises:
            ConfigError: When the URL has none.
        """
        try:
            parts = urlsplit(self.url)
            host, port = parts.hostname, parts.port
        except ValueError:
            host, port = None, None
        if not host or not port:
            raise ConfigError(f"options.url: expected an address with a port, e.g. ws://127.0.0.1:8000; got {self.url}")
        return host, port


@contextlib.contextmanager
def serving(
    server: Server | None, folder: Path, *, on_event: OnEvent, cancellation: Cancellation | None = None
) -> Iterator[None]:
    """Serve a checkpoint.

    Args:
        server: The server; none: there is nothing to serve.
        folder: Folder of the evaluation; the server's output is in ``<folder>.server.log``.
        on_event: Receives a notice when the server answers.
        cancellation: Ends the wait when it is set.

    Raises:
        CancelledError: When the run was cancelled before the server answered.
        ConfigError: When the command cannot be started.
        RoboximError: When something answers there already, or the server does not start.
    """
    if server is None:
        yield
        return
    if _answers(server):
        raise RoboximError(
            f"something answers at {server.url} already, so the evaluation in {folder} would measure another model; "
            "end it, or change the port in the trainer's serve and options.url"
        )
    log = folder.with_name(f"{folder.name}.server.log")
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("a") as output:
        process = started(server.words, output)
    reporter = Reporter(on_event, cancellation)
    try:
        _wait(server, process, log, reporter)
        reporter.notice(f"serving {folder.name} at {server.url}")
        yield
    finally:
        _end(process)


def require_reachable(servers: Iterable[Server | None], executor: Executor | None) -> None:
    """Refuse servers that workers on other machines would look for on their own.

    Args:
        servers: The servers; none: there is nothing to serve.
        executor: Where the workers run; none: on this machine.

    Raises:
        ConfigError: When workers may run elsewhere, and a server's address means the machine that asks.
    """
    if not getattr(executor, "elsewhere", False):
        return
    for server in servers:
        if server is not None and _means_the_asker(server.address[0]):
            raise ConfigError(
                f"options.url: workers on other machines of the cluster cannot reach {server.url}, which means their "
                "own machine; write this machine's address in the cluster's network, and let the trainer's serve "
                "listen there"
            )


def _means_the_asker(host: str) -> bool:
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return host == "localhost" or host.endswith(".localhost")
    address = getattr(address, "ipv4_mapped", None) or address
    return address.is_loopback or address.is_unspecified


def _answers(server: Server) -> bool:
    try:
        with socket.create_connection(server.address, CONNECT_S):
            return True
    except OSError:
        return False


def _wait(server: Server, process: subprocess.Popen[bytes], log: Path, reporter: Reporter) -> None:
    """Wait until a server answers.

    Raises:
        CancelledError: When the run was cancelled.
        RoboximError: When it has ended, or does not answer in time; the message has the end of its log.
    """
    deadline = time.monotonic() + START_S
    while not _answers(server):
        reporter.require_wanted()
        ended = process.poll()
        if ended is not None or time.monotonic() > deadline:
            what = f"ended with {describe_exit(ended)}" if ended is not None else f"did not answer in {START_S:.0f} s"
            raise RoboximError(
                f"the server {shlex.join(server.words)} {what} at {server.url}; the end of {log}:\n{last_lines(log)}"
            )
        time.sleep(POLL_S)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a server and the processes that it started, and wait until all are gone."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        deadline = time.monotonic() + END_S
        with contextlib.suppress(ProcessLookupError):  # no process of the group is left
            os.killpg(process.pid, number)
            while time.monotonic() < deadline:
                process.poll()  # a leader that has ended would stay in its group
                os.killpg(process.pid, 0)
                time.sleep(POLL_S)
            continue
        return


def server_of(command: str, url: str, **values: str) -> Server:
    """Return the server of a checkpoint.

    Args:
        command: The trainer's ``serve``.
        url: Where it answers.
        **values: Values of the command's placeholders.

    Raises:
        ConfigError: When the URL has no host and port, or a quote in the command does not end.
    """
    try:
        words: Sequence[str] = shlex.split(command)
    except ValueError as error:
        raise ConfigError(f"serve: {error} in '{command}'") from None
    server = Server(words=tuple(word.format(**values) for word in words), url=url)
    assert server.address
    return server
