"""Several episodes in one call, for a caller in the evaluator's process.

Other processes use the action and the service of the same name.
"""

from __future__ import annotations

RUN_EPISODES = "evaluator/run_episodes"
"""Name, relative to the graph's namespace, of a function that runs in the caller's thread (`roboxim_ros.local.calls`):
``(config: RunConfig, indices: Sequence[int], progress: (episode_id, seq) -> None, cancelled: () -> bool) ->
list[EpisodeResult]``. It calls ``progress`` from time to time, and ``cancelled`` before every tick."""
