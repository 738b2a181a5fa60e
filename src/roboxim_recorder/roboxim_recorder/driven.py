"""Episodes of a recording of a running graph (`roboxim bag record`), which has no task and no verdict.

Such a bag has the scene, a state for each tick and perhaps images. That suffices for an episode: the action of a tick
is the controller's command, i.e. the joints at its end and the opening. Whether a task was solved is unknown. A new
scene, a lost tick and a tick of another length end an episode; states without an episode are reported.

Messages are recorded in the order in which they arrive, which need not be the order in which they were sent. So a state
belongs to the scene whose hash it has, and to the images whose checksums the simulator's notice of its tick has.
"""

from __future__ import annotations

import zlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from roboxim_core.actions import ActionSemantics
from roboxim_core.config import digest
from roboxim_core.errors import ErrorCode, RecorderError
from roboxim_core.proprioception import STATE_FIELDS, Proprioception, ProprioField, component_names
from roboxim_core.specs import CameraSpec, SceneSpec
from roboxim_core.state import StateRecord
from roboxim_datasets.account import Account
from roboxim_datasets.dataset import Dataset, Description, Features
from roboxim_datasets.episode import Episode, ImageSize, Step, Wanted
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader
from roboxim_ros.messages.conversions import from_msg, image_from_msg, stamp_to_ns

SCENE = "/sim/scene"
"""Topic of the scene, latched."""
GRIPPER = "gripper.opening"
UNSURE = f"with images that may be of another scene: record {topics.NOTICE}, too"
FIELDS = (ProprioField.JOINT_POSITIONS, ProprioField.JOINT_VELOCITIES)
"""Observed vectors beside ``state``."""
ROUNDING_NS = 1
"""Largest difference between equal ticks [ns]: stamps are rounded, and a tick of 30 Hz has no whole number of them."""


@dataclass(frozen=True, kw_only=True)
class Stretch:
    """Successive ticks of one scene, of equal length."""

    scene: SceneSpec
    """The scene."""
    clock_epoch: int
    """Number of restarts of the simulated time before it."""
    states: tuple[StateRecord, ...]
    """The states."""

    @property
    def tick_ns(self) -> int:
        """Length of a tick [ns]."""
        return self.states[1].stamp_ns - self.states[0].stamp_ns

    @property
    def rate_hz(self) -> float:
        """Ticks per second: the scene's control rate, unless the ticks have another length."""
        return self.scene.control_rate_hz if _equal(self.tick_ns, self.scene.tick_ns) else 1e9 / self.tick_ns


def is_driven(path: Path) -> bool:
    """Return whether a path is a bag of a running graph that is not an episode.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when it is a bag that cannot be read.
    """
    if path.suffix != ".mcap" and not any(path.glob("*.mcap")):
        return False
    counts = BagReader(path).counts
    return not counts.get(topics.INFO) and bool(counts.get(topics.STATE))


