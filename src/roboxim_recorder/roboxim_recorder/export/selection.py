"""Which bags an export takes: the same for every format. `roboxim_recorder.export.fit` checks that they fit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError, one_of
from roboxim_core.shards import Shard
from roboxim_datasets.dataset import SPLITS
from roboxim_datasets.where import Choice
from roboxim_recorder.acted import ActedBy, is_shared
from roboxim_recorder.bag import BagReader
from roboxim_recorder.bag_writer import REPAIRED
from roboxim_recorder.export.sources import Source, by_actor, edited, stating_actors
from roboxim_recorder.export.where import facts_of
from roboxim_recorder.run_bags import RunBags


@dataclass(frozen=True, kw_only=True)
class Selection:
    """Selection of an export's content; a format's own configuration is a subclass with the format's fields.

    Filters apply in the order of the fields ``only_successful``, ``keep_recovered``, ``where``, ``per_cell``,
    ``split``, ``shard``.
    """

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("cell_counts",)
    """Later fields, see `roboxim_core.config.LEFT_OUT`: datasets without them keep their identity."""

    cameras: dict[str, str] = field(default_factory=dict)
    """Camera to image key; empty: every camera, ``workspace`` as ``image`` and ``wrist`` as ``wrist_image``."""
    image_height: int = 0
    """Height to resize images to [px]; 0: as recorded."""
    image_width: int = 0
    """Width to resize images to [px]; 0: as recorded."""
    depth: tuple[str, ...] = ()
    """Cameras whose depth images are exported."""
    segmentation: tuple[str, ...] = ()
    """Cameras whose segmentation images are exported."""
    val_fraction: float = 0.05
    """Fraction of the episodes in the split ``val``, spread evenly; at least one of two or more episodes."""
    split: dict[str, int] = field(default_factory=dict)
    """Split (``train``, ``val``, ``test``) to its number of episodes, instead of ``val_fraction``; 0: the remaining
    ones, for one split at most. Without such a split further episodes are left out."""
    only_successful: bool = True
    """Whether to leave out episodes that did not succeed; conditions on ``outcome`` and ``reason`` replace it."""
    keep_recovered: bool = False
    """Whether to export episodes in which the actor had to try again, e.g. needed a second grasp; a condition on
    ``recovered`` replaces it."""
    where: tuple[str, ...] = ()
    """Conditions that every episode must meet: ``KEY=VALUE[,VALUE...]``, ``KEY!=VALUE``, ``KEY<NUMBER``. Keys:
    ``skill``, ``object``, ``target``, ``target.color``, ``camera``, ``outcome``, ``steps``, ``cell``, ``drawn.NAME``,
    ...; see `roboxim_recorder.export.where`. Also edits, ``trim EPISODE FIRST..LAST`` and ``relabel EPISODE WORDS``,
    see `roboxim_datasets.where`."""
    acted_by: str = ""
    """Only the steps of one actor: ``policy``, ``human`` or ``expert``. Where a person took over from a policy, each
    stretch of it becomes an episode of its own. Empty: all steps."""
    per_cell: int = 0
    """Number of episodes of each cell, the first ones that pass the filters; 0: all. A cell is that of the task's mix,
    else the skill."""
    cell_counts: dict[str, int] = field(default_factory=dict)
    """Cell to its own number of episodes, instead of ``per_cell``."""
    uneven: bool = False
    """Whether cells of a mix may have different numbers of episodes; otherwise such an export is refused."""
    shard: str = ""
    """``I/N``: the I-th of N parts of each split, so that several machines export one dataset; empty: all."""
    skip_missing: bool = False
    """Whether to export the other bags when some that the run's results name are missing; otherwise an error."""
    rate_hz: float = 0.0
    """Steps per second; must divide the recorded rate. 0: as recorded."""
    actions: str = ""
    """Meaning of the exported actions, e.g. ``end_effector_absolute,rotation_6d`` or
    ``joint_position,absolute_open_0_closed_1``; see `roboxim_core.actions.ActionSemantics`. Empty: as recorded."""
    state: str = ""
    """Fields of ``state``, e.g. ``tcp_position,tcp_quaternion_xyzw,gripper_opening``; see
    `roboxim_core.proprioception.ProprioField`. Empty: ``tcp_position,tcp_rotation_6d,gripper_opening``."""
    convention: str = ""
    """Convention (a name or a YAML file) that defines images, state, actions and rate, e.g. ``libero``; 'roboxim policy
    conventions' lists them. Empty: the fields above do."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidRequestError: On a value out of range, or options that exclude each other.
        """
        if not 0.0 <= self.val_fraction < 1.0:
            raise InvalidRequestError(f"val_fraction must be in 0..1 (1 excluded), got {self.val_fraction}")
        if (self.image_height > 0) != (self.image_width > 0) or min(self.image_height, self.image_width) < 0:
            raise InvalidRequestError("give image_height and image_width both, or neither")
        for name in self.split:
            if name not in SPLITS:
                raise InvalidRequestError(f"unknown split '{name}'; {one_of(SPLITS, name)}")
        if self.split and (min(self.split.values()) < 0 or list(self.split.values()).count(0) > 1):
            raise InvalidRequestError(
                f"split needs counts of at least 0, with one 0 (the rest) at most; got {self.split}"
            )
        if self.per_cell < 0:
            raise InvalidRequestError(f"per_cell must be at least 0, got {self.per_cell}")
        if self.cell_counts and (min(self.cell_counts.values()) < 1 or not self.per_cell):
            raise InvalidRequestError(
                f"cell_counts are at least 1, and need per_cell for the other cells; got {self.cell_counts} and "
                f"{self.per_cell}"
            )
        if self.rate_hz < 0:
            raise InvalidRequestError(f"rate_hz must be at least 0, got {self.rate_hz}")
        Choice.parse(self.where)
        if self.acted_by and self.acted_by not in list(ActedBy):
            raise InvalidRequestError(f"nobody acts as '{self.acted_by}'; {one_of(ActedBy, self.acted_by)}")
        Shard.parse(self.shard)
        given = {
            "cameras": self.cameras, "image_width": self.image_width, "actions": self.actions, "state": self.state,
            "rate_hz": self.rate_hz,
        }  # fmt: skip
        if self.convention and (twice := [name for name, value in given.items() if value]):
            raise InvalidRequestError(
                f"the convention '{self.convention}' defines images, state, actions and rate; leave out "
                f"{', '.join(twice)}, or write a convention of your own"
            )


