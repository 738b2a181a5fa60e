"""The loop's step and the recorder's acknowledgement as one call, for an evaluator and a recorder of the same process.

Between processes the step is a message on ``evaluator/step`` and the acknowledgement one on ``recorder/recorded``.
"""

from __future__ import annotations

from roboxim_interfaces.msg import EpisodeStep, RecordedTick


class RecordStep:
    """The call's types, in the form of a service class; `roboxim_ros.local_calls` offers and finds it."""

    Request = EpisodeStep
    Response = RecordedTick


RECORD_STEP = "recorder/record_step"
"""Name of the call, relative to the graph's namespace."""
