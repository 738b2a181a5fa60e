"""Which bags an export takes, and whether they fit together: the same for every format."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from roboxim_core.actions import ActionSemantics
from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError, one_of
from roboxim_core.proprioception import STATE_FIELDS, ProprioField, component_names
from roboxim_datasets.dataset import SPLITS, Description, Features
from roboxim_datasets.episode import EXECUTED, ImageSize
from roboxim_datasets.rlds.episodes import USUAL_KEYS
from roboxim_recorder.bag import BagReader
from roboxim_recorder.bag_writer import REPAIRED
from roboxim_recorder.run_bags import RunBags

RESERVED = {"state", "joint_positions"}
"""Names of observations that no image key may have."""


@dataclass(frozen=True, kw_only=True)
class Selection:
    """What goes into an export; a format's own configuration is a subclass with the format's fields."""

    cameras: dict[str, str] = field(default_factory=dict)
    """Camera to image key; empty: every camera, ``workspace`` as ``image`` and ``wrist`` as ``wrist_image``."""
    image_height: int = 0
    """Height to resize images to [px]; 0: as recorded."""
    image_width: int = 0
    """Width to resize images to [px]; 0: as recorded."""
    val_fraction: float = 0.05
    """Fraction of the episodes in the split ``val``, spread evenly; at least one of two or more episodes."""
    only_successful: bool = True
    """Whether to leave out episodes that did not succeed."""
    keep_recovered: bool = False
    """Whether to export episodes in which the actor had to try again, e.g. needed a second grasp."""
    skip_missing: bool = False
    """Whether to export the other bags when some that the run's results name are missing; otherwise an error."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidRequestError: On a fraction or size out of range.
        """
        if not 0.0 <= self.val_fraction < 1.0:
            raise InvalidRequestError(f"val_fraction must be in 0..1 (1 excluded), got {self.val_fraction}")
        if (self.image_height > 0) != (self.image_width > 0) or min(self.image_height, self.image_width) < 0:
            raise InvalidRequestError("give image_height and image_width both, or neither")


@dataclass(frozen=True, kw_only=True)
class Source:
    """A bag to export, with the facts that are known before its ticks are read."""

    path: Path
    """The bag."""
    info: EpisodeInfo
    """Everything needed to reproduce the episode."""
    result: EpisodeResult
    """How the episode ended."""


@dataclass(frozen=True, kw_only=True)
class Selected:
    """Bags that fit together."""

    sources: tuple[Source, ...]
    """The bags to export, sorted by index."""
    left_out: dict[str, int]
    """Reason to number of bags left out for that reason."""
    missing: tuple[str, ...]
    """Missing bags that the run's results name, relative to the run."""
    unexpected: tuple[Path, ...]
    """Bags that no result of the run names; they are not exported."""
    keys: dict[str, str]
    """Camera to image key."""
    sizes: dict[str, ImageSize]
    """Camera to the size of its images in the export."""
    semantics: ActionSemantics
    """Meaning of the actions."""

    joint_names: tuple[str, ...]
    """Arm joints of the robot, in the order of their positions."""

    vectors: dict[str, tuple[ProprioField, ...]]
    """Observed vector of the dataset to the fields that it consists of."""

    @property
    def robot(self) -> str:
        """Id of the robot model."""
        return self.sources[0].info.scene.robot.model

    @property
    def description(self) -> Description:
        """Description of the dataset."""
        action = self.semantics.component_names(self.joint_names)
        skills = tuple(sorted({source.info.task.skill for source in self.sources}))
        return Description(
            features=Features(
                cameras=self.sizes,
                keys=self.keys,
                action=action,
                vectors={name: component_names(fields, self.joint_names) for name, fields in self.vectors.items()},
                signals={EXECUTED: action},
            ),
            fps=self.semantics.rate_hz,
            robot=self.robot,
            joint_names=self.joint_names,
            semantics=self.semantics,
            skills=skills,
            text=(
                f"{len(self.sources)} simulated episodes recorded with RoboXim; robot: {self.robot}; skills: "
                f"{', '.join(skills)}; {self.semantics.rate_hz:g} Hz; actions: {self.semantics.control} in "
                f"{self.semantics.frame}, {self.semantics.rotation}, gripper {self.semantics.gripper}."
            ),
        )


