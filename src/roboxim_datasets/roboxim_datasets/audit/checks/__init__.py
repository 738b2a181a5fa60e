"""The checks, one file per family; importing this package registers them."""

from roboxim_datasets.audit.checks import cameras, control, dataset, gripper, limits, rotation, task, timing, visibility

__all__ = ["cameras", "control", "dataset", "gripper", "limits", "rotation", "task", "timing", "visibility"]
