"""Draws a filmstrip of every skill, and of the tasks in `TASKS`: the expert, seen by the workspace camera.

Usage: ``python scripts/film_skills.py [NAME ...]``; writes ``docs/images/skills/<skill>.jpg`` and
``docs/images/tasks/<task>.jpg``.
"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from roboxim_bringup.core_graph import CoreGraph
from roboxim_bringup.task_choice import task_text
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_recorder.bag import BagReader
from roboxim_tasks.skills import SKILLS

FOLDER = Path(__file__).parents[1] / "docs" / "images"
FRAMES = 6
SEED = 2
SIZE = 224
TASKS = {"pick_up_blocked": (0,), "place_on_blocked": (0,), "pick_cube_areas": (0, 1, 2, 3, 4)}
"""Task of ``config/tasks`` to the episodes that are filmed: one as a strip, of several the last frames."""


def main() -> None:
    """Film what is named on the command line, or everything."""
    for name in sys.argv[1:] or (*SKILLS, *TASKS):
        task = task_text(skill=name) if name in SKILLS else task_text(name)
        episodes = TASKS.get(name, (0,))
        frames = [frame for index in episodes for frame in film(task, index, FRAMES if len(episodes) == 1 else 1)]
        file = FOLDER / ("skills" if name in SKILLS else "tasks") / f"{name}.jpg"
        file.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(np.concatenate(frames, axis=1)).save(file, quality=82)


def film(task: str, index: int, count: int) -> list[npt.NDArray[np.uint8]]:
    """Run an episode of the expert and return frames from its start to its end; of one, the last."""
    with tempfile.TemporaryDirectory() as folder, CoreGraph(Path(folder)) as cores:
        config = RunConfig(
            run_seed=SEED, purpose="test", task_config=task, output_dir=folder, cameras=("workspace",),
            image_width=SIZE, image_height=SIZE,
        )  # fmt: skip
        result = EpisodeRunner(cores.ports, config).run_index(index)
        sys.stdout.write(f"{result.instruction}: {result.outcome} {result.reason}, {result.steps} ticks\n")
        bag = BagReader(Path(folder, result.bag))
        picks = np.linspace(len(bag) - 1, 0, count).round().astype(int).tolist()
        return [tick.images["workspace"] for tick in bag.ticks() if tick.seq in picks]


if __name__ == "__main__":
    main()
