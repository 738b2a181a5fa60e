"""A policy, or the expert, that shares an episode with a person: either side can take over control.

The episode loop requests one action of the executed meaning per tick, from the actor that has control. The partner's
own chunks, gripper rule and lag are therefore applied here, with the loop's own `Acting`. When it gets control back, it
starts afresh: it is reset and plans from the present state, since the actions in between were not its own.
"""

from __future__ import annotations

from dataclasses import replace

from roboxim_core.actions import Chunking, GripperRule
from roboxim_core.episode import ActorPort, EpisodeInfo, RunConfig
from roboxim_core.episode.acting import Acting
from roboxim_core.errors import ConfigError
from roboxim_core.policies import ActionChunk, EpisodeStart, ObservationWindow, PolicyDescription
from roboxim_core.policy_guard import checked_answer
from roboxim_core.state import StateRecord
from roboxim_recorder.acted import ActedBy
from roboxim_studio.acting.what_if import EXPERT


class Partner:
    """Who acts while no person does."""

    def __init__(self, name: str, actor: ActorPort) -> None:
        """Let a policy act.

        Args:
            name: Its name, or ``expert``.
            actor: The policy.

        Raises:
            ConfigError: When it does not act by end-effector motions, as a person does.
        """
        self.name = name
        """Its name."""
        self.acts_as = ActedBy.EXPERT if name == EXPERT else ActedBy.POLICY
        """What a bag calls it."""
        self._actor, self._described = actor, actor.describe()
        declared = self._described.semantics
        if declared.control.is_joint_space:
            raise ConfigError(
                f"'{name}' acts by {declared.control}, a person by end-effector motions; choose a policy of "
                "end-effector motions"
            )
        executed = replace(declared.executed(1.0), rate_hz=declared.rate_hz)
        self.description: PolicyDescription = replace(
            self._described, semantics=executed, horizon=1, chunking=Chunking(), gripper=GripperRule(), lag=()
        )
        """Description for the episode loop: one action of the executed meaning per tick."""
        self._start: EpisodeStart | None = None
        self._info: EpisodeInfo | None = None
        self._acting: Acting | None = None

    def begin(self, start: EpisodeStart, info: EpisodeInfo) -> None:
        """Note the episode; the partner is reset at its first action."""
        self._start, self._info, self._acting = start, info, None

    def let_go(self) -> None:
        """Forget the plan, because a person has taken over."""
        self._acting = None

    def act(self, window: ObservationWindow, state: StateRecord) -> ActionChunk:
        """Return the action of a tick, in the executed meaning, and whether the partner has finished with it.

        Raises:
            PolicyError: When it cannot answer, or its answer is invalid.
        """
        assert self._start is not None
        assert self._info is not None
        if self._acting is None:
            self._actor.reset(self._start)
            self._acting = Acting(self._described, RunConfig(), self._info.scene, self._info.semantics)
        received: tuple[str, ...] = ()
        if self._acting.due(state.seq):
            answer = checked_answer(self._actor.act(window), self._described)
            received = answer.received
            self._acting.add(answer, state, 0.0)
        action = self._acting.action(state).action
        done = self._acting.finished(state.seq + 1)
        return ActionChunk(actions=action[None], done=done, received=received)
