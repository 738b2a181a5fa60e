"""Draws a filmstrip of every skill: one episode of the expert, seen by the workspace camera.

Usage: ``python scripts/film_skills.py [SKILL ...]``; writes ``docs/images/skills/<skill>.jpg``.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

from roboxim_bringup.core_graph import CoreGraph
from roboxim_bringup.task_choice import task_text
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_recorder.bag import BagReader
from roboxim_tasks.skills import SKILLS

FOLDER = Path(__file__).parents[1] / "docs" / "images" / "skills"
FRAMES = 6
SEED = 2
SIZE = 224


def main() -> None:
    """Film the skills named on the command line, or all."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for skill in sys.argv[1:] or SKILLS:
        with tempfile.TemporaryDirectory() as folder, CoreGraph(Path(folder)) as cores:
            config = RunConfig(
                run_seed=SEED, purpose="test", task_config=task_text(skill=skill), output_dir=folder,
                cameras=("workspace",), image_width=SIZE, image_height=SIZE,
            )  # fmt: skip
            result = EpisodeRunner(cores.ports, config).run_index(0)
            bag = BagReader(Path(folder, result.bag))
            picks = np.linspace(0, len(bag) - 1, FRAMES).round().astype(int).tolist()
            frames = [tick.images["workspace"] for tick in bag.ticks() if tick.seq in picks]
            Image.fromarray(np.concatenate(frames, axis=1)).save(FOLDER / f"{skill}.jpg", quality=82)
            sys.stdout.write(f"{skill}: {result.instruction}: {result.outcome} {result.reason}, {result.steps} ticks\n")


if __name__ == "__main__":
    main()
