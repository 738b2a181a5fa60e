"""Whether the fixed cameras see what an instruction names: shown by segmentation, before anything is simulated.

The named objects are drawn twice in one image pass: in the scene, and alone. A copy of each stands far below the scene
with a copy of the camera before it, so that the share that is hidden, or out of the picture, can be counted.
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
from roboxim_core.poses import Pose
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
from roboxim_tasks.roles import task_objects
from roboxim_tasks.solvable import state_at_rest
from roboxim_tasks.task_config import VisibleConfig

CONSTRAINT = "visible"
"""Name of the constraint for messages and statistics; the object that is not seen comes before it."""
SIZE_PX = 128
"""Longer side of the images that are looked at."""
BELOW_M = 32.0
"""How far below the scene, and below each other, objects stand alone; further than any camera sees."""
PLAIN = MaterialSpec()
LOOK = LookSpec(table=PLAIN, floor=PLAIN, wall=PLAIN, lights=(), background="plain")
"""No shadows and no textures: only the segmentation is looked at."""

Segmentation = npt.NDArray[np.uint16]


class Eyes(Protocol):
    """Who draws: the simulator's renderer, by its service or called directly."""

    def segment(self, scene: SceneSpec, state: StateRecord) -> Mapping[str, Segmentation]:
        """Return what the cameras of a scene see, by camera: ids as `drawn_entities` numbers them, from 1.

        Args:
            scene: Models, look and cameras; every camera asks for its segmentation.
            state: Where robot and entities are.

        Raises:
            RoboximError: When nothing can be drawn.
        """
        ...


@dataclass(frozen=True, kw_only=True)
class Sight:
    """What a camera sees of an object."""

    camera: str
    """The camera."""
    entity: str
    """The object."""
    pixels: int
    """Pixels of it, in an image whose longer side has `SIZE_PX`."""
    whole: int
    """Pixels that it would have with nothing before it, and if the picture went on for a quarter on every side."""

    @property
    def share(self) -> float:
        """Share of the silhouette that is seen."""
        return self.pixels / self.whole if self.whole else 0.0


class Visibility:
    """Looks at drawn scenes through the cameras that are fixed in the world."""

    def __init__(self, eyes: Eyes) -> None:
        """Use a renderer."""
        self._eyes = eyes

    def refusal(self, task: TaskSpec, scene: SceneSpec, arm: ArmKinematics, config: VisibleConfig) -> str:
        """Return the name of the constraint that a scene breaks, e.g. ``target_visible``, or nothing.

        Args:
            task: The task; every object that its instruction names is to be seen.
            scene: Its scene, with objects where they come to rest; without fixed cameras nothing is demanded.
            arm: Kinematics of the scene's robot.
            config: What is to be seen.

        Raises:
            ConfigError: When a camera that must see is not in the scene.
            RoboximError: When nothing can be drawn.
        """
        for sight in self.look(task, scene, state_at_rest(scene, arm), config.cameras):
            if sight.pixels < config.pixels or sight.share < config.share:
                return f"{sight.entity}_{CONSTRAINT}"
        return ""

    def look(
        self, task: TaskSpec, scene: SceneSpec, state: StateRecord, cameras: tuple[str, ...] | None = None
    ) -> list[Sight]:
        """Return what each camera sees of each object that the instruction names.

        Args:
            task: The task.
            scene: Its models and cameras.
            state: Where robot and objects are.
            cameras: The cameras; none: all that are fixed in the world.

        Raises:
            ConfigError: When a camera is not in the scene, or not fixed in the world.
            RoboximError: When nothing can be drawn.
        """
        views = [_small(camera) for camera in _chosen(scene, cameras)]
        names = [thing.entity for thing in task_objects(task)]
        if not views or not names:
            return []
        shown, posed = _with_copies(scene, names, state)
        depths = {name: BELOW_M * number for number, name in enumerate(names, start=1)}
        copies = [_copy(view, name, depth) for view in views for name, depth in depths.items()]
        shown = replace(shown, cameras=(*views, *copies))
        ids = {name: number for number, name in enumerate(drawn_entities(shown), start=1)}
        images = self._eyes.segment(shown, posed)
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
    """Return the cameras that must see."""
    fixed = {camera.name: camera for camera in scene.cameras if camera.parent == "world"}
    if names is None:
        return list(fixed.values())
    for name in names:
        if name not in fixed:
            raise ConfigError(f"visible.cameras names '{name}', no fixed camera of the scene; {one_of(fixed, name)}")
    return [fixed[name] for name in names]


def _small(camera: CameraSpec) -> CameraSpec:
    """Return a camera as it is looked through: a small picture without the lens' distortion, segmentation alone."""
    scale = min(1.0, SIZE_PX / max(camera.width, camera.height))
    small = camera.resized(max(16, round(scale * camera.width)), max(16, round(scale * camera.height)))
    return replace(small, depth=False, segmentation=True, distortion=(), noise=CameraNoise(), rate_hz=0.0)


def _copy(camera: CameraSpec, entity: str, depth_m: float) -> CameraSpec:
    """Return the camera that sees an object's copy alone, in a picture that is larger by a quarter on every side."""
    (fx, fy, cx, cy), dx, dy = camera.matrix, camera.width // 4, camera.height // 4
    return replace(
        camera,
        name=_alone(camera.name, entity),
        width=camera.width + 2 * dx,
        height=camera.height + 2 * dy,
        intrinsics=(fx, fy, cx + dx, cy + dy),
        pose=_below(camera.pose, depth_m),
        far=min(camera.far, BELOW_M / 2),
    )


def _with_copies(scene: SceneSpec, names: list[str], state: StateRecord) -> tuple[SceneSpec, StateRecord]:
    """Add the objects' copies. Poses are the state's alone, so that a renderer need not load every draw anew."""
    bodies = [EntitySpec(name=e.name, model=e.model, modifiers=e.modifiers) for e in scene.entities]
    bodies += [replace(bodies[[e.name for e in bodies].index(name)], name=_alone(name)) for name in names]
    copies = [
        replace(state.entity(name), name=_alone(name), pose=_below(state.entity(name).pose, BELOW_M * number))
        for number, name in enumerate(names, start=1)
    ]
    robot = RobotSpec(model=scene.robot.model, pose=scene.robot.pose)
    shown = replace(scene, entities=tuple(bodies), robot=robot, look=LOOK, cameras=())
    return shown, replace(state, entities=(*state.entities, *copies))


def _below(pose: Pose, depth_m: float) -> Pose:
    x, y, z = pose.position
    return replace(pose, position=(x, y, z - depth_m))


def _alone(*names: str) -> str:
    return " ".join((*names, "alone"))
