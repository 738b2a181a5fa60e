"""Whether bags fit together in one dataset: one robot, one meaning of actions, the same cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError, one_of
from roboxim_datasets.episode import ImageSize
from roboxim_recorder.bag import BagReader
from roboxim_recorder.export.selection import Source


def one_robot(sources: Sequence[Source]) -> str:
    """Return the robot model of all bags.

    Raises:
        RecorderError: ``EXPORT_REFUSED`` if they have several.
    """
    bags: dict[str, list[Path]] = {}
    for source in sources:
        bags.setdefault(source.info.scene.robot.model, []).append(source.path)
    if len(bags) > 1:
        counts = ", ".join(f"{len(paths)} of {robot} (e.g. {paths[0].name})" for robot, paths in sorted(bags.items()))
        raise RecorderError(
            f"the bags are of several robots: {counts}; export each apart (--where robot=...)",
            ErrorCode.EXPORT_REFUSED,
        )
    return next(iter(bags))


def one_semantics(sources: Sequence[Source]) -> ActionSemantics:
    """Return the meaning of the recorded actions.

    Raises:
        RecorderError: ``EXPORT_REFUSED`` if the bags have several.
    """
    semantics = sources[0].info.semantics
    for source in sources:
        if source.info.semantics != semantics:
            raise RecorderError(
                f"bag {source.path}: its actions mean something else than those of {sources[0].path} "
                f"({source.info.semantics} against {semantics}); export them apart",
                ErrorCode.EXPORT_REFUSED,
            )
    return semantics


def camera_sizes(sources: Sequence[Source], cameras: Sequence[str], *, resized: bool) -> dict[str, ImageSize]:
    """Return camera to the size of its recorded images.

    Args:
        sources: The bags.
        cameras: Cameras that every bag must have.
        resized: Whether images are resized; sizes may then differ, and those of the first bag are returned.

    Raises:
        InvalidRequestError: On a camera that a bag does not have.
        RecorderError: ``EXPORT_REFUSED`` if sizes differ.
    """
    sizes: dict[str, ImageSize] = {}
    for source in sources:
        have = {c.name: ImageSize(height=c.height, width=c.width) for c in source.info.scene.cameras}
        for name in cameras:
            if name not in have:
                raise InvalidRequestError(f"bag {source.path} has no camera '{name}'; {one_of(have, name)}")
            size = have[name]
            if sizes.setdefault(name, size) != size and not resized:
                raise RecorderError(
                    f"bag {source.path}: camera '{name}' has images of {size.width} x {size.height} px, earlier bags "
                    f"{sizes[name].width} x {sizes[name].height}; give image_height and image_width to resize them all",
                    ErrorCode.EXPORT_REFUSED,
                )
    return sizes


def joint_names_of(source: Source) -> tuple[str, ...]:
    """Return the arm joints of a bag's robot, in the order of their positions."""
    first = next(iter(BagReader(source.path).ticks(cameras=[])))
    return first.state.robot.joint_names
