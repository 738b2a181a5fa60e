"""The box that the commanded tool centre point stays in."""

from __future__ import annotations

from roboxim_core.poses import IDENTITY, Pose, Vec3
from roboxim_core.specs import WorkspaceSpec


class WorkspaceBox:
    """A workspace in the world, queried with positions in the robot's base.

    Note: a position that starts outside of the box is not moved inside; it only cannot move farther out.
    """

    def __init__(self, workspace: WorkspaceSpec, pose_base_in_world: Pose) -> None:
        """Describe the box.

        Args:
            workspace: The box in the world.
            pose_base_in_world: Pose of the robot's base.
        """
        self._workspace = workspace
        self._base = pose_base_in_world
        self._base_is_identity = pose_base_in_world == IDENTITY

    def keep(self, now: Vec3, then: Vec3) -> Vec3 | None:
        """Return the border position that replaces a position outside the box.

        Args:
            now: Position before the motion, in the base [m].
            then: Position after it.

        Returns:
            The replacement in the base; None: the motion stays inside.
        """
        now_world, then_world = (now, then) if self._base_is_identity else map(self._in_world, (now, then))
        bounds = zip(self._workspace.lower, self._workspace.upper, now_world, then_world, strict=True)
        inside = [min(max(c, min(low, b)), max(high, b)) for low, high, b, c in bounds]
        if all(abs(a - b) < 1e-9 for a, b in zip(inside, then_world, strict=True)):
            return None
        x, y, z = inside if self._base_is_identity else self._base.inverse().apply(inside).tolist()
        return x, y, z

    def _in_world(self, position: Vec3) -> Vec3:
        x, y, z = self._base.apply(position).tolist()
        return x, y, z