class DrivenDataset(Dataset):
    """A recording of a running graph as a dataset of the split ``train``."""

    format = "driven bag"

    def __init__(self, path: Path, instruction: str) -> None:
        """Open a recording.

        Args:
            path: The bag.
            instruction: Instruction of its episodes.

        Raises:
            RecorderError: ``EXPORT_REFUSED``, naming what it lacks; ``BAG_DAMAGED`` when it cannot be read.
        """
        super().__init__(path)
        self._bag, self._instruction = BagReader(path), instruction
        for topic, what in ((topics.STATE, "states"), (SCENE, "scene")):
            if not self._bag.counts.get(topic):
                raise _refused(f"{path} has no {what}: record {topic}, too (without topics, bag record records all)")
        self._others: Counter[str] = Counter()
        found = list(self._stretches())
        longest = max(found, key=lambda one: len(one.states), default=None)
        self._kept = [one for one in found if longest is not None and self._like(one, longest)]
        if other := sum(len(one.states) for one in found if one not in self._kept):
            self._others["of another robot, rate or cameras than the longest episode"] = other
        if not self._kept:
            if UNSURE in self._others:
                raise _refused(f"{path} has {self._others[UNSURE]} states {UNSURE}")
            raise _refused(f"{path} has no two successive ticks of one scene: nothing moved while it was recorded")

    @property
    def splits(self) -> Mapping[str, int]:
        """Number of episodes; all are in ``train``."""
        return {"train": len(self._kept)}

    @cached_property
    def description(self) -> Description:
        """Content of its steps."""
        first = self._kept[0]
        joints = first.states[0].robot.joint_names
        sizes = {c.name: ImageSize(height=c.height, width=c.width) for c in self._cameras(first.scene)}
        vectors = {"state": component_names(STATE_FIELDS, joints)}
        vectors |= {str(field): component_names((field,), joints) for field in FIELDS}
        rate = first.rate_hz
        return Description(
            features=Features(
                cameras=sizes, keys={name: name for name in sizes}, lossless=True, action=(*joints, GRIPPER),
                vectors=vectors,
            ),
            fps=rate, robot=first.scene.robot.model, joint_names=joints, outcomes=False, metadata={},
            semantics=ActionSemantics(control="joint_position", rate_hz=rate),  # type: ignore[arg-type]
            text=f"{len(self._kept)} episodes of a running graph that somebody drove; actions are commanded joints.",
        )  # fmt: skip

    def read(self, split: str, index: int) -> Episode:
        """Return a stretch as an episode."""
        stretch = self._kept[index]

        def steps(wanted: Wanted) -> Iterator[Step]:
            images = self._images(stretch, wanted.cameras)
            for number, (observed, following) in enumerate(zip(stretch.states, stretch.states[1:], strict=False)):
                measured = Proprioception.of(observed, stretch.scene.robot.pose)
                yield Step(
                    index=number, images=next(images),
                    proprio={"state": measured.vector()} | {str(one): measured.vector((one,)) for one in FIELDS},
                    action=np.array([*following.robot.joint_commands, following.robot.gripper_command], np.float32),
                    stamp_s=observed.stamp_ns / 1e9,
                )  # fmt: skip

        return self.description.episode(
            length=len(stretch.states) - 1, instruction=self._instruction, success=None, metadata={}, read=steps,
            name=f"{self.path.stem}-{index}",
        )  # fmt: skip

    def _take_stock(self, account: Account) -> None:
        for topic, count in self._bag.counts.items():
            account.holds("key", topic, count)
        images = {topics.image_topic(name) for name in self.features.cameras}
        for topic in self._bag.counts:
            if topic == topics.STATE:
                kept = sum(len(one.states) for one in self._kept)
                account.reads("key", topic, kept)
                for why, count in self._others.items():
                    account.leaves_out("key", topic, why, count)
            elif topic == SCENE or topic in images:
                account.reads("key", topic)
            else:
                account.leaves_out("key", topic, "datasets have observations and actions only")

    # ------------------------------------------------------------------ content of the bag

    def _stretches(self) -> Iterator[Stretch]:
        """Yield the stretches of ticks with an action, and count the states that belong to none."""
        scenes = {digest(scene): scene for scene in self._scenes()}
        told = any(message.scene_hash in scenes for _, _, message in self._bag.messages((topics.STATE,)))
        newest: SceneSpec | None = None  # for states of versions without a hash, or with another one
        last: SceneSpec | None = None
        run: list[StateRecord] = []
        epochs, epoch = _Epochs(), 0
        for topic, _, message in self._bag.messages((SCENE, topics.STATE)):
            if topic == SCENE:
                newest = from_msg(message, SceneSpec)
                continue
            state = from_msg(message, StateRecord)
            scene = scenes.get(state.scene_hash) if told else newest
            clock_epoch = epochs.of(topic, state.stamp_ns)
            if run and (clock_epoch != epoch or scene != last or not _follows(run, state)):
                yield from self._closed(last, epoch, run)
                run = []
            run.append(state)
            epoch, last = clock_epoch, scene
        yield from self._closed(last, epoch, run)

    def _scenes(self) -> Iterator[SceneSpec]:
        return (from_msg(message, SceneSpec) for _, _, message in self._bag.messages((SCENE,)))

    def _closed(self, scene: SceneSpec | None, clock_epoch: int, run: Sequence[StateRecord]) -> Iterator[Stretch]:
        """Yield the parts of a run of states that have all images, which a busy machine may lose."""
        if scene is None:
            self._others["without their scene"] += len(run)
            return
        names = [topics.image_topic(camera.name) for camera in self._cameras(scene)]
        part: list[StateRecord] = []
        for state in (*run, None):
            keys = [] if state is None else [self._key(name, state, clock_epoch) for name in names]
            if state is not None and all(key in self._found[name] for name, key in zip(names, keys, strict=True)):
                part.append(state)
                continue
            if len(part) > 1:
                yield Stretch(scene=scene, clock_epoch=clock_epoch, states=tuple(part))
            elif part:
                self._others["alone: no tick follows"] += 1
            if state is not None:
                self._others[UNSURE if None in keys else "without an image of each camera"] += 1
            part = []

    def _cameras(self, scene: SceneSpec) -> list[CameraSpec]:
        """Return the cameras of a scene whose images were recorded."""
        return [camera for camera in scene.cameras if self._bag.counts.get(topics.image_topic(camera.name))]

    @cached_property
    def _found(self) -> dict[str, set[_Key]]:
        """Topic of images to the keys of those that were recorded."""
        names = [topic for topic, kind in self._bag.types.items() if kind == topics.IMAGE]
        found: dict[str, set[_Key]] = {name: set() for name in names}
        for topic, keys, _ in self._recorded(names):
            found[topic] |= set(keys)
        return found

    def _recorded(self, names: Sequence[str]) -> Iterator[tuple[str, tuple[_Key, _Key], Any]]:
        """Yield each image message with its topic and its two keys: by its time's era and by its checksum."""
        epochs = _Epochs()
        for topic, _, message in self._bag.messages(tuple(names)) if names else ():
            stamp = stamp_to_ns(message.header.stamp)
            yield topic, (("era", epochs.of(topic, stamp), stamp), ("crc", zlib.crc32(message.data), stamp)), message

    @cached_property
    def _checksums(self) -> dict[tuple[str, int, int], list[dict[str, int]]]:
        """Episode, tick and stamp [ns] to the checksums of the images, by topic, in each notice of such a tick."""
        found: dict[tuple[str, int, int], list[dict[str, int]]] = {}
        for _, _, notice in self._bag.messages((topics.NOTICE,)) if self._bag.counts.get(topics.NOTICE) else ():
            named = dict(zip(map(topics.absolute, notice.topics), map(int, notice.image_crc32), strict=False))
            found.setdefault((notice.episode_id, notice.seq, stamp_to_ns(notice.stamp)), []).append(named)
        return found

    @cached_property
    def _eras(self) -> dict[str, int]:
        """Topic of states or images to the restarts of its time."""
        names = {topic for topic, kind in self._bag.types.items() if kind == topics.IMAGE} | {topics.STATE}
        epochs, found = _Epochs(), dict.fromkeys(names, 0)
        for topic, _, message in self._bag.messages(tuple(names)):
            stamp_ns = message.stamp_ns if topic == topics.STATE else stamp_to_ns(message.header.stamp)
            found[topic] = epochs.of(topic, int(stamp_ns))
        return found

    def _key(self, topic: str, state: StateRecord, clock_epoch: int) -> _Key | None:
        """Return the key of a state's image: by its checksum, or by its era if notices do not tell.

        None: the time of the images restarted less or more often than that of the states, so that eras do not tell.
        """
        notices = self._checksums.get((state.episode_id, state.seq, state.stamp_ns), ())
        told = {notice.get(topic, 0) for notice in notices} - {0}
        if len(told) == 1:
            return "crc", told.pop(), state.stamp_ns
        return ("era", clock_epoch, state.stamp_ns) if self._eras[topic] == self._eras[topics.STATE] else None

    def _like(self, one: Stretch, other: Stretch) -> bool:
        """Return whether two stretches fit into one dataset."""
        first, second = (
            (of.scene.robot.model, [(c.name, c.width, c.height) for c in self._cameras(of.scene)])
            for of in (one, other)
        )
        return first == second and _equal(one.tick_ns, other.tick_ns)

    def _images(self, stretch: Stretch, cameras: Sequence[str]) -> Iterator[dict[str, Any]]:
        """Yield the images of each state of a stretch, by camera."""
        names = {topics.image_topic(camera): camera for camera in cameras}
        if not names:
            yield from ({} for _ in stretch.states)
            return
        wanted: dict[tuple[str, _Key | None], list[int]] = {}
        for number, state in enumerate(stretch.states):
            for topic in names:
                wanted.setdefault((topic, self._key(topic, state, stretch.clock_epoch)), []).append(number)
        found: dict[int, dict[str, Any]] = {number: {} for number in range(len(stretch.states))}
        at = 0
        for topic, keys, message in self._recorded(tuple(names)):
            for number in (number for key in keys for number in wanted.pop((topic, key), ())):
                found[number][names[topic]] = image_from_msg(message)
            while len(found[at]) == len(names):
                yield found.pop(at)
                at += 1
                if at == len(stretch.states):
                    return