@dataclass(frozen=True, kw_only=True)
class Chosen:
    """Bags to export, and the reasons for leaving out the others."""

    splits: dict[str, tuple[Source, ...]]
    """Split to its bags, in order."""
    left_out: dict[str, int]
    """Reason to number of bags left out for that reason."""
    missing: tuple[str, ...]
    """Missing bags that the runs' results name."""
    unexpected: tuple[Path, ...]
    """Bags that no result of the runs names; they are not exported."""

    @property
    def sources(self) -> tuple[Source, ...]:
        """The bags of all splits."""
        return tuple(source for sources in self.splits.values() for source in sources)

    @property
    def cells(self) -> dict[str, dict[str, int]]:
        """Split to cell to number of episodes."""
        return {split: dict(sorted(Counter(s.cell for s in found).items())) for split, found in self.splits.items()}


def choose(runs: Sequence[RunBags], selection: Selection) -> Chosen:
    """Choose the bags of runs to export.

    Raises:
        InvalidRequestError: On a condition that no episode can meet, or counts that exceed the episodes.
        RecorderError: ``EXPORT_REFUSED`` when bags are missing, none can be exported, an episode occurs twice, or the
            cells of a mix have different numbers of episodes; ``BAG_DAMAGED`` naming a bag that cannot be read, or that
            holds an unexpected episode.
    """
    missing = [bag for run in runs for bag in run.missing]
    for run in runs:
        if run.missing and not selection.skip_missing:
            raise _refused(
                f"{run.missing_text}; restore {'them' if len(run.missing) > 1 else 'it'}, or export the others "
                "(--skip-missing or skip_missing=True)"
            )
    found: list[Source] = []
    for run in runs:
        found += in_order([_source(path, run) for path in run.paths])
    _require_unique(found)
    left_out: Counter[str] = Counter()
    splits = selected(found, selection, left_out)
    unexpected = tuple(bag for run in runs for bag in run.unexpected)
    left_out.update({"no_bag": len(missing), "no_result": len(unexpected)})
    return Chosen(
        splits=splits,
        left_out={reason: count for reason, count in left_out.items() if count},
        missing=tuple(missing),
        unexpected=unexpected,
    )


def in_order(sources: Sequence[Source]) -> list[Source]:
    """Return the bags of one run in the order in which an export takes them."""
    return sorted(sources, key=lambda s: (s.info.purpose, s.info.run_seed, s.info.index, s.info.attempt))


