"""The interface of renderers: plain values in, images out. A renderer depends on no physics engine and not on ROS.

The geometry of a world is loaded once per scene; each tick then passes the poses of its bodies.
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
    """Texture coordinates, shape (N, 2); None: no texture."""


@dataclass(frozen=True, kw_only=True, eq=False)
class VisualPart:
    """A mesh with one material, in a link's frame."""

    mesh: TriangleMesh
    """The geometry."""
    material: MaterialSpec
    """The material."""


@dataclass(frozen=True, kw_only=True, eq=False)
class RenderBody:
    """A rigid body to draw: a link of a robot or an object, the table, the floor, or a wall."""

    key: str
    """Unique key that poses refer to: ``<entity>`` for a rigid object, otherwise ``<entity>/<link>``."""
    entity: str
    """Entity that the body belongs to: an entity's name, ``robot``, ``table``, ``floor`` or ``wall``."""
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
        """Names of the entities, in the order of their first bodies."""
        return tuple(dict.fromkeys(body.entity for body in self.bodies))


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraImages:
    """Images of one camera at one tick. Arrays are C-contiguous and not shared with later frames."""

    rgb: npt.NDArray[np.uint8]
    """Shape (height, width, 3), sRGB."""
    depth: npt.NDArray[np.float32] | None = None
    """Distance along the optical axis, shape (height, width) [m]; infinity without a surface or beyond ``far``."""
    segmentation: npt.NDArray[np.uint16] | None = None
    """Entity ids (see `RenderWorld`), shape (height, width)."""

    def freeze(self) -> None:
        """Make the arrays read-only."""
        for array in (self.rgb, self.depth, self.segmentation):
            if array is not None:
                array.flags.writeable = False


class Renderer(Protocol):
    """A renderer of worlds. Only the thread that made a renderer may call it; calls of other threads are refused.

    A renderer draws the pinhole image of a camera (`CameraSpec.matrix`, size, near, far). It ignores lens distortion,
    noise and frame rate: `roboxim_sim.rendering.camera_effects` adds them to the images of every renderer.
    """

    name: str
    """Registered name, e.g. ``raster``."""
    device: str
    """The device that draws: the GL renderer's string, or ``PyBullet TinyRenderer``."""

    def load(self, world: RenderWorld) -> None:
        """Replace the world."""
        ...

    def render(
        self, poses: Mapping[str, Pose], cameras: Sequence[tuple[CameraSpec, Pose]], *, colour: bool = True
    ) -> dict[str, CameraImages]:
        """Draw all cameras of a tick.

        Args:
            poses: Body key to pose in the world; static bodies left out stay at the identity.
            cameras: Cameras with the pose of their optical frames in the world.
            colour: False: the caller needs no colour, so that a renderer may leave ``rgb`` black; depth and
                segmentation are the same.

        Returns:
            Camera name to images, with depth and segmentation if the camera's specification requests them.
        """
        ...

    def close(self) -> None:
        """Free the context."""
        ...
