"""Draw the film of `roboxim assets import`: five meshes side by side, from the file to the expert that picks them up.

Nothing is staged: the meshes are imported by the default options into a temporary folder, the drop and the trial of the
first grasp are simulated as the import does it, and the expert acts in a scene of the skill `pick_up`.

Usage: ``python scripts/film_import.py [--out FILE] [--work DIR]``; writes ``docs/images/import.webp``. DIR keeps the
imports.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pybullet_data
import trimesh
import yaml
from PIL import Image, ImageDraw, ImageFont
from scipy.spatial.transform import Rotation

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.models.description import ObjectModel, Visual
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.modifiers import PALETTE
from roboxim_core.models.visuals import render_world, visual_parts
from roboxim_core.poses import Pose, look_at
from roboxim_core.specs import CameraSpec, EntitySpec, MaterialSpec, SceneSpec, TableSpec
from roboxim_core.vision.renderer import RenderBody, Renderer
from roboxim_recorder.bag import BagReader
from roboxim_runs.assets.check import UNITS
from roboxim_runs.assets.floating_hand import LIFT_M, TIP, FloatingHand
from roboxim_runs.assets.importing import guessed_unit, import_mesh, object_id_of
from roboxim_runs.assets.solids import placed
from roboxim_runs.episodes.task_choice import task_text
from roboxim_sim.bodies import ObjectBody, build_table, configure
from roboxim_sim.bullet import BulletClient
from roboxim_sim.rendering import make_renderer
from roboxim_tasks.config import merged

Picture = npt.NDArray[np.uint8]
Array = npt.NDArray[np.float64]

MESHES = (
    "random_urdfs/396/396.obj",
    "random_urdfs/492/492.obj",
    "objects/mug.obj",
    "random_urdfs/098/098.obj",
    "random_urdfs/573/573.obj",
)
"""Files of pybullet_data."""
SIDE, LINE = 220, 24
"""Side of a picture, and height of its line of text [px]."""
PLACE = np.array((0.5, 0.0, 0.0))
"""Where on the table the object is [m]."""
PART_COLOURS = ("red", "yellow", "blue", "green", "orange", "purple", "cyan", "pink")
MIDDLE = (0.22 * 2 * SIDE, 0.3 * 2 * SIDE, 0.82 * 2 * SIDE, 0.9 * 2 * SIDE)
"""Part of the expert's picture that is shown."""
DROP_M = 0.03
FRAME_S = 0.1


