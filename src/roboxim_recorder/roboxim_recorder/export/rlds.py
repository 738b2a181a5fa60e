"""Exports bags as an RLDS dataset, without TensorFlow; the files themselves are `roboxim_datasets.rlds.writer`'s.

A step pairs the observation of tick k with the action that leads to tick k + 1, as an imitator should output it
(``action_label``: without the noise that was injected). The ticks of settling at the end are not exported.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np

from roboxim_core.actions import ActionSemantics
from roboxim_core.config import digest as digest_of
from roboxim_core.config import to_json, to_plain
from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError, one_of
from roboxim_core.images import encode_image
from roboxim_core.proprioception import STATE_NAMES, Proprioception
from roboxim_datasets.rlds import RldsEpisode, RldsFeatures, RldsReader
from roboxim_datasets.rlds.format import MetaValue
from roboxim_datasets.rlds.loader_files import action_statistics, dead_dimensions, loader_files, statistics_of
from roboxim_datasets.rlds.writer import RldsWriter
from roboxim_recorder.bag import BagReader
from roboxim_recorder.bag_writer import disk_errors
from roboxim_recorder.run_bags import list_bags

Progress = Callable[[int, int], None]
EXPORT_FILE = "export.json"
USUAL_KEYS = {"workspace": "image", "wrist": "wrist_image"}
"""Camera to image key where the configuration names none; other cameras keep their name."""
SNAP = 1e-5
"""Smaller deltas [m or rad] become 0: normalised, the noise of a dead dimension would look like an action."""
METADATA = {
    "episode_id": "text",
    "file_path": "text",
    "run_seed": "int64",
    "index": "int64",
    "attempt": "int64",
    "skill": "text",
    "success": "bool",
    "actor": "text",
    "robot": "text",
    "action_semantics": "text",
    "cameras": "text",
    "state_layout": "text",
    "joint_names": "text",
    "task": "text",
}


@dataclass(frozen=True, kw_only=True)
class ExportConfig:
    """What an export holds."""

    name: str = "roboxim"
    """Name of the dataset, lower case with underscores; never one that loaders treat specially, as ``bridge_*``."""
    version: str = "1.0.0"
    """Version of the dataset."""
    cameras: dict[str, str] = field(default_factory=dict)
    """Camera to image key; empty: every camera, ``workspace`` as ``image`` and ``wrist`` as ``wrist_image``."""
    encoding: str = "jpeg"
    """``jpeg`` (quality 95) or ``png`` (lossless)."""
    image_height: int = 0
    """Height to resize images to [px]; 0: as recorded."""
    image_width: int = 0
    """Width to resize images to [px]; 0: as recorded."""
    val_fraction: float = 0.05
    """Part of the episodes that becomes the split ``val``, spread evenly; at least one where there are two."""
    only_successful: bool = True
    """Whether episodes that did not succeed are left out."""
    keep_recovered: bool = False
    """Whether episodes are exported in which the actor had to try again, e.g. needed a second grasp."""
    shard_mib: int = 128
    """Size of a shard [MiB]."""

    def __post_init__(self) -> None:
        """Check the ranges.

        Raises:
            InvalidRequestError: On a fraction or size out of range, or a name of another dataset's family.
        """
        if not 0.0 <= self.val_fraction < 1.0 or self.shard_mib < 1:
            raise InvalidRequestError("val_fraction must be in 0..1 (1 excluded) and shard_mib at least 1")
        if (self.image_height > 0) != (self.image_width > 0) or min(self.image_height, self.image_width) < 0:
            raise InvalidRequestError("give image_height and image_width both, or neither")
        if self.name.startswith("bridge"):
            raise InvalidRequestError("loaders rewrite the actions of datasets called bridge*; choose another name")


@dataclass(frozen=True, kw_only=True)
class ExportReport:
    """What was exported."""

    path: Path
    """The dataset, ``<target>/<name>/<version>``."""
    splits: dict[str, int]
    """Split to number of episodes."""
    steps: int
    """Steps in all."""
    left_out: dict[str, int]
    """Reason to number of bags that were not exported."""
    dead_dimensions: tuple[str, ...]
    """Components of the action that (nearly) never change; a policy cannot learn them."""
    resumed: int = 0
    """Episodes that an interrupted export had already."""


@dataclass(frozen=True, kw_only=True)
class _Source:
    """A bag that is exported, as far as it is known before its ticks are read."""

    path: Path
    info: EpisodeInfo
    result: EpisodeResult


def export_rlds(
    source: Path | str,
    target: Path | str,
    config: ExportConfig | None = None,
    *,
    if_exists: Literal["refuse", "overwrite", "keep"] = "refuse",
    progress: Progress = lambda done, total: None,
) -> ExportReport:
    """Export a run's folder, a folder of bags or one bag.

    An interrupted export goes on after its last finished shard; nothing carries the dataset's name before it is whole.
    Equal bags and configuration give equal bytes.

    Args:
        source: Where the bags are; set apart ones are not taken.
        target: Data directory to write ``<name>/<version>`` into.
        config: What to export; none: the defaults.
        if_exists: Whether an existing dataset is an error, is replaced when the new one is whole, or is left as it is
            when it is of the same bags and configuration (an error otherwise).
        progress: Called with the episodes done and their total.

    Raises:
        InvalidRequestError: On a name, camera or size that does not fit.
        RecorderError: ``EXPORT_REFUSED`` when there is nothing to export, when bags do not fit together or when the
            dataset exists; ``BAG_DAMAGED`` naming the bag; ``DISK`` when it cannot be written.
    """
    config = config or ExportConfig()
    bags = list_bags(source)
    sources, left_out = _select(bags, config)
    cameras = _cameras(sources, config)
    semantics = _semantics(sources)
    _require_one_robot(sources)
    identity = _identity(sources, config)
    path = Path(target) / config.name / config.version
    if if_exists == "keep" and _exported_identity(path) == identity:
        progress(len(sources), len(sources))
        return _report(path, sources, left_out, resumed=len(sources))
    features = RldsFeatures(
        images={cameras[name]: size for name, size in _sizes(sources, cameras, config).items()},
        encoding=config.encoding,
        metadata=METADATA,
        joints=_joint_count(sources[0]),
    )
    with disk_errors(path):
        writer = RldsWriter(
            Path(target),
            features,
            name=config.name,
            version=config.version,
            description=_describe(sources, semantics),
            identity=f"{identity} {digest_of(METADATA)}",
            overwrite=if_exists == "overwrite",
            shard_bytes=config.shard_mib << 20,
        )
        resumed = _write_episodes(writer, sources, cameras, config, progress)
        writer.finish_shards()
        statistics = statistics_of(writer.shard_files("train"), features)
        files = loader_files(config.name, config.version, features, semantics, statistics)
        files[EXPORT_FILE] = _as_json({"identity": identity, "config": to_plain(config), "left_out": left_out})
        writer.complete(files)
    return _report(path, sources, left_out, resumed=resumed)


def _select(bags: Sequence[Path], config: ExportConfig) -> tuple[list[_Source], dict[str, int]]:
    """Return the bags to export, sorted by index, and reason to number of those left out."""
    sources: list[_Source] = []
    left_out: dict[str, int] = {}
    for bag in bags:
        reader = BagReader(bag)
        result = reader.result
        reason = ""
        if config.only_successful and result.outcome != "success":
            reason = result.reason or result.outcome
        elif result.recovered and not config.keep_recovered:
            reason = "recovered"
        elif result.steps == 0:
            reason = "no_action"
        if reason:
            left_out[reason] = left_out.get(reason, 0) + 1
        else:
            sources.append(_Source(path=bag, info=reader.info, result=result))
    if not sources:
        raise RecorderError(
            f"none of the {len(bags)} bags can be exported ({left_out}); record successful episodes, or ask for all",
            ErrorCode.EXPORT_REFUSED,
        )
    sources.sort(key=lambda s: (s.info.purpose, s.info.run_seed, s.info.index, s.info.attempt))
    return sources, left_out


def _cameras(sources: Sequence[_Source], config: ExportConfig) -> dict[str, str]:
    """Return camera to image key; every bag must have the cameras."""
    first = [camera.name for camera in sources[0].info.scene.cameras]
    cameras = config.cameras or {name: USUAL_KEYS.get(name, name) for name in first}
    if len(set(cameras.values())) < len(cameras) or "state" in cameras.values():
        raise InvalidRequestError(f"every camera needs an image key of its own, none of them 'state'; got {cameras}")
    for source in sources:
        have = [camera.name for camera in source.info.scene.cameras]
        for name in cameras:
            if name not in have:
                raise InvalidRequestError(f"bag {source.path} has no camera '{name}'; {one_of(have, name)}")
    return cameras


def _sizes(sources: Sequence[_Source], cameras: dict[str, str], config: ExportConfig) -> dict[str, tuple[int, int]]:
    """Return camera to (height, width) in the export."""
    if config.image_height:
        return {name: (config.image_height, config.image_width) for name in cameras}
    sizes: dict[str, tuple[int, int]] = {}
    for source in sources:
        for camera in source.info.scene.cameras:
            size = camera.height, camera.width
            if camera.name in cameras and sizes.setdefault(camera.name, size) != size:
                raise RecorderError(
                    f"bag {source.path}: camera '{camera.name}' has {size} px (height, width), earlier bags "
                    f"{sizes[camera.name]}; give image_height and image_width to resize them all",
                    ErrorCode.EXPORT_REFUSED,
                )
    return sizes


def _semantics(sources: Sequence[_Source]) -> ActionSemantics:
    semantics = sources[0].info.semantics
    for source in sources:
        if source.info.semantics != semantics:
            raise RecorderError(
                f"bag {source.path}: its actions mean something else than those of {sources[0].path} "
                f"({source.info.semantics} against {semantics}); export them apart",
                ErrorCode.EXPORT_REFUSED,
            )
    return semantics


def _require_one_robot(sources: Sequence[_Source]) -> None:
    bags: dict[str, list[Path]] = {}
    for source in sources:
        bags.setdefault(source.info.scene.robot.model, []).append(source.path)
    if len(bags) > 1:
        counts = ", ".join(f"{len(paths)} of {robot} (e.g. {paths[0].name})" for robot, paths in sorted(bags.items()))
        raise RecorderError(
            f"the bags are of several robots: {counts}; export each from a folder of its own",
            ErrorCode.EXPORT_REFUSED,
        )


def _identity(sources: Sequence[_Source], config: ExportConfig) -> str:
    """Return a hash of everything that the exported bytes depend on."""
    digest = hashlib.blake2b(to_json(config).encode(), digest_size=16)
    for source in sources:
        result = source.result
        digest.update(f"{result.episode_id} {result.last_seq} {result.final_state_hash}\n".encode())
    return digest.hexdigest()


def _exported_identity(path: Path) -> str:
    try:
        return str(json.loads((path / EXPORT_FILE).read_text())["identity"])
    except (OSError, ValueError, KeyError):
        return ""


def _splits(count: int, fraction: float) -> list[str]:
    """Spread ``val`` evenly over the episodes; at least one where there are two and any is wanted."""
    names = ["val" if int((i + 1) * fraction) > int(i * fraction) else "train" for i in range(count)]
    if fraction > 0 and count > 1 and "val" not in names:
        names[-1] = "val"
    return names


def _write_episodes(
    writer: RldsWriter, sources: Sequence[_Source], cameras: dict[str, str], config: ExportConfig, progress: Progress
) -> int:
    """Add every episode that an interrupted export has not; return how many it had."""
    skip = {split: writer.resumed(split) for split in ("train", "val")}
    resumed = sum(skip.values())
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:  # encoders free the interpreter's lock
        for done, (source, split) in enumerate(
            zip(sources, _splits(len(sources), config.val_fraction), strict=True), start=1
        ):
            if skip[split]:
                skip[split] -= 1
            else:
                writer.add(split, _episode(source, cameras, config, pool))
            progress(done, len(sources))
    return resumed


def _episode(source: _Source, cameras: dict[str, str], config: ExportConfig, pool: ThreadPoolExecutor) -> RldsEpisode:
    size = (config.image_height, config.image_width) if config.image_height else None
    images: dict[str, list[Future[bytes]]] = {key: [] for key in cameras.values()}
    measured: list[Proprioception] = []
    actions = []
    base = source.info.scene.robot.pose
    for tick in BagReader(source.path).ticks(cameras=list(cameras)):
        if tick.step.phase == "act":
            actions.append(tick.step.action_label)
        if len(actions) == source.result.steps:
            break
        measured.append(Proprioception.of(tick.state, base))
        for name, key in cameras.items():
            images[key].append(pool.submit(encode_image, tick.images[name], config.encoding, size))
    if len(actions) != source.result.steps or len(measured) != len(actions):
        raise RecorderError(
            f"bag {source.path} has {len(actions)} actions, its result says {source.result.steps}; check it",
            ErrorCode.BAG_DAMAGED,
        )
    action = np.array(actions, np.float32)
    action[:, :6][np.abs(action[:, :6]) < SNAP] = 0.0
    reward = np.zeros(len(action), np.float32)
    reward[-1] = source.result.outcome == "success"
    return RldsEpisode(
        images={key: [future.result() for future in futures] for key, futures in images.items()},
        state=np.stack([proprio.vector() for proprio in measured]),
        joint_positions=np.array([proprio.joint_positions for proprio in measured], np.float32),
        action=action,
        instruction=source.info.task.instruction,
        reward=reward,
        metadata=_metadata(source, cameras, measured[0].joint_names),
    )


def _joint_count(source: _Source) -> int:
    first = next(iter(BagReader(source.path).ticks(cameras=[])))
    return len(first.state.robot.joint_names)


def _metadata(source: _Source, cameras: dict[str, str], joint_names: Sequence[str]) -> dict[str, MetaValue]:
    info = source.info
    return {
        "episode_id": info.episode_id,
        "file_path": f"{source.path.parent.name}/{source.path.name}",
        "run_seed": info.run_seed,
        "index": info.index,
        "attempt": info.attempt,
        "skill": info.task.skill,
        "success": source.result.outcome == "success",
        "actor": info.actor,
        "robot": info.scene.robot.model,
        "action_semantics": to_json(info.semantics),
        "cameras": json.dumps({key: name for name, key in cameras.items()}, sort_keys=True),
        "state_layout": json.dumps(STATE_NAMES),
        "joint_names": json.dumps(joint_names),
        "task": to_json(info.task),
    }


def _describe(sources: Sequence[_Source], semantics: ActionSemantics) -> str:
    skills = ", ".join(sorted({source.info.task.skill for source in sources}))
    robots = ", ".join(sorted({source.info.scene.robot.model for source in sources}))
    return (
        f"{len(sources)} simulated episodes recorded with RoboXim; robot: {robots}; skills: {skills}; "
        f"{semantics.rate_hz:g} Hz; actions: {semantics.control} in {semantics.frame}, {semantics.rotation}, "
        f"gripper {semantics.gripper}."
    )


def _as_json(data: Any) -> str:
    return json.dumps(data, indent=2, sort_keys=True) + "\n"


def _report(path: Path, sources: Sequence[_Source], left_out: dict[str, int], *, resumed: int) -> ExportReport:
    reader = RldsReader(path)
    statistics = action_statistics(path)
    return ExportReport(
        path=path,
        splits={split: sum(lengths) for split, lengths in reader.splits.items()},
        steps=sum(source.result.steps for source in sources),
        left_out=left_out,
        dead_dimensions=dead_dimensions(statistics),
        resumed=resumed,
    )
