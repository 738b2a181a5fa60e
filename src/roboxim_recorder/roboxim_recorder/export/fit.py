"""Whether bags fit together in one dataset: robots, one meaning of actions, the same cameras."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from roboxim_core.actions import ActionSemantics
from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError, one_of
from roboxim_datasets.episode import ImageSize
from roboxim_recorder.bag import BagReader
from roboxim_recorder.export.sources import Source


def firsts_of_robots(sources: Sequence[Source]) -> dict[str, Source]:
    """Return robot model to its first bag, by the models' names."""
    found: dict[str, Source] = {}
    for source in sources:
        found.setdefault(source.info.scene.robot.model, source)
    return dict(sorted(found.items()))


def one_semantics(sources: Sequence[Source]) -> ActionSemantics:
    """Return the meaning of the recorded actions.

    Raises:
        RecorderError: ``EXPORT_REFUSED`` if the bags have several.
    """
    semantics = sources[0].info.semantics
    for source in sources:
        if source.info.semantics != semantics:
            raise RecorderError(
                f"bag {source.path}: its actions have another meaning than those of {sources[0].path} "
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


def joint_names_of(sources: Iterable[Source]) -> tuple[str, ...]:
    """Return the arm joints of the bags' robots, in the order of their positions; empty if they are not the same."""
    found = {next(iter(BagReader(source.path).ticks(cameras=[]))).state.robot.joint_names for source in sources}
    return found.pop() if len(found) == 1 else ()


def require_common_space(robots: Mapping[str, Source], joints: Sequence[str], what: Mapping[str, bool]) -> None:
    """Refuse joint values in a dataset of robots whose joints differ.

    Args:
        robots: Robot model to a bag of it.
        joints: The joints that all of them have.
        what: Part of the dataset to whether it contains joint values.

    Raises:
        RecorderError: ``EXPORT_REFUSED`` naming the robots and the part.
    """
    wrong = [part for part, of_joints in what.items() if of_joints]
    if len(robots) > 1 and not joints and wrong:
        bags = ", ".join(f"{robot} (e.g. {source.path.name})" for robot, source in robots.items())
        raise RecorderError(
            f"the bags are of robots with different joints: {bags}, so their {' and '.join(wrong)} cannot be of "
            "joints; export end-effector motions and states, or each robot apart (--where robot=...)",
            ErrorCode.EXPORT_REFUSED,
        )
