"""The registry of recorded parameters: facts about a scene that are saved in addition to the ticks.

To add one, register a class with a ``record`` method under a name. Its value is stored as JSON in the episode info of
every bag.
"""

from __future__ import annotations

import json
from typing import Any, Protocol

from roboxim_core.config import to_plain
from roboxim_core.errors import RecorderError
from roboxim_core.registry import Registry
from roboxim_core.specs import SceneSpec, TaskSpec


class RecordedParameter(Protocol):
    """A value that is saved with every episode."""

    def record(self, task: TaskSpec, scene: SceneSpec) -> Any:
        """Return plain data (dicts, lists, scalars) that JSON can hold."""
        ...


RECORDED_PARAMETERS: Registry[type[RecordedParameter]] = Registry("recorded parameter")


@RECORDED_PARAMETERS.conformance
def records_json_of_any_scene(name: str, item: type[RecordedParameter]) -> None:
    """Refuse a parameter that cannot record a scene without objects as JSON, or records it differently each time."""
    task, scene = TaskSpec(skill="pick_up", objects={}, instruction="Pick it up"), SceneSpec()
    first, second = (json.dumps(item().record(task, scene), allow_nan=False) for _ in range(2))
    assert first == second, "two recordings of the same scene differ"


@RECORDED_PARAMETERS.register("objects")
class RecordedObjects:
    """Model, modifiers and initial pose of every entity."""

    def record(self, task: TaskSpec, scene: SceneSpec) -> Any:
        """Return entity name to its spec."""
        return {entity.name: to_plain(entity) for entity in scene.entities}


@RECORDED_PARAMETERS.register("cameras")
class RecordedCameras:
    """Pose, field of view and size of every camera."""

    def record(self, task: TaskSpec, scene: SceneSpec) -> Any:
        """Return camera name to its spec."""
        return {camera.name: to_plain(camera) for camera in scene.cameras}


@RECORDED_PARAMETERS.register("lights")
class RecordedLights:
    """The lights."""

    def record(self, task: TaskSpec, scene: SceneSpec) -> Any:
        """Return the list of lights."""
        return [to_plain(light) for light in scene.look.lights]


@RECORDED_PARAMETERS.register("robot")
class RecordedRobot:
    """Initial joint positions and gripper opening."""

    def record(self, task: TaskSpec, scene: SceneSpec) -> Any:
        """Return the robot's spec."""
        return to_plain(scene.robot)


def recorded_parameters(task: TaskSpec, scene: SceneSpec) -> dict[str, str]:
    """Record every registered parameter.

    Returns:
        Name to JSON text.

    Raises:
        RecorderError: When a parameter returns a value that JSON cannot hold; the message names it.
    """
    values = {}
    for name in RECORDED_PARAMETERS:
        try:
            values[name] = json.dumps(RECORDED_PARAMETERS[name]().record(task, scene), sort_keys=True)
        except (TypeError, ValueError) as error:
            raise RecorderError(
                f"recorded parameter '{name}' returned a value that JSON cannot hold: {error}"
            ) from None
    return values
