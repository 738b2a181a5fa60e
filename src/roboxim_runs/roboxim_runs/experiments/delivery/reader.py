"""Reads what a bag shows, for the proofs of delivery.

The pictures of tick 0 are compared with pictures that the bag's renderer draws of the recorded state from the camera
poses that the *cell* demands. A camera at another pose therefore shows the tool away from its projection.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from roboxim_core.kinematics import ArmKinematics, Arms
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses, camera_parent, drawn_entities
from roboxim_core.poses import Pose, distance
from roboxim_core.seeds import CELL, CELL_NUMBER
from roboxim_core.specs import CameraSpec, EntitySpec, PhysicalObject, SceneSpec
from roboxim_core.state import StateRecord
from roboxim_core.vision.cameras import project
from roboxim_core.vision.renderer import CameraImages
from roboxim_datasets.audit.color import color_difference, median_lab
from roboxim_eval.experiments.proving.demand import Demand, Shown, Value, View, plain_value
from roboxim_recorder.bag import BagReader, BagTick
from roboxim_runs.experiments.delivery.demands import look_of, noise_of
from roboxim_sim.rendering import make_renderer
from roboxim_sim.rendering.states import StateRenderer
from roboxim_tasks.meaning import read_instruction
from roboxim_tasks.roles import description, task_objects

DRAWN_AGAIN = ("raster", "tiny")
"""Renderers whose pictures are drawn again for a comparison; the others take minutes."""
TOOL_M = 0.045
"""Distance from the tool centre point within which the open fingers are [m]."""
WINDOW = 0.15
"""Half the side of the window around the tool, as a fraction of the picture's longer side."""
ALIKE = 0.5
"""Least correlation of two windows that show the same."""
MIN_PIXELS = 12
"""Fewest pixels of a surface from which its median colour is taken."""
HAND = "gripper"
"""Parent of a camera on the hand of any robot, in a camera's file."""
THUMBNAIL = 16
"""Side of a thumbnail [px]."""
GRAVITY = 9.81
"""Acceleration of gravity in the simulator [m/s^2]."""

RGB = npt.NDArray[np.uint8]


