"""A policy that receives another instruction than the task's, e.g. none, to test what the scene alone reveals."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any

from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.wordings import require_set, reworded
from roboxim_core.policies import EpisodeStart, ObservationWindow, PassesOn, Policy, PolicyDescription
from roboxim_policies.base import POLICIES, load_policy


@POLICIES.register("reworded")
class RewordedPolicy:
    """A policy that passes everything but the instruction to another policy."""

    def __init__(self, *, policy: str, instruction: str = "", wordings: str = "", **options: Any) -> None:
        """Make the policy.

        Args:
            policy: The other policy, as for ``roboxim evaluate --policy``.
            instruction: What it receives instead of the task's instruction; empty: no words.
            wordings: Set of ``config/wordings`` in whose words it receives the task's instruction, e.g. ``german``; one
                is drawn by the episode's seed. An instruction that the set does not cover is not changed.
            **options: Its arguments, e.g. ``checkpoint``.

        Raises:
            ConfigError: When there is no such policy or set, both words and a set are given, or the policy does not
                take these arguments.
            PolicyError: When its module or its constructor raises.
        """
        if wordings:
            require_set(wordings)
            if instruction:
                raise ConfigError("reworded takes an instruction or a set of wordings, not both")
        self._policy = InstructionRecorder(load_policy(policy, **options))
        self._instruction, self._wordings = instruction, wordings

    @property
    def any_thread(self) -> bool:
        """Whether the other policy may be called by any thread, see `BasePolicy`."""
        return bool(getattr(self._policy.policy, "any_thread", False))

    def another(self) -> RewordedPolicy | None:
        """Return a policy that shares the other policy's model but keeps its own episode; none: it cannot."""
        another = getattr(self._policy.policy, "another", None)
        inner = another() if callable(another) else None
        if inner is None:
            return None
        found = copy.copy(self)
        found._policy = InstructionRecorder(inner)
        return found

    def describe(self) -> PolicyDescription:
        """Describe the other policy; the version names the instruction."""
        description = self._policy.describe()
        wording = f"wordings '{self._wordings}'" if self._wordings else f"instruction '{self._instruction}'"
        version = f"{description.version} with the {wording}".strip()
        return replace(description, version=version)

    def reset(self, start: EpisodeStart) -> None:
        """Start an episode of the other policy with the instruction."""
        if self._wordings:
            known = wordings_or_itself(start.instruction, self._wordings)
            self._instruction = known[start.seed % len(known)]
        self._policy.reset(replace(start, instruction=self._instruction))

    def act(self, window: ObservationWindow) -> Any:
        """Return the other policy's answer to the instruction."""
        return self._policy.act(replace(window, instruction=self._instruction))

    def received_instructions(self) -> tuple[str, ...]:
        """Return the instructions that the other policy was given since the last reset, as its calls had them."""
        return self._policy.received_instructions()


def wordings_or_itself(instruction: str, name: str) -> tuple[str, ...]:
    """Return an instruction in the words of a set; itself where the set does not cover it."""
    return reworded(instruction, name) or (instruction,)


class InstructionRecorder:
    """A wrapper of a policy that records the instructions of its calls."""

    def __init__(self, policy: Policy) -> None:
        """Wrap a policy."""
        self.policy = policy
        """The wrapped policy."""
        self._given: dict[str, None] = {}

    def describe(self) -> PolicyDescription:
        """Describe the wrapped policy."""
        return self.policy.describe()

    def reset(self, start: EpisodeStart) -> None:
        """Start an episode of the wrapped policy."""
        self._given = {start.instruction: None}
        self.policy.reset(start)

    def act(self, window: ObservationWindow) -> Any:
        """Return the other policy's answer."""
        self._given[window.instruction] = None
        return self.policy.act(window)

    def received_instructions(self) -> tuple[str, ...]:
        """Return the instructions since the last reset; those that the wrapped policy reports, if it passes them on."""
        if isinstance(self.policy, PassesOn):
            return tuple(self.policy.received_instructions())
        return tuple(self._given)
