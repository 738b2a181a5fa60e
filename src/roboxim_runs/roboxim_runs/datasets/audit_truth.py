"""Ground truth of recorded episodes for an audit: the judge, the renderer and the simulator on a bag's states.

`roboxim_datasets.audit` decides what is a fault; this module only measures.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from roboxim_core.actions import ActionSemantics
from roboxim_core.episode import EpisodeInfo, EpisodeResult
from roboxim_core.errors import ConfigError, RoboximError
from roboxim_core.kinematics import Arms
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses, drawn_entities
from roboxim_core.plain_data.documents import parse_json
from roboxim_core.specs import PhysicalObject, SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_core.verdicts import Verdict
from roboxim_datasets.audit import Approach, ColorPair, Meaning, Sighting, Touch, Truth
from roboxim_datasets.audit.color import palette_difference
from roboxim_datasets.episode import Episode
from roboxim_recorder.bag import BagReader, BagTick
from roboxim_tasks.judging import Judge
from roboxim_tasks.meaning import Reading, asks_for_same, read_instruction
from roboxim_tasks.roles import description, task_objects
from roboxim_tasks.sampling.visible import SIZE_PX, SegmentationPort, Visibility

ROBOT, TABLE = "robot", "table"
SIDE_PX = 256
"""Side of the image that numbers of pixels are given for [px]."""
LOOKS = 8
"""Ticks before the first touch at which visibility is measured, besides tick 0."""
MIN_PIXELS = 50
"""Fewest pixels of an object from which its colour is taken."""
SAME_SIZE = 1.1
"""Largest ratio of two objects' sizes at which their size does not distinguish them."""


class ReplayPort(Protocol):
    """A simulator that executes actions; `roboxim_sim.world.World` implements it."""

    def load(self, scene: SceneSpec, episode_id: str = "", semantics: ActionSemantics | None = None) -> StateRecord:
        """Rebuild the world for actions of a meaning: tick 0."""
        ...

    def tick(self, seq: int, action: npt.ArrayLike, *, episode_id: str | None = None) -> StateRecord:
        """Execute an action."""
        ...

    def release(self, episode_id: str = "") -> None:
        """Give the lease back."""
        ...


@dataclass(frozen=True, kw_only=True, eq=False)
class TruthPorts:
    """What the measurements use."""

    library: ModelLibrary
    """The models."""
    segmentation: SegmentationPort | None = None
    """The renderer of segmentation images; none: visibility and colours are not measured."""
    sim: ReplayPort | None = None
    """The simulator; none: actions are not executed again."""
    arms: Arms
    """Kinematics by robot."""


