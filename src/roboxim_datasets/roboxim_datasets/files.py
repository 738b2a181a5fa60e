"""The files of a dataset that is being read: nothing outside of its folder, and only regular files.

Paths in a dataset (templates, rows, links) come from whoever made it. `file_in` is the only way from such a path to a
file; `reading` turns any exception in a damaged file into one error that names the file.
"""

from __future__ import annotations

import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from roboxim_core.errors import ErrorCode, RecorderError, RoboximError, printable

_LFS = b"version https://git-lfs.github.com/spec/"
_MAX_LFS_BYTES = 1024  # a pointer is smaller [B]


def file_in(folder: Path, name: Path | str) -> Path:
    """Return a file of a dataset, with links resolved.

    Non-obvious: a hub's cache keeps a dataset as links to the files of the same repository (``snapshots/REVISION`` to
    ``blobs``), so there the repository's folder is the boundary.

    Args:
        folder: The dataset's folder.
        name: Path relative to it; an absolute one must lie in it.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when there is no such file, it lies outside of the folder, it is no
            regular file, or it is a pointer of Git LFS instead of the data.
    """
    root = _boundary(folder.resolve())
    path = folder / name
    try:
        place = path.resolve()
        if not place.is_relative_to(root):
            raise _bad(f"{path} lies outside of the dataset's folder {folder}; only its own files are read")
        about = place.stat()
        if not stat.S_ISREG(about.st_mode):
            raise _bad(f"{path} is no regular file; only regular files are read")
        if about.st_size < _MAX_LFS_BYTES and place.read_bytes().startswith(_LFS):
            raise _bad(f"{path} is a pointer of Git LFS, not the data; run 'git lfs pull' in its repository")
    except OSError as error:
        raise _bad(f"cannot read {printable(path)}: {error.strerror or error}") from None
    except ValueError as error:  # a zero byte in the name
        raise _bad(f"cannot read {printable(path)}: {error}") from None
    return place


def files_below(folder: Path, pattern: str) -> list[Path]:
    """Return the files of a dataset that match a pattern, in order of their names, each checked by `file_in`."""
    return [file_in(folder, file.relative_to(folder)) for file in sorted(folder.glob(pattern))]


def has_file(folder: Path, name: str) -> bool:
    """Return whether a dataset has an entry of a name, of any kind."""
    return (folder / name).is_symlink() or (folder / name).exists()


def _boundary(root: Path) -> Path:
    for place in (root, *root.parents):
        if place.parent.name == "snapshots" and (place.parent.parent / "blobs").is_dir():
            return place.parent.parent
    return root


def _bad(message: str) -> RecorderError:
    return RecorderError(message, ErrorCode.BAG_DAMAGED)


@contextmanager
def reading(where: object) -> Iterator[None]:
    """Name the part that was being read when a file does not follow its format.

    Args:
        where: File, episode, key, as the message names them.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` instead of any other exception.
    """
    try:
        yield
    except RoboximError:
        raise
    except Exception as error:  # the content of a file decides what a library raises
        what = error.args[0] if isinstance(error, KeyError) and error.args else error
        kind = "it has no" if isinstance(error, KeyError) else f"{type(error).__name__}:"
        raise _bad(f"{printable(where)} cannot be read: {kind} {printable(what, 300) or 'no details'}") from error
