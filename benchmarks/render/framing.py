"""Things that cameras crop at the start of every skill, per camera: the hand and each object, by segmentation.

Scenes of every skill are drawn as a run draws them; hand and objects are rendered without arm, table and room.
Something is cropped when its pixels touch the picture's edge, or when its origin is outside. ``--quick``: one scene
a skill.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

from benchmarks._harness import Bench

from roboxim_core.config import load_config, named_config
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses, render_world
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import CameraSpec, SceneSpec
from roboxim_core.state import StateRecord
from roboxim_core.vision.cameras import load_camera, project
from roboxim_core.vision.looks import LookSet
from roboxim_core.vision.renderer import Renderer
from roboxim_runs.episodes.task_choice import task_text
from roboxim_runs.scenes.pictures import ScenePainter
from roboxim_sim.rendering import make_renderer
from roboxim_sim.world import World
from roboxim_tasks.config import parse_task_config
from roboxim_tasks.skills import SKILLS

HAND = "hand"
"""Name of the gripper among the things that are measured."""
SIZE_PX = 256
SEEDS = 10
SIDE = ("open_drawer", "close_drawer", "open_door", "close_door", "put_into_drawer")
"""Tasks that are seen from beside the robot, in every room."""
TASKS = (
    "pick_cube", "pick_cube_distractors", "pick_up_blocked", "place_on_blocked", "pick_cube_ur5", "put_into_drawer",
    *SKILLS,
)  # fmt: skip
"""The built-in tasks of one skill that do not choose a view themselves."""


@dataclass(frozen=True, kw_only=True)
class Crop:
    """Something that a camera does not see whole."""

    camera: str
    """The camera's file."""
    thing: str
    """`HAND`, or the model of an object."""
    edge: str
    """``left``, ``right``, ``top``, ``bottom``, or ``outside`` when nothing of it is in the picture."""


def cropped(
    scene: SceneSpec, state: StateRecord, cameras: Sequence[CameraSpec], library: ModelLibrary, renderer: Renderer
) -> list[Crop]:
    """Return what fixed cameras crop of a scene's hand and objects.

    Args:
        scene: The scene.
        state: Poses of its robot and objects.
        cameras: Cameras that are fixed in the world.
        library: Models of the scene.
        renderer: Draws them.
    """
    robot = library.robot(scene.robot.model)
    hand = {f"robot/{link}" for link in robot.gripper.links}
    world = render_world(scene, library)
    things = {entity.name: entity.model for entity in scene.entities} | {HAND: HAND}
    bodies = [replace(body, entity=HAND) if body.key in hand else body for body in world.bodies]
    world = replace(world, bodies=tuple(body for body in bodies if body.entity in things))
    shown = {body.key for body in world.bodies}
    poses = ScenePoses(scene, library, ArmKinematics(robot)).body_poses(state)
    views = [replace(camera, width=SIZE_PX, height=SIZE_PX, segmentation=True) for camera in cameras]
    entity_of = {body.key: body.entity for body in world.bodies}
    renderer.load(world)
    images = renderer.render(
        {key: pose for key, pose in poses.items() if key in shown}, [(view, view.pose) for view in views], colour=False
    )
    found = []
    for view in views:
        ids = images[view.name].segmentation
        assert ids is not None
        for number, name in enumerate(world.entity_names, start=1):
            mask = ids == number
            sides = {"top": mask[0], "bottom": mask[-1], "left": mask[:, 0], "right": mask[:, -1]}
            edges = [side for side, pixels in sides.items() if pixels.any()]
            if not mask.any() and not _inside(view, poses[next(key for key in shown if entity_of[key] == name)]):
                edges = ["outside"]  # else it is hidden by another thing
            found += [Crop(camera=view.name, thing=things[name], edge=edge) for edge in edges]
    return found


def _inside(camera: CameraSpec, pose: Pose) -> bool:
    [[x, y]] = project(camera, [(camera.pose.inverse() @ pose).position])
    return bool(0 <= x < camera.width and 0 <= y < camera.height)


def room_views(looks: str) -> list[CameraSpec]:
    """Return the cameras that a set of looks draws from, by the names of their files."""
    rooms = load_config(named_config("looks", looks), LookSet).looks.values()
    return [replace(load_camera(view), name=view) for view in sorted({room.view for room in rooms if room.view})]


class Framing:
    """Draws scenes and finds what cameras crop of them. A context manager."""

    def __init__(self) -> None:
        """Make what draws scenes and pictures."""
        self._library, self._renderer = ModelLibrary(), make_renderer("raster")
        self._painter, self._world = ScenePainter(), World(self._library)

    def __enter__(self) -> Framing:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Free everything."""
        self._painter.__exit__()
        self._world.close()
        self._renderer.close()

    def start(self, task: str, index: int) -> tuple[SceneSpec, StateRecord]:
        """Return the scene of a task that a run of seed 0 has at an index, at rest.

        Args:
            task: A task of ``config/tasks``.
            index: The episode's index.
        """
        seed = SeedPath(run_seed=0, purpose="demo", index=index)
        scene = self._painter.draw(seed, parse_task_config(task_text(task))).scene
        return scene, self._world.load(replace(scene, cameras=()))

    def cropped(self, scene: SceneSpec, state: StateRecord, cameras: Sequence[CameraSpec]) -> list[Crop]:
        """Return what cameras crop, see `cropped`."""
        return cropped(scene, state, cameras, self._library, self._renderer)


def main() -> None:
    """Print, for each task and camera, what is cropped, and in how many of its scenes."""
    bench = Bench("framing", __doc__)
    bad, rooms = 0, room_views("varied")
    with Framing() as framing:
        for task in TASKS:
            found: dict[str, Counter[str]] = {}
            for index in range(1 if bench.quick else SEEDS):
                scene, state = framing.start(task, index)
                [shown] = [camera for camera in scene.cameras if camera.parent == "world"]
                beside = [] if task in SIDE else rooms
                old = load_camera("workspace_side" if task in SIDE else "workspace")
                cameras = [replace(old, name="before"), replace(shown, name="default"), *beside]
                for camera in cameras:
                    found.setdefault(camera.name, Counter())
                for crop in framing.cropped(scene, state, cameras):
                    found[crop.camera][f"{crop.thing} {crop.edge}"] += 1
            texts = {name: ", ".join(f"{what} {n}" for what, n in tally.items()) for name, tally in found.items()}
            bench.row(task=task, **texts)
            bad += sum(tally.total() for name, tally in found.items() if name != "before")
    bench.finish("things cropped by the default camera and by the rooms' cameras", bad, "", at_most=0)


if __name__ == "__main__":
    main()
