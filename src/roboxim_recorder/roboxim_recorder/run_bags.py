"""The bags of a run's folder, compared with the run's results."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from roboxim_core.config import from_plain
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, RecorderError
from roboxim_core.plain_data.results_log import RESULTS_FILE, ResultsLog
from roboxim_core.user_folders import expanded
from roboxim_recorder.bag_writer import PLACES

SHOWN = 5
"""Number of names in a message; further ones are only counted."""


@dataclass(frozen=True, kw_only=True)
class RunBags:
    """Existing and expected bags of a folder."""

    paths: tuple[Path, ...]
    """Kept bags that the run's results name, sorted by name; in a folder without results all kept bags."""
    missing: tuple[str, ...] = ()
    """Missing bags, kept or set apart, that results name, relative to the run's folder."""
    unexpected: tuple[Path, ...] = ()
    """Kept bags that no result names."""
    results: dict[str, EpisodeResult] = field(default_factory=dict)
    """Name of a kept bag to its line in the run's results."""

    @property
    def missing_text(self) -> str:
        """Readable list of the missing bags; empty if there are none."""
        shown = ", ".join(self.missing[:SHOWN]) + (", ..." if len(self.missing) > SHOWN else "")
        bags = "bag is" if len(self.missing) == 1 else "bags are"
        return f"{len(self.missing)} {bags} missing that {RESULTS_FILE} names: {shown}"

    @property
    def unexpected_text(self) -> str:
        """Readable list of the bags that no result names; empty if there are none."""
        names = [path.name for path in self.unexpected]
        shown = ", ".join(names[:SHOWN]) + (", ..." if len(names) > SHOWN else "")
        return f"{len(names)} {'bag has' if len(names) == 1 else 'bags have'} no line in {RESULTS_FILE}: {shown}"


def run_bags(path: Path | str) -> RunBags:
    """Return the bags of a run's folder or of a folder of bags, compared with the run's results if there are any.

    A bag is missing if its folder or its ``.mcap`` file is missing. An unfinished or killed run may have one bag per
    worker whose result is not yet written; resuming the run records these episodes again.

    Args:
        path: A run's folder, its ``episodes`` folder, another folder of bags, or one bag.

    Raises:
        ConfigError: When there is no such folder, or a line of the results is not readable.
        RecorderError: When there is neither a bag nor a result that names one.
    """
    folder = expanded(path)
    run = folder.parent if folder.name == PLACES["keep"] else folder
    results = [result for result in read_results(run) if result.bag]
    if not results:
        return RunBags(paths=tuple(list_bags(folder)))
    kept = {Path(r.bag).name: r for r in results if Path(r.bag).parent.name == PLACES["keep"]}
    missing = tuple(sorted(r.bag for r in results if not any((run / r.bag).glob("*.mcap"))))
    there = _bags_in(run / PLACES["keep"])
    if not there and not missing:
        list_bags(folder)  # raises an error with the reason
    return RunBags(
        paths=tuple(bag for bag in there if bag.name in kept and f"{PLACES['keep']}/{bag.name}" not in missing),
        missing=missing,
        unexpected=tuple(bag for bag in there if bag.name not in kept),
        results=kept,
    )


def run_name(path: Path) -> str:
    """Return the name of a run: of its folder or of its folder of bags."""
    return path.parent.name if path.name == PLACES["keep"] else path.name


def read_results(run: Path) -> list[EpisodeResult]:
    """Return the results of a run, the last of each index. A torn last line (a crash) is left out.

    Episodes that their policy did not play are also left out, see `EpisodeResult.played`.

    Raises:
        ConfigError: When a line is not readable.
    """
    log, found = ResultsLog(run / RESULTS_FILE), {}
    for entry in log.read():
        result = from_plain(entry.data, EpisodeResult, source=f"{log.path} line {entry.line}")
        found[result.episode] = result
    return [result for result in found.values() if result.played]


def holds_bags(path: Path) -> bool:
    """Return whether a path is a run, a folder of bags, or a bag."""
    if path.is_file():
        return path.suffix == ".mcap"
    inside = path / "episodes" if (path / "episodes").is_dir() else path
    return any(inside.glob("*.mcap")) or any(inside.glob("[!.]*/*.mcap"))


def list_bags(path: Path | str) -> list[Path]:
    """Return the bags of a run's folder or of a folder of bags, sorted by name, without those set apart.

    A bag that has lost its ``.mcap`` file counts, so that its reader reports the loss.

    Args:
        path: A run's folder (its ``episodes/`` is meant), a folder of bags, or one bag.

    Raises:
        ConfigError: When there is no such folder.
        RecorderError: When no bag is in it.
    """
    folder = expanded(path)
    if not folder.is_dir():
        what = "is a file; expected a run's folder or a folder of bags"
        raise ConfigError(f"{folder} {what}" if folder.exists() else f"no such folder: {folder}")
    apart = len(list((folder / PLACES["set_apart"]).glob("[!.]*/*.mcap")))
    if (folder / PLACES["keep"]).is_dir():
        folder = folder / PLACES["keep"]
    bags = [folder] if list(folder.glob("*.mcap")) else _bags_in(folder)
    if not bags:
        failed = (
            f"; the {apart} in set_apart did not succeed" if apart else "; expected folders that hold an .mcap file"
        )
        if runs := [str(results.parent) for results in sorted(folder.glob(f"*/{RESULTS_FILE}"))]:
            raise RecorderError(
                f"{folder} is an evaluation with a folder of bags for each policy; name a policy's: {' or '.join(runs)}"
            )
        raise RecorderError(f"{folder} has no bags{failed}")
    return bags


def _bags_in(folder: Path) -> list[Path]:
    return sorted({path.parent for name in ("*.mcap", "metadata.yaml") for path in folder.glob(f"[!.]*/{name}")})
