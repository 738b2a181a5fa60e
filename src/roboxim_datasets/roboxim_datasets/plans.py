"""The plan of a new dataset: which episodes of other datasets it has, and in which split."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from roboxim_core.errors import InvalidRequestError
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.episode import Episode
from roboxim_datasets.where import Edit


@dataclass(frozen=True, kw_only=True)
class Place:
    """An episode of a dataset."""

    dataset: Dataset
    """The dataset."""
    split: str
    """Its split."""
    index: int
    """Its number in the split."""
    change: Callable[[Episode], Episode] = lambda episode: episode
    """Changes the episode after reading."""
    changed: Edit | None = None
    """What the change is, with the episode's id if it has one; None: none."""

    def read(self) -> Episode:
        """Read the episode, with its change.

        Raises:
            RecorderError: With code ``BAG_DAMAGED``, naming the file.
        """
        return self.change(self.dataset.read(self.split, self.index))


Plan = Mapping[str, Sequence[Place]]
"""Split of the new dataset to its episodes."""


def plan_of(*datasets: Dataset) -> dict[str, list[Place]]:
    """Return the plan that keeps every episode in its split, one dataset after another."""
    found: dict[str, list[Place]] = {}
    for dataset in datasets:
        for split, count in dataset.splits.items():
            places = [Place(dataset=dataset, split=split, index=index) for index in range(count)]
            found.setdefault(split, []).extend(places)
    return found


def split_plan(dataset: Dataset, counts: Mapping[str, int]) -> dict[str, list[Place]]:
    """Return the plan that divides all episodes of a dataset into other splits.

    The splits take turns so that each is spread evenly over the whole order.

    Args:
        dataset: The dataset.
        counts: New split to its number of episodes; one may be 0: the rest.

    Raises:
        InvalidRequestError: When the counts are not those of the dataset.
    """
    places = [place for group in plan_of(dataset).values() for place in group]
    rest, fixed = [name for name, count in counts.items() if not count], sum(counts.values())
    if len(rest) > 1 or fixed > len(places) or (fixed < len(places) and not rest) or (fixed == len(places) and rest):
        raise InvalidRequestError(
            f"{dataset.path} has {len(places)} episodes; expected counts that add up to this, or one 0 for the rest, "
            f"got {dict(counts)}"
        )
    wanted = {name: count or len(places) - fixed for name, count in counts.items()}
    turns = sorted(((at + 0.5) / count, name) for name, count in wanted.items() for at in range(count))
    found: dict[str, list[Place]] = {name: [] for name in wanted}
    for place, (_, name) in zip(places, turns, strict=True):
        found[name].append(place)
    return found
