"""The bags of a run's folder."""

from __future__ import annotations

from pathlib import Path

from roboxim_core.errors import ConfigError, RecorderError
from roboxim_recorder.bag_writer import PLACES


def list_bags(path: Path | str) -> list[Path]:
    """Return the bags of a run's folder or of a folder of bags, sorted by name; set apart ones are not among them.

    A bag that has lost its ``.mcap`` file counts, so that whoever reads it learns of the loss.

    Args:
        path: A run's folder (its ``episodes/`` is meant), a folder of bags, or one bag.

    Raises:
        ConfigError: When there is no such folder.
        RecorderError: When no bag is in it.
    """
    folder = Path(path)
    if not folder.is_dir():
        what = "is a file; expected a run's folder or a folder of bags"
        raise ConfigError(f"{folder} {what}" if folder.exists() else f"no such folder: {folder}")
    apart = len(list((folder / PLACES["set_apart"]).glob("[!.]*/*.mcap")))
    if (folder / "episodes").is_dir():
        folder = folder / "episodes"
    bags = (
        [folder]
        if list(folder.glob("*.mcap"))
        else sorted({path.parent for name in ("*.mcap", "metadata.yaml") for path in folder.glob(f"[!.]*/{name}")})
    )
    if not bags:
        failed = (
            f"; the {apart} in set_apart did not succeed" if apart else "; expected folders that hold an .mcap file"
        )
        raise RecorderError(f"{folder} has no bags{failed}")
    return bags
