"""The page of an episode."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from roboxim_datasets.view import page


def test_numbers_that_are_not_finite_are_counted_and_not_drawn(episode_of):
    episode = episode_of(0, length=4)

    def read(wanted):
        for step in episode.read(wanted):
            joints = np.float32([np.nan])
            state = np.float32([np.inf if step.index == 1 else step.index, 1.0])
            yield replace(step, proprio={"state": state, "joints": joints})

    shown = page(replace(episode, read=read), ("a", "b", "c", "d", "e", "f", "g"), 2)
    for words in ("tcp.x (1 not finite)", "tcp.y", "j0.position (4 not finite)"):
        assert words in shown
    assert "nan" not in shown
    assert "inf" not in shown
