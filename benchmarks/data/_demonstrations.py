"""Demonstrations of all skills for the benchmarks of data: generated once, a run for each skill."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader
from roboxim_recorder.edited import copy_edited
from roboxim_runs.episodes.generation import GenerationConfig, generate
from roboxim_tasks.skills import SKILLS

QUICK = ("pick_up", "push_button")


def demonstrations(
    out: Path, episodes: int, *, skills: tuple[str, ...] = (), seed: int = 0, workers: int = 2, size: int = 0
) -> dict[str, Path]:
    """Demonstrate skills; the same call continues.

    Args:
        out: Folder of the runs.
        episodes: Episodes in all, spread evenly.
        skills: Skills; empty: all.
        seed: Seed of the first run; the next runs have the next seeds, so that every episode has an id of its own.
        workers: Processes.
        size: Width and height of the images [pixels]; 0: as the task states.

    Returns:
        Skill to its run.
    """
    chosen = skills or tuple(SKILLS)
    each, more = divmod(episodes, len(chosen))
    runs = {}
    for number, skill in enumerate(chosen):
        runs[skill] = out / skill
        count = each + (number < more)
        generate(
            GenerationConfig(
                task=skill,
                out=runs[skill],
                episodes=count,
                seed=seed + number,
                workers=workers,
                first_try=True,
                size=size,
            )
        )
    return runs


def copy(original: Path, out: Path, name: str, index: int) -> None:
    """Copy a bag under another id, with another hash of its last state."""

    def edit(topic: str, message: Any) -> None:
        if hasattr(message, "episode_id"):
            message.episode_id = name
        if hasattr(message, "index"):
            message.index = index
        if topic == topics.RESULT:
            message.final_state_hash = f"{index:032x}"

    named = [topic for topic, kind in BagReader(original).types.items() if kind.startswith("roboxim_interfaces/")]
    shutil.rmtree(out / ".partial" / name, ignore_errors=True)
    copy_edited(original, out, named, edit, episode_id=name)
