"""Runs: each has a ROS domain, access control, and an entry in a registry in which other terminals find it.

This module uses only the environment and files and does not import `rclpy`. Call it before a context is initialised.

Non-obvious:
- By default, Fast DDS opens every network interface. ``ROS_LOCALHOST_ONLY`` still admits a host that names this one as
  a static peer, and every user of this machine. ``transport/user.xml`` has no sockets at all: file permissions decide
  who has access (`roboxim_ros.shared_memory`).
- A domain is free when no process has reserved it (`domain_coordinator`'s convention) *and* no process listens at one
  of its ports, UDP or shared memory: leftovers of a killed process would answer new clients with old types.
"""

from __future__ import annotations

import dataclasses
import fcntl
import json
import os
import re
import secrets
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import domain_coordinator

from roboxim_core.errors import ConfigError, UnavailableError
from roboxim_core.user_folders import runtime_dir as runtime_dir
from roboxim_core.whole_files import write_whole
from roboxim_ros.environment import clean_environment
from roboxim_ros.shared_memory import busy_domains

LONGEST_RUN_ID = 100
"""Largest number of characters of a run's name, which is also a file's name."""
LARGEST_DOMAIN = 100
"""Largest domain used. Ports of higher domains reach into the ephemeral range, where any connection may take them."""
JOINABLE = ("up", "node", "policy", "play")
"""Kinds of runs that commands and new nodes join by default; jobs such as ``generate`` start their own nodes."""
_TRANSPORTS = ("user", "network")


def transport_environment(open_network: bool = False) -> dict[str, str]:
    """Return the environment variables that set who can reach a graph.

    Args:
        open_network: Admit every host that reaches this one; false: this user on this machine only.
    """
    transport = "network" if open_network else "user"
    profile = str(Path(__file__).parent / "transport" / f"{transport}.xml")
    return {
        "ROBOXIM_TRANSPORT": transport,
        "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp",
        "FASTRTPS_DEFAULT_PROFILES_FILE": profile,
        "FASTDDS_DEFAULT_PROFILES_FILE": profile,
        # Any other range makes the middleware replace the profile's transports by its own.
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET",
        "ROS_STATIC_PEERS": "",
    }


def activate_transport(open_network: bool | None = None) -> None:
    """Set the environment of this process and its children; call before a context is initialised.

    Args:
        open_network: As for `transport_environment`; none: as set in the environment, else this user only.

    Raises:
        ConfigError: When ``ROBOXIM_TRANSPORT`` is neither ``user`` nor ``network``, or the environment is of another
            ROS; see `roboxim_ros.environment`.
    """
    if open_network is None:
        given = os.environ.get("ROBOXIM_TRANSPORT", "user")
        if given not in _TRANSPORTS:
            raise ConfigError(f"ROBOXIM_TRANSPORT is '{given}'; expected one of {', '.join(_TRANSPORTS)}")
        open_network = given == "network"
    _apply(transport_environment(open_network))


def _apply(environment: dict[str, str]) -> None:
    clean_environment()
    os.environ.update(environment)
    os.environ.pop("ROS_LOCALHOST_ONLY", None)  # deprecated, and would override the range


def _udp_ports_in_use() -> set[int]:
    ports = set()
    for table in ("/proc/net/udp", "/proc/net/udp6"):
        with suppress(OSError):
            for line in Path(table).read_text().splitlines()[1:]:
                ports.add(int(line.split()[1].rpartition(":")[2], 16))
    return ports


