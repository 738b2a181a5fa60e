"""Worker that reads bags for the proofs of delivery, a bag per job."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from roboxim_core.config import from_plain, to_plain
from roboxim_core.models.library import ModelLibrary
from roboxim_eval.experiments.proving.demand import Shown, View, plain_value
from roboxim_runs.experiments.delivery.demands import demands_of
from roboxim_runs.experiments.delivery.reader import DeliveryReader


@dataclass(frozen=True, kw_only=True)
class BagJob:
    """A bag to read."""

    bag: str
    """Its path."""
    mix: str
    """Name of the task mix that its cell is of."""
    words: str | None = None
    """What the policy must receive as instruction; none: the task's."""
    latency_ticks: int = 0
    """Ticks by which each of its answers must be late."""
    instruction: str | None = None
    """An instruction to read in its scene; none: nothing to read."""


class DeliveryWorker:
    """Reads one bag per job, a `BagJob` as plain data; see `roboxim_runs.executors`."""

    def __init__(self, settings: Mapping[str, Any], number: int) -> None:
        """Make the reader.

        Args:
            settings: ``mixes``, task mixes by name as JSON texts, and ``pictures``, whether to compare pictures.
            number: The worker's number.
        """
        self._mixes: Mapping[str, str] = settings["mixes"]
        self._pictures = bool(settings["pictures"])
        self._reader = DeliveryReader(ModelLibrary())

    def run(self, job: Mapping[str, Any], note: Callable[[Any], None]) -> dict[str, Any]:
        """Return what a bag shows, and what an instruction asks for in its scene."""
        wanted = from_plain(job, BagJob)
        demands = demands_of(self._mixes[wanted.mix], wanted.words, wanted.latency_ticks)
        shown = self._reader.read(Path(wanted.bag), demands.get, pictures=self._pictures)
        instructed = [] if wanted.instruction is None else self._reader.instructed(Path(wanted.bag), wanted.instruction)
        return {"shown": to_plain(shown), "asked": instructed}

    def close(self) -> None:
        """Free the renderers."""
        self._reader.close()


def shown_from(data: Mapping[str, Any]) -> Shown:
    """Return what a bag shows from plain data, as a worker returns it."""
    values = dict(data)
    for name in ("arguments", "look"):
        values[name] = {key: plain_value(value) for key, value in data[name].items()}
    for name in ("modifiers", "other_modifiers"):
        values[name] = {one: {k: plain_value(v) for k, v in kinds.items()} for one, kinds in data[name].items()}
    values["cameras"] = {name: from_plain(view, View) for name, view in data["cameras"].items()}
    values["positions"] = {role: tuple(position) for role, position in data["positions"].items()}
    values["sizes"] = {name: tuple(shape) for name, shape in data["sizes"].items()}
    values["thumbnails"] = {name: tuple(numbers) for name, numbers in data["thumbnails"].items()}
    return Shown(**{**values, "received": tuple(data["received"]), "start": tuple(data["start"])})
