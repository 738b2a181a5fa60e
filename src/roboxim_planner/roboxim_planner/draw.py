"""Pictures of a query: the scene with the path through it, and the motion's profiles against their limits.

The pictures show what the planner checks: convex hulls, not visual meshes. Matplotlib is imported only here and draws
without a display.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from mpl_toolkits.mplot3d.art3d import Poly3DCollection

from roboxim_core.errors import PlannerError
from roboxim_core.poses import Pose
from roboxim_planner.collisions.contacts import ContactPair
from roboxim_planner.pipeline import Plan, Planner
from roboxim_planner.queries import Answer, IkQuery, LineQuery, PoseQuery, Query, RetimeQuery, SequenceQuery
from roboxim_planner.robot import PlannerRobot
from roboxim_planner.scene import PlanningScene
from roboxim_planner.triangles import body_triangles, robot_triangles

Array = npt.NDArray[np.float64]
DPI = 110
_LIGHT = np.array([0.35, -0.45, 0.82]) / np.linalg.norm([0.35, -0.45, 0.82])
_START, _END, _GHOST, _HELD, _BAD = "#8fa3b5", "#e8963c", "#b9c3cc", "#5fa55a", "#cc2f2f"
_OBSTACLES = ("#c8a27a", "#7d9cc0", "#b48ead", "#a3b18a", "#d08770", "#8a8f98")
_VIEWS = ((24.0, -52.0, "from the front, right"), (90.0, -90.0, "from above"))


def draw_scene(query: Query, planner: Planner, answer: Answer | None, path: Path, *, error: str = "") -> Path:
    """Draw the scene, the robot at the start, along the path and at the end, and the contacts.

    Args:
        query: The query.
        planner: Planner of the robot.
        answer: The answer; none after an error.
        path: PNG file to write.
        error: Error message of the planner; empty: there was no error.

    Returns:
        The file.
    """
    plans = answer.plans if answer is not None else ()
    picture = _Picture(query, planner, plans, answer)
    figure = Figure(figsize=(15.0, 8.2), dpi=DPI)
    for column, (elevation, azimuth, name) in enumerate(_VIEWS):
        axes: Any = figure.add_axes((0.5 * column, 0.05, 0.5, 0.84), projection="3d")
        picture.fill(axes)
        axes.view_init(elev=elevation, azim=azimuth)
        axes.text2D(0.5, 0.97, name, transform=axes.transAxes, ha="center", color="#555555")
    figure.text(0.02, 0.975, _title(query, plans), fontsize=13, fontweight="bold", va="top")
    figure.text(0.02, 0.94, "\n".join(textwrap.wrap(error, 190)[:3]), fontsize=10, va="top", color=_BAD)
    figure.legend(handles=picture.legend(), loc="lower center", ncol=9, frameon=False, fontsize=9)
    return _save(figure, path)


def draw_profiles(query: Query, planner: Planner, plans: Sequence[Plan], path: Path) -> Path:
    """Draw joint positions, velocities, accelerations and jerks as fractions of their limits, and the TCP's speed.

    Args:
        query: The query; its options give the limits.
        planner: Planner of the robot.
        plans: Motions in sequence, at least one.
        path: PNG file to write.

    Returns:
        The file.
    """
    robot = planner.robot
    figure = Figure(figsize=(12.0, 11.0), dpi=DPI)
    axes = figure.subplots(5, 1, sharex=True)
    colors = [f"C{i % 10}" for i in range(robot.dof)]
    peaks = np.zeros(3)
    begun = 0.0
    for plan, options in zip(plans, _options(query, len(plans)), strict=True):
        limits = planner.limits(options)
        times = np.unique(np.append(np.arange(0.0, plan.duration, 1e-3), plan.duration))
        q, v, a, j = plan.motion.evaluate(times)
        shares = [
            2.0 * (q - robot.lower) / (robot.upper - robot.lower) - 1.0,
            v / limits.velocity,
            a / limits.acceleration,
            j / limits.jerk,
        ]
        peaks = np.maximum(peaks, [float(np.abs(share).max()) for share in shares[1:]])
        for row, share in enumerate(shares):
            for i, color in enumerate(colors):
                axes[row].plot(begun + times, share[:, i], color=color, linewidth=1.3)
        linear, angular = _tcp_speeds(robot, q, v)
        axes[4].plot(begun + times, linear, color="#333333", label="speed [m/s]" if begun == 0.0 else None)
        axes[4].plot(
            begun + times, angular, color="#999999", linestyle="--", label="angular [rad/s]" if begun == 0.0 else None
        )
        for limit, color in ((limits.tcp_speed, "#333333"), (limits.tcp_rot_speed, "#999999")):
            if np.isfinite(limit):
                axes[4].hlines(limit, begun, begun + plan.duration, color=color, linestyle=":", linewidth=1.2)
        begun += plan.duration
        for axis in axes:
            axis.axvline(begun, color="#cccccc", linewidth=0.8, zorder=0)
    for axis, name in zip(axes, ("position", "velocity", "acceleration", "jerk", "tcp"), strict=True):
        axis.set_ylabel(name)
        axis.grid(alpha=0.25)
        axis.margins(x=0.01)
        if axis is not axes[4]:
            axis.axhline(1.0, color=_BAD, linestyle="--", linewidth=1.0)
            axis.axhline(-1.0, color=_BAD, linestyle="--", linewidth=1.0)
            axis.set_ylim(-1.15, 1.15)
            axis.set_yticks([-1.0, -0.5, 0.0, 0.5, 1.0], ["-limit", "", "0", "", "limit"])
    axes[0].set_yticks([-1.0, 0.0, 1.0], ["lower", "middle", "upper"])
    axes[4].set_xlabel("time [s]")
    axes[4].legend(loc="upper right", fontsize=9, frameon=False)
    figure.legend(
        handles=[Line2D([], [], color=c, label=n) for c, n in zip(colors, robot.description.joint_names, strict=True)],
        loc="lower center", ncol=min(8, robot.dof), frameon=False, fontsize=9,
    )  # fmt: skip
    peaks_text = ", ".join(
        f"{n} {100 * p:.1f} %" for n, p in zip(("velocity", "acceleration", "jerk"), peaks, strict=True)
    )
    figure.suptitle(f"{_title(query, plans)}\nhighest share of its limit at 1 kHz: {peaks_text}", fontsize=11, y=0.985)
    figure.subplots_adjust(left=0.08, right=0.98, top=0.925, bottom=0.085, hspace=0.12)
    return _save(figure, path)


class _Picture:
    """Triangles and lines of a query, computed once and drawn in several views."""

    def __init__(self, query: Query, planner: Planner, plans: Sequence[Plan], answer: Answer | None) -> None:
        self._planner = planner
        self._base = query.scene.robot_pose
        self._triangles: list[Array] = []
        self._colors: list[Array] = []
        self._entries: dict[str, str] = {}
        self._first: list[Array] = []
        self.contacts: list[ContactPair] = []
        scene = query.scene
        for index, body in enumerate(scene.bodies):
            color = _OBSTACLES[index % len(_OBSTACLES)]
            self._add(body_triangles(body), color, 1.0)
            self._entries[body.name] = color
        joints = [plan.sample(max(plan.duration / 120.0, 1e-3)).positions for plan in plans]
        if not joints and isinstance(query, RetimeQuery):
            joints = [np.array(query.path)]
        self.lines = [self._tcp(path) for path in joints]
        self.goals = _goals(query)
        self._robots(query, np.concatenate(joints) if joints else None, answer)

    def _robots(self, query: Query, path: Array | None, answer: Answer | None) -> None:
        scene = query.scene
        start = np.array(query.start) if query.start else (None if path is None else path[0])
        if start is not None:
            self._arm(scene, start, _START, 1.0, "seed state" if isinstance(query, IkQuery) else "start")
            self._note(scene, start)
        if path is not None:
            for q in path[np.linspace(0, len(path) - 1, 6).astype(int)[1:-1]]:
                self._arm(scene, q, _GHOST, 0.22, "on the way")
            self._arm(self._last_scene(query, answer), path[-1], _END, 1.0, "end")
            return
        solutions = answer.solutions if answer is not None else self._nearest(query)
        for q in solutions[:4]:
            self._arm(scene, q, _END, 0.75, "solution" if answer is not None else "nearest goal configuration")
            self._note(scene, q)

    def _last_scene(self, query: Query, answer: Answer | None) -> PlanningScene:
        """Return the scene at the end of the motion: a sequence attaches and releases bodies and moves the gripper."""
        scene = query.scene
        if isinstance(query, SequenceQuery) and answer is not None:
            for stage, plan in zip(query.stages, answer.plans, strict=True):
                start = plan.motion.evaluate(np.zeros(1))[0][0]
                _, scene = stage.enter(scene, self._base @ self._planner.robot.fk(start))
        return scene

    def _nearest(self, query: Query) -> Array:
        """Return the nearest goal configurations of a failed query, collisions ignored."""
        for goal in self.goals:
            try:
                return self._planner.inverse_kinematics(goal, query.start, robot_pose=self._base)
            except PlannerError:
                continue
        wanted = np.array(getattr(query, "goal", ()))
        return wanted[None] if wanted.size else np.empty((0, self._planner.robot.dof))

    def _note(self, scene: PlanningScene, q: Array) -> None:
        self.contacts += self._planner.check_state(scene, q).contacts

    def _arm(self, scene: PlanningScene, q: Array, color: str, alpha: float, name: str) -> None:
        self._entries[name] = color
        links = list(robot_triangles(self._planner.robot, q, scene.gripper_opening))
        for triangles, drawn in zip(links, self._first or links, strict=True):
            if not self._first or np.abs(triangles - drawn).max() > 1e-6:  # a link that has not moved is already drawn
                self._add(self._base.apply(triangles.reshape(-1, 3)).reshape(-1, 3, 3), color, alpha)
        self._first = self._first or links
        tcp = self._base @ self._planner.robot.fk(q)
        for held in scene.attached:
            self._entries[held.body.name] = _HELD
            corners = body_triangles(held.body)
            self._add(tcp.apply(corners.reshape(-1, 3)).reshape(-1, 3, 3), _HELD, alpha)

    def _tcp(self, path: Array) -> Array:
        return np.array([(self._base @ pose).position for pose in self._planner.robot.tcp_poses(path)])

    def _add(self, triangles: Array, color: str, alpha: float) -> None:
        normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        light = 0.62 + 0.38 * np.abs(normals @ _LIGHT)
        rgb = np.array([int(color[k : k + 2], 16) / 255.0 for k in (1, 3, 5)])
        self._triangles.append(triangles)
        self._colors.append(np.concatenate([light[:, None] * rgb, np.full((len(light), 1), alpha)], axis=1))

    def fill(self, axes: Any) -> None:
        """Draw into axes."""
        triangles, colors = np.concatenate(self._triangles), np.concatenate(self._colors)
        axes.add_collection3d(Poly3DCollection(triangles, facecolors=colors, edgecolors="none", zsort="average"))
        for index, line in enumerate(self.lines):
            axes.plot(*line.T, color=f"C{index % 10}", linewidth=2.5, zorder=10_000)
        for goal in self.goals:
            origin = np.array(goal.position)
            for axis, color in zip(goal.rotation.as_matrix().T, ("r", "g", "b"), strict=True):
                axes.plot(*np.stack([origin, origin + 0.08 * axis]).T, color=color, linewidth=2.0, zorder=10_001)
        for contact in self.contacts:
            axes.plot(*np.array(contact.position)[:, None], "o", color=_BAD, markersize=7, zorder=10_002)
        low, high = self._extent()
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]))
        size = high - low
        axes.set_box_aspect(size, zoom=1.3 * min(1.0, float(np.linalg.norm(size) / size.max()) / 1.45))  # long: smaller
        axes.set_axis_off()

    def _extent(self) -> tuple[Array, Array]:
        """Return the corners of a box around what is within 1.6 m of the robot's base, and goals within 4 m."""
        base = np.array(self._base.position)
        shapes = np.clip(np.concatenate(self._triangles).reshape(-1, 3) - base, -1.6, 1.6)
        goals = np.clip(np.array([goal.position for goal in self.goals]).reshape(-1, 3) - base, -4.0, 4.0)
        near = np.concatenate([shapes, goals - 0.08, goals + 0.08]) + base
        return near.min(axis=0), near.max(axis=0)

    def legend(self) -> list[Any]:
        """Return the legend's entries."""
        entries: list[Any] = [Patch(color=color, label=name) for name, color in self._entries.items()]
        if self.lines:
            entries.append(Line2D([], [], color="C0", linewidth=2.5, label="path of the TCP"))
        if self.goals:
            entries.append(Line2D([], [], color="r", linewidth=2.0, label="goal: x red, y green, z blue"))
        if self.contacts:
            entries.append(Line2D([], [], color=_BAD, marker="o", linestyle="", label="contact"))
        return entries


