"""Rendering of recorded states without simulation: a scene's models at the poses of a state record."""

from __future__ import annotations

from dataclasses import replace

from roboxim_core.kinematics import Arms
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses, render_world
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_core.vision.renderer import CameraImages, Renderer
from roboxim_sim.rendering.camera_effects import draw_frames


class StateRenderer:
    """Draws states with a renderer. Use it from the renderer's thread only; the renderer's owner closes that."""

    def __init__(self, renderer: Renderer, library: ModelLibrary) -> None:
        """Use a renderer and the models of a library."""
        self.renderer = renderer
        self._library = library
        self._loaded: SceneSpec | None = None
        self._arms = Arms(library)

    def draw(self, scene: SceneSpec, state: StateRecord, *, colour: bool = True) -> dict[str, CameraImages]:
        """Return the images of a state from each camera of a scene; loads a scene once for many states and cameras.

        Args:
            scene: The scene.
            state: Poses of its robot and entities.
            colour: See `Renderer.render`.

        Raises:
            ConfigError: On an unknown model, texture or link.
            InvalidRequestError: On a malformed world or an impossible camera.
            SimError: As the renderer's `load` and `render`.
        """
        bodies = replace(scene, cameras=())
        if self._loaded != bodies:
            self._loaded = None
            self.renderer.load(render_world(scene, self._library))
            self._loaded = bodies
        poses = ScenePoses(scene, self._library, self._arms[scene.robot.model])
        cameras = poses.camera_poses(state.robot)
        views = [(camera, cameras[camera.name]) for camera in scene.cameras]
        return draw_frames(self.renderer, state.seq, poses.body_poses(state), views, colour=colour)
