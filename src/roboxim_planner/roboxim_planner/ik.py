"""Inverse kinematics of the tcp: Levenberg-Marquardt from many starts at once, vectorised over the starts.

Deterministic: the starts come from the caller's seed, the budget is a number of iterations. Any serial arm of revolute
and prismatic joints will do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from roboxim_core.errors import ErrorCode, PlannerError
from roboxim_core.poses import Pose
from roboxim_planner.robot import PlannerRobot

Array = npt.NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class IkConfig:
    """Budget and accuracy of the search."""

    position_tolerance_m: float = 1e-6
    """Largest position error of a solution [m]."""
    rotation_tolerance_rad: float = 1e-5
    """Largest rotation error of a solution [rad]."""
    iterations: int = 60
    """Iterations per start."""
    starts: int = 48
    """Starts per round: the reference, some near it, the rest uniform within the limits."""
    enough: int = 12
    """A round ends when so many of its starts have arrived (many of them at the same solution)."""
    rounds: int = 4
    """Rounds of new starts while no solution was found."""
    same_rad: float = 0.05
    """Solutions closer than this in every joint count as one [rad]."""


class IkSolver:
    """Finds arm configurations that put the tcp at a pose in the robot's base."""

    def __init__(self, robot: PlannerRobot, config: IkConfig | None = None) -> None:
        """Read the chain from the base to the tcp.

        Args:
            robot: The robot.
            config: Budget and accuracy; none: the defaults.
        """
        self.robot = robot
        self.config = config or IkConfig()
        self._read_chain()

    def _read_chain(self) -> None:
        model = self.robot.model
        data = model.createData()
        pin.computeJointJacobians(model, data, self.robot.full(np.zeros(self.robot.dof)))
        tcp = model.frames[self.robot.tcp_frame]
        chain = [i for i in model.supports[tcp.parentJoint] if i != 0]
        self._offsets = [(model.jointPlacements[i].rotation, model.jointPlacements[i].translation) for i in chain]
        self._tip = (tcp.placement.rotation, tcp.placement.translation)
        self._axes, self._skews, self._prismatic, self._columns = [], [], [], []
        arm = [model.getJointId(name) for name in self.robot.description.joint_names]
        for i in chain:
            motion = pin.getJointJacobian(model, data, i, pin.LOCAL)[:, model.joints[i].idx_v]
            prismatic = bool(np.linalg.norm(motion[3:]) < 0.5)
            axis = np.asarray(motion[:3] if prismatic else motion[3:])
            self._axes.append(axis)
            self._skews.append(pin.skew(axis))
            self._prismatic.append(prismatic)
            self._columns.append(arm.index(i))

    def nearest(self, target: Pose, reference: Array) -> Array | None:
        """Return the solution that descends from a reference, or none: what a small motion nearly always wants.

        Args:
            target: The tcp in the robot's base.
            reference: Arm configuration to start from, shape (dof,) [rad].
        """
        found = self.robot.kinematics.ik_near(target, reference)
        return found.joints if found.converged else None

    def solve(self, target: Pose, reference: Array, *, seed: int, rounds: int | None = None) -> Array:
        """Return all solutions found, nearest to the reference first.

        Args:
            target: The tcp in the robot's base.
            reference: Arm configuration that distances are measured from, shape (dof,) [rad].
            seed: Seed of the starts.
            rounds: Rounds of starts to spend even when solutions are found; none: the first that succeeds ends it.

        Returns:
            Shape (N, dof), N >= 1.

        Raises:
            PlannerError: ``GOAL_UNREACHABLE``, with how close the tcp came.
        """
        rng = np.random.default_rng(seed)
        found = np.empty((0, self.robot.dof))
        best: tuple[float, float] = (np.inf, np.inf)
        for turn in range(rounds or self.config.rounds):
            starts = self._starts(reference, rng, first=turn == 0)
            solutions, closest = self._descend(target, starts)
            found = np.concatenate([found, solutions])
            best = min(best, closest)
            if len(found) and rounds is None:
                break
        if not len(found):
            position, quat = (np.round(part, 4).tolist() for part in (target.position, target.quat_xyzw))
            raise PlannerError(
                f"goal unreachable: the tcp came within {1000.0 * best[0]:.1f} mm and {best[1]:.3f} rad of position "
                f"{position}, quaternion {quat} in the robot's base; move or turn the goal",
                ErrorCode.GOAL_UNREACHABLE,
            )
        return self._distinct(found, reference)

    def _starts(self, reference: Array, rng: np.random.Generator, *, first: bool) -> Array:
        low, high = self.robot.lower, self.robot.upper
        starts = rng.uniform(low, high, (self.config.starts, self.robot.dof))
        if first:
            near = max(1, self.config.starts // 4)
            starts[:near] = reference + rng.normal(0.0, 0.3, (near, self.robot.dof))
            starts[0] = reference
        return np.clip(starts, low, high)

    def _distinct(self, found: Array, reference: Array) -> Array:
        order = np.argsort(np.abs(found - reference).max(axis=1), kind="stable")
        kept: list[Array] = []
        for q in found[order]:
            if all(np.abs(q - other).max() > self.config.same_rad for other in kept):
                kept.append(q)
        return np.array(kept)

    def _descend(self, target: Pose, starts: Array) -> tuple[Array, tuple[float, float]]:
        """Run the descent; return the solutions, and the error [m], [rad] of the best that is none."""
        config = self.config
        goal_rotation, goal_position = target.matrix[:3, :3], target.matrix[:3, 3]
        q = starts.copy()
        solutions: list[Array] = []
        best = (np.inf, np.inf)
        for _ in range(config.iterations):
            rotation, position, jacobian = self._forward(q)
            error = np.concatenate([goal_position - position, _rotation_error(goal_rotation, rotation)], axis=1)
            off, turned = np.linalg.norm(error[:, :3], axis=1), np.linalg.norm(error[:, 3:], axis=1)
            closest = int(np.argmin(off + 0.1 * turned))
            best = min(best, (float(off[closest]), float(turned[closest])))
            done = (off <= config.position_tolerance_m) & (turned <= config.rotation_tolerance_rad)
            if done.any():
                solutions.extend(q[done])
                q, error, jacobian = q[~done], error[~done], jacobian[~done]
                if not len(q) or len(solutions) >= config.enough:
                    break
            q = self._step(q, error, jacobian)
        return np.array(solutions).reshape(-1, self.robot.dof), best

    def _step(self, q: Array, error: Array, jacobian: Array) -> Array:
        """One damped step; damping falls with the error (Sugihara, IEEE T-RO 2011), joints at a limit stay."""
        low, high = self.robot.lower, self.robot.upper
        damping = 0.5 * (error**2).sum(axis=1) + 1e-7
        gradient = np.einsum("nij,ni->nj", jacobian, error)
        stuck = ((q <= low) & (gradient < 0)) | ((q >= high) & (gradient > 0))
        active = np.where(stuck[:, None, :], 0.0, jacobian)
        normal = active @ active.transpose(0, 2, 1)
        normal[:, range(6), range(6)] += damping[:, None]
        step = np.einsum("nij,ni->nj", active, np.linalg.solve(normal, error[..., None])[..., 0])
        largest = np.abs(step).max(axis=1, keepdims=True)
        return np.asarray(np.clip(q + step * np.minimum(1.0, 0.6 / np.maximum(largest, 1e-12)), low, high))

    def _forward(self, q: Array) -> tuple[Array, Array, Array]:
        """Return rotation (N, 3, 3), position (N, 3) and Jacobian (N, 6, dof) of the tcp, in the base's axes."""
        count = len(q)
        rotation = np.broadcast_to(np.eye(3), (count, 3, 3))
        position = np.zeros((count, 3))
        axes, origins = [], []
        sin, cos = np.sin(q), np.cos(q)
        for k, (turn, shift) in enumerate(self._offsets):
            position = position + rotation @ shift
            rotation = rotation @ turn
            axes.append(rotation @ self._axes[k])
            column = self._columns[k]
            if self._prismatic[k]:
                position = position + axes[-1] * q[:, column, None]
            else:
                skew = self._skews[k]
                s, c = sin[:, column, None, None], 1.0 - cos[:, column, None, None]
                rotation = rotation @ (np.eye(3) + s * skew + c * (skew @ skew))
            origins.append(position)
        position = position + rotation @ self._tip[1]
        rotation = rotation @ self._tip[0]
        axis = np.stack(axes, axis=2)
        arm = position[:, :, None] - np.stack(origins, axis=2)
        turning = ~np.array(self._prismatic)
        jacobian = np.zeros((count, 6, self.robot.dof))
        jacobian[:, :3, self._columns] = np.where(turning, _cross(axis, arm), axis)
        jacobian[:, 3:, self._columns] = np.where(turning, axis, 0.0)
        return rotation, position, jacobian


def _cross(a: Array, b: Array) -> Array:
    """Return the cross product along axis 1; a tenth of numpy's time on small arrays."""
    x, y, z = a[:, 0], a[:, 1], a[:, 2]
    u, v, w = b[:, 0], b[:, 1], b[:, 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


def _rotation_error(goal: Array, rotation: Array) -> Array:
    """Return the rotation vectors (N, 3) that turn (N, 3, 3) into the goal (3, 3), in the base's axes."""
    relative = goal @ rotation.transpose(0, 2, 1)
    axis = 0.5 * np.stack(
        [
            relative[:, 2, 1] - relative[:, 1, 2],
            relative[:, 0, 2] - relative[:, 2, 0],
            relative[:, 1, 0] - relative[:, 0, 1],
        ],
        axis=1,
    )
    sine = np.linalg.norm(axis, axis=1)
    angle = np.arctan2(sine, 0.5 * (np.trace(relative, axis1=1, axis2=2) - 1.0))
    scale = np.where(sine > 1e-9, angle / np.maximum(sine, 1e-12), 1.0)
    flipped = (sine <= 1e-9) & (angle > 3.0)
    return np.where(flipped[:, None], np.array([np.pi, 0.0, 0.0]), axis * scale[:, None])
