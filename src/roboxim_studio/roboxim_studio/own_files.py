"""Files that a part of the studio may replace: those that it wrote or read itself."""

from __future__ import annotations

from pathlib import Path

from roboxim_core.errors import ConfigError
from roboxim_core.whole_files import write_whole


class OwnFiles:
    """Guards the files of other sessions, of other scenes and of editors: a saved file has the same name by default."""

    def __init__(self) -> None:
        """Begin with none."""
        self._own: set[Path] = set()

    def add(self, file: Path) -> None:
        """Note a file that was read: it may be replaced."""
        self._own.add(file.resolve())

    def require(self, file: Path) -> None:
        """Refuse a file that is not one's own; note it.

        Raises:
            ConfigError: When it exists.
        """
        if file.exists() and file.resolve() not in self._own:
            raise ConfigError(f"{file.name} exists already and was not saved from here; choose another name")
        self.add(file)

    def write(self, file: Path, text: str) -> None:
        """Write a file.

        Raises:
            ConfigError: When it is not one's own.
            OSError: When it cannot be written.
        """
        self.require(file)
        write_whole(file, text)