class BagTruth:
    """Ground truth of one bag."""

    def __init__(self, bag: Path, ports: TruthPorts, dataset_episode: Episode | None = None) -> None:
        """Read a bag's states.

        Args:
            bag: The bag.
            ports: Renderer and simulator.
            dataset_episode: The episode of a dataset that was made from the bag: its instruction is judged and its
                executed actions are replayed. None: the bag's.

        Raises:
            RecorderError: When the bag is damaged.
        """
        self._reader, self._ports = BagReader(bag), ports
        self.info: EpisodeInfo = self._reader.info
        self.result: EpisodeResult = self._reader.result
        self._instruction = dataset_episode.instruction if dataset_episode else self.info.task.instruction
        self._episode = dataset_episode
        self._ticks: list[BagTick] = list(self._reader.ticks(cameras=()))
        self._acting = [tick for tick in self._ticks if tick.step.phase != "settle"][: self.result.steps + 1]

    @property
    def steps(self) -> int:
        """Number of steps that are trained on."""
        return len(self._acting) - 1

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Arm joints of the robot, in the order of their positions."""
        return self._ticks[0].state.robot.joint_names

    def measure(self) -> Truth:
        """Measure everything that the ports allow.

        Raises:
            RoboximError: When the scene cannot be drawn, or the bag is damaged.
        """
        return Truth(
            solved=tuple(verdict.success for verdict in self._verdicts(self.info.task)),
            approaches=tuple(self._approaches()),
            meaning=self._meaning(),
            sightings=self._sightings(self._first_touch),
            pairs=self._pairs(),
            touches=tuple(self._touches()),
            replay_error_m=self._replay(),
        )

    # ------------------------------------------------------------------ judge

    def _verdicts(self, task: TaskSpec) -> list[Verdict]:
        judge = Judge(task)
        states = [tick.state for tick in self._ticks]
        return [judge.start(states[0]), *(judge.step(state) for state in states[1:])]

    def _meaning(self) -> Meaning | None:
        recorded, library = self.info.task, self._ports.library
        found = read_instruction(self._instruction, self.info.scene, library, self._templates)
        if recorded.step_words and self._instruction.lower() == recorded.instruction.lower():
            found = Reading(understood=True, tasks=(recorded,))  # its sentence may be one of its own, of all objects
        if not found.understood:
            return None
        tasks = [recorded if asks_for_same(task, recorded) else task for task in found.tasks]
        if any(any(verdict.success for verdict in self._verdicts(task)) for task in tasks):
            return Meaning(ever=True)
        facts = [f"the scene has no {thing}" for thing in found.absent]
        for thing in dict.fromkeys(thing for task in tasks for thing in task_objects(task)):
            facts.append(f"the hand stays {100 * self._nearest(thing):.0f} cm from the {description(thing)}")
        if not any(asks_for_same(task, recorded) for task in tasks):
            things = ", ".join(description(thing) for thing in task_objects(recorded))
            solved = "solved" if any(v.success for v in self._verdicts(recorded)) else "not solved either"
            facts.append(f"the recorded task, {recorded.skill} ({things}), is {solved}")
        return Meaning(ever=False, detail="; ".join(facts))

    @property
    def _templates(self) -> dict[str, list[str]]:
        """Templates of the task's configuration, which may be a user's."""
        try:
            task: Any = parse_json(self.info.config_json, source="config_json").get("task") or {}
            return {str(task["skill"]): [str(text) for text in task["templates"]["values"]]}
        except (ConfigError, KeyError, TypeError, AttributeError):
            return {}

    def _nearest(self, thing: PhysicalObject) -> float:
        pairs = ((t.state.robot.pose_tcp_measured, t.state.entity(thing.entity).pose) for t in self._acting)
        return min(math.dist(tcp.position, pose.position) for tcp, pose in pairs)

    # ------------------------------------------------------------------ motion and contacts

    @cached_property
    def _touching(self) -> npt.NDArray[np.bool_]:
        """Whether the robot touches an object of the task at each tick."""
        named = {thing.entity for thing in task_objects(self.info.task)}
        return np.array(
            [any({c.body_a, c.body_b} - {ROBOT} <= named and ROBOT in (c.body_a, c.body_b) for c in t.state.contacts)
             for t in self._acting]
        )  # fmt: skip

    @property
    def _first_touch(self) -> int | None:
        return int(self._touching.argmax()) if self._touching.any() else None

    def _touched(self, tick: int) -> set[str]:
        """Return the objects that the robot touches at a tick."""
        contacts = self._acting[tick].state.contacts
        return {body for c in contacts if ROBOT in (c.body_a, c.body_b) for body in (c.body_a, c.body_b)} - {ROBOT}

    def _approaches(self) -> Iterator[Approach]:
        """Describe, for each step of the task, the way to its longest touch: a miss touches the object for less long.

        A step begins when the hand has let go of what the step before was about.
        """
        numbers = np.array([tick.step.verdict.step for tick in self._acting])
        for number in dict.fromkeys(numbers.tolist()):
            here = np.flatnonzero(numbers == number)
            begin, end = int(here[0]), int(here[-1]) + 1
            free = np.flatnonzero(~self._touching[begin:end])
            begin += int(free[0]) if len(free) else 0
            if self._touching[begin:end].any():
                yield self._approach(begin, end)

    def _approach(self, begin: int, end: int) -> Approach:
        edges = np.flatnonzero(np.diff(np.r_[0, self._touching[begin:end].astype(int), 0]))
        start, _ = max(zip(edges[::2], edges[1::2], strict=True), key=lambda run: run[1] - run[0])
        tcp = np.array([t.state.robot.pose_tcp_measured.position for t in self._acting[begin : begin + start + 1]])
        command = np.array([t.state.robot.gripper_command for t in self._acting[begin:end]])
        return Approach(
            begin=begin,
            distance_m=tuple(np.linalg.norm(tcp - tcp[-1], axis=1).tolist()),
            path_m=float(np.linalg.norm(np.diff(tcp, axis=0), axis=1).sum()),
            closings=int(((command[1:] < 0.5) & (command[:-1] >= 0.5)).sum()),
            recovered=self.result.recovered,
        )

    def _touches(self) -> Iterator[Touch]:
        named = {thing.entity for thing in task_objects(self.info.task)}
        for tick in self._acting:
            for contact in tick.state.contacts:
                bodies = {contact.body_a, contact.body_b}
                if ROBOT in bodies and not bodies & named and contact.force_max > 0:
                    text = f"{ROBOT} and {(bodies - {ROBOT} or {ROBOT}).pop()}"
                    yield Touch(tick=tick.seq, bodies=text, force_n=contact.force_max)

    # ------------------------------------------------------------------ renderer

    def _sightings(self, touch: int | None) -> tuple[Sighting, ...] | None:
        if self._ports.segmentation is None:
            return None
        last = len(self._acting) - 1 if touch is None else max(touch - 1, 0)
        ticks = np.unique(np.linspace(0, last, LOOKS + 1).round().astype(int))
        visibility, scene = Visibility(self._ports.segmentation), self.info.scene
        poses = ScenePoses(scene, self._ports.library)
        things = {thing.entity: description(thing) for thing in task_objects(self.info.task)}
        wanted = set(things) if touch is None else self._touched(touch) & set(things)
        fixed = {camera.name for camera in scene.cameras if camera.parent == "world"}
        found = []
        for index in ticks:
            state = self._acting[index].state
            placed = poses.camera_poses(state.robot)
            cameras = tuple(replace(camera, parent="world", pose=placed[camera.name]) for camera in scene.cameras)
            for sight in visibility.look(self.info.task, replace(scene, cameras=cameras), state):
                if index and sight.entity not in wanted:
                    continue  # the other objects matter when the hand turns to them
                found.append(
                    Sighting(
                        camera=sight.camera,
                        fixed=sight.camera in fixed,
                        thing=things[sight.entity],
                        tick=int(index),
                        pixels=sight.pixels * (SIDE_PX / SIZE_PX) ** 2,
                        share=sight.share,
                    )
                )
        return tuple(found)

    def _pairs(self) -> tuple[ColorPair, ...] | None:
        if self._ports.segmentation is None:
            return None
        scene, task = self.info.scene, self.info.task
        pairs = [pair for thing in task_objects(task) for pair in self._alike(thing)]
        if not pairs or not scene.cameras:
            return ()
        first = next(iter(self._reader.ticks()))
        masked = replace(scene, cameras=tuple(replace(c, depth=False, segmentation=True) for c in scene.cameras))
        masks = self._ports.segmentation.segment(masked, first.state)
        ids = {name: number for number, name in enumerate(drawn_entities(masked), start=1)}
        found = []
        for named, other in pairs:
            for camera, image in first.images.items():
                areas = [image[masks[camera] == ids[thing.entity]] for thing in (named, other)]
                if min(map(len, areas)) >= MIN_PIXELS:
                    difference = palette_difference(*areas)
                    found.append(
                        ColorPair(
                            camera=camera, named=description(named), other=description(other), difference=difference
                        )
                    )
        return tuple(found)

    def _alike(self, named: PhysicalObject) -> Iterator[tuple[PhysicalObject, PhysicalObject]]:
        """Yield the objects that only a colour or a material distinguishes from a named one."""
        library, scene = self._ports.library, self.info.scene
        others = task_objects(self.info.task)
        done = {thing.entity for thing in others[: others.index(named) + 1]}
        model_of_named = library.entity_model(scene.entity(named.entity))
        for entity in scene.entities:
            model = library.entity_model(entity)
            if (
                entity.name not in done
                and model.name == model_of_named.name
                and _same_size(model.size, model_of_named.size)
            ):
                yield (
                    named,
                    PhysicalObject(entity=entity.name, model=entity.model, name=model.name, modifiers=entity.modifiers),
                )

    # ------------------------------------------------------------------ simulator

    def _replay(self) -> tuple[float, ...] | None:
        sim = self._ports.sim
        if sim is None:
            return None
        executed = self._executed()
        if executed is None:
            return None
        lease, errors = f"audit-{self.info.episode_id}", []
        try:
            state = sim.load(replace(self.info.scene, cameras=()), lease, self.info.semantics)
            for tick in self._acting:
                if tick.seq:
                    state = sim.tick(tick.seq, executed[tick.seq - 1], episode_id=lease)
                recorded, replayed = (s.robot.pose_tcp_measured.position for s in (tick.state, state))
                errors.append(math.dist(recorded, replayed))
        except RoboximError:
            if not errors:
                raise
            errors += [math.inf] * (len(self._acting) - len(errors))
        finally:
            sim.release(lease)
        return tuple(errors)

    def _executed(self) -> Sequence[npt.NDArray[np.float32]] | None:
        """Return the actions to execute; none: the dataset holds none that the simulator executes."""
        if self._episode is None:
            return [np.array(tick.step.action_executed, np.float32) for tick in self._acting[1:]]
        if self._episode.semantics != self.info.semantics:
            return None
        actions = [step.action_executed for step in self._episode.steps(())]
        there = [action for action in actions if action is not None]
        return there if len(there) == len(actions) else None


def _same_size(first: Sequence[float], second: Sequence[float]) -> bool:
    return all(max(a, b) <= SAME_SIZE * min(a, b) for a, b in zip(sorted(first), sorted(second), strict=True))
