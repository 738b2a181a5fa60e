"""The loop's step and the recorder's acknowledgement as one call, for an evaluator and a recorder of the same process.

Between processes the step is a message on ``evaluator/step`` and the acknowledgement one on ``recorder/recorded``.
"""

from __future__ import annotations

RECORD_STEP = "recorder/record_step"
"""Name, relative to the graph's namespace, of the function that takes a `roboxim_core.episode.EpisodeStep`
(`roboxim_ros.local.calls`) and returns whether the tick was taken. It runs in the caller's thread, for one caller at a
time."""
RECORD_STORE = "recorder/record_store"
"""Name of the function that stores the chunk that has ended, in the caller's thread. An evaluator calls it while the
sim computes a tick. Without this call the chunk is stored when the next one ends."""
RECORD_ARRIVING = "recorder/record_arriving"
"""Name of the function that takes the step of a tick whose messages come from the middleware."""
RECORD_RECEIVED = "recorder/record_received"
"""Name of the function that takes an episode's id and the instructions that its policy was given, before the bag is
closed. There is no message for them: a recorder in another process does not store them."""
