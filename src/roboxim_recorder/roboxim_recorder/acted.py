"""Who acted at each action of an episode: a policy, a person, or the expert.

An episode in which a person took over from a policy has the topic `topics.ACTED_BY`: one message after each action's
tick. In all others the actor of the episode acted throughout.
"""

from __future__ import annotations

from enum import StrEnum

from roboxim_core.episode import EpisodeInfo
from roboxim_core.errors import one_of
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader, damaged


class ActedBy(StrEnum):
    """Who acted."""

    POLICY = "policy"
    """A policy under test, or one that a person watches."""
    HUMAN = "human"
    """A person, by hand."""
    EXPERT = "expert"
    """The scripted expert."""


ACTED_BY = "sim.acted_by"
"""Signal of exported steps: who acted. Only in datasets with episodes that several shared."""
ACTORS = tuple(map(str, ActedBy))
"""Names of its components; one is 1, the others are 0."""


def actor_of(info: EpisodeInfo) -> ActedBy:
    """Return who acts in an episode that has one actor, or who began it."""
    return ActedBy(info.actor) if info.actor in (ActedBy.HUMAN, ActedBy.EXPERT) else ActedBy.POLICY


def is_shared(reader: BagReader) -> bool:
    """Return whether several may have acted in a bag's episode: whether it says who acted at each action."""
    return reader.counts.get(topics.ACTED_BY, 0) > 0


def acted_by(reader: BagReader) -> tuple[ActedBy, ...]:
    """Return who acted, for each action of a bag's episode.

    Raises:
        RecorderError: With code ``BAG_DAMAGED`` when the bag does not say it for each action.
    """
    steps = reader.result.steps
    if not is_shared(reader):
        return (actor_of(reader.info),) * steps
    names = [message.data for _, _, message in reader.messages((topics.ACTED_BY,))]
    if len(names) != steps:
        raise damaged(reader.path, f"it names the actor of {len(names)} actions, but it has {steps}")
    for name in names:
        if name not in list(ActedBy):
            raise damaged(reader.path, f"'{name}' acted in it; {one_of(ActedBy, name)}")
    return tuple(map(ActedBy, names))