class DeliveryReader:
    """Reads what bags show; belongs to the thread that made it."""

    def __init__(self, library: ModelLibrary) -> None:
        """Use a library of models; renderers are made when a bag needs them."""
        self._library = library
        self._renderers: dict[str, StateRenderer] = {}
        self._arms = Arms(library)

    def close(self) -> None:
        """Free the renderers."""
        for renderer in self._renderers.values():
            renderer.renderer.close()
        self._renderers.clear()

    def read(self, bag: Path, demand_for: Callable[[str], Demand | None], *, pictures: bool = True) -> Shown:
        """Return what a bag shows.

        Args:
            bag: The bag.
            demand_for: Returns what a cell demands, by the cell's key; none: there is no such cell.
            pictures: Whether to compare the pictures of tick 0.

        Raises:
            RoboximError: When the bag is damaged, or its scene cannot be drawn.
        """
        reader = BagReader(bag)
        info = reader.info
        tick = next(iter(reader.ticks()))
        base = info.scene.robot.pose.inverse()
        present = {entity.name for entity in tick.state.entities}
        entities = {entity.name: entity for entity in info.scene.entities if entity.name in present}
        roles = {role: thing.entity for role, thing in info.task.objects.items() if thing.entity in entities}
        named = {thing.entity for thing in task_objects(info.task)}
        others = {
            state.name: entities[state.name]
            for state in tick.state.entities
            if state.name in entities and state.name not in named and _on_table(info.scene, state.pose)
        }
        own = {role: entities[name] for role, name in roles.items() if name in named}
        drawn = info.task.drawn
        shown = Shown(
            bag=str(bag),
            cell=drawn.get(CELL, ""),
            number=int(drawn.get(CELL_NUMBER, info.index)),
            skill=info.task.skill,
            arm=info.scene.robot.model,
            arguments={name: plain_value(value) for name, value in info.task.arguments.items()},
            models={role: thing.model for role, thing in own.items()},
            modifiers={role: _modifiers(thing) for role, thing in own.items()},
            descriptions={role: self._description(thing) for role, thing in own.items()},
            physics={role: self._physics(thing) for role, thing in own.items()},
            weights={
                role: weight
                for role, thing in own.items()
                if not thing.fixed and (weight := _weight(tick.state, thing.name)) is not None
            },
            table_friction=info.scene.table.friction,
            others={name: thing.model for name, thing in others.items()},
            other_modifiers={name: _modifiers(thing) for name, thing in others.items()},
            positions={role: _vec(base.apply(tick.state.entity(name).pose.position)) for role, name in roles.items()},
            start=_vec(base.apply(tick.state.robot.pose_tcp_measured.position)),
            cameras={
                camera.name: View(parent=_parent(camera, self._arms[info.scene.robot.model]), pose=camera.pose)
                for camera in info.scene.cameras
            },
            look=_look(info.scene),
            state_hash=tick.state.state_hash,
            pictures={name: zlib.crc32(image.tobytes()) for name, image in tick.images.items()},
            sizes={name: tuple(image.shape) for name, image in tick.images.items()},
            thumbnails={name: _thumbnail(image) for name, image in tick.images.items()},
            instruction=info.task.instruction,
            received=reader.received,
            latency_ticks=reader.result.delay_ticks,
        )
        demand = demand_for(shown.cell)
        name = info.renderer.split(" ")[0]
        if demand is None or not info.scene.cameras:
            return shown
        if not pictures or name not in DRAWN_AGAIN:
            return replace(shown, not_compared=f"renderer {name}" if pictures else "as asked for")
        return self._with_pictures(shown, {r: thing.name for r, thing in own.items()}, info.scene, tick, demand, name)

    def instructed(self, bag: Path, instruction: str) -> list[dict[str, Any]]:
        """Return skill and models, by role, that an instruction may ask for in a bag's scene; empty: it says nothing.

        Raises:
            RoboximError: When the bag is damaged.
        """
        tasks = read_instruction(instruction, BagReader(bag).info.scene, self._library).tasks
        return [
            {"skill": task.skill, "models": {role: thing.model for role, thing in task.objects.items()}}
            for task in tasks
        ]

    def _description(self, entity: EntitySpec) -> str:
        noun = self._library.entity_model(entity).name
        thing = PhysicalObject(entity=entity.name, model=entity.model, name=noun, modifiers=entity.modifiers)
        return description(thing)

    def _physics(self, entity: EntitySpec) -> dict[str, float]:
        model = self._library.entity_model(entity)
        return {"mass_kg": sum(link.mass for link in model.links), "friction_coefficient": model.friction.lateral}

    def _with_pictures(
        self, shown: Shown, own: Mapping[str, str], scene: SceneSpec, tick: BagTick, demand: Demand, renderer: str
    ) -> Shown:
        if renderer not in self._renderers:
            self._renderers[renderer] = StateRenderer(make_renderer(renderer), self._library)
        arm = self._arms[scene.robot.model]
        cameras = tuple(
            replace(_demanded(camera, demand, arm), segmentation=True, depth=False, rate_hz=0.0)
            for camera in scene.cameras
        )
        scene = replace(scene, cameras=cameras)
        drawn = self._renderers[renderer].draw(scene, tick.state)
        poses = ScenePoses(scene, self._library, arm).camera_poses(tick.state.robot)
        ids = {name: number for number, name in enumerate(drawn_entities(scene), start=1)}
        tool = tick.state.robot.pose_tcp_measured.position
        offsets = {}
        for camera in cameras:
            found = tool_offset(
                camera, poses[camera.name].inverse().apply(tool), tick.images[camera.name], drawn[camera.name],
                ids["robot"],
            )  # fmt: skip
            if found is not None:
                offsets[camera.name] = found
        fixed = [camera for camera in cameras if camera.parent == "world"]
        named = {
            role: name for role, name in (dict(own) | {name: name for name in shown.others}).items() if name in ids
        }
        return replace(
            shown,
            tool_px=offsets,
            pixels={role: _visible(fixed, drawn, ids[name]) for role, name in named.items()} if fixed else {},
            colors=_colors(fixed, tick.images, drawn, {"table": ids["table"], **{r: ids[n] for r, n in named.items()}}),
            brightness={
                camera.name: float(_grey(tick.images[camera.name]).mean() - _grey(drawn[camera.name].rgb).mean())
                for camera in cameras
            },
        )


def _modifiers(entity: EntitySpec) -> dict[str, Value]:
    return {kind: plain_value(value) for kind, value in entity.modifiers.items()}


def _weight(state: StateRecord, name: str) -> float | None:
    """Return the mass with which an object presses on the table [kg]; none: it touches something else, or no force."""
    touching = [contact for contact in state.contacts if name in (contact.body_a, contact.body_b)]
    if {contact.body_a if contact.body_b == name else contact.body_b for contact in touching} != {"table"}:
        return None
    forces = [contact.force_on_b[2] * (1.0 if contact.body_b == name else -1.0) for contact in touching]
    return sum(forces) / GRAVITY if any(forces) else None  # bags of earlier versions have no directions of forces


def _on_table(scene: SceneSpec, pose: Pose) -> bool:
    (x, y, z), (cx, cy, _), (sx, sy, _) = pose.position, scene.table.center, scene.table.size
    return z > -0.05 and abs(x - cx) <= sx / 2 and abs(y - cy) <= sy / 2


def _vec(position: npt.ArrayLike) -> tuple[float, float, float]:
    x, y, z = (float(number) for number in np.asarray(position))
    return x, y, z


def _parent(camera: CameraSpec, arm: ArmKinematics) -> str:
    """Return what a camera is mounted on, as a camera's file says it."""
    if camera.parent == "world":
        return "world"
    hand = camera_parent(replace(camera, parent=HAND), arm)
    return HAND if camera.parent == hand else camera.parent


