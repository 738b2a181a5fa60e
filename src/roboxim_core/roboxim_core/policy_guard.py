"""The guard between a policy and its callers: it converts every fault of the policy to a specific error.

The guard is pure: the policy node and loops without nodes use the same one. A policy's exception never ends its node:
the traceback is logged and the answer carries ``POLICY_FAULT``. The guard checks every answer before it is used.
Anything other than a chunk of finite numbers of the declared size is ``INVALID_ACTION``; nothing is cast.
"""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from roboxim_core.actions import check_chunk
from roboxim_core.errors import ErrorCode, InvalidRequestError, PolicyError, RoboximError, printable
from roboxim_core.policies import ActionChunk, EpisodeStart, ObservationWindow, PassesOn, Policy, PolicyDescription

LONGEST_PHASE = 64
"""Largest length of the name of a phase [characters]."""
LONGEST_TRACEBACK = 20_000
"""Largest length of a traceback in the log [characters]."""


def checked_answer(answer: Any, description: PolicyDescription) -> ActionChunk:
    """Validate the answer of a policy.

    Args:
        answer: An `ActionChunk`, or an array-like of actions.
        description: The policy's description, which gives the size of an action and the horizon.

    Returns:
        Actions as float32, shape (horizon, D), ``done`` as a bool, phases and received instructions as tuples of
        strings.

    Raises:
        PolicyError: With code ``INVALID_ACTION``, if the answer is invalid in any way.
    """
    try:
        return _checked(answer, description)
    except InvalidRequestError as error:
        raise PolicyError(str(error), ErrorCode.INVALID_ACTION) from None
    except (Exception, SystemExit) as error:  # reading an attribute runs foreign code, which may raise anything
        raise PolicyError(
            f"the answer cannot be read: {type(error).__name__}: {printable(error)}", ErrorCode.INVALID_ACTION
        ) from None


def _checked(answer: Any, description: PolicyDescription) -> ActionChunk:
    chunk = answer if isinstance(answer, ActionChunk) else ActionChunk(actions=answer)
    semantics = description.semantics
    size = None if semantics.control.is_joint_space else semantics.dimension()
    actions = check_chunk(chunk.actions, size=size, max_rows=description.horizon)
    done: Any = chunk.done
    if not isinstance(done, bool | np.bool_):
        raise InvalidRequestError(f"done must be a bool, got {printable(done, 100, form=repr)}")
    phases: Any = chunk.phases
    if not isinstance(phases, tuple | list) or len(phases) not in (0, len(actions)):
        raise InvalidRequestError(
            f"phases must be a tuple of one string per action ({len(actions)}), or empty; "
            f"got {printable(phases, 100, form=repr)}"
        )
    for phase in phases:
        if not isinstance(phase, str) or len(phase) > LONGEST_PHASE or not phase.isprintable():
            raise InvalidRequestError(
                f"a phase must be a printable string of at most {LONGEST_PHASE} characters, "
                f"got {printable(phase, 100, form=repr)}"
            )
    received: Any = chunk.received
    if not isinstance(received, tuple | list) or not all(isinstance(text, str) for text in received):
        raise InvalidRequestError(
            f"received must be a tuple of instructions, or empty; got {printable(received, 100, form=repr)}"
        )
    return ActionChunk(
        actions=actions, done=bool(done), phases=tuple(str(phase) for phase in phases), received=tuple(received)
    )


