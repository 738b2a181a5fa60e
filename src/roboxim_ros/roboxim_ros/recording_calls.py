"""The loop's step and the recorder's acknowledgement as one call, for an evaluator and a recorder of the same process.

Between processes the step is a message on ``evaluator/step`` and the acknowledgement one on ``recorder/recorded``.
"""

from __future__ import annotations

RECORD_STEP = "recorder/record_step"
"""Name, relative to the graph's namespace, of the function that takes a `roboxim_core.episode.EpisodeStep`
(`roboxim_ros.local_calls`)."""