def _goals(query: Query) -> list[Pose]:
    if isinstance(query, PoseQuery):
        return list(query.targets)
    if isinstance(query, LineQuery):
        return list(query.waypoints)
    if isinstance(query, IkQuery):
        return [query.target]
    if isinstance(query, SequenceQuery):
        return [
            goal.pose for stage in query.stages for goal in stage.goals if goal.frame == "world" and not goal.relative
        ]
    return []


def _options(query: Query, count: int) -> list[Any]:
    if isinstance(query, SequenceQuery):
        return [stage.options or query.options for stage in query.stages][:count]
    return [query.options] * count


def _tcp_speeds(robot: PlannerRobot, q: Array, v: Array) -> tuple[Array, Array]:
    every = max(1, len(q) // 400)
    places = np.arange(0, len(q), every)
    rates = np.array([robot.kinematics.jacobian(q[i]) @ v[i] for i in places])
    full = np.arange(len(q))
    return (
        np.interp(full, places, np.linalg.norm(rates[:, :3], axis=1)),
        np.interp(full, places, np.linalg.norm(rates[:, 3:], axis=1)),
    )


def _title(query: Query, plans: Sequence[Plan]) -> str:
    what = f"{query.kind}, {query.robot}"
    if isinstance(query, RetimeQuery):
        what += f", path of {len(query.path)} points"
    if not plans:
        return what
    routes = ", ".join(f"{plan.duration:.2f} s (route: {plan.route})" for plan in plans)
    return f"{what}: {routes}"


def _save(figure: Figure, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    canvas: Any = FigureCanvasAgg(figure)
    canvas.print_png(str(path))
    return path
