"""Expected episodes of an audited dataset: an export of their bags, or another dataset's episodes.

The export's own code makes the expected values, in memory, with the settings that the dataset's ``export.json`` states.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from roboxim_core.config import from_plain
from roboxim_core.errors import RoboximError
from roboxim_datasets.choosing import edited
from roboxim_datasets.dataset import CONVENTION_FILE, Dataset
from roboxim_datasets.episode import Episode, whole_id
from roboxim_datasets.where import Choice, Edit
from roboxim_recorder.acted import is_shared
from roboxim_recorder.bag import BagReader
from roboxim_recorder.export.content import Content, content_of
from roboxim_recorder.export.episodes import exported_episode
from roboxim_recorder.export.registry import EXPORTERS
from roboxim_recorder.export.selection import Selection, exported_sources, in_order, selected
from roboxim_recorder.export.sources import Source
from roboxim_recorder.run_bags import run_name

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
    configs = _settings(dataset)
    if not configs:
        return NO_SETTINGS
    sources = _sources(path for paths in bags.values() for path in paths)
    if not sources:
        return NO_BAG
    try:
        exports = [_made(sources, config) for config in configs]
        edits = list(_edits(dataset.facts))
    except RoboximError as error:
        return f"its bags cannot be exported with the settings of its export.json: {error}"

    def find(episode: Episode, name: str) -> Episode | None:
        """Return what an export gives; of several, the one that fits in length and words."""
        alike = [one for exported in exports for one in _of(episode, exported)]
        made = []
        for source, content in alike or _of(episode, [(source, exports[0][0][1]) for source in sources]):
            made.append(exported_episode(source, content))
            for edit in edits:
                made[-1] = edited(made[-1], edit) if edit.episode == made[-1].episode_id else made[-1]
        fits = (one for one in made if (len(one), one.instruction) == (len(episode), episode.instruction))
        return next(fits, made[0] if made else None)

    lossless, unclaimed = dataset.features.lossless, _selected(dataset, sources, configs[0])
    return Expected(find=find, missing=NO_BAG, lossless=lossless, unclaimed=unclaimed)


def _sources(paths: Iterable[Path]) -> list[Source]:
    """Return bags, each episode once, however many bags hold it."""
    found: dict[tuple[str, str], Source] = {}
    for path in paths:
        reader = BagReader(path)
        source = Source(path=path, info=reader.info, result=reader.result, shared=is_shared(reader))
        found.setdefault((source.episode_id, source.result.final_state_hash), source)
    return list(found.values())


def _made(sources: Sequence[Source], config: Selection) -> list[tuple[Source, Content]]:
    """Return what an export makes of bags."""
    exported = exported_sources(sources, config)
    content = content_of(exported, config)
    return [(source, content) for source in exported]


def _of(episode: Episode, exported: Sequence[tuple[Source, Content]]) -> list[tuple[Source, Content]]:
    """Return those that are of an audited episode: runs of one seed have the same ids."""
    state = episode.metadata.get("final_state_hash")
    return [
        (source, content) for source, content in exported
        if source.episode_id == episode.episode_id and state in (None, source.result.final_state_hash)
    ]  # fmt: skip


def relabels(dataset: Dataset) -> Callable[[str], str]:
    """Return a function of an episode's id to the instruction that the dataset's export or a conversion gave it.

    It returns an empty text for an episode that kept the recorded one.

    Raises:
        RoboximError: When the dataset states edits that are none.
    """
    first = [edit for _, config in _exports(dataset.facts, whole=False) for edit in _given(config)]
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


def _exports(facts: Mapping[str, Any], *, whole: bool) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield format and settings of the exports that a dataset comes from; ``whole``: of those that it has all of."""
    how = facts.get("how")
    if "config" in facts:
        yield str(facts.get("format", "")), dict(facts["config"])
    elif not whole or how == "merge" or (how == "convert" and not facts.get("where")):
        for source in facts.get("sources", ()):
            yield from _exports(source, whole=whole)


def _selected(dataset: Dataset, sources: Sequence[Source], config: Selection) -> set[str]:
    """Return the episodes that a dataset should have: if it is an export, or the merged shards of one.

    Otherwise, or where the bags are too few for its settings, nothing says which episodes of the bags it should have.
    """
    exports = [settings for _, settings in _exports(dataset.facts, whole=True)]
    shards = [str(export.pop("shard", "")) for export in exports]
    if not exports or exports.count(exports[0]) < len(exports) or (len(exports) > 1 and not all(shards)):
        return set()
    names = _run_names(dataset.facts)
    runs = sorted(
        dict.fromkeys(source.path.parent for source in sources),
        key=lambda run: names.index(name) if (name := run_name(run)) in names else len(names),
    )
    ordered = [one for run in runs for one in in_order([source for source in sources if source.path.parent == run])]
    try:
        parts = [selected(ordered, replace(config, shard=shard), Counter()) for shard in shards]
    except RoboximError:
        return set()
    return {source.episode_id for part in parts for group in part.values() for source in group}


def _run_names(facts: Mapping[str, Any]) -> list[str]:
    """Return the names of an export's runs in its order, of merged shards those of the first."""
    while "runs" not in facts and facts.get("sources"):
        facts = facts["sources"][0]
    return list(facts.get("runs", ()))


def _settings(dataset: Dataset) -> list[Selection]:
    """Return the settings of the exports that a dataset comes from, without shards; empty: it does not say all."""
    file = dataset.folder / CONVENTION_FILE
    found: list[Selection] = []
    for form, settings in _exports(dataset.facts, whole=False):
        if form not in EXPORTERS:
            return []
        try:
            config: Selection = from_plain({**settings, "shard": ""}, EXPORTERS[form]().config, source="export.json")
        except RoboximError:
            return []
        config = replace(config, convention=str(file)) if config.convention and file.is_file() else config
        if config not in found:
            found.append(config)
    return found
