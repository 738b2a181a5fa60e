"""Recording folders of workers that may keep writing after the run has given them up.

A worker on another machine may keep running for seconds after the run has given it up and repeats its episode
elsewhere. So it records into its own folder, ``<out>/.partial/w<number>-<random>``, or, if the run has a store, into a
temporary folder of its machine, from which it uploads the bags. Only the run moves a bag to its place, when it has the
result.
"""

from __future__ import annotations

import secrets
import shutil
import tempfile
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import UnavailableError
from roboxim_recorder.bag_writer import PARTIAL, PLACES, disk_errors

if TYPE_CHECKING:
    from roboxim_bringup.graph import GraphConfig
    from roboxim_runs.storage.folder import RunFolder

VISIBLE_WITHIN_S = 30.0
"""Longest time in which a file on a network's file system appears on other machines [s]."""


@dataclass(frozen=True, kw_only=True)
class Staging:
    """A worker's own folder."""

    folder: Path
    """Absolute."""
    store: str = ""
    """URL that its bags are uploaded to; empty: the run takes them from the folder."""

    @classmethod
    def of(cls, settings: Mapping[str, str] | None, output_dir: str, number: int) -> Staging | None:
        """Make the folder.

        Args:
            settings: ``store``, its URL or empty; none: the worker records in the run's folder.
            output_dir: The run's folder.
            number: The worker's number.
        """
        if settings is None:
            return None
        if settings["store"]:
            return cls(folder=Path(tempfile.mkdtemp(prefix="roboxim-bags-")), store=settings["store"])
        folder = Path(output_dir) / PARTIAL / f"w{number}-{secrets.token_hex(4)}"
        with disk_errors(folder):
            folder.mkdir(parents=True)
        return cls(folder=folder)

    def recording(self, graph: GraphConfig) -> GraphConfig:
        """Return the worker's graph with a recorder that may write into the folder."""
        recorder = {**graph.parameters.get("recorder", {}), "output_root": str(self.folder)}
        return replace(graph, parameters={**graph.parameters, "recorder": recorder})

    def handed_over(self) -> dict[str, Any]:
        """Return what the run needs to take over the bags of the finished episode, after uploading them.

        Raises:
            RoboximError: When a bag cannot be uploaded.
        """
        if not self.store:
            return {"staging": self.folder.name}
        from roboxim_runs.storage.store import Store

        with Store.opened(self.store) as store:
            stored = {bag: store.put_folder(self.folder / bag, bag) for bag in bags_in(self.folder)}
        for bag in stored:
            shutil.rmtree(self.folder / bag)
        return {"stored": stored}

    def close(self) -> None:
        """Remove a temporary folder; the run removes the others."""
        if self.store:
            shutil.rmtree(self.folder, ignore_errors=True)


def bags_in(folder: Path) -> list[str]:
    """Return the bags in a worker's folder, kept or set apart, as relative paths."""
    return sorted(str(bag.relative_to(folder)) for place in PLACES.values() for bag in (folder / place).glob("[!.]*"))


def take_over(folder: RunFolder, result: EpisodeResult, handed_over: Mapping[str, Any]) -> None:
    """Put the bags of a finished episode in their place.

    Args:
        folder: The run's folder.
        result: The episode's result.
        handed_over: As `Staging.handed_over` returns it.

    Raises:
        UnavailableError: When the bag cannot be seen from this machine.
    """
    if "stored" in handed_over:
        from roboxim_runs.storage.store import note_stored

        note_stored(folder.path, handed_over["stored"])
        return
    staging = folder.path / PARTIAL / handed_over["staging"]
    deadline = time.monotonic() + VISIBLE_WITHIN_S
    while result.bag and not (staging / result.bag).is_dir():
        if time.monotonic() > deadline:
            raise UnavailableError(
                f"the bag {result.bag} is not in {staging} after {VISIBLE_WITHIN_S:g} s: the machine that recorded it "
                "does not share this folder; choose an output folder that all machines share, or give --store URL"
            )
        time.sleep(0.1)
    with disk_errors(folder.path):
        for bag in bags_in(staging):
            (folder.path / bag).parent.mkdir(exist_ok=True)
            (staging / bag).rename(folder.path / bag)


def clear_staging(folder: RunFolder) -> None:
    """Remove the workers' folders of this run or an earlier one."""
    for path in (folder.path / PARTIAL).glob("w[0-9]*-*"):
        shutil.rmtree(path, ignore_errors=True)