def main() -> None:
    """Import, draw, save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "--out", type=Path, default=Path(__file__).parents[1] / "docs/images/import.webp", metavar="FILE"
    )
    parser.add_argument("--work", type=Path, metavar="DIR", help="keep the imports here (default: nowhere)")
    options = parser.parse_args()
    out: Path = options.out
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.work or Path(scratch)
        os.environ["ROBOXIM_CONFIG_PATH"] = str(folder)
        columns = [list(column(Path(pybullet_data.getDataPath()) / mesh, folder)) for mesh in MESHES]
    stages = []
    for parts in zip(*columns, strict=True):  # a stage lasts as long as its longest film
        most = max(map(len, parts))
        stages += [np.concatenate([part[min(k, len(part) - 1)] for part in parts], axis=1) for k in range(most)]
    frames = [Image.fromarray(frame) for frame in stages]
    frames += [frames[-1]] * 12
    frames[0].save(
        out, save_all=True, append_images=frames[1:], duration=round(1000 * FRAME_S), loop=0, quality=55, method=4
    )
    sys.stdout.write(f"wrote {out}: {len(frames)} frames, {out.stat().st_size / 1e6:.2f} MB\n")


def column(mesh: Path, folder: Path) -> Iterator[list[Picture]]:
    """Import a mesh; yield the film of each stage."""
    file = folder / "objects" / f"{object_id_of(mesh)}.yaml"
    if not file.is_file():
        sys.stdout.write("\n  ".join([mesh.name, *import_mesh(mesh, folder / "objects").report]) + "\n")
    model = ModelLibrary().object(file.stem)
    if not model.grasps:
        sys.exit(f"{mesh.name}: no grasp was found; choose another mesh")
    renderer = make_renderer("raster")
    try:
        stage = Stage(renderer, model)
        yield [titled(picture, mesh.name) for picture in as_in_the_file(stage, mesh, folder)]
        count = len(model.links[0].collision)
        text = f"{count} convex parts" if count > 1 else "convex as it is"
        yield [titled(picture, text) for picture in parts_apart(stage)]
        yield [titled(picture, "dropped until it rests") for picture in dropped(stage)]
        text = f"a floating hand proves {len(model.grasps)} grasps"
        yield [titled(picture, text) for picture in grasped(stage)]
    finally:
        renderer.close()
    yield [titled(picture, "picked up by the expert") for picture in picked_up(model.id)]


class Stage:
    """The default table with one object, and a camera that sees it."""

    def __init__(self, renderer: Renderer, model: ObjectModel) -> None:
        """Set the renderer and the object."""
        self.renderer, self.model = renderer, model
        self._reach = 0.5 * float(np.linalg.norm(model.size)) + 0.02

    def draw(self, shapes: dict[str, tuple[Visual, Pose]], middle: Array = PLACE, more_m: float = 0.0) -> Picture:
        """Return a picture of shapes at poses in the world.

        Args:
            shapes: Name to what is drawn and where.
            middle: Point of the table in the middle of the picture [m].
            more_m: Height above the object that is seen, too [m].
        """
        reach = self._reach + more_m / 2
        middle = middle + (0.0, 0.0, 0.45 * reach)
        view = look_at(middle + 4.6 * reach * np.array((0.62, 0.52, 0.59)), middle)
        room = render_world(SceneSpec(), ModelLibrary())
        bodies = [body for body in room.bodies if body.entity != "robot"]
        bodies += [RenderBody(key=key, entity="it", parts=visual_parts(visual)) for key, (visual, _) in shapes.items()]
        self.renderer.load(replace(room, bodies=tuple(bodies)))
        camera = CameraSpec(name="film", width=2 * SIDE, height=2 * SIDE, fov_y_rad=0.5, near=0.02)
        poses = {key: pose for key, (_, pose) in shapes.items()}
        return self.renderer.render(poses, [(camera, view)])["film"].rgb

    def own(self, pose: Pose) -> dict[str, tuple[Visual, Pose]]:
        """Return the object's own visuals at a pose of its base."""
        return {f"own{k}": (visual, pose) for k, visual in enumerate(self.model.links[0].visual)}


def as_in_the_file(stage: Stage, mesh: Path, folder: Path) -> Iterator[Picture]:
    """Yield the mesh as it is in its file, turning once."""
    _, solid = placed(mesh, 1.0, "z")
    scale = UNITS[guessed_unit(float(max(solid.extents)))]
    scene = trimesh.load_scene(mesh, process=False)
    scene.apply_transform(np.diag([scale, scale, scale, 1.0]))
    middle, low = scene.bounds.mean(axis=0), scene.bounds[0][2]
    scene.apply_translation((-middle[0], -middle[1], -low))
    file = folder / f"{mesh.stem}_raw.glb"
    file.write_bytes(scene.export(file_type="glb"))
    visual = Visual(kind="mesh", mesh=str(file))
    for turn in np.linspace(0.0, 2 * np.pi, 20, endpoint=False):
        yield stage.draw({"raw": (visual, Pose.from_arrays(PLACE, Rotation.from_euler("z", turn)))})


def parts_apart(stage: Stage) -> Iterator[Picture]:
    """Yield the convex parts in colours, as they move apart and together again."""
    shapes = stage.model.links[0].collision
    middles = [trimesh.load_mesh(shape.mesh).bounds.mean(axis=0) for shape in shapes]
    lift = np.array((0.0, 0.0, stage.model.rest_height))
    base = PLACE + lift
    for share in np.sin(np.linspace(0.0, np.pi, 16)):
        yield stage.draw(
            {
                f"part{k}": (
                    Visual(
                        kind="hull", mesh=shape.mesh, scale=(shape.scale,) * 3,
                        material=MaterialSpec(color=PALETTE[PART_COLOURS[k % len(PART_COLOURS)]]),
                    ),
                    Pose.from_arrays(base + 0.6 * share * (middle + lift), Rotation.identity()),
                )
                for k, (shape, middle) in enumerate(zip(shapes, middles, strict=True))
            }
        )  # fmt: skip


