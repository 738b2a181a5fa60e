"""Reset component ``cameras``: which cameras look at the scene, and from where."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from scipy.spatial.transform import Rotation

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.poses import Pose, Vec3, look_at
from roboxim_core.specs import CameraSpec, SceneSpec
from roboxim_tasks.choices import VectorChoice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register
from roboxim_tasks.files import named


@dataclass(frozen=True, kw_only=True)
class CameraConfig:
    """A YAML file of ``config/cameras``: a camera described by where it is and what it looks at."""

    parent: str = "world"
    """``world``, or the robot link that it is mounted on."""
    eye: Vec3
    """Position in the parent [m]."""
    target: Vec3
    """Point in the parent that is in the image's centre [m]."""
    up: Vec3 = (0.0, 0.0, 1.0)
    """Direction in the parent that shows upwards in the image."""
    fov_y_deg: float = 45.0
    """Vertical field of view [deg]."""
    width: int = 256
    """Image width [px]."""
    height: int = 256
    """Image height [px]."""
    near: float = 0.02
    """Nearest visible distance [m]."""
    far: float = 6.0
    """Farthest visible distance [m]."""

    def spec(self, name: str) -> CameraSpec:
        """Return the camera.

        Raises:
            InvalidRequestError: When the numbers make no image.
        """
        return CameraSpec(
            name=name,
            parent=self.parent,
            pose=look_at(self.eye, self.target, self.up),
            fov_y_rad=math.radians(self.fov_y_deg),
            width=self.width,
            height=self.height,
            near=self.near,
            far=self.far,
        )


@dataclass(frozen=True, kw_only=True)
class CamerasResetConfig:
    """Which cameras, and how their poses vary."""

    names: tuple[str, ...] = ("workspace", "wrist")
    """Names of cameras in ``config/cameras``."""
    shift_m: dict[str, VectorChoice] = field(default_factory=dict)
    """Camera to a shift of its position in the parent frame [m]."""
    turn_rad: dict[str, VectorChoice] = field(default_factory=dict)
    """Camera to a rotation about its own x (tilt), y (pan) and z (roll) axes [rad]."""

    def __post_init__(self) -> None:
        """Check the names and lengths.

        Raises:
            ConfigError: When a camera that is not used is to be moved, or a vector is not of three numbers.
        """
        for key, choices in (("shift_m", self.shift_m), ("turn_rad", self.turn_rad)):
            for camera, choice in choices.items():
                if camera not in self.names:
                    raise ConfigError(f"{key} names camera '{camera}', which is not used; {one_of(self.names, camera)}")
                choice.require_size(3, f"{key}.{camera}")


@register
class CamerasReset(ResetComponent):
    """Sets up the named cameras, moved by drawn amounts."""

    name = "cameras"
    Config = CamerasResetConfig

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw each camera's pose.

        Raises:
            ConfigError: When a camera is unknown or hangs on a link that the robot lacks.
        """
        cameras = []
        for name in self.config.names:
            spec = load_camera(name)
            if spec.parent != "world" and spec.parent not in context.arm.link_names:
                raise ConfigError(
                    f"camera '{name}': no link '{spec.parent}'; {one_of(context.arm.link_names, spec.parent)}"
                )
            rng = context.rng(f"{self.name}/{name}")
            shift, turn = self.config.shift_m.get(name), self.config.turn_rad.get(name)
            if shift is not None:
                spec = replace(spec, pose=Pose.from_arrays(shift.draw(rng, context.seed.index)) @ spec.pose)
            if turn is not None:
                angles = turn.draw(rng, context.seed.index)
                spec = replace(spec, pose=spec.pose @ Pose.from_arrays((0, 0, 0), Rotation.from_euler("xyz", angles)))
            cameras.append(spec)
        return replace(scene, cameras=tuple(cameras))


def load_camera(name: str) -> CameraSpec:
    """Load a camera of ``config/cameras``.

    Raises:
        ConfigError: When there is none of that name or its file is wrong.
    """
    return named("cameras", name, CameraConfig).spec(name)