@contextmanager
def free_domain() -> Iterator[int]:
    """Reserve a ROS domain that is unused on this machine while the block runs.

    Raises:
        UnavailableError: When none of the domains is free.
    """
    busy = {(port - 7400) // 250 for port in _udp_ports_in_use()}  # DDS: ports 7400 + 250 * domain and up
    busy |= busy_domains()
    start = os.getpid()  # so that processes started together try different domains
    candidates = [1 + (start + i) % LARGEST_DOMAIN for i in range(LARGEST_DOMAIN)]
    free = [domain for domain in candidates if domain not in busy]
    # It always tries 100 times, for any range of the selector.
    reservation = domain_coordinator.domain_id(iter(free * (LARGEST_DOMAIN // max(1, len(free)) + 1)).__next__)
    try:
        domain = reservation.__enter__()
    except (RuntimeError, StopIteration):
        raise UnavailableError(
            f"all ROS domains from 1 to {LARGEST_DOMAIN} are in use on this machine; end some ROS processes"
        ) from None
    try:
        yield domain
    finally:  # without the block's exception, which the reservation would treat as its own failed attempt
        reservation.__exit__(None, None, None)


def _start_time(pid: int) -> int | None:
    """Return a process's start in clock ticks since boot, to distinguish it from a later process of the same id."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return None if fields[0] in "ZX" else int(fields[19])


@dataclass(frozen=True, kw_only=True)
class Run:
    """A running graph on this machine."""

    id: str
    """Short unique name, e.g. ``up-1f3a``."""
    domain: int
    """ROS domain of the run's graph."""
    transport: str
    """``user``: this user on this machine only; ``network``: every interface."""
    kind: str
    """Command that started it: up, generate, evaluate, ..."""
    namespaces: tuple[str, ...]
    """Namespaces of its graphs; the empty one is the root."""
    started: str
    """Time of the start, ISO 8601, UTC."""
    pids: tuple[int, ...]
    """Process ids; the first process started the run."""
    births: tuple[int, ...]
    """Start of each process in clock ticks since boot, to detect reused process ids."""
    nodes: tuple[str, ...] = ()
    """Full names of the run's known nodes, so that discovery knows when it is complete."""
    folder: str = ""
    """Absolute path of the folder that its episodes are recorded in; empty: none."""

    @property
    def live_pids(self) -> tuple[int, ...]:
        """Ids of the run's live processes."""
        return _live_pids(self.pids, self.births)

    @property
    def environment(self) -> dict[str, str]:
        """Environment variables for a process that joins the run."""
        return {
            **transport_environment(self.transport == "network"),
            "ROS_DOMAIN_ID": str(self.domain),
            "ROBOXIM_RUN": self.id,
        }

    def join(self) -> None:
        """Join the run with this process; call before a context is initialised."""
        _apply(self.environment)


def _file(run_id: str) -> Path:
    return runtime_dir() / f"{run_id}.json"


@contextmanager
def _lock() -> Iterator[None]:
    with open(runtime_dir() / ".lock", "w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _write(run: Run) -> None:
    write_whole(_file(run.id), json.dumps(dataclasses.asdict(run)))


def _read(path: Path) -> Run | None:
    return _run(_content(path))


def _content(path: Path) -> dict[str, Any]:
    """Return what a file of the registry says; nothing, if it is removed or damaged."""
    try:
        data = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    whole = isinstance(data, dict) and all(isinstance(data.get(key), list) for key in ("pids", "births"))
    return data if whole else {}


def _run(data: dict[str, Any]) -> Run | None:
    """Return a run, without fields of later versions; none if an earlier version lacks one."""
    fields = {field.name for field in dataclasses.fields(Run)}
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in data.items() if k in fields}
    try:
        return Run(**values)
    except TypeError:
        return None


def _live_pids(pids: Iterable[int], births: Iterable[int]) -> tuple[int, ...]:
    return tuple(pid for pid, start in zip(pids, births, strict=False) if _start_time(pid) == start)


def check_run_id(run_id: str | None) -> None:
    """Check a run's name, which is also a file's name.

    Raises:
        ConfigError: When it has characters other than letters, digits, dots, hyphens and underscores, or too many.
    """
    if run_id is not None and len(run_id) > LONGEST_RUN_ID:
        raise ConfigError(f"a run's name has at most {LONGEST_RUN_ID} characters, '{run_id[:40]}...' has {len(run_id)}")
    if run_id is not None and not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", run_id):
        raise ConfigError(f"a run's name has letters, digits, '.', '-' and '_' only, e.g. bench-2; got '{run_id}'")


def _require_apart(run: Run, other: Run) -> None:
    shared = set(run.namespaces) & set(other.namespaces)
    if other.domain == run.domain and shared:
        raise ConfigError(
            f"run '{other.id}' is alive in domain {run.domain} with namespace '{min(shared) or '/'}': two graphs would "
            f"share all names; choose another domain or namespace, or end it (roboxim down --run {other.id})"
        )


@contextmanager
def register_run(
    kind: str,
    *,
    domain: int,
    namespaces: Sequence[str] = ("",),
    run_id: str | None = None,
    folder: Path | str = "",
) -> Iterator[Run]:
    """Register this process's graph for other terminals while the block runs.

    Args:
        kind: Command that starts it: ``up``, ``generate``, ...
        domain: ROS domain.
        namespaces: Namespaces of its graphs, e.g. ``/w0``; empty or ``/``: the root.
        run_id: Name of the run; none: a new name.
        folder: Folder that its episodes are recorded in; empty: none.

    Raises:
        ConfigError: When a live run has the name, or one of the namespaces in the same domain, or the name is not
            valid.
    """
    check_run_id(run_id)
    run = Run(
        id=run_id or f"{kind}-{secrets.token_hex(2)}",
        domain=domain,
        transport=os.environ.get("ROBOXIM_TRANSPORT", "user"),
        kind=kind,
        namespaces=tuple(namespace.rstrip("/") for namespace in namespaces),
        started=datetime.now(UTC).isoformat(timespec="seconds"),
        pids=(os.getpid(),),
        births=(_start_time(os.getpid()) or 0,),
        folder=str(Path(folder).absolute()) if str(folder) else "",
    )
    with _lock():
        others = _live()
        if _file(run.id).exists():
            raise ConfigError(f"a run named '{run.id}' is alive already; choose another name or end it (roboxim down)")
        for other in others:
            _require_apart(run, other)
        _write(run)
    try:
        yield run
    finally:
        leave_run(run.id, os.getpid())


def extend_run(run_id: str, *, pids: Sequence[int] = (), nodes: Sequence[str] = ()) -> None:
    """Add processes and nodes to a run, and drop dead processes."""
    with _lock():
        run = _read(_file(run_id))
        if run is not None:
            run = dataclasses.replace(run, nodes=tuple(dict.fromkeys((*run.nodes, *nodes))))
            _write(_with_pids(run, [*run.live_pids, *pids]))


def leave_run(run_id: str, pid: int, *, nodes: Sequence[str] = ()) -> None:
    """Remove a process and its nodes. The run is removed with its last process."""
    with _lock():
        run = _read(_file(run_id))
        if run is None:
            return
        run = dataclasses.replace(run, nodes=tuple(node for node in run.nodes if node not in nodes))
        left = [other for other in run.live_pids if other != pid]
        if left:
            _write(_with_pids(run, left))
        else:
            _file(run_id).unlink(missing_ok=True)


def _with_pids(run: Run, pids: Sequence[int]) -> Run:
    known = {pid: start for pid in dict.fromkeys(pids) if (start := _start_time(pid)) is not None}
    return dataclasses.replace(run, pids=tuple(known), births=tuple(known.values()))


def live_runs() -> list[Run]:
    """Return the live runs, oldest first, and remove dead ones from the registry; those of other versions too."""
    with _lock():
        return _live()


def _live() -> list[Run]:
    found = []
    for path in runtime_dir().glob("*.json"):
        data = _content(path)
        if not _live_pids(data.get("pids", ()), data.get("births", ())):
            path.unlink(missing_ok=True)
        elif (run := _run(data)) is not None:
            found.append(run)
    return sorted(found, key=lambda run: (run.started, run.id))


def find_run(run_id: str | None = None) -> Run:
    """Return a live run.

    Args:
        run_id: Name of the run; none: ``$ROBOXIM_RUN``, else the only live run, else the only one of a kind in
            ``JOINABLE``.

    Raises:
        ConfigError: When the run is unknown, no run is live, or several are live without a choice.
    """
    runs = live_runs()
    listing = "".join(f"\n  {run.id}  (domain {run.domain}, started {run.started})" for run in runs)
    wanted = run_id or os.environ.get("ROBOXIM_RUN")
    if wanted:
        for run in runs:
            if run.id == wanted:
                return run
        raise ConfigError(f"no live run '{wanted}'; live runs:{listing or ' none'}")
    if not runs:
        raise ConfigError("no run is alive on this machine; start one with: roboxim up")
    graphs = [run for run in runs if run.kind in JOINABLE] if len(runs) > 1 else runs
    if len(graphs) != 1:
        raise ConfigError(f"several runs are alive; choose one with --run ID:{listing}")
    return graphs[0]
