"""Reads the description in a checkpoint without JAX, for callers that do not need the weights."""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.documents import parse_json
from roboxim_core.proprioception import STATE_NAMES
from roboxim_core.user_folders import expanded

FORMAT = 7
"""1: proprioception with a quaternion, 8 numbers; 2: with ``state_layout``, see `roboxim_core.proprioception`; 3: the
network with a memory of the grasp; 4: a grasp begins with the command to close; 5: the memory of a failed grasp; 6: the
identity of a training includes every label and picture; 7: a sample's place in an epoch follows from the sample."""
ACTING = (5, 6, FORMAT)
"""Formats whose policies act."""
UNREADABLE = (
    OSError, ValueError, KeyError, EOFError, RuntimeError, MemoryError, zipfile.BadZipFile, zlib.error,
)  # fmt: skip
"""Exceptions that reading a damaged ``.npz`` raises; RuntimeError: its bytes say that it is encrypted, or compressed in
another way."""


MAX_UNPACKED = 256 * 2**20
"""Largest size of the compressed arrays of a file once unpacked [B]; RoboXim stores weights uncompressed."""


def require_no_bomb(file: Path) -> None:
    """Refuse an archive of arrays of which a few bytes unpack to very many.

    Raises:
        ValueError: Naming the array.
        OSError: When the file cannot be read.
        zipfile.BadZipFile: When it is no archive.
    """
    with zipfile.ZipFile(file) as archive:
        for member in archive.infolist():
            if member.file_size > max(MAX_UNPACKED, member.compress_size):
                raise ValueError(
                    f"'{member.filename}' has {member.compress_size} bytes and unpacks to {member.file_size}; "
                    f"compressed arrays may have {MAX_UNPACKED}"
                )


def checkpoint_file(path: Path) -> Path:
    """Return the file of a checkpoint, given the file or the folder of its training.

    Raises:
        ConfigError: When the path begins with ``~`` and the home is not known.
    """
    path = expanded(path)
    return path / "checkpoint.npz" if path.is_dir() else path


def family_in(description: Mapping[str, Any]) -> str:
    """Return the family of the policy that a description is of."""
    return str(description.get("family", "bc"))


def read_description(path: Path) -> dict[str, Any]:
    """Return the description in a checkpoint, as written by `roboxim_policies.learning.checkpoint.save_checkpoint`.

    Args:
        path: The file, or the folder of a training.

    Raises:
        ConfigError: When it is missing, damaged or of another version.
    """
    file = checkpoint_file(path)
    if not file.is_file():
        raise ConfigError(f"no checkpoint at {file}; train one, e.g. with 'roboxim train bc'")
    try:
        require_no_bomb(file)
        with np.load(file, allow_pickle=False) as archive:
            if "said" not in archive:
                raise ConfigError(f"{file} is no checkpoint of a policy; give what 'roboxim train' wrote")
            text = str(archive["said"])
    except UNREADABLE as error:
        raise ConfigError(f"{file} is not a readable checkpoint: {str(error) or type(error).__name__}") from None
    description: Any = parse_json(text, source=f"the description in {file}")
    if not isinstance(description, dict):
        raise ConfigError(f"{file} is not a readable checkpoint: its description is a {type(description).__name__}")
    if description.get("format") == 1:
        raise ConfigError(
            f"{file} was trained on proprioception of the old layout (8 numbers with a quaternion); this "
            "version has tcp_rotation_6d instead: export the bags and train again"
        )
    if description.get("format") == 2:
        raise ConfigError(
            f"{file} holds the earlier network, which had no memory of the grasp; this version cannot run it: "
            "train again on the same dataset"
        )
    if description.get("format") not in ACTING:
        raise ConfigError(
            f"{file} has format {description.get('format')}, this version reads {ACTING[0]} to {FORMAT}; train it again"
        )
    if description.get("state_layout") != list(STATE_NAMES):
        raise ConfigError(
            f"{file} was trained on proprioception {description.get('state_layout')}, this version has "
            f"{list(STATE_NAMES)}; export the bags and train again"
        )
    return dict(description)
