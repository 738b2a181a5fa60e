"""What genuine LeRobot makes of an observation of LIBERO, for `scripts/verify_conventions.py`.

Runs in the environment ``verify-lerobot`` on what `scripts/genuine_clients.py` wrote, and imports nothing of RoboXim.
"""

from __future__ import annotations

import importlib.metadata
import sys
from pathlib import Path

import numpy as np
import torch
from lerobot.processor.env_processor import LiberoProcessorStep


def main(out: Path) -> None:
    """Write ``OUT/lerobot.npz``: picture, state and LeRobot's version."""
    scene = np.load(out / "scene.npz")

    def batch(name: str) -> torch.Tensor:
        return torch.from_numpy(scene[name].copy())[None].float()

    robot = {
        "eef": {"pos": batch("robot0_eef_pos"), "quat": batch("robot0_eef_quat"), "mat": torch.eye(3)[None]},
        "gripper": {"qpos": batch("robot0_gripper_qpos"), "qvel": torch.zeros(1, 2)},
        "joints": {"pos": torch.zeros(1, 7), "vel": torch.zeros(1, 7)},
    }
    picture = batch("agentview_image").permute(0, 3, 1, 2) / 255
    observed = {"observation.images.image": picture, "observation.robot_state": robot}
    made = LiberoProcessorStep()._process_observation(observed)
    sent = (made["observation.images.image"][0].permute(1, 2, 0) * 255).round().byte().numpy()
    state, version = made["observation.state"][0].numpy(), importlib.metadata.version("lerobot")
    np.savez(out / "lerobot.npz", picture=sent, state=state, version=version)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
