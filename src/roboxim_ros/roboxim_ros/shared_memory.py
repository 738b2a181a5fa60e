"""Access control over shared memory: only this user, by the permissions of Fast DDS's files in ``/dev/shm``.

A graph on the ``user`` transport communicates through these files only, without sockets. To discover a participant, to
send to it or to join its domain, a process must open its ports for writing, which the kernel refuses to other users.

Non-obvious:
- Fast DDS creates the segments with mode 0644 and ignores the umask: other users could read the messages. `seal`
  removes that permission right after a participant is made. For the milliseconds in between, a waiting process of
  another user can open a segment for reading; it can never write.
- Another user could create a domain's ports first, so that the graph would communicate through that user's files.
  `foreign_ports` detects this, `roboxim_ros.runs.free_domain` avoids such a domain, and `seal` refuses it.
- The superuser has full access, and so has every process that may act as this user.
"""

from __future__ import annotations

import fcntl
import os
import re
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from roboxim_core.errors import UnavailableError

FOLDER = Path("/dev/shm")
NEEDED_BYTES = 600 * 1024
"""Size of the files that Fast DDS makes for one process with nodes; it refuses less [bytes]."""
_FIRST_PORT, _PORTS_PER_DOMAIN = 7400, 250
_LOCKS = ("_el", "_sl")
"""Suffixes of the files that a participant locks while it listens at a port, alone or with others."""


def _domain_of(path: Path) -> int | None:
    port = re.fullmatch(r"fastrtps_port(\d+)(?:_el|_sl)?", path.name)
    return None if port is None else (int(port[1]) - _FIRST_PORT) // _PORTS_PER_DOMAIN


def _ports() -> Iterator[tuple[int, Path]]:
    """Yield the domain and the file of every port, locks included."""
    for path in FOLDER.glob("fastrtps_port*"):
        domain = _domain_of(path)
        if domain is not None:
            yield domain, path


def busy_domains() -> set[int]:
    """Return the domains in which a live process listens, or which have files of another user."""
    found = foreign_ports()
    for domain, path in _ports():
        if path.name.endswith(_LOCKS) and domain not in found and _locked(path):
            found.add(domain)
    return found


def foreign_ports() -> set[int]:
    """Return the domains with ports that belong to another user."""
    found = set()
    for domain, path in _ports():
        with suppress(FileNotFoundError):
            if path.lstat().st_uid != os.geteuid():
                found.add(domain)
    return found


def _locked(path: Path) -> bool:
    try:
        file = os.open(path, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    finally:
        os.close(file)
    return False


def fault_of_folder() -> str | None:
    """Return why this process cannot make its files in `FOLDER`, with the remedy; None: it can."""
    remedy = "RoboXim's nodes communicate only through it; in Docker: --shm-size=512m"
    if not FOLDER.is_dir() or not os.access(FOLDER, os.W_OK | os.X_OK):
        return f"the shared memory {FOLDER} cannot be written: {remedy}, without a read-only mount over it"
    usage = shutil.disk_usage(FOLDER)
    if usage.free < NEEDED_BYTES:
        return (
            f"the shared memory {FOLDER} has {usage.free // 1024} of {usage.total // 1024} KiB free, a process with "
            f"nodes needs {NEEDED_BYTES // 1024}: {remedy}; 'fastdds shm clean' removes files of dead processes"
        )
    return None


@contextmanager
def private_files() -> Iterator[None]:
    """Set a umask for the block, so that only this user can open its new files; Fast DDS partly ignores it."""
    before = os.umask(0o077)
    try:
        yield
    finally:
        os.umask(before)


def seal(domain: int) -> None:
    """Close the files of this process's participants to other users; call it after making a participant.

    Args:
        domain: The ROS domain of the participants.

    Raises:
        UnavailableError: When a port of the domain belongs to another user, who could read and send messages.
    """
    if domain in foreign_ports():
        raise UnavailableError(
            f"the shared memory of ROS domain {domain} belongs to another user, who could read and send messages; "
            "choose another domain"
        )
    if not any(_open_to_others(path) for path in FOLDER.glob("*fastrtps_*")):
        return  # the nodes of a context share a participant, whose files the first node has closed
    for name in _mapped():
        for path in (FOLDER / name, *(FOLDER / f"{name}{ending}" for ending in _LOCKS)):
            if _open_to_others(path):
                with suppress(FileNotFoundError):
                    path.chmod(0o600)


def _open_to_others(path: Path) -> bool:
    """Return whether a file of this user gives other users any permission."""
    try:
        status = path.lstat()
    except FileNotFoundError:
        return False
    return status.st_uid == os.geteuid() and stat.S_ISREG(status.st_mode) and bool(status.st_mode & 0o077)


def _mapped() -> set[str]:
    """Return the names of Fast DDS's files that this process has mapped; with many libraries it takes 5 ms."""
    maps = Path("/proc/self/maps").read_text()
    return set(re.findall(rf"{FOLDER}/((?:sem\.)?fastrtps_\w+)", maps))
