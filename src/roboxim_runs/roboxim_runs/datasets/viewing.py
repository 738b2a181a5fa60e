"""One episode to look at, of a dataset or of recorded bags."""

from __future__ import annotations

from pathlib import Path

from roboxim_core.errors import ConfigError, counted
from roboxim_datasets.episode import Episode
from roboxim_datasets.formats import open_dataset
from roboxim_recorder.bag import BagReader, mcap_file
from roboxim_recorder.export.episodes import bag_episode
from roboxim_recorder.export.sources import Source
from roboxim_recorder.run_bags import holds_bags, list_bags


def viewed_episode(place: Path, number: int = 0) -> tuple[Episode, tuple[str, ...]]:
    """Return an episode, and the names of its action's components.

    Args:
        place: A dataset, a bag, a folder of bags, or a run's folder.
        number: Its number, through all splits, or in the order of the bags' names.

    Raises:
        ConfigError: When it is none of these, or has fewer episodes.
        RecorderError: With code ``BAG_DAMAGED`` when the bag is not whole.
    """
    if not holds_bags(place):
        opened = open_dataset(place)
        return opened.episode(number), tuple(opened.features.action)
    bags = [mcap_file(place)] if place.is_file() else list_bags(place)
    if number >= len(bags):
        raise ConfigError(f"{place} has {counted(len(bags), 'bag')}, so episodes 0 to {len(bags) - 1}; got {number}")
    return episode_of_bag(bags[number])


def episode_of_bag(bag: Path) -> tuple[Episode, tuple[str, ...]]:
    """Return a bag's episode as it was recorded, and the names of its action's components.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when the bag is not whole.
    """
    reader = BagReader(bag)
    source = Source(path=bag, info=reader.info, result=reader.result)
    joints = next(iter(reader.ticks(cameras=()))).state.robot.joint_names
    return bag_episode(source, joints), reader.info.semantics.component_names(joints)