def selected(
    sources: Sequence[Source], selection: Selection, left_out: Counter[str]
) -> dict[str, tuple[Source, ...]]:  # fmt: skip
    """Return the bags of each split: those that pass every filter, edited and divided by actor.

    Args:
        sources: All bags, each run's `in_order`.
        selection: The filters.
        left_out: Reason to number of bags; those that are left out are added.

    Raises:
        InvalidRequestError: On a condition that no episode can meet.
        RecorderError: ``EXPORT_REFUSED`` when none is left, cells have different numbers of episodes, or counts exceed
            the episodes.
    """
    kept = _per_cell(_filtered(sources, selection, left_out), selection, left_out)
    splits = _shard(_split(stating_actors(kept), selection, left_out), selection, left_out)
    return _by_actor(splits, selection.acted_by, left_out)


def exported_sources(sources: Sequence[Source], selection: Selection) -> tuple[Source, ...]:
    """Return what an export makes of bags, trimmed, relabelled and divided by actor, whichever of them it counts off.

    Raises:
        InvalidRequestError: On a condition that no episode can meet.
        RecorderError: ``EXPORT_REFUSED`` when none is exported.
    """
    left_out: Counter[str] = Counter()
    found = stating_actors(_filtered(sources, selection, left_out))
    return tuple(_by_actor({"": tuple(found)}, selection.acted_by, left_out)[""])


def _source(path: Path, bags: RunBags) -> Source:
    reader = BagReader(path)
    info, result = reader.info, reader.result
    line, name = bags.results.get(path.name), path.name.removesuffix(REPAIRED)
    expected = (name, name) if line is None else (name, name, line.outcome, line.final_state_hash)
    found = (info.episode_id, result.episode_id, result.outcome, result.final_state_hash)[: len(expected)]
    if found != expected:
        raise RecorderError(
            f"bag {path} holds another episode than its name or the run's results say: expected {expected}, found "
            f"{found}; 'roboxim bag check' gives details",
            ErrorCode.BAG_DAMAGED,
        )
    return Source(path=path, info=info, result=result, shared=is_shared(reader))


def _require_unique(sources: Sequence[Source]) -> None:
    """Refuse an episode that occurs twice, e.g. in two runs of one seed."""
    seen: dict[tuple[str, str, object], Source] = {}
    for source in sources:
        key = (source.info.episode_id, source.result.final_state_hash, source.info.scene.cameras)
        if key in seen:
            raise _refused(f"{seen[key].path} and {source.path} hold the same episode; give each run once")
        seen[key] = source


def _filtered(sources: Sequence[Source], selection: Selection, left_out: Counter[str]) -> list[Source]:
    choice = Choice.parse(selection.where)
    facts = [facts_of(source.info, source.result) for source in sources]
    choice.require_known(facts)
    named = {condition.key for _, condition in choice.conditions}
    kept = []
    for source, known in zip(sources, facts, strict=True):
        reason = _refusal(source.result, selection, named)
        if not reason:
            failed = choice.refusal(known)
            reason = f"not {failed}" if failed else ""
        if reason:
            left_out[reason] += 1
        else:
            kept.append(edited(source, choice.edits.get(source.info.episode_id)))
    if not kept:
        reasons = ", ".join(f"{reason}: {count}" for reason, count in left_out.most_common())
        advice = (
            "change the conditions"
            if any(reason.startswith("not ") for reason in left_out)
            else "record successful episodes, or export failures too (--all or only_successful=False)"
        )
        raise _refused(f"none of the {len(sources)} bags can be exported ({reasons}); {advice}")
    return kept


def _refusal(result: EpisodeResult, selection: Selection, named: set[str]) -> str:
    """Return why an episode is left out, apart from conditions; empty: it is not left out."""
    if selection.only_successful and not named & {"outcome", "reason"} and result.outcome != "success":
        return result.reason or result.outcome
    if result.recovered and not selection.keep_recovered and "recovered" not in named:
        return "recovered"
    return "" if result.steps else "no_action"


