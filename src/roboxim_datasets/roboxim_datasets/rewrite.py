"""Writes a dataset from the episodes of others: in another format, several as one, or with other splits.

The sources are only read. The result is atomic and resumable, as every writer is: it gets its final name only when it
is complete, and the same call continues an interrupted one.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

from roboxim_core.config import from_plain, to_plain
from roboxim_core.config import to_json as config_json
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, RecorderError, printable
from roboxim_core.plain_data.documents import read_json_object, read_text
from roboxim_core.shards import Shard
from roboxim_datasets.account import Part, Treatment, to_json
from roboxim_datasets.build import only_build
from roboxim_datasets.card import card_path, write_card
from roboxim_datasets.dataset import CONVENTION_FILE, EXPORT_FILE, Dataset, Description, in_order
from roboxim_datasets.episode import OWN_FIELDS, Episode, MetaValue, Step, Wanted
from roboxim_datasets.files import file_in, has_file, reading
from roboxim_datasets.plans import Plan
from roboxim_datasets.registry import FORMATS
from roboxim_datasets.rlds.episodes import USUAL_KEYS

_NAME = re.compile(r"[^./\\][^/\\]{0,99}")
_COUNTED = re.compile(r"(?:simulated )?episodes\b")
_COUNT = re.compile(rf"^\d+ (?={_COUNTED.pattern})")
Progress = Callable[[int, int], None]


@dataclass(frozen=True, kw_only=True)
class Written:
    """A dataset that was written."""

    path: Path
    """The dataset."""
    splits: dict[str, int]
    """Split to number of episodes."""
    resumed: int
    """Episodes that an interrupted call had already written; all of them if the dataset was there."""
    left_out: tuple[Part, ...] = ()
    """What the sources have and the dataset does not."""
    changed: tuple[Part, ...] = ()
    """What was read of the sources but not bit for bit."""


def options_like(dataset: Dataset) -> Any:
    """Return options that write a dataset like another one of the format: as its files show them, or as it says."""
    kind = FORMATS[dataset.format]().options
    facts = dataset.facts
    options = {**facts.get("config", {}), **facts.get("options", {}), **dataset.options}
    names = {item.name for item in fields(kind)}
    return from_plain(
        {key: options[key] for key in names & options.keys()}, kind, source=f"{dataset.path}/{EXPORT_FILE}"
    )


def write_dataset(
    plan: Plan,
    target: Path,
    format: str,
    options: Any = None,
    *,
    how: str,
    keep_keys: bool = False,
    fps: float = 0.0,
    where: Sequence[str] = (),
    overwrite: bool = False,
    progress: Progress = lambda done, total: None,
) -> Written:
    """Write a dataset from episodes of others.

    Args:
        plan: What it consists of.
        target: Folder to write into.
        format: Registered name of the format.
        options: Options of the format; None: the defaults.
        how: How it is made, e.g. ``convert``, for ``export.json``.
        keep_keys: Whether the images keep the keys that they have in the first dataset, which is of the same format.
        fps: Steps per second of sources that do not say it; 0: unknown.
        where: Conditions and edits by which the plan was made, for ``export.json``.
        overwrite: Whether an existing dataset is replaced when the new one is whole.
        progress: Called with the episodes done and their total.

    Raises:
        ConfigError: On an unknown format.
        InvalidRequestError: When the format does not hold what the episodes have.
        RecorderError: ``EXPORT_REFUSED`` when the sources do not fit together, an episode occurs twice, the target lies
            in a source or is another dataset; ``BAG_DAMAGED`` when a source cannot be read.
    """
    made = FORMATS[format]()
    settings = options if options is not None else made.options()
    sources = list(dict.fromkeys(place.dataset for places in plan.values() for place in places))
    if not sources:
        raise RecorderError("there are no episodes to write", ErrorCode.EXPORT_REFUSED)
    path = made.path(target, settings)
    _require_outside(path, sources)
    description = stated_rate(common_description(sources, keep_keys=keep_keys), fps, sources)
    metadata, partial = _metadata_of(plan)
    description = replace(description, metadata=metadata, text=_text(sources, sum(map(len, plan.values()))))
    if any(place.changed and place.read().success is None for places in plan.values() for place in places):
        description = replace(description, outcomes=False)
    _require_names(description, plan)
    left_out = [part for source in sources for part in source.account.left_out]
    changed = tuple(part for source in sources for part in source.account.changed)
    if not getattr(made, "own_metadata", True):
        left_out += partial
    if not getattr(made, "maps", True):
        description, more = _without_maps(description, plan, format)
        left_out += more
    elif (why := getattr(made, "rounds_depth", "")) and not all(s.format == format and s.facts for s in sources):
        changed += tuple(_parts([f"depth of camera {name}" for name in description.features.depth], plan, "read", why))
    identity = _identity(plan, sources, format, settings, fps)
    splits = {split: len(places) for split, places in plan.items() if places}
    written = Written(path=path, splits=splits, resumed=sum(splits.values()), left_out=tuple(left_out), changed=changed)
    copied = format if getattr(made, "copies_images", False) else ""
    if not overwrite and _identity_of(path) == identity:
        there = made.open(path)
        if not card_path(path).is_file():  # the call that wrote it was interrupted
            write_card(there)
        return replace(written, changed=changed + _compressed(there, plan, copied))
    edits = [to_plain(place.changed) for places in plan.values() for place in places if place.changed]
    further: dict[str, list[Any]] = {"where": list(where), "edits": edits, "not_read": to_json(left_out)}
    files = files_beside(
        sources, format=format, how=how, options=settings, identity=identity,
        **{name: fact for name, fact in further.items() if fact},
    )  # fmt: skip
    with (
        only_build(path),
        made.create(target, description, settings, identity=identity, overwrite=overwrite) as writer,
    ):
        order = in_order(splits)
        skip = {split: writer.resumed(split) for split in order}
        done = resumed = sum(skip.values())
        seen: dict[str, Dataset] = {}
        for split in order:
            for number, place in enumerate(plan[split]):
                where = f"{place.dataset.path}, {place.split}[{place.index}]"
                with reading(where):
                    episode = place.read()
                episode = replace(episode, fps=episode.fps or description.fps)
                _require_new(episode.episode_id, seen, place.dataset)
                if number >= skip[split]:
                    writer.add(split, _checked(episode, where))
                    done += 1
                    progress(done, sum(splits.values()))
        writer.complete(files)
    there = made.open(path)
    write_card(there)
    return replace(written, resumed=resumed, changed=changed + _compressed(there, plan, copied))


def stated_rate(description: Description, fps: float, sources: Sequence[Dataset]) -> Description:
    """Return a description with the rate that the caller states, where the sources state none.

    Raises:
        InvalidRequestError: When the sources state another one, or it is none.
    """
    if not fps:
        return description
    if not (math.isfinite(fps) and fps > 0):
        raise InvalidRequestError(f"fps must be a number of steps per second above 0, got {fps:g}")
    if description.fps and description.fps != fps:
        raise InvalidRequestError(
            f"{sources[0].path} says that it has {description.fps:g} steps per second, not {fps:g}; leave --fps out"
        )
    return replace(description, fps=fps)


def _require_names(description: Description, plan: Plan) -> None:
    """Refuse names that cannot be parts of file names and keys: they come from whoever made the sources.

    Raises:
        RecorderError: ``EXPORT_REFUSED``, naming the first one.
    """
    features = description.features
    names = [*plan, *features.cameras, *features.vectors, *features.signals]
    wrong = [name for name in names if not (_NAME.fullmatch(name) and name.isprintable())]
    if wrong:
        raise RecorderError(
            f"'{printable(wrong[0], 120)}' cannot be the name of a split, camera or vector of a new dataset: expected "
            "1 to 100 printable characters without slash or leading dot; rename it in the source",
            ErrorCode.EXPORT_REFUSED,
        )


def _without_maps(description: Description, plan: Plan, format: str) -> tuple[Description, list[Part]]:
    """Return a description without images of depth and segmentation, and these as parts that are left out."""
    features = description.features
    names = [f"depth of camera {camera}" for camera in features.depth]
    names += [f"segmentation of camera {camera}" for camera in features.segmentation]
    lost = _parts(names, plan, "left out", f"{format} holds colour images only")
    return replace(description, features=replace(features, depth=(), segmentation=())), lost


def _compressed(written: Dataset, plan: Plan, copied: str) -> tuple[Part, ...]:
    """Return the images that lost a little.

    Args:
        written: The dataset that was written.
        plan: Its episodes.
        copied: Format whose compressed images were copied; empty: none.
    """
    if written.description.features.lossless:
        return ()

    def loses(source: Dataset) -> bool:
        return source.description.features.lossless or source.format != copied

    anew = {split: [place for place in places if loses(place.dataset)] for split, places in plan.items()}
    names = (
        [f"images of camera {camera}" for camera in written.description.features.cameras] if any(anew.values()) else []
    )
    return tuple(_parts(names, anew, "read", "compressed anew with a small loss"))


def _parts(names: Sequence[str], plan: Plan, treatment: Treatment, why: str) -> list[Part]:
    """Return parts of all frames of a plan."""
    if not names:
        return []
    frames = sum(p.dataset.read(p.split, p.index).length for places in plan.values() for p in places)
    return [Part(kind="key", name=name, count=frames, treatment=treatment, why=why) for name in names]


def _checked(episode: Episode, where: str) -> Episode:
    """Return an episode that names itself when it cannot be read or a number in it is not finite."""
    read = episode.read

    def steps(wanted: Wanted) -> Iterator[Step]:
        with reading(where):
            for step in read(wanted):
                numbers: dict[str, Any] = {
                    "the action": step.action,
                    "the reward": step.reward,
                    **step.proprio,
                    **step.signals,
                }
                if step.action_executed is not None:
                    numbers["the executed action"] = step.action_executed
                for name, values in numbers.items():
                    if not np.isfinite(values).all():
                        raise RecorderError(
                            f"{where} '{episode.episode_id}': {name} is not a finite number at step {step.index}, got "
                            f"{np.asarray(values).tolist()}; correct the episode or leave it out of the source",
                            ErrorCode.BAG_DAMAGED,
                        )
                yield step

    return replace(episode, read=steps)


def files_beside(
    sources: Sequence[Dataset], *, format: str, how: str, options: Any, identity: str = "", **facts: Any
) -> dict[str, str | bytes]:
    """Return the files beside a dataset that was made from others: how it was made, and its convention if it has one.

    Args:
        sources: The others.
        format: Registered name of the new dataset's format.
        how: How it is made, e.g. ``convert``.
        options: Options of the format.
        identity: Distinguishes this content from others.
        facts: Further facts.

    Raises:
        RecorderError: ``EXPORT_REFUSED`` when the sources have different conventions.
    """
    listed_facts = {
        "format": format,
        "identity": identity,
        "how": how,
        "options": to_plain(options),
        "sources": [{"format": source.format, "name": _name(source), **source.facts} for source in sources],
        **facts,
    }
    files: dict[str, str | bytes] = {EXPORT_FILE: json.dumps(listed_facts, indent=2, sort_keys=True) + "\n"}
    if convention := _common_convention(sources):
        files[CONVENTION_FILE] = convention
    return files


def common_description(sources: Sequence[Dataset], *, keep_keys: bool = False) -> Description:
    """Return the description of datasets that fit together.

    Args:
        sources: The datasets.
        keep_keys: Whether the images keep the keys that they have in the first dataset; otherwise they get keys that
            every format can hold.

    Raises:
        RecorderError: ``EXPORT_REFUSED``, naming what differs.
    """
    first = sources[0].description
    for source in sources[1:]:
        other = source.description
        pairs = {
            "cameras": (first.features.cameras, other.features.cameras),
            "action": (first.features.action, other.features.action),
            "depth images": (tuple(sorted(first.features.depth)), tuple(sorted(other.features.depth))),
            "segmentation images": (
                tuple(sorted(first.features.segmentation)),
                tuple(sorted(other.features.segmentation)),
            ),
            "vectors": (first.features.vectors, other.features.vectors),
            "signals": (first.features.signals, other.features.signals),
            "steps per second": (first.fps, other.fps),
            "robot": (first.robot, other.robot),
            "joints": (first.joint_names, other.joint_names),
            "meaning of the actions": (first.semantics, other.semantics),
        }
        for what, (left, right) in pairs.items():
            if left != right:
                raise RecorderError(
                    f"{sources[0].path} and {source.path} do not fit together: {what}: {left} against {right}; only "
                    "datasets with equal ones can be one (of RoboXim's bags: export them with the same options)",
                    ErrorCode.EXPORT_REFUSED,
                )
    keys = dict(first.features.keys)
    if not keep_keys:
        keys = {camera: _neutral(camera, key) for camera, key in keys.items()}
        if len(set(keys.values())) < len(keys):
            keys = {camera: re.sub(r"[./]", "_", camera) for camera in keys}
    outcomes = all(source.description.outcomes for source in sources)
    subtasks = any(source.features.subtasks for source in sources)
    features = replace(first.features, keys=keys, subtasks=subtasks)
    return replace(first, features=features, outcomes=outcomes)


def _text(sources: Sequence[Dataset], episodes: int) -> str:
    """Return the description of a dataset that has some episodes of others: theirs, with its own number of episodes."""
    about = sources[0].description
    rate = f"{about.fps:g} Hz" if about.fps else "rate not stated"
    stated = [source.description.text for source in sources if source.description.text]
    texts = list(dict.fromkeys(_COUNT.sub("", text) for text in stated))
    texts = texts or [f"episodes; robot: {about.robot or 'not stated'}; {rate}."]
    if len(texts) > 1:
        return " ".join([f"{episodes} episodes.", *texts])
    return f"{episodes} {texts[0]}" if _COUNTED.match(texts[0]) else texts[0]


def require_all_shards(sources: Sequence[Dataset]) -> None:
    """Refuse datasets that are shards of an export (``--shard``), but not all of them.

    Raises:
        RecorderError: ``EXPORT_REFUSED``, naming those that are missing.
    """
    given: dict[str, Counter[Shard]] = {}
    for source in sources:
        for export, shard in _shards(source.facts):
            given.setdefault(export, Counter())[shard] += 1
    for shards in given.values():
        count = next(iter(shards)).count
        every = [Shard(number=number, count=count) for number in range(1, count + 1)]
        missing = [str(shard) for shard in every if shards[shard] < max(shards.values())]
        if missing:
            shown = ", ".join(missing[:5]) + (", ..." if len(missing) > 5 else "")
            raise RecorderError(
                f"the datasets are shards of an export, of which {shown} {'are' if missing[1:] else 'is'} missing; "
                "merge all of them, or those that there are (--partial or partial=True)",
                ErrorCode.EXPORT_REFUSED,
            )


def _shards(facts: Mapping[str, Any]) -> Iterator[tuple[str, Shard]]:
    """Yield the shards that a dataset consists of, each with the settings of its export and the number of shards."""
    config = facts.get("config")
    if isinstance(config, Mapping) and config.get("shard"):
        shard = Shard.parse(str(config["shard"]))
        yield json.dumps([{**config, "shard": shard.count}, facts.get("format")], sort_keys=True), shard
    if facts.get("how") in ("convert", "merge"):
        for source in facts.get("sources", ()):
            yield from _shards(source)


def _neutral(camera: str, key: str) -> str:
    """Return an image key that every format can hold, without what a format puts around it."""
    last = re.split(r"[./]", key)[-1]
    return USUAL_KEYS.get(camera, last) if last in (camera, f"{camera}_image", f"{camera}_rgb") else last


def _metadata_of(plan: Plan) -> tuple[dict[str, type[MetaValue]], list[Part]]:
    """Return the metadata that every episode has in one type, key to type, and the others as parts."""
    kinds: dict[str, Counter[type]] = {}
    for place in (place for places in plan.values() for place in places):
        for key, value in place.read().metadata.items():
            if key not in OWN_FIELDS:
                kinds.setdefault(key, Counter())[type(value)] += 1
    total = sum(map(len, plan.values()))
    common = {key: next(iter(of)) for key, of in kinds.items() if list(of.values()) == [total]}
    found = {key: kind for key, kind in common.items() if kind in get_args(MetaValue)}
    why = "only metadata that every episode has, as text, number or truth value of one type, are written"
    left = {key: of.total() for key, of in kinds.items() if key not in found}
    return found, [Part(kind="metadata", name=k, count=n, treatment="left out", why=why) for k, n in left.items()]


def _common_convention(sources: Sequence[Dataset]) -> str:
    """Return the text of the convention beside the sources; empty: there is none.

    Raises:
        RecorderError: ``EXPORT_REFUSED`` when they have different ones.
    """
    folders = [source.folder for source in sources]
    texts = [read_text(file_in(at, CONVENTION_FILE)) if has_file(at, CONVENTION_FILE) else "" for at in folders]
    for source, text in zip(sources, texts, strict=True):
        if text != texts[0]:
            raise RecorderError(
                f"{sources[0].path} and {source.path} were exported by different conventions ({CONVENTION_FILE}); "
                "export the bags again by one of them",
                ErrorCode.EXPORT_REFUSED,
            )
    return texts[0]


def _require_outside(path: Path, sources: Sequence[Dataset]) -> None:
    """Refuse to write into a source, or over it."""
    place = path.resolve()
    for source in sources:
        at = source.path.resolve()
        if place == at or at in place.parents or place in at.parents:
            raise RecorderError(
                f"{path} is, or lies in, the source {source.path}; choose another", ErrorCode.EXPORT_REFUSED
            )


def _require_new(episode_id: str, seen: dict[str, Dataset], dataset: Dataset) -> None:
    """Refuse an episode of RoboXim's that another source has too: datasets of one run overlap.

    Others number episodes as they like, from 0 in every source file for example, so their ids may repeat.
    """
    other = seen.setdefault(episode_id, dataset)
    own = "-" in episode_id and bool(dataset.facts) and bool(other.facts)
    if own and other is not dataset:
        raise RecorderError(
            f"{dataset.path}: episode '{episode_id}' occurs twice; datasets of one run overlap, merge others",
            ErrorCode.EXPORT_REFUSED,
        )


def _identity(plan: Plan, sources: Sequence[Dataset], format: str, options: Any, fps: float) -> str:
    """Return a hash of everything that the written bytes depend on."""
    found = hashlib.blake2b(f"{format} {config_json(options)}{f' {fps}' if fps else ''}".encode(), digest_size=16)
    numbers = {source: number for number, source in enumerate(sources)}
    for source in sources:
        found.update(fingerprint(source).encode())
    for split, places in plan.items():
        found.update(
            f"{split} {[(numbers[p.dataset], p.split, p.index, *filter(None, [p.changed])) for p in places]}".encode()
        )
    return found.hexdigest()


def fingerprint(dataset: Dataset) -> str:
    """Return a hash of a dataset's files: their names, sizes and times."""
    files = [dataset.path] if dataset.path.is_file() else sorted(p for p in dataset.path.rglob("*") if p.is_file())
    found = hashlib.blake2b(f"{dataset.depth_unit_m}".encode() if dataset.depth_unit_m else b"", digest_size=16)
    for file in files:
        about = file.stat()
        found.update(f"{file.relative_to(dataset.folder)} {about.st_size} {about.st_mtime_ns}\n".encode())
    return found.hexdigest()


def _identity_of(path: Path) -> str:
    folder = path if path.is_dir() else path.parent
    try:
        return str(read_json_object(folder / EXPORT_FILE).get("identity", ""))
    except ConfigError:
        return ""


def _name(dataset: Dataset) -> str:
    """Return a name of a dataset without the path of this machine."""
    return dataset.path.parent.name if dataset.format == "rlds" else dataset.path.name
