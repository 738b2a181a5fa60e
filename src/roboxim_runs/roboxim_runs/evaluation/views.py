"""Viewpoints of a task's cameras, and whether a policy was trained with them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from roboxim_runs.policies.specs import ChosenPolicy

if TYPE_CHECKING:
    from roboxim_tasks.task_config import TaskConfig


def view_warnings(chosen: Sequence[ChosenPolicy], cells: Sequence[TaskConfig]) -> tuple[str, ...]:
    """Return a sentence for each policy that receives a camera with another viewpoint than in its training.

    A policy whose checkpoint states no viewpoints gives none.

    Args:
        chosen: The policies.
        cells: The tasks of the evaluation.
    """
    found = []
    for policy in chosen:
        trained = policy.camera_views
        new = {
            camera: other
            for camera, views in trained.items()
            if (other := sorted({view for cell in cells for view in _views(cell, camera)} - set(views)))
        }
        if not new:
            continue
        moved = " and ".join(
            f"camera '{camera}' in the place of {_listed(trained[camera])}, and sees from that of {_listed(views)} here"
            for camera, views in new.items()
        )
        found.append(f"{policy.name} was trained with {moved}, so its rate may be lower{_remedy(trained)}.")
    return tuple(found)


def _views(cell: TaskConfig, camera: str) -> Sequence[str]:
    """Return the files of ``config/cameras`` from whose places a task's camera may look."""
    from roboxim_core.vision.looks import LookSet
    from roboxim_tasks.components.look import VIEWED
    from roboxim_tasks.files import named

    cameras, look = cell.reset.get("cameras"), cell.reset.get("look")
    if cameras and camera in cameras.views:
        return [str(view) for view in cameras.views[camera].values]
    if look and look.set and camera == VIEWED:
        looks = named("looks", look.set, LookSet).looks
        names = [str(name) for name in look.names.values] if look.names else list(looks)
        return [looks[name].view or camera for name in names]
    return [camera]


def _listed(views: Sequence[str]) -> str:
    return f"'{views[0]}'" if len(views) == 1 else f"{len(views)} others"


def _remedy(trained: dict[str, tuple[str, ...]]) -> str:
    """Return the options that show what the policy was trained with; empty when it saw from several places."""
    if any(len(views) != 1 for views in trained.values()):
        return ""
    words = (f"--camera {camera}" + (f"={view}" if view != camera else "") for camera, (view,) in trained.items())
    return f" (as trained: {' '.join(words)})"