def select(bags: RunBags, selection: Selection) -> Selected:
    """Choose the bags to export.

    Raises:
        InvalidRequestError: On a camera that a bag does not have.
        RecorderError: ``EXPORT_REFUSED`` when bags are missing, none can be exported, or they do not fit together;
            ``BAG_DAMAGED`` naming a bag that cannot be read, or that holds another episode than it should.
    """
    if bags.missing and not selection.skip_missing:
        raise RecorderError(
            f"{bags.missing_text}; restore {'them' if len(bags.missing) > 1 else 'it'}, or export the others "
            "(--skip-missing or skip_missing=True)",
            ErrorCode.EXPORT_REFUSED,
        )
    sources: list[Source] = []
    left_out: dict[str, int] = {}
    for path in bags.paths:
        source = _source(path, bags)
        reason = _refusal(source.result, selection)
        if reason:
            left_out[reason] = left_out.get(reason, 0) + 1
        else:
            sources.append(source)
    for reason, count in (("no_bag", len(bags.missing)), ("no_result", len(bags.unexpected))):
        if count:
            left_out[reason] = count
    if not sources:
        raise RecorderError(
            f"none of the {len(bags.paths)} bags can be exported ({left_out}); record successful episodes, or ask for "
            "all",
            ErrorCode.EXPORT_REFUSED,
        )
    sources.sort(key=lambda s: (s.info.purpose, s.info.run_seed, s.info.index, s.info.attempt))
    keys = _keys(sources, selection)
    _require_one_robot(sources)
    return Selected(
        sources=tuple(sources),
        left_out=left_out,
        missing=bags.missing,
        unexpected=bags.unexpected,
        keys=keys,
        sizes=_sizes(sources, keys, selection),
        semantics=_semantics(sources),
        joint_names=_joint_names(sources[0]),
        vectors={"state": STATE_FIELDS, "joint_positions": (ProprioField.JOINT_POSITIONS,)},
    )


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
    return Source(path=path, info=info, result=result)


def _refusal(result: EpisodeResult, selection: Selection) -> str:
    """Return why an episode is left out; empty: it is not."""
    if selection.only_successful and result.outcome != "success":
        return result.reason or result.outcome
    if result.recovered and not selection.keep_recovered:
        return "recovered"
    return "" if result.steps else "no_action"


def _keys(sources: Sequence[Source], selection: Selection) -> dict[str, str]:
    """Return camera to image key; every bag must have the cameras."""
    first = [camera.name for camera in sources[0].info.scene.cameras]
    keys = selection.cameras or {name: USUAL_KEYS.get(name, name) for name in first}
    if len(set(keys.values())) < len(keys) or RESERVED & set(keys.values()):
        raise InvalidRequestError(
            f"every camera needs a unique image key other than {' and '.join(sorted(RESERVED))}; got {keys}"
        )
    for source in sources:
        have = [camera.name for camera in source.info.scene.cameras]
        for name in keys:
            if name not in have:
                raise InvalidRequestError(f"bag {source.path} has no camera '{name}'; {one_of(have, name)}")
    return dict(keys)


def _sizes(sources: Sequence[Source], keys: dict[str, str], selection: Selection) -> dict[str, ImageSize]:
    """Return camera to the size of its images in the export."""
    if selection.image_height:
        size = ImageSize(height=selection.image_height, width=selection.image_width)
        return dict.fromkeys(keys, size)
    sizes: dict[str, ImageSize] = {}
    for source in sources:
        for camera in source.info.scene.cameras:
            size = ImageSize(height=camera.height, width=camera.width)
            if camera.name in keys and sizes.setdefault(camera.name, size) != size:
                raise RecorderError(
                    f"bag {source.path}: camera '{camera.name}' has images of {size.width} x {size.height} px, earlier "
                    f"bags {sizes[camera.name].width} x {sizes[camera.name].height}; give image_height and image_width "
                    "to resize them all",
                    ErrorCode.EXPORT_REFUSED,
                )
    return {name: sizes[name] for name in keys}


def _semantics(sources: Sequence[Source]) -> ActionSemantics:
    semantics = sources[0].info.semantics
    for source in sources:
        if source.info.semantics != semantics:
            raise RecorderError(
                f"bag {source.path}: its actions mean something else than those of {sources[0].path} "
                f"({source.info.semantics} against {semantics}); export them apart",
                ErrorCode.EXPORT_REFUSED,
            )
    return semantics


def _joint_names(source: Source) -> tuple[str, ...]:
    first = next(iter(BagReader(source.path).ticks(cameras=[])))
    return first.state.robot.joint_names


def _require_one_robot(sources: Sequence[Source]) -> None:
    bags: dict[str, list[Path]] = {}
    for source in sources:
        bags.setdefault(source.info.scene.robot.model, []).append(source.path)
    if len(bags) > 1:
        counts = ", ".join(f"{len(paths)} of {robot} (e.g. {paths[0].name})" for robot, paths in sorted(bags.items()))
        raise RecorderError(
            f"the bags are of several robots: {counts}; export each from a separate folder",
            ErrorCode.EXPORT_REFUSED,
        )


def splits(count: int, fraction: float) -> list[str]:
    """Return ``train`` or ``val`` for each of ``count`` episodes, ``val`` spread evenly.

    If a positive fraction is wanted, ``val`` gets at least one of two or more episodes.
    """
    names = ["val" if int((i + 1) * fraction) > int(i * fraction) else "train" for i in range(count)]
    if fraction > 0 and count > 1 and "val" not in names:
        names[-1] = "val"
    return names


def by_split(sources: Sequence[Source], selection: Selection) -> dict[str, list[Source]]:
    """Return each split's bags, in order."""
    names = splits(len(sources), selection.val_fraction)
    return {split: [s for s, name in zip(sources, names, strict=True) if name == split] for split in SPLITS}
