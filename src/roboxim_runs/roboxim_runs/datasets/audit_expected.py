"""Expected episodes of an audited dataset: an export of their bags, or another dataset's episodes.

The export's own code makes the expected values, in memory, with the settings that the dataset's ``export.json`` states.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from roboxim_core.config import from_plain
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_datasets.choosing import edited
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.episode import Episode, whole_id
from roboxim_datasets.where import Choice, Edit
from roboxim_recorder.acted import is_shared
from roboxim_recorder.bag import BagReader
from roboxim_recorder.export.content import content_of
from roboxim_recorder.export.convention_file import CONVENTION_FILE
from roboxim_recorder.export.episodes import exported_episode
from roboxim_recorder.export.registry import EXPORTERS
from roboxim_recorder.export.selection import Selection, exported_sources, in_order, selected
from roboxim_recorder.export.sources import Source

NO_SETTINGS = "the dataset does not say how it was exported (export.json), so its bags cannot be exported alike"
NO_BAG = "none of the bags given is of this episode"
NO_EPISODE = "the dataset given with --against has no such episode"


@dataclass(kw_only=True, eq=False)
class Expected:
    """Finds the expected episode of each audited one."""

    find: Callable[[Episode, str], Episode | None]
    """Returns what an episode should be, by itself and its name (``split/index``); None: there is none."""
    missing: str
    """What is wrong with an episode that has no expected one."""
    lossless: bool
    """Whether images should be equal pixel by pixel."""
    unclaimed: set[str] = field(default_factory=set)
    """Expected episodes that no audited episode has been matched with yet."""


def expected_of_bags(dataset: Dataset, bags: Mapping[str, list[Path]]) -> Expected | str:
    """Return what an export of bags gives; a text: why that is not known.

    Args:
        dataset: The audited dataset.
        bags: Episode id to its bags.
    """
    config = _settings(dataset)
    if config is None:
        return NO_SETTINGS
    sources: dict[str, Source] = {}
    for name, paths in bags.items():
        for path in paths:
            reader = BagReader(path)
            made = Source(path=path, info=reader.info, result=reader.result, shared=is_shared(reader))
            sources.setdefault(name, made)
    if not sources:
        return NO_BAG
    try:
        exported = {source.episode_id: source for source in exported_sources(list(sources.values()), config)}
        content = content_of(list(exported.values()), config)
        edits = list(_edits(dataset.facts))
    except RoboximError as error:
        return f"its bags cannot be exported with the settings of its export.json: {error}"

    whole = {source.info.episode_id: source for source in sources.values()}

    def find(episode: Episode, name: str) -> Episode | None:
        source = exported.get(episode.episode_id) or whole.get(episode.episode_id)
        if source is None:
            return None
        made = exported_episode(source, content)
        for edit in edits:
            made = edited(made, edit) if edit.episode == made.episode_id else made
        return made

    lossless, unclaimed = dataset.features.lossless, _selected(dataset, list(sources.values()), config)
    return Expected(find=find, missing=NO_BAG, lossless=lossless, unclaimed=unclaimed)


def relabels(dataset: Dataset) -> Callable[[str], str]:
    """Return a function of an episode's id to the instruction that the dataset's export or a conversion gave it.

    It returns an empty text for an episode that kept the recorded one.

    Raises:
        RoboximError: When the dataset states edits that are none.
    """
    first = [edit for config in _exports(dataset.facts, whole=False) for edit in _given(config)]
    words = {edit.episode: edit.instruction for edit in first if edit.instruction}
    later = {edit.episode: edit.instruction for edit in _edits(dataset.facts) if edit.instruction}
    return lambda name: later.get(name) or words.get(whole_id(name), "")


def _given(config: Mapping[str, Any]) -> tuple[Edit, ...]:
    """Return the edits of an export's settings."""
    where = config.get("where")
    return Choice.parse(map(str, where)).given if isinstance(where, list) else ()


def expected_of_dataset(dataset: Dataset, other: Dataset) -> Expected:
    """Return what another dataset holds: the episode of the same id, or of the same place where there are no ids."""
    places: dict[str, tuple[str, int]] = {}
    for number in range(len(other)):
        split, index = other.place(number)
        places[f"{split}/{index}"] = places[other.read(split, index).episode_id or f"{split}/{index}"] = (split, index)

    def find(episode: Episode, name: str) -> Episode | None:
        place = places.get(episode.episode_id) or (None if episode.episode_id in places else places.get(name))
        return None if place is None else other.read(*place)

    return Expected(find=find, missing=NO_EPISODE, lossless=dataset.features.lossless and other.features.lossless)


def _edits(facts: Mapping[str, Any]) -> Iterator[Edit]:
    """Yield the edits by which a dataset differs from the exports that it comes from, in the order they were made.

    Raises:
        ConfigError: When one is none.
    """
    for source in facts.get("sources", ()):
        yield from _edits(source)
    for edit in facts.get("edits", ()):
        yield from_plain(edit, Edit, source="export.json")


def _exports(facts: Mapping[str, Any], *, whole: bool) -> Iterator[dict[str, Any]]:
    """Yield the settings of the exports that a dataset comes from; ``whole``: only of those that it has all of."""
    how = facts.get("how")
    if "config" in facts:
        yield dict(facts["config"])
    elif not whole or how == "merge" or (how == "convert" and not facts.get("where")):
        for source in facts.get("sources", ()):
            yield from _exports(source, whole=whole)


def _selected(dataset: Dataset, sources: Sequence[Source], config: Selection) -> set[str]:
    """Return the episodes that a dataset should have: if it is an export, or the merged shards of one.

    Otherwise, or where the bags are too few for its settings, nothing says which episodes of the bags it should have.
    """
    exports = list(_exports(dataset.facts, whole=True))
    shards = [str(export.pop("shard", "")) for export in exports]
    if not exports or exports.count(exports[0]) < len(exports) or (len(exports) > 1 and not all(shards)):
        return set()
    by_run = groupby(sources, key=lambda source: source.path.parent)
    ordered = [source for _, of_run in by_run for source in in_order(list(of_run))]
    try:
        parts = [selected(ordered, replace(config, shard=shard), Counter()) for shard in shards]
    except RoboximError:
        return set()
    return {source.episode_id for part in parts for group in part.values() for source in group}


def _settings(dataset: Dataset) -> Selection | None:
    """Return the settings of the export that a dataset comes from, also through conversions; None: it does not say."""
    facts: Any = dataset.facts
    while isinstance(facts, Mapping) and "config" not in facts:
        sources = facts.get("sources") or [None]
        facts = sources[0]
    if not isinstance(facts, Mapping) or facts.get("format") not in EXPORTERS:
        return None
    try:
        config: Selection = from_plain(facts["config"], EXPORTERS[facts["format"]]().config, source="export.json")
    except (ConfigError, RoboximError):
        return None
    file = dataset.folder / CONVENTION_FILE
    return replace(config, convention=str(file)) if config.convention and file.is_file() else config
