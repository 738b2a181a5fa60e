"""``meta/modality.json``, which GR00T reads: the parts of state and action, and the cameras."""

from __future__ import annotations

from itertools import groupby
from typing import Any

from roboxim_datasets.lerobot.content import LeRobotContent
from roboxim_datasets.lerobot.layout import LeRobotLayout


def modality(layout: LeRobotLayout, content: LeRobotContent) -> dict[str, Any]:
    """Return the content of the file.

    The state's parts are its runs of components whose names differ in the last word alone: ``tcp.x`` and ``tcp.y`` are
    of ``tcp``.
    """
    names = content.names
    semantics = content.semantics
    size = layout.columns[names.action].size
    arm = "joints" if semantics is not None and semantics.control.is_joint_space else "end_effector"
    state = layout.columns.get(names.state)
    return {
        "state": {
            name: {"start": start, "end": end, "original_key": names.state}
            for name, start, end in _parts(state.names or () if state else ())
        },
        "action": {
            arm: {"start": 0, "end": size - 1, "original_key": names.action},
            "gripper": {"start": size - 1, "end": size, "original_key": names.action},
        },
        "video": {camera: {"original_key": key} for key, camera in content.cameras.items()},
        "annotation": {"human.task_description": {"original_key": "task_index"}},
    }


def _parts(names: tuple[str, ...]) -> list[tuple[str, int, int]]:
    """Return the name, start and end of each run of components."""
    found: list[tuple[str, int, int]] = []
    at = 0
    for part, run in groupby(names, key=lambda name: name.rpartition(".")[0] or name):
        end = at + len(list(run))
        found.append((part.replace(".", "_"), at, end))
        at = end
    return found
