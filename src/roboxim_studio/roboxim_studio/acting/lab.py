"""The rooms' cores, created at their first use, in the bench's thread."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roboxim_core.episode import ActorPort, Draw
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord
from roboxim_studio.acting.what_if import EXPERT
from roboxim_studio.episode.film import Picture

if TYPE_CHECKING:
    from roboxim_bringup.core_graph import CoreGraph
    from roboxim_runs.policies.specs import ChosenPolicy
    from roboxim_sim.rendering.states import StateRenderer


class Lab:
    """Cores for drawing, simulating, planning and judging. Every method belongs to the thread of the first call."""

    def __init__(self, policies: Sequence[ChosenPolicy] = ()) -> None:
        """Nothing is made before it is needed.

        Args:
            policies: Policies that may act, besides the expert. A page can name no others: making a policy runs code.
        """
        self.policies = {chosen.name: chosen for chosen in policies}
        """Policies that may act, by name."""
        self._graph: CoreGraph | None = None
        self._folder = tempfile.TemporaryDirectory(prefix="roboxim-studio-", ignore_cleanup_errors=True)
        self._actors: dict[str, ActorPort] = {}
        self._states: StateRenderer | None = None

    @property
    def graph(self) -> CoreGraph:
        """The cores."""
        if self._graph is None:
            from roboxim_bringup.core_graph import CoreGraph

            self._graph = CoreGraph(Path(self._folder.name))
        return self._graph

    def actor(self, name: str) -> ActorPort:
        """Return the expert, or one of the policies, which is made at its first use.

        Raises:
            ConfigError: When there is no such policy.
            PolicyError: When it cannot be made.
        """
        if name == EXPERT:
            return self.graph.ports.actor
        if name not in self._actors:
            from roboxim_bringup.core_graph import CoreActor

            if name not in self.policies:
                raise ConfigError(
                    f"the studio was not given a policy '{name}'; {one_of((EXPERT, *self.policies), name)}"
                )
            chosen = self.policies[name]
            make: Any = chosen.make
            self._actors[name] = CoreActor(make(**chosen.options))
        return self._actors[name]

    def draw(self, task_config: str, seed: SeedPath) -> Draw:
        """Draw the episode of a seed path, with every check of a reset.

        Raises:
            TaskError: With code ``RESET_INFEASIBLE``, naming the constraint that refused most draws.
            ConfigError: When the configuration names what does not exist.
        """
        return self.graph.tasks.draw(seed, task_config)

    def pictures(self, scene: SceneSpec, state: StateRecord) -> dict[str, Picture]:
        """Return what the cameras of a scene see of a state, without noise and lens.

        Raises:
            RoboximError: When it cannot be drawn.
        """
        if self._states is None:
            from roboxim_sim.rendering import make_renderer
            from roboxim_sim.rendering.states import StateRenderer

            self._states = StateRenderer(make_renderer("raster"), self.graph.sim.library)
        return {name: seen.rgb for name, seen in self._states.draw(scene, state).items()}

    def close(self) -> None:
        """Free everything."""
        if self._states is not None:
            self._states.renderer.close()
            self._states = None
        if self._graph is not None:
            self._graph.close()
            self._graph = None
        self._folder.cleanup()
