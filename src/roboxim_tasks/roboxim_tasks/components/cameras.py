"""Reset component ``cameras``: the cameras of the scene, their poses and exposures."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.visuals import camera_parent
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, SceneSpec
from roboxim_core.vision.cameras import load_camera, with_noise_seed
from roboxim_tasks.choices import Choice, VectorChoice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register


@dataclass(frozen=True, kw_only=True)
class CamerasResetConfig:
    """The cameras and their variation."""

    names: tuple[str, ...] = ("workspace", "wrist")
    """Names of cameras in ``config/cameras``."""
    views: dict[str, Choice] = field(default_factory=dict)
    """Camera to the files of ``config/cameras`` that it is drawn from: a policy then sees one camera name from many
    poses. A camera that is left out uses the file of its name."""
    shift_m: dict[str, VectorChoice] = field(default_factory=dict)
    """Camera to a shift of its position in the parent frame [m]."""
    turn_rad: dict[str, VectorChoice] = field(default_factory=dict)
    """Camera to a rotation about its own x (tilt), y (pan) and z (roll) axes [rad]."""
    exposure_ev: dict[str, Choice] = field(default_factory=dict)
    """Camera to an exposure correction [stops], added to the one in the camera's file."""

    def __post_init__(self) -> None:
        """Check the names and lengths.

        Raises:
            ConfigError: When an unused camera varies, a vector does not have three numbers, or a camera's file is
                missing or invalid.
        """
        for key in ("views", "shift_m", "turn_rad", "exposure_ev"):
            for camera, choice in getattr(self, key).items():
                if camera not in self.names:
                    raise ConfigError(f"{key} names camera '{camera}', which is not used; {one_of(self.names, camera)}")
                if isinstance(choice, VectorChoice):
                    choice.require_size(3, f"{key}.{camera}")
                elif key == "exposure_ev":
                    choice.require_numbers(f"{key}.{camera}", -8.0, 8.0)
        for name in self.names:
            views = self.views.get(name, Choice(values=(name,)))
            if not views.values:
                raise ConfigError(f"views.{name} must be values, names of files in config/cameras, not a range")
            for view in views.values:
                load_camera(str(view))


@register
class CamerasReset(ResetComponent):
    """Sets up the named cameras with drawn offsets.

    Randomisation: view, shift, turn and exposure of each camera. Each camera has its own random stream. The task
    records them as ``drawn["camera.<name>"]`` (the view), ``drawn["camera.<name>.exposure_ev"]`` and so on.
    """

    name = "cameras"
    Config = CamerasResetConfig

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw each camera.

        Raises:
            ConfigError: When a camera is unknown, or its parent is a link that the robot lacks.
        """
        return replace(scene, cameras=tuple(self._draw(name, context) for name in self.config.names))

    def _draw(self, name: str, context: ResetContext) -> CameraSpec:
        from scipy.spatial.transform import Rotation

        config, index = self.config, context.index
        view = name
        if name in config.views:
            view = str(config.views[name].draw(context.rng(f"{self.name}/{name}/view"), index))
            context.record(f"camera.{name}", config.views[name], view, always=True)
        camera = replace(load_camera(view), name=name)
        camera = replace(camera, parent=camera_parent(camera, context.arm))
        rng = context.rng(f"{self.name}/{name}")
        if name in config.shift_m:
            shift = config.shift_m[name].draw(rng, index)
            camera = replace(camera, pose=Pose.from_arrays(shift) @ camera.pose)
            context.record(f"camera.{name}.shift_m", config.shift_m[name], shift)
        if name in config.turn_rad:
            angles = config.turn_rad[name].draw(rng, index)
            turn = Pose.from_arrays((0, 0, 0), Rotation.from_euler("xyz", angles))
            camera = replace(camera, pose=camera.pose @ turn)
            context.record(f"camera.{name}.turn_rad", config.turn_rad[name], angles)
        if name in config.exposure_ev:
            exposure = config.exposure_ev[name].draw_number(rng, index)
            camera = replace(camera, noise=replace(camera.noise, exposure_ev=camera.noise.exposure_ev + exposure))
            context.record(f"camera.{name}.exposure_ev", config.exposure_ev[name], exposure)
        return with_noise_seed(camera, context.seed)