_Key = tuple[str, int, int]
"""``era`` or ``crc``, its value, and the stamp [ns]."""


class _Epochs:
    """Counts the restarts of each topic's time, because stamps alone do not distinguish two scenes."""

    def __init__(self) -> None:
        self._last: dict[str, tuple[int, int]] = {}

    def of(self, topic: str, stamp_ns: int) -> int:
        """Return the era of a topic's next message."""
        clock_epoch, last = self._last.get(topic, (0, -1))
        clock_epoch += stamp_ns <= last
        self._last[topic] = clock_epoch, stamp_ns
        return clock_epoch


def _follows(run: Sequence[StateRecord], state: StateRecord) -> bool:
    """Return whether a state is the tick after a run's last one, of the same scene and the same length."""
    last = run[-1]
    if state.seq != last.seq + 1 or state.scene_hash != last.scene_hash or state.stamp_ns <= last.stamp_ns:
        return False
    return len(run) < 2 or _equal(state.stamp_ns - last.stamp_ns, run[1].stamp_ns - run[0].stamp_ns)


def _equal(tick_ns: int, other_ns: int) -> bool:
    """Return whether two ticks have the same length."""
    return abs(tick_ns - other_ns) <= ROUNDING_NS


def _refused(message: str) -> RecorderError:
    return RecorderError(message, ErrorCode.EXPORT_REFUSED)
