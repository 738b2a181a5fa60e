"""robosuite's Lift with two 256x256 RGB cameras at 10 Hz.

The response to a request ``{"steps": n}`` is the wall times of n control steps and of a preceding soft reset [ms].
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import robosuite
from _serve import serve

SIZE = 256


def make() -> Any:
    """Make the environment."""
    env = robosuite.make(
        "Lift",
        robots="Panda",
        has_renderer=False,
        has_offscreen_renderer=True,
        use_camera_obs=True,
        camera_names=["agentview", "robot0_eye_in_hand"],
        camera_heights=SIZE,
        camera_widths=SIZE,
        control_freq=10,
        horizon=1_000_000,
        hard_reset=False,
        seed=0,
    )
    rng = np.random.default_rng(0)
    low, high = env.action_spec
    env.reset()

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        start = time.perf_counter()
        env.reset()
        reset = 1e3 * (time.perf_counter() - start)
        times = []
        for _ in range(request["steps"]):
            action = rng.uniform(low, high)
            start = time.perf_counter()
            observation, *_ = env.step(action)
            times.append(1e3 * (time.perf_counter() - start))
        shapes = [observation[f"{name}_image"].shape for name in ("agentview", "robot0_eye_in_hand")]
        return {"step_ms": times, "reset_ms": reset, "shapes": shapes}

    return handle


if __name__ == "__main__":
    serve(make)
