"""Episodes as one call, for a caller in the process of the evaluator.

Other processes use the action and the service of the same name.
"""

from __future__ import annotations

RUN_EPISODES = "evaluator/run_episodes"
"""Name, relative to the graph's namespace, of the function that takes a `roboxim_core.episode.RunConfig`, indices, a
function that hears of the progress, and one that tells whether to cancel (`roboxim_ros.local_calls`). It returns the
results. It runs in the caller's thread."""