def dropped(stage: Stage) -> Iterator[Picture]:
    """Yield a fall onto the table from a random orientation, and the pose in which the object stands."""
    client = BulletClient()
    try:
        configure(client, 240.0)
        build_table(client, TableSpec())
        start = Pose.from_arrays((*PLACE[:2], 0.5), Rotation.random(random_state=1))
        body = ObjectBody(client, stage.model, EntitySpec(name="it", model=stage.model.id, pose=start))
        position, turn = client.getBasePositionAndOrientation(body.id)
        lift = DROP_M - client.getAABB(body.id, -1)[0][2]
        client.resetBasePositionAndOrientation(body.id, [*position[:2], position[2] + lift], turn)
        for _ in range(14):
            now = pose_of(body)
            yield stage.draw(stage.own(now), np.array((*now.position[:2], 0.0)))
            for _ in range(24):
                client.stepSimulation()
    finally:
        client.disconnect()


def grasped(stage: Stage) -> Iterator[Picture]:
    """Yield the trial of the first grasp: the floating hand closes, and lifts the object."""
    client = BulletClient()
    try:
        configure(client, 240.0)
        build_table(client, TableSpec())
        pose = Pose(position=(*PLACE[:2].tolist(), stage.model.rest_height))
        body = ObjectBody(client, stage.model, EntitySpec(name="it", model=stage.model.id, pose=pose))
        grasp = stage.model.grasps[0]
        hand = FloatingHand(client, pose @ grasp.pose, grasp.opening_m)
        for way in [(0.0, 0.0, 0.0)] * 5 + [(0.0, 0.0, LIFT_M / 10)] * 10 + [(0.0, 0.0, 0.0)] * 2:
            yield stage.draw({**stage.own(pose_of(body)), **hand_shapes(client, hand)}, more_m=LIFT_M)
            hand.run(FRAME_S, 0.0, way)
    finally:
        client.disconnect()


def hand_shapes(client: BulletClient, hand: FloatingHand) -> dict[str, tuple[Visual, Pose]]:
    """Return the boxes of the floating hand at their poses."""
    grey = MaterialSpec(color=(0.85, 0.86, 0.88))
    size, (x, y, z) = TIP
    palm = Visual(kind="box", size=(0.04, 0.2, 0.02), pose=Pose(position=(0.0, 0.0, 0.055)), material=grey)
    shapes = {"palm": (palm, hand.base)}
    for number, side in ((0, 1), (1, -1)):
        position, turn = client.getLinkState(hand.id, number, computeForwardKinematics=True)[4:6]
        tip = Visual(kind="box", size=size, pose=Pose(position=(x, side * y, z)), material=grey)
        shapes[f"finger{number}"] = (tip, Pose(position=tuple(position), quat_xyzw=tuple(turn)))
    return shapes


def pose_of(body: ObjectBody) -> Pose:
    """Return the pose of an object's base."""
    joints = body.read_joints()[0]
    return body.read(joints, joints)[0].pose


def picked_up(object_id: str) -> Iterator[Picture]:
    """Yield what the workspace camera sees while the expert picks the object up."""
    change = {"objects": {"target": {"models": [object_id]}}, "distractors": {"minimum": 0, "maximum": 0}}
    task = yaml.safe_dump(merged(yaml.safe_load(task_text(skill="pick_up")), change))
    with tempfile.TemporaryDirectory() as folder, CoreGraph(Path(folder)) as cores:
        config = RunConfig(
            run_seed=3, purpose="demo", task_config=task, output_dir=folder, cameras=("workspace",),
            image_width=2 * SIDE, image_height=2 * SIDE, stop_on_success=False,
        )  # fmt: skip
        result = EpisodeRunner(cores.ports, config).run_index(0)
        if result.outcome != "success":
            sys.exit(f"{object_id}: the expert failed ({result.reason}); choose another mesh or seed")
        for tick in BagReader(Path(folder, result.bag)).ticks(("workspace",)):
            if tick.seq % 3 == 0:
                yield np.asarray(Image.fromarray(tick.images["workspace"]).crop(MIDDLE).resize((2 * SIDE, 2 * SIDE)))


def titled(picture: Picture, text: str) -> Picture:
    """Return a picture at half its size under a line of text."""
    line = Image.new("RGB", (SIDE, LINE), "white")
    ImageDraw.Draw(line).text((4, 3), text, "black", ImageFont.load_default(14))
    small = Image.fromarray(picture).resize((SIDE, SIDE), Image.Resampling.BOX)
    return np.concatenate([np.asarray(line), np.asarray(small)])


if __name__ == "__main__":
    main()