class GuardedPolicy:
    """Wrapper that calls a policy and checks everything that it does.

    A policy that does not declare ``privileged`` never receives the task, the scene or a state record, even if a caller
    sends them. Every answer lists the instructions that the policy was given (`ActionChunk.received`). A policy that
    passes its requests on (`PassesOn`) lists those of the other policy.
    """

    def __init__(
        self,
        policy: Policy,
        *,
        log: Callable[[str], None] = lambda text: None,
        named_errors: tuple[type[RoboximError], ...] = (),
    ) -> None:
        """Ask the policy for its description.

        Args:
            policy: The policy.
            log: Called with the traceback of every exception that the policy raises.
            named_errors: Errors that keep their code, for RoboXim's own policies such as the expert. All other
                exceptions, except `PolicyError`, become ``POLICY_FAULT``.

        Raises:
            PolicyError: When the policy does not return a valid description.
        """
        self._policy, self._log, self._named_errors = policy, log, named_errors
        self._label = f"policy '{type(policy).__name__}'"
        with self._converting_errors("describe"):
            description = policy.describe()
            if not isinstance(description, PolicyDescription):
                raise PolicyError(f"{self._label}: describe must return a PolicyDescription, got {description!r}")
        self.description = description
        """The policy's description."""
        self.any_thread = bool(getattr(policy, "any_thread", False))
        """Whether any thread may call the policy, one at a time; false unless the policy has this attribute."""
        self._label = f"policy '{description.name}'"
        self._episode: str | None = None
        self._given: dict[str, None] = {}

    def describe(self) -> PolicyDescription:
        """Return the description that the policy gave when the guard was made."""
        return self.description

    def reset(self, start: EpisodeStart) -> None:
        """Start an episode.

        Raises:
            PolicyError: When the policy raises.
            InvalidRequestError: When the policy is privileged and the task or the scene is missing.
        """
        self._episode = None
        if not self.description.privileged:
            start = replace(start, task=None, scene=None)
        elif start.task is None or start.scene is None:
            raise InvalidRequestError(f"{self._label} is privileged: a reset needs the task and the scene")
        self._given = {start.instruction: None}
        with self._converting_errors(f"reset for episode {start.episode_id}"):
            self._policy.reset(start)
        self._episode = start.episode_id

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Ask for the next actions.

        Raises:
            InvalidRequestError: When the window does not match the policy's description, or its episode was not
                started.
            PolicyError: With code ``POLICY_FAULT`` when the policy raises, ``INVALID_ACTION`` when its answer is
                invalid, see `checked_answer`.
        """
        self._check_window(window)
        if not self.description.privileged:
            observations = [replace(o, state=None) for o in window.observations]
            window = replace(window, observations=observations)
        where = f"act at tick {window.seq} of episode {window.episode_id}"
        self._given[window.instruction] = None
        with self._converting_errors(where):
            answer = self._policy.act(window)
            received = self._received()
        try:
            return replace(checked_answer(answer, self.description), received=received)
        except PolicyError as error:
            raise PolicyError(f"{self._label} in {where}: {error}", error.code) from None

    def _received(self) -> tuple[str, ...]:
        """Return the instructions that the policy, or the policy behind it, was given since the last reset."""
        if isinstance(self._policy, PassesOn):
            return tuple(map(str, self._policy.received_instructions()))
        return tuple(self._given)

    def _check_window(self, window: ObservationWindow) -> None:
        if window.episode_id != self._episode:
            raise InvalidRequestError(
                f"{self._label} was not reset for episode '{window.episode_id}' "
                f"(its episode: {self._episode or 'none'}); call reset_policy first"
            )
        if not window.observations or len(window.pad_mask) != len(window.observations):
            raise InvalidRequestError(
                f"a window needs at least one observation and a pad mask of the same length, got "
                f"{len(window.observations)} and {len(window.pad_mask)}"
            )
        opening: Any = window.commanded_opening
        if opening is not None and not (isinstance(opening, int | float) and math.isfinite(opening)):
            raise InvalidRequestError(
                f"commanded_opening must be a finite number or none, got {printable(opening, 100, form=repr)}"
            )
        if self.description.privileged and window.newest.state is None:
            raise InvalidRequestError(f"{self._label} is privileged: its observations need the state record")
        for observation in window.observations:
            for name, given in observation.images.items():
                if given.dtype != np.uint8 or given.shape[2:] != (3,):
                    raise InvalidRequestError(
                        f"{self._label} needs RGB images, uint8 of shape (height, width, 3), got {given.dtype} of "
                        f"shape {given.shape} from camera '{name}'"
                    )
            for camera in self.description.cameras:
                image = observation.images.get(camera.name)
                if image is None:
                    raise InvalidRequestError(
                        f"{self._label} needs camera '{camera.name}', but the observation of tick "
                        f"{observation.seq} has only {sorted(observation.images) or 'none'}",
                        ErrorCode.OBSERVATION_MISSING,
                    )
                wanted = (camera.height or image.shape[0], camera.width or image.shape[1])
                if image.shape[:2] != wanted:
                    raise InvalidRequestError(
                        f"{self._label} needs camera '{camera.name}' at {wanted[1]}x{wanted[0]} px, got "
                        f"{image.shape[1]}x{image.shape[0]}; leave the run's image size to the policy"
                    )

    @contextmanager
    def _converting_errors(self, where: str) -> Iterator[None]:
        """Convert every exception of the policy, including ``SystemExit``, to a `PolicyError`; let Ctrl-C pass."""
        try:
            yield
        except KeyboardInterrupt:
            raise
        except self._named_errors as error:
            raise error if isinstance(error, PolicyError) else PolicyError(str(error), error.code) from error
        except BaseException as error:
            self._log(printable(f"{self._label} in {where}:\n{traceback.format_exc()}", LONGEST_TRACEBACK))
            if isinstance(error, PolicyError):
                raise
            text = printable(error) or "no message"
            raise PolicyError(f"{self._label} raised {type(error).__name__} in {where}: {text}") from error
