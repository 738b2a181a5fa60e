"""Folders of this user outside a project: active runs, the cache, the logs of ROS.

A container often has a user without a home, or with one that cannot be written (``docker --user``, a read-only file
system, ``HOME`` not set, no entry in the password database). RoboXim then uses the temporary folder.
"""

from __future__ import annotations

import contextlib
import getpass
import os
import stat
import tempfile
from pathlib import Path

from roboxim_core.errors import ConfigError


def runtime_dir() -> Path:
    """Return this user's directory of runs, made if missing: ``$XDG_RUNTIME_DIR/roboxim`` or in the temporary folder.

    Raises:
        ConfigError: When it belongs to another user or is not a directory, or no temporary folder can be written.
    """
    base = os.environ.get("XDG_RUNTIME_DIR")
    usable = base and os.path.isdir(base) and os.access(base, os.W_OK)
    path = Path(base or "", "roboxim") if usable else Path(_temporary(), f"roboxim-{os.getuid()}")
    try:
        path.mkdir(mode=0o700, exist_ok=True)
        status = path.lstat()
    except OSError as error:
        raise ConfigError(
            f"cannot make {path}: {error.strerror}; set XDG_RUNTIME_DIR or TMPDIR to a folder that can be written"
        ) from None
    if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
        raise ConfigError(f"{path} is not a directory of this user; remove it or set XDG_RUNTIME_DIR to another place")
    path.chmod(0o700)
    return path


def cache_dir() -> Path:
    """Return RoboXim's folder in the user's cache, or in `runtime_dir` when the user has no home that can be written.

    Raises:
        ConfigError: As `runtime_dir`.
    """
    given = os.environ.get("XDG_CACHE_HOME")
    if given:
        return Path(given) / "roboxim"
    home = home_dir()
    if home is not None and can_write(home / ".cache" / "roboxim"):
        return home / ".cache" / "roboxim"
    return runtime_dir() / "cache"


def home_dir() -> Path | None:
    """Return the user's home; none: ``HOME`` is not set, and the password database does not have the user."""
    try:
        return Path.home()
    except (RuntimeError, KeyError):
        return None


def expanded(path: Path | str) -> Path:
    """Return a path with ``~`` replaced by the user's home.

    Raises:
        ConfigError: When the home is not known.
    """
    try:
        return Path(path).expanduser()
    except RuntimeError:
        raise ConfigError(f"{path}: the home (~) is not known; set HOME, or give the whole path") from None


def user_name() -> str:
    """Return the user's name, or the number of a user that the password database does not have."""
    try:
        return getpass.getuser()
    except (KeyError, OSError):
        return str(os.getuid())


def can_write(folder: Path) -> bool:
    """Return whether this user can write into a folder, or can make it. Nothing is made."""
    with contextlib.suppress(OSError):
        for place in (folder, *folder.parents):
            if place.exists() or place.is_symlink():
                return place.is_dir() and os.access(place, os.W_OK | os.X_OK)
    return False


def _temporary() -> str:
    try:
        return tempfile.gettempdir()
    except FileNotFoundError:
        raise ConfigError(
            "no folder for temporary files can be written; set TMPDIR to one that can (in Docker: --tmpfs /tmp)"
        ) from None
