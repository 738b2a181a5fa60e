"""Record the README's demonstration film: one episode of the expert, from the workspace and the wrist camera.

Usage: ``python scripts/film_demonstration.py``; writes ``docs/images/demonstration.webp``.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from PIL import Image

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_recorder.bag import BagReader
from roboxim_runs.episodes.caption import captioned
from roboxim_runs.episodes.task_choice import task_text

FILE = Path(__file__).parents[1] / "docs" / "images" / "demonstration.webp"
SIZE = 320
SEED = 4
EVERY = 2
"""Ticks per picture."""


def main() -> None:
    """Run the episode and write the film."""
    with tempfile.TemporaryDirectory() as folder, CoreGraph(Path(folder)) as cores:
        task = task_text(skill="place_on", objects=("apple,cucumber,onion", "support=plate"), distractors="3")
        wide: dict[str, Any] = yaml.safe_load(task)  # sees the whole arm
        wide.setdefault("reset", {}).setdefault("cameras", {})["views"] = {"workspace": {"values": ["workspace_wide"]}}
        config = RunConfig(
            run_seed=SEED,
            purpose="test",
            task_config=yaml.safe_dump(wide),
            output_dir=folder,
            image_width=SIZE,
            image_height=SIZE,
        )
        result = EpisodeRunner(cores.ports, config).run_index(0)
        reader = BagReader(Path(folder, result.bag))
        workspace = next(camera for camera in reader.info.scene.cameras if camera.name == "workspace")
        frames = [
            Image.fromarray(
                captioned(
                    np.concatenate([tick.images["workspace"], tick.images["wrist"]], axis=1),
                    result.instruction,
                    workspace,
                )
            )
            for tick in reader.ticks()
            if tick.seq % EVERY == 0
        ]
    pause = [frames[-1]] * 8
    frames[0].save(
        FILE, save_all=True, append_images=[*frames[1:], *pause], duration=100 * EVERY, loop=0, quality=55, method=6
    )
    sys.stdout.write(f"{result.instruction}: {result.outcome}, {len(frames)} frames, {FILE.stat().st_size} bytes\n")


if __name__ == "__main__":
    main()
