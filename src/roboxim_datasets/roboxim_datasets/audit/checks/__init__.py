"""The checks, one file per family; importing this package registers them."""

from roboxim_datasets.audit.checks import (
    behaviour,
    cameras,
    content,
    control,
    dataset,
    gripper,
    limits,
    motion,
    recorded_task,
    rotation,
    task,
    timing,
    visibility,
)

__all__ = [
    "behaviour",
    "cameras",
    "content",
    "control",
    "dataset",
    "gripper",
    "limits",
    "motion",
    "recorded_task",
    "rotation",
    "task",
    "timing",
    "visibility",
]
