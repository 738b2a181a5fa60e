"""Who can reach a graph over shared memory: only this user, by the permissions of Fast DDS's files in ``/dev/shm``.

A graph on the ``user`` transport talks through these files and nothing else: no socket. To find a participant, to send
to it or to take part in its domain, a process must open its ports for writing, which the kernel refuses to other users.

Non-obvious:
- Fast DDS creates the segments with mode 0644 whatever the umask is: other users could read what is sent. `seal` takes
  that away at once after a participant was made. Between the two lies a moment (milliseconds) in which a process of
  another user that waits for it can open a segment for reading; it can never write.
- Another user could make a domain's ports before us and let us talk through files that belong to them. `foreign_ports`
  tells, `roboxim_ros.runs.free_domain` avoids such a domain, and `seal` refuses it.
- The superuser can do everything, and so can whoever may act as this user.
"""

from __future__ import annotations

import fcntl
import os
import re
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from roboxim_core.errors import UnavailableError

FOLDER = Path("/dev/shm")
_FIRST_PORT, _PORTS_PER_DOMAIN = 7400, 250
_LOCKS = ("_el", "_sl")
"""Endings of the files that a participant locks while it listens at a port, alone or with others."""


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
    """Return the domains that a live process listens in, or that have files of another user."""
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


@contextmanager
def private_files() -> Iterator[None]:
    """Have the block make files that only this user can open, as far as whoever makes them respects the umask."""
    before = os.umask(0o077)
    try:
        yield
    finally:
        os.umask(before)


def seal(domain: int) -> None:
    """Close the files of this process's participants to other users; call after one was made.

    Args:
        domain: The ROS domain of the participants.

    Raises:
        UnavailableError: When a port of the domain belongs to another user, who could read and write what is sent.
    """
    if domain in foreign_ports():
        raise UnavailableError(
            f"the shared memory of ROS domain {domain} belongs to another user, who could read and send messages; "
            "choose another domain"
        )
    for name in _mapped():
        for path in (FOLDER / name, *(FOLDER / f"{name}{ending}" for ending in _LOCKS)):
            with suppress(FileNotFoundError):
                status = path.lstat()
                if status.st_uid == os.geteuid() and stat.S_ISREG(status.st_mode) and status.st_mode & 0o077:
                    path.chmod(0o600)


def _mapped() -> set[str]:
    """Return the names of Fast DDS's files that this process has in its memory."""
    maps = Path("/proc/self/maps").read_text()
    return set(re.findall(rf"{FOLDER}/((?:sem\.)?fastrtps_\w+)", maps))