def _look(scene: SceneSpec) -> dict[str, Value]:
    found = look_of(scene.look) | {f"exposure.{camera.name}": camera.noise.exposure_ev for camera in scene.cameras}
    return found | {f"noise.{camera.name}": noise_of(camera) for camera in scene.cameras}


def _demanded(camera: CameraSpec, demand: Demand, arm: ArmKinematics) -> CameraSpec:
    """Return a recorded camera at the nearest pose that its cell demands; where the pose is drawn, as it is."""
    views = demand.cameras.get(camera.name, ())
    if not views or camera.name in demand.shifts or camera.name in demand.turned:
        return camera
    nearest = min(views, key=lambda view: distance(view.pose, camera.pose))
    moved = replace(camera, parent=nearest.parent, pose=nearest.pose)
    return replace(moved, parent=camera_parent(moved, arm))


# ------------------------------------------------------------------ pictures


def tool_offset(camera: CameraSpec, tool: npt.ArrayLike, picture: RGB, drawn: CameraImages, robot: int) -> float | None:
    """Return how far the tool in a picture is from where a camera projects it [px].

    The surroundings of the projection in the drawing are searched in the picture. In the drawing itself, pixels of the
    robot must lie where the open fingers are projected.

    Args:
        camera: The demanded camera.
        tool: Tool centre point in its optical frame [m].
        picture: The recorded picture.
        drawn: What the camera sees of the recorded state, with segmentation.
        robot: Id of the robot in the segmentation.

    Returns:
        The distance; infinity if the tool is not found; none if the camera does not show it, or shows no contrast.
    """
    x, y, z = (float(number) for number in np.asarray(tool))
    if z <= camera.near:
        return None
    u, v = project(camera, [[x, y, z]])[0]
    if not (0 <= u < camera.width and 0 <= v < camera.height) or drawn.segmentation is None:
        return None
    rows, columns = np.nonzero(drawn.segmentation == robot)
    if not len(rows):
        return None
    fingers = max(camera.matrix[:2]) * TOOL_M / z
    sideways = max(0.0, float(np.hypot(columns - u, rows - v).min()) - fingers)
    moved = _moved(picture, drawn.rgb, (round(u), round(v)), max(8, round(WINDOW * max(camera.width, camera.height))))
    return None if moved is None else max(sideways, moved)


def _moved(picture: RGB, drawn: RGB, at: tuple[int, int], radius: int) -> float | None:
    """Return by how much a window of a drawing is moved in a picture [px]; none: it has no contrast."""
    height, width = drawn.shape[:2]
    left, right = max(at[0] - radius, 0), min(at[0] + radius + 1, width)
    top, bottom = max(at[1] - radius, 0), min(at[1] + radius + 1, height)
    seen, wanted = _grey(picture), _grey(drawn)
    window = wanted[top:bottom, left:right]
    if window.std() < 2.0:
        return None
    if np.abs(seen[top:bottom, left:right] - window).mean() < 1.0:
        return 0.0
    around = cv2.copyMakeBorder(seen, radius, radius, radius, radius, cv2.BORDER_REPLICATE)
    found = cv2.matchTemplate(around, window, cv2.TM_CCOEFF_NORMED)
    near = found[top : top + 2 * radius + 1, left : left + 2 * radius + 1]
    row, column = np.unravel_index(int(near.argmax()), near.shape)
    if near[row, column] < ALIKE:
        return math.inf
    return float(np.hypot(row - radius, column - radius))


def _grey(image: RGB) -> npt.NDArray[np.float32]:
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_RGB2GRAY), np.float32)


def _thumbnail(image: RGB) -> tuple[int, ...]:
    small = cv2.resize(np.ascontiguousarray(image), (THUMBNAIL, THUMBNAIL), interpolation=cv2.INTER_AREA)
    return tuple(int(number) for number in small.reshape(-1))


def _visible(cameras: list[CameraSpec], drawn: Mapping[str, CameraImages], entity: int) -> float:
    """Return the visible pixels of an entity in the best camera, scaled to 256 x 256 px."""
    return max(
        float(np.count_nonzero(drawn[camera.name].segmentation == entity)) * 256**2 / (camera.width * camera.height)
        for camera in cameras
    )


def _colors(
    cameras: list[CameraSpec], pictures: Mapping[str, RGB], drawn: Mapping[str, CameraImages], ids: Mapping[str, int]
) -> dict[str, float]:
    """Return the least difference over the cameras between an entity's median colours in picture and drawing."""
    found: dict[str, float] = {}
    for name, number in ids.items():
        for camera in cameras:
            segmentation = drawn[camera.name].segmentation
            mask = np.zeros(0) if segmentation is None else segmentation == number
            if np.count_nonzero(mask) >= MIN_PIXELS:
                first, second = median_lab(pictures[camera.name][mask]), median_lab(drawn[camera.name].rgb[mask])
                found[name] = min(found.get(name, math.inf), float(color_difference(first, second)))
    return found
