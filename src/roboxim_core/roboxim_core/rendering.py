"""The renderer's contract: plain values in, images out. A renderer knows no physics engine and no ROS.

A world's geometry is loaded once per scene; each tick then passes the poses of its bodies.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import numpy.typing as npt

from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, LookSpec, MaterialSpec


@dataclass(frozen=True, kw_only=True, eq=False)
class TriangleMesh:
    """A triangle mesh in its link's frame."""

    vertices: npt.NDArray[np.float32]
    """Shape (N, 3) [m]."""
    normals: npt.NDArray[np.float32]
    """Unit normals, shape (N, 3)."""
    faces: npt.NDArray[np.uint32]
    """Vertex indices, shape (M, 3), counter-clockwise from outside."""
    uv: npt.NDArray[np.float32] | None = None
    """Texture coordinates, shape (N, 2), or none."""


@dataclass(frozen=True, kw_only=True, eq=False)
class VisualPart:
    """A mesh with one material, in a link's frame."""

    mesh: TriangleMesh
    """The geometry."""
    material: MaterialSpec
    """The material."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderBody:
    """A rigid body to draw: one link of a robot or an object, the table, the floor."""

    key: str
    """Unique key; poses are given by it: ``<entity>`` for a rigid object, ``<entity>/<link>`` else."""
    entity: str
    """Entity that it belongs to: an entity's name, ``robot``, ``table``, ``floor`` or ``wall``."""
    parts: tuple[VisualPart, ...]
    """What to draw."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderWorld:
    """Everything to draw that does not change within an episode. Background, floor and table are bodies too."""

    bodies: tuple[RenderBody, ...]
    """The bodies; a body's segmentation id is the index of its entity in `entity_names`, plus 1 (0 = background)."""
    look: LookSpec
    """Lights and materials."""

    @property
    def entity_names(self) -> tuple[str, ...]:
        """Entities in the order of first appearance among the bodies."""
        return tuple(dict.fromkeys(body.entity for body in self.bodies))


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraImages:
    """What one camera sees at one tick. Arrays are C-contiguous and not shared with later frames."""

    rgb: npt.NDArray[np.uint8]
    """Shape (height, width, 3), sRGB."""
    depth: npt.NDArray[np.float32] | None = None
    """Distance along the optical axis, shape (height, width) [m]; nothing there, or beyond ``far``: infinity."""
    segmentation: npt.NDArray[np.uint16] | None = None
    """Entity ids (see `RenderWorld`), shape (height, width)."""


class Renderer(Protocol):
    """Draws a world. All calls of one renderer come from the thread that made it; another thread's are refused.

    A renderer draws a camera's pinhole (`CameraSpec.matrix`, size, near, far). Lens distortion, noise and frame rate
    are not its business: `roboxim_sim.rendering.rig` adds them to what any renderer draws.
    """

    name: str
    """Registered name, e.g. ``raster``."""
    device: str
    """The device that draws: the GL renderer's string, or ``PyBullet TinyRenderer``."""

    def load(self, world: RenderWorld) -> None:
        """Replace the world."""
        ...

    def render(self, poses: Mapping[str, Pose], cameras: Sequence[tuple[CameraSpec, Pose]]) -> dict[str, CameraImages]:
        """Draw all cameras of a tick.

        Args:
            poses: Body key to pose in the world; static bodies left out stay at the identity.
            cameras: Cameras with the pose of their optical frames in the world.

        Returns:
            Camera name to images; depth and segmentation where the camera asks for them.
        """
        ...

    def close(self) -> None:
        """Free the context."""
        ...
