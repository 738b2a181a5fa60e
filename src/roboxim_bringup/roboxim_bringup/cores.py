"""The rooms' cores connected without a node graph, for tests and benchmarks."""

from __future__ import annotations

import numpy as np

from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Array, Pose
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_core.surroundings import Surroundings
from roboxim_planner.pipeline import MotionOptions, Planner
from roboxim_planner.scene import SceneMaker
from roboxim_sim.rendering import make_renderer
from roboxim_sim.rendering.states import StateRenderer
from roboxim_tasks.sampling.visible import Segmentation

SAMPLE_PERIOD_S = 0.02


class CoreSegmentation:
    """The visibility check's segmentation port, served by a renderer's core.

    The first call of `segment` makes the renderer; all later calls must come from the same thread.
    """

    def __init__(self, library: ModelLibrary, renderer: str = "raster") -> None:
        """Use a renderer by name; the first call of `segment` makes it."""
        self._library, self._name = library, renderer
        self._states: StateRenderer | None = None

    def segment(self, scene: SceneSpec, state: StateRecord) -> dict[str, Segmentation]:
        """Return what the cameras of a scene see; see `roboxim_tasks.sampling.visible.SegmentationPort`."""
        if self._states is None:
            self._states = StateRenderer(make_renderer(self._name), self._library)
        images = self._states.draw(scene, state, colour=False)
        return {name: seen.segmentation for name, seen in images.items() if seen.segmentation is not None}

    def close(self) -> None:
        """Free the renderer."""
        if self._states is not None:
            self._states.renderer.close()
            self._states = None


class CorePlanner:
    """The expert's planner port, served by the planner's core. Not thread-safe."""

    def __init__(self, library: ModelLibrary) -> None:
        """Use the models of a library; each robot is loaded on first use."""
        self._library = library
        self._planners: dict[str, Planner] = {}
        self._scenes = SceneMaker(library)

    def plan_to_pose(self, joints: Array, pose_tcp_in_world: Pose, around: Surroundings, seed: int) -> Array:
        """Return a collision-free joint path to a pose; see `roboxim_tasks.demonstration.planning.PlannerPort`."""
        planner, options = self._planner(around), MotionOptions(seed=seed)
        plan = planner.plan_to_pose(self._scenes.scene(around), joints, [pose_tcp_in_world], options)
        return plan.sample(SAMPLE_PERIOD_S).positions

    def check_path(self, path: Array, period_s: float, around: Surroundings) -> str:
        """Return the fault of a joint path; empty when it is valid."""
        options = MotionOptions(padding_m=around.padding_m)
        times = np.arange(len(path)) * period_s
        finding = self._planner(around).check_trajectory(self._scenes.scene(around), path, times, options=options)
        return "" if finding.valid else str(finding)

    def _planner(self, around: Surroundings) -> Planner:
        robot = around.scene.robot.model
        if robot not in self._planners:
            self._planners[robot] = Planner(self._library.robot(robot))
        return self._planners[robot]
