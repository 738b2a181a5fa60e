"""Demonstrations of all skills for the benchmarks of data: generated once, a run for each skill."""

from __future__ import annotations

from pathlib import Path

from roboxim_bringup.runs.generation import GenerationConfig, generate
from roboxim_tasks.skills import SKILLS

QUICK = ("pick_up", "push_button")


def demonstrations(
    out: Path, episodes: int, *, skills: tuple[str, ...] = (), seed: int = 0, workers: int = 2
) -> dict[str, Path]:
    """Demonstrate skills; the same call continues.

    Args:
        out: Folder of the runs.
        episodes: Episodes in all, spread evenly.
        skills: Skills; empty: all.
        seed: Seed of the first run; the next runs have the next seeds, so that every episode has an id of its own.
        workers: Processes.

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
                task=skill, out=runs[skill], episodes=count, seed=seed + number, workers=workers, first_try=True
            )
        )
    return runs
