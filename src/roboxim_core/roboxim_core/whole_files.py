"""Files that are written completely or not at all."""

from __future__ import annotations

import errno
import json
import os
import secrets
from pathlib import Path
from typing import Any


def write_whole(path: Path, content: str | bytes) -> None:
    """Write a file under a temporary name beside its place and rename it, so that a full disk leaves no half file.

    Its folder is made if it is missing.

    Raises:
        OSError: When it cannot be written; nothing is left then.
    """
    if path.is_dir():
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")  # several processes may write one file
    try:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


def write_json(path: Path, value: Any, *, sort_keys: bool = False) -> None:
    """Write plain data as JSON for people to read, as `write_whole` does."""
    write_whole(path, json.dumps(value, indent=2, sort_keys=sort_keys) + "\n")