def _per_cell(sources: list[Source], selection: Selection, left_out: Counter[str]) -> list[Source]:
    """Take the wanted number of episodes of each cell; refuse cells with fewer, or with different numbers."""
    counts = Counter(source.cell for source in sources)
    listed = ", ".join(f"{cell}: {count}" for cell, count in sorted(counts.items()))
    if not selection.per_cell:
        if len(set(counts.values())) > 1 and not selection.uneven:
            raise _refused(
                f"the cells have different numbers of episodes ({listed}); take as many of each "
                f"(--per-cell {min(counts.values())}), record more, or export them all (--uneven)"
            )
        return sources
    wanted = {cell: selection.cell_counts.get(cell, selection.per_cell) for cell in counts}
    short = {cell: count for cell, count in sorted(counts.items()) if count < wanted[cell]}
    if short:
        raise _refused(
            f"per_cell is {selection.per_cell}, but these cells have fewer episodes after all filters: "
            + ", ".join(f"{cell}: {count} of {wanted[cell]}" for cell, count in short.items())
        )
    taken: Counter[str] = Counter()
    kept = []
    for source in sources:
        taken[source.cell] += 1
        if taken[source.cell] <= wanted[source.cell]:
            kept.append(source)
        else:
            left_out["more than per_cell"] += 1
    return kept


def _split(sources: Sequence[Source], selection: Selection, left_out: Counter[str]) -> dict[str, tuple[Source, ...]]:
    """Return each split's bags; the smaller splits are spread evenly over the cells and over the order of recording."""
    if not selection.split:
        names = splits(len(sources), selection.val_fraction)
    else:
        names = _counted(len(sources), selection.split)
        left_out["more than split"] += names.count("")
    order = sorted(range(len(sources)), key=lambda index: sources[index].cell)  # stable: by cell, then by order
    name_of = dict(zip(order, names, strict=True))
    found = {split: [s for i, s in enumerate(sources) if name_of[i] == split] for split in SPLITS}
    return {split: tuple(group) for split, group in found.items() if group}


def _shard(
    splits: dict[str, tuple[Source, ...]], selection: Selection, left_out: Counter[str]
) -> dict[str, tuple[Source, ...]]:
    """Return the shard's part of each split."""
    shard = Shard.parse(selection.shard)
    if shard.count == 1:
        return splits
    found = {split: sources[shard.part(len(sources))] for split, sources in splits.items()}
    whole, taken = (sum(map(len, parts.values())) for parts in (splits, found))
    if not taken:
        raise _refused(f"shard {shard} has no episode: only {whole} can be exported; divide them into fewer shards")
    left_out["other shards"] += whole - taken
    return {split: sources for split, sources in found.items() if sources}


def _by_actor(
    splits: dict[str, tuple[Source, ...]], actor: str, left_out: Counter[str]
) -> dict[str, tuple[Source, ...]]:
    """Return the stretches in which one actor acted; empty: everything. Those of an episode stay in its split."""
    if not actor:
        return splits
    found: dict[str, tuple[Source, ...]] = {}
    for split, sources in splits.items():
        parts = {source.path: by_actor(source, ActedBy(actor)) for source in sources}
        left_out[f"nothing by {actor}"] += sum(not some for some in parts.values())
        if together := tuple(part for some in parts.values() for part in some):
            found[split] = together
    if not found:
        raise _refused(f"none of the episodes has a step by '{actor}'; choose another --acted-by, or leave it out")
    return found


def _counted(total: int, wanted: Mapping[str, int]) -> list[str]:
    """Return a split for each of ``total`` episodes so that each has its number; empty: left out."""
    fixed = sum(wanted.values())
    if fixed > total or (fixed == total and 0 in wanted.values()):
        splits = ", ".join(f"{name}={count}" for name, count in wanted.items())
        raise _refused(
            f"{total} episodes pass the filters, not enough for the splits {splits}; ask for fewer, or record more "
            "(0: the rest)"
        )
    counts = {name: count for name, count in wanted.items() if count}
    counts[next((name for name, count in wanted.items() if not count), "")] = total - fixed
    # The n-th episode of a split is at the middle of the n-th of equal parts of the whole order.
    places = [((at + 0.5) / count, name) for name, count in counts.items() for at in range(count)]
    return [name for _, name in sorted(places, key=lambda place: place[0])]


def splits(count: int, fraction: float) -> list[str]:
    """Return ``train`` or ``val`` for each of ``count`` episodes, ``val`` spread evenly.

    If a positive fraction is wanted, ``val`` gets at least one of two or more episodes.
    """
    names = ["val" if int((i + 1) * fraction) > int(i * fraction) else "train" for i in range(count)]
    if fraction > 0 and count > 1 and "val" not in names:
        names[-1] = "val"
    return names


def _refused(message: str) -> RecorderError:
    return RecorderError(message, ErrorCode.EXPORT_REFUSED)
