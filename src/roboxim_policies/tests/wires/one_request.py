"""A request to a wire, and the answer."""

import numpy as np

from roboxim_core.policies import EpisodeStart

REQUEST = {
    "observation/image": np.zeros((8, 8, 3), np.uint8),
    "observation/arm": np.zeros(8, np.float32),
    "prompt": "pick up the red cube",
}
START = EpisodeStart(episode_id="e0", instruction="pick up the red cube", seed=1)
GENEROUS_S = 60.0


def answer(wire):
    """Run an episode with one request; return the actions as rows."""
    wire.reset(START)
    return np.concatenate(list(wire.ask(REQUEST).values()), axis=1)
