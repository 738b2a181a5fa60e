"""Reset component ``look``: a room of a set (materials, lights, background, view), or lights of ``config/lights``."""

from __future__ import annotations

from dataclasses import dataclass, replace

from roboxim_core.errors import ConfigError, one_of
from roboxim_core.models.visuals import camera_parent
from roboxim_core.specs import SceneSpec
from roboxim_core.vision.cameras import load_camera, with_noise_seed
from roboxim_core.vision.looks import Lighting, LookSet
from roboxim_tasks.choices import Choice
from roboxim_tasks.components.base import ResetComponent, ResetContext, register
from roboxim_tasks.files import named

VIEWED = "workspace"
"""Camera that a look's view is for."""


@dataclass(frozen=True, kw_only=True)
class LookResetConfig:
    """The room around the table. ``lights``, ``surfaces`` and ``background`` vary what it gives."""

    set: str = ""
    """Set of looks in ``config/looks``, e.g. ``varied``; empty: the scene's look."""
    names: Choice | None = None
    """Looks of the set to choose from; none: all, at random."""
    lights: Choice | None = None
    """Names in ``config/lights``, instead of the look's lights."""

    def __post_init__(self) -> None:
        """Check the names.

        Raises:
            ConfigError: When a set, a look or a file of lights is unknown or invalid; names the key.
        """
        known = named("looks", self.set, LookSet).looks if self.set else {}
        if self.names is not None:
            self.names.require_words("names", "names of looks")
            for name in map(str, self.names.values):
                if name not in known:
                    raise ConfigError(f"names: no look '{name}' in set '{self.set}'; {one_of(known, name)}")
        if self.lights is not None:
            self.lights.require_words("lights", "names in config/lights")
            for name in map(str, self.lights.values):
                named("lights", name, Lighting)


@register
class LookReset(ResetComponent):
    """Draws a look and lights.

    Randomisation: the look and the lights have a random stream each. The task records them as ``drawn["look"]`` and
    ``drawn["lights"]``, and the look's view as ``drawn["camera.workspace"]``.
    """

    name = "look"
    before = "lights"
    Config = LookResetConfig

    def reset(self, scene: SceneSpec, context: ResetContext) -> SceneSpec:
        """Draw the look."""
        config: LookResetConfig = self.config
        if config.set:
            looks = named("looks", config.set, LookSet).looks
            choice = config.names or Choice(values=tuple(looks))
            name = str(choice.draw(context.rng(self.name), context.index))
            context.record("look", choice, name)
            scene = replace(scene, look=looks[name].look)
            if looks[name].view:
                scene = _viewed(scene, looks[name].view, context)
        if config.lights is not None:
            name = str(config.lights.draw(context.rng(f"{self.name}/lights"), context.index))
            context.record("lights", config.lights, name, always=True)
            lighting = named("lights", name, Lighting)
            ambient = lighting.ambient or scene.look.ambient
            scene = replace(scene, look=replace(scene.look, lights=lighting.lights, ambient=ambient))
        return scene


def _viewed(scene: SceneSpec, view: str, context: ResetContext) -> SceneSpec:
    """Return the scene with the viewed camera at another place, unless the task's cameras vary themselves."""
    cameras = context.config.reset.get("cameras")
    if cameras and any(
        VIEWED in given for given in (cameras.views, cameras.shift_m, cameras.turn_rad, cameras.exposure_ev)
    ):
        return scene
    context.record(f"camera.{VIEWED}", Choice(values=(view,)), view, always=True)
    file = load_camera(view)
    placed = [
        with_noise_seed(replace(file, name=VIEWED, parent=camera_parent(file, context.arm)), context.seed)
        if camera.name == VIEWED
        else camera
        for camera in scene.cameras
    ]
    return replace(scene, cameras=tuple(placed))
