"""The sim node's interface for the standard services and actions."""

from __future__ import annotations

from dataclasses import dataclass

from roboxim_core.errors import RequestTimeoutError
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_ros.node import RoboximNode, parameter
from roboxim_sim.world import World


@dataclass(frozen=True, kw_only=True)
class SimConfig:
    """Parameters of the sim node."""

    renderer: str = parameter("raster", "renderer by name: raster, tiny")
    """Renderer used unless a request names one."""
    scene: str = parameter("three_cubes", "scene loaded at the start, a name in config/scenes or a file; empty: none")
    """Scene loaded at the start."""
    motion_timeout_s: float = parameter(
        600.0, "wall-clock time after which stepping, a trajectory or a gripper motion is aborted [s]", 0.1, 86400.0
    )
    """Wall-clock limit of motions that advance time outside an episode."""
    publish_unheard: bool = parameter(
        True,
        "whether ticks are published without subscribers, so that a late subscriber gets the newest "
        "one; otherwise it gets the scene's topics and the ticks from 0.1 s later on",
    )
    """Whether ticks are published without subscribers. The workers of runs switch it off: nodes of their process take
    ticks from `roboxim_ros.local.ticks`, and the next tick comes within milliseconds."""


class SimServer(RoboximNode):
    """A node that serves a world, implemented by `roboxim_sim.node.SimNode`."""

    config: SimConfig
    """Its parameters."""
    world: World
    """The served world."""

    @property
    def renderer_info(self) -> dict[str, str]:
        """Name and device of the renderer for requests that name none."""
        raise NotImplementedError

    def overtime(self) -> RequestTimeoutError:
        """Return the error for a motion that takes too long."""
        raise NotImplementedError

    def load(self, scene: SceneSpec, episode_id: str = "", renderer: str = "") -> StateRecord:
        """Load a scene and publish tick 0."""
        raise NotImplementedError

    def scene_changed(self) -> None:
        """Publish the scene and its state after entities were added or removed."""
        raise NotImplementedError

    def publish(self, record: StateRecord) -> None:
        """Publish all topics of a state."""
        raise NotImplementedError
