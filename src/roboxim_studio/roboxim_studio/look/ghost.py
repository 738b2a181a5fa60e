"""What the planner sees, as a ghost in the view: its collision shapes, the newest path, and the arm at its end.

The shapes are the planner's own (`PlanningScene.from_state`): convex hulls, not the meshes that the renderer draws.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import viser

from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import IDENTITY, Pose
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_studio.look.scene_view import wxyz

BODY, ARM, PATH = (64, 192, 240), (240, 150, 60), (250, 176, 5)
"""Colours of obstacles, of the arm at the path's end, and of the path."""
OPACITY = 0.35
OUT_M = 0.002
"""Distance by which shapes are larger in the view: two surfaces at one place flicker [m]."""


class Ghost:
    """The planner's view of a scene. Call it from one thread at a time."""

    def __init__(self, server: viser.ViserServer, library: ModelLibrary, root: str) -> None:
        """Show nothing yet.

        Args:
            server: The server.
            library: Robots and objects.
            root: Name of the node that everything is below.
        """
        self._server, self._library, self._root = server, library, root
        self._bodies: dict[str, tuple[object, Any]] = {}
        self._line: Any = None
        self._arm: Any = None
        self.path: npt.NDArray[np.float64] = np.empty((0, 3))
        """Path of the tool in the world, shape (N, 3) [m]."""

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the obstacles that are shown."""
        return tuple(self._bodies)

    def show_scene(self, scene: SceneSpec, state: StateRecord) -> None:
        """Show the planner's obstacles of a state.

        Raises:
            ConfigError: When a model is unknown.
        """
        from roboxim_planner.scene import PlanningScene
        from roboxim_planner.triangles import body_triangles

        seen = PlanningScene.from_state(scene, state, self._library)
        with self._server.atomic():
            for name in [name for name in self._bodies if name not in seen.names]:
                self._bodies.pop(name)[1].remove()
            for body in seen.bodies:
                known = self._bodies.get(body.name)
                if known is None or known[0] != body.shapes:
                    if known is not None:
                        known[1].remove()
                    mesh = self._mesh(f"bodies/{body.name}", body_triangles(replace(body, pose=IDENTITY)), BODY)
                    self._bodies[body.name] = (body.shapes, mesh)
                self._bodies[body.name][1].position = body.pose.position
                self._bodies[body.name][1].wxyz = wxyz(body.pose)

    def show_path(self, path: npt.NDArray[np.float64]) -> None:
        """Show a path of the tool in the world, shape (N, 3) [m]; one of fewer than two points: none."""
        self.path = path
        if self._line is not None:
            self._line.remove()
            self._line = None
        if len(path) > 1:
            self._line = self._server.scene.add_line_segments(
                f"{self._root}/path", np.stack([path[:-1], path[1:]], axis=1).astype(np.float32), colors=PATH,
                thickness=2.5, thickness_units="screen",
            )  # fmt: skip

    def show_joint_path(self, scene: SceneSpec, arm: ArmKinematics, rows: Sequence[Sequence[float]]) -> None:
        """Show a joint path [rad] of the scene's robot as the path of its tool."""
        base = scene.robot.pose
        points = [base.apply(arm.fk(np.array(row, dtype=float)).position) for row in rows]
        self.show_path(np.array(points, dtype=float).reshape(-1, 3))

    def show_arm(self, base: Pose, robot: str, joints: Sequence[float], opening: float) -> None:
        """Show the planner's arm at joint positions [rad]."""
        from roboxim_planner.robot import PlannerRobot
        from roboxim_planner.triangles import robot_triangles

        self.hide_arm()
        made = PlannerRobot(self._library.robot(robot))
        links = list(robot_triangles(made, np.array(joints, dtype=float), opening))
        self._arm = self._mesh("arm", np.concatenate(links), ARM)
        self._arm.position, self._arm.wxyz = base.position, wxyz(base)

    def hide_arm(self) -> None:
        """Show no arm."""
        if self._arm is not None:
            self._arm.remove()
            self._arm = None

    def hide_scene(self) -> None:
        """Show neither obstacles nor an arm; the path stays."""
        for _, handle in self._bodies.values():
            handle.remove()
        self._bodies = {}
        self.hide_arm()

    def clear(self) -> None:
        """Show nothing."""
        self.hide_scene()
        self.show_path(np.empty((0, 3)))

    def _mesh(self, name: str, triangles: npt.NDArray[np.float64], colour: tuple[int, int, int]) -> Any:
        corners = triangles.reshape(-1, 3)
        middle = (corners.min(axis=0) + corners.max(axis=0)) / 2
        corners = (corners + OUT_M * np.sign(corners - middle)).astype(np.float32)
        return self._server.scene.add_mesh_simple(
            f"{self._root}/{name}", corners, np.arange(len(corners), dtype=np.uint32).reshape(-1, 3), color=colour,
            opacity=OPACITY, flat_shading=True, side="double", cast_shadow=False, receive_shadow=False,
        )  # fmt: skip
