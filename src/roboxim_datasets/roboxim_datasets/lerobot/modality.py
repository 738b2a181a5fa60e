"""``meta/modality.json``, which GR00T reads: the parts of state and action, and the cameras."""

from __future__ import annotations

from itertools import groupby
from typing import Any

from roboxim_datasets.dataset import UNUSED, gripper_components
from roboxim_datasets.lerobot.content import LeRobotContent
from roboxim_datasets.lerobot.layout import LeRobotLayout


def modality(layout: LeRobotLayout, content: LeRobotContent) -> dict[str, Any]:
    """Return the content of the file.

    The state's parts are its runs of components whose names differ in the last word alone: ``tcp.x`` and ``tcp.y`` are
    of ``tcp``. The action's parts are the gripper and the arm, if the names tell them apart; else it is one part. A
    convention that names ranges, as GR00T's do, has the last word.
    """
    names = content.names
    semantics = content.semantics
    arm = "joints" if semantics is not None and semantics.control.is_joint_space else "end_effector"
    state = layout.columns.get(names.state)
    states = content.parts.get("state") or _parts(state.names or () if state else ())
    actions = content.parts.get("action") or _action_parts(layout.columns[names.action].names or (), arm)
    return {
        "state": {name: _range(start, end, names.state) for name, (start, end) in states.items()},
        "action": {name: _range(start, end, names.action) for name, (start, end) in actions.items()},
        "video": {content.views.get(key, camera): {"original_key": key} for key, camera in content.cameras.items()},
        "annotation": {"human.task_description": {"original_key": "task_index"}},
    }


def _range(start: int, end: int, key: str) -> dict[str, Any]:
    return {"start": start, "end": end, "original_key": key}


def _action_parts(names: tuple[str, ...], arm: str) -> dict[str, tuple[int, int]]:
    """Return ``arm`` and ``gripper`` to start and end; ``action`` alone if there is no single range of each."""
    grippers = gripper_components(names)
    kinds = ["gripper" if at in grippers else "" if name == UNUSED else arm for at, name in enumerate(names)]
    found: dict[str, tuple[int, int]] = {}
    at = 0
    for kind, run in groupby(kinds):
        end = at + len(list(run))
        if kind in found:
            return {"action": (0, len(names))}
        if kind:
            found[kind] = (at, end)
        at = end
    return found if len(found) == 2 else {"action": (0, len(names))}


def _parts(names: tuple[str, ...]) -> dict[str, tuple[int, int]]:
    """Return the name of each run of components to its start and end."""
    found: dict[str, tuple[int, int]] = {}
    at = 0
    for part, run in groupby(names, key=lambda name: name.rpartition(".")[0] or name):
        end = at + len(list(run))
        found[part.replace(".", "_")] = (at, end)
        at = end
    return found
