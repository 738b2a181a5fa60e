"""Check by segmentation that the fixed cameras see the objects that an instruction names, before the simulation.

One image pass draws each named object twice: in the scene, and alone. The second one is a copy far below the scene,
with a copy of the camera in front of it. The difference is the share that is hidden or out of the picture.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import numpy.typing as npt

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.visuals import drawn_entities
from roboxim_core.poses import Pose, Vec3
from roboxim_core.specs import (
    CameraNoise,
    CameraSpec,
    EntitySpec,
    LookSpec,
    MaterialSpec,
    RobotSpec,
    SceneSpec,
    TaskSpec,
)
from roboxim_core.state import StateRecord
from roboxim_tasks.demonstration.solvable import state_at_rest
from roboxim_tasks.roles import task_objects
from roboxim_tasks.task_config import VisibleConfig

CONSTRAINT = "visible"
"""Name of the constraint for messages and statistics, prefixed by the name of the object that is not seen."""
SIZE_PX = 128
"""Longer side of the segmentation images [px]."""
BELOW_M = 32.0
"""Distance of the copies below the scene and below each other [m]; further than any camera sees."""
PLAIN = MaterialSpec()
LOOK = LookSpec(table=PLAIN, floor=PLAIN, wall=PLAIN, lights=(), background="plain")
"""No shadows and no textures: the check only reads the segmentation."""

Segmentation = npt.NDArray[np.uint16]


class SegmentationPort(Protocol):
    """The simulator's renderer, called through its service or directly."""

    def segment(self, scene: SceneSpec, state: StateRecord) -> Mapping[str, Segmentation]:
        """Return a segmentation image per camera, with ids from 1 in the order of `drawn_entities`.

        Args:
            scene: Models, look and cameras; every camera requests a segmentation image.
            state: Poses of robot and entities.

        Raises:
            RoboximError: When the scene cannot be drawn.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class Sight:
    """The visible part of an object in a camera's image."""

    camera: str
    """The camera."""
    entity: str
    """The object."""
    pixels: int
    """Visible pixels of the object, in an image whose longer side has `SIZE_PX`."""
    whole: int
    """Pixels of the object without occlusion, in a picture extended by a quarter on every side."""

    @property
    def share(self) -> float:
        """Visible share of the silhouette, 0..1."""
        return self.pixels / self.whole if self.whole else 0.0


class Visibility:
    """Check of drawn scenes through the cameras that are fixed in the world."""

    def __init__(self, renderer: SegmentationPort) -> None:
        """Use a renderer of segmentation images."""
        self._renderer = renderer

    def refusal(self, task: TaskSpec, scene: SceneSpec, arm: ArmKinematics, config: VisibleConfig) -> str:
        """Return the name of the constraint that a scene breaks, e.g. ``target_visible``, or nothing.

        Args:
            task: The task; every object that its instruction names must be visible.
            scene: Its scene, with the objects at rest. A scene without fixed cameras always passes.
            arm: Kinematics of the scene's robot.
            config: The visibility that the task demands.

        Raises:
            ConfigError: When the scene lacks a camera that the configuration names.
            RoboximError: When the scene cannot be drawn.
        """
        for sight in self.look(task, scene, state_at_rest(scene, arm), config.cameras):
            if sight.pixels < config.pixels or sight.share < config.share:
                return f"{sight.entity}_{CONSTRAINT}"
        return ""

    def look(
        self, task: TaskSpec, scene: SceneSpec, state: StateRecord, cameras: tuple[str, ...] | None = None
    ) -> list[Sight]:
        """Return how each camera sees each object that the instruction names.

        Args:
            task: The task.
            scene: Its models and cameras.
            state: Poses of robot and objects.
            cameras: The cameras; none: all that are fixed in the world.

        Raises:
            ConfigError: When a camera is not in the scene, or not fixed in the world.
            RoboximError: When the scene cannot be drawn.
        """
        views = [_small(camera) for camera in _chosen(scene, cameras)]
        names = [thing.entity for thing in task_objects(task)]
        if not views or not names:
            return []
        shown, posed = _with_copies(scene, names, state)
        copies = [_copy(view, name, _away(n)) for view in views for n, name in enumerate(names)]
        shown = replace(shown, cameras=(*views, *copies))
        ids = {name: number for number, name in enumerate(drawn_entities(shown), start=1)}
        images = self._renderer.segment(shown, posed)
        return [
            Sight(
                camera=view.name,
                entity=name,
                pixels=int(np.count_nonzero(images[view.name] == ids[name])),
                whole=int(np.count_nonzero(images[_alone(view.name, name)] == ids[_alone(name)])),
            )
            for view in views
            for name in names
        ]


def _chosen(scene: SceneSpec, names: tuple[str, ...] | None) -> list[CameraSpec]:
    """Return the cameras that must see the objects."""
    fixed = {camera.name: camera for camera in scene.cameras if camera.parent == "world"}
    if names is None:
        return list(fixed.values())
    for name in names:
        if name not in fixed:
            raise ConfigError(f"visible.cameras names '{name}', no fixed camera of the scene; {one_of(fixed, name)}")
    return [fixed[name] for name in names]


def _small(camera: CameraSpec) -> CameraSpec:
    """Return a camera for the check: a small image, without lens distortion, segmentation only."""
    scale = min(1.0, SIZE_PX / max(camera.width, camera.height))
    small = camera.resized(max(16, round(scale * camera.width)), max(16, round(scale * camera.height)))
    return replace(small, depth=False, segmentation=True, distortion=(), noise=CameraNoise(), rate_hz=0.0)


def _copy(camera: CameraSpec, entity: str, away: Vec3) -> CameraSpec:
    """Return the camera that sees only an object's copy, in a picture extended by a quarter on every side."""
    (fx, fy, cx, cy), dx, dy = camera.matrix, camera.width // 4, camera.height // 4
    return replace(
        camera,
        name=_alone(camera.name, entity),
        width=camera.width + 2 * dx,
        height=camera.height + 2 * dy,
        intrinsics=(fx, fy, cx + dx, cy + dy),
        pose=_moved(camera.pose, away),
        far=min(camera.far, BELOW_M / 2),
    )


def _with_copies(scene: SceneSpec, names: list[str], state: StateRecord) -> tuple[SceneSpec, StateRecord]:
    """Add the objects' copies. Change poses only in the state, so that a renderer need not reload each draw."""
    bodies = [EntitySpec(name=e.name, model=e.model, modifiers=e.modifiers) for e in scene.entities]
    bodies += [replace(bodies[[e.name for e in bodies].index(name)], name=_alone(name)) for name in names]
    copies = [
        replace(state.entity(name), name=_alone(name), pose=_moved(state.entity(name).pose, _away(n)))
        for n, name in enumerate(names)
    ]
    robot = RobotSpec(model=scene.robot.model, pose=scene.robot.pose)
    shown = replace(scene, entities=tuple(bodies), robot=robot, look=LOOK, cameras=())
    return shown, replace(state, entities=(*state.entities, *copies))


def _away(number: int) -> Vec3:
    """Return how far from the scene an object's copy is [m]: three below each other, the next three beside them."""
    column, row = divmod(number, 3)
    return (BELOW_M * column, 0.0, -BELOW_M * (row + 1))


def _moved(pose: Pose, by: Vec3) -> Pose:
    x, y, z = pose.position
    return replace(pose, position=(x + by[0], y + by[1], z + by[2]))


def _alone(*names: str) -> str:
    return " ".join((*names, "alone"))
