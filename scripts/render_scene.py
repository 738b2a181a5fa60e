"""Render the README's image: the workspace and the wrist camera's view of the Panda above a few objects."""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from PIL import Image

from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses, render_world
from roboxim_core.poses import IDENTITY, Pose, look_at
from roboxim_core.specs import CameraSpec, EntitySpec, SceneSpec
from roboxim_core.state import RobotState
from roboxim_sim.rendering import RENDERERS, make_renderer

OBJECTS = {
    "apple": (0.50, 0.06, 0.4),
    "soda_can": (0.58, -0.13, 1.0),
    "knife": (0.41, -0.12, 0.9),
    "plate": (0.63, 0.17, 0.7),
    "cucumber": (0.38, 0.21, 0.25),
}
"""Position x, y [m] and yaw [rad] by model."""
ARM = (0.12, 0.28, 0.0, -2.05, 0.0, 2.33, 0.9)
"""Arm joint positions [rad]: the hand above the apple."""


def example_scene(size: int, depth: bool = False, segmentation: bool = False) -> SceneSpec:
    """Return a table with objects in the default look, a workspace camera and a wrist camera.

    Args:
        size: Width and height of the cameras [px].
        depth: Whether the cameras deliver depth images.
        segmentation: Whether the cameras deliver segmentation images.
    """
    library = ModelLibrary()
    entities = tuple(
        EntitySpec(
            name=model,
            model=model,
            pose=Pose(
                position=(x, y, library.object(model).rest_height),
                quat_xyzw=(0.0, 0.0, math.sin(yaw / 2), math.cos(yaw / 2)),
            ),
        )
        for model, (x, y, yaw) in OBJECTS.items()
    )
    workspace = look_at((1.3, 0.6, 0.68), (0.3, -0.01, 0.23))
    wrist = look_at((0.095, 0.0, 0.03), (0.03, 0.0, 0.16), up=(1.0, 0.0, 0.0))
    flags = {"width": size, "height": size, "depth": depth, "segmentation": segmentation}
    cameras = (
        CameraSpec(name="workspace", pose=workspace, fov_y_rad=math.radians(48.0), **flags),
        CameraSpec(name="wrist", parent="panda_hand", pose=wrist, fov_y_rad=math.radians(75.0), near=0.01, **flags),
    )
    return SceneSpec(entities=entities, cameras=cameras)


def example_poses(
    scene: SceneSpec, library: ModelLibrary, turned_rad: float = 0.0
) -> tuple[dict[str, Pose], list[tuple[CameraSpec, Pose]]]:
    """Return the poses of the moving bodies and of the cameras, with the gripper open.

    Args:
        scene: The scene.
        library: Library of its models.
        turned_rad: Offset of the arm's joints from `ARM` [rad].
    """
    arm = tuple(angle + turned_rad for angle in ARM)
    state = RobotState(
        joint_names=library.robot(scene.robot.model).joint_names,
        joint_positions=arm,
        joint_velocities=(0.0,) * 7,
        joint_commands=arm,
        pose_tcp_measured=IDENTITY,
        pose_tcp_commanded=IDENTITY,
        gripper_opening=1.0,
        gripper_command=1.0,
        finger_positions=(0.04, 0.04),
    )
    placed = ScenePoses(scene, library)
    poses = {f"robot/{link}": pose for link, pose in placed.link_poses(state).items()}
    poses |= {entity.name: entity.pose for entity in scene.entities}
    views = placed.camera_poses(state)
    world_keys = {body.key for body in render_world(scene, library).bodies}
    return {k: v for k, v in poses.items() if k in world_keys}, [(c, views[c.name]) for c in scene.cameras]


def main() -> None:
    """Render and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images/scene.png"))
    parser.add_argument("--size", type=int, default=512, help="width and height of each view [px]")
    parser.add_argument("--renderer", choices=list(RENDERERS), default="raster")
    options = parser.parse_args()
    library, scene = ModelLibrary(), example_scene(options.size)
    poses, cameras = example_poses(scene, library)
    renderer = make_renderer(options.renderer)
    renderer.load(render_world(scene, library))
    images = renderer.render(poses, cameras)
    renderer.close()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.concatenate([image.rgb for image in images.values()], axis=1)).save(options.out, optimize=True)
    print(f"wrote {options.out}")


if __name__ == "__main__":
    main()
