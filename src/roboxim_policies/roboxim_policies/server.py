"""The guard between a user's policy and the graph: whatever the policy does wrong becomes an error by name.

Pure: the node converts messages and calls this. A policy's exception never ends the node; its traceback is logged and
the answer carries ``POLICY_FAULT`` with the exception's text. Actions are checked before they leave.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

from roboxim_core.actions import check_chunk
from roboxim_core.errors import ErrorCode, InvalidRequestError, PolicyError
from roboxim_core.policies import ActionChunk, EpisodeStart, ObservationWindow, Policy, PolicyDescription


class GuardedPolicy:
    """Calls a policy and trusts nothing it returns.

    A policy that does not declare ``privileged`` never gets the task, the scene or a state record, even where a caller
    sends them.
    """

    def __init__(self, policy: Policy, *, log: Callable[[str], None] = lambda text: None) -> None:
        """Ask the policy what it is.

        Args:
            policy: The policy.
            log: Takes the traceback of whatever the policy raises.

        Raises:
            PolicyError: When its description is not one.
        """
        self._policy, self._log = policy, log
        self._label = f"policy '{type(policy).__name__}'"
        with self._blaming("describe"):
            description = policy.describe()
        if not isinstance(description, PolicyDescription):
            raise PolicyError(f"{self._label}: describe must return a PolicyDescription, got {description!r}")
        self.description = description
        """What the policy said of itself."""
        self._label = f"policy '{description.name}'"
        self._episode: str | None = None

    def reset(self, start: EpisodeStart) -> None:
        """Start an episode.

        Raises:
            PolicyError: When the policy raises.
            InvalidRequestError: When a privileged policy is not given the task and the scene.
        """
        self._episode = None
        if not self.description.privileged:
            start = replace(start, task=None, scene=None)
        elif start.task is None or start.scene is None:
            raise InvalidRequestError(f"{self._label} is privileged: a reset needs the task and the scene")
        with self._blaming(f"reset for episode {start.episode_id}"):
            self._policy.reset(start)
        self._episode = start.episode_id

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Ask for the next actions.

        Raises:
            InvalidRequestError: When the window is not what the policy declared, or its episode was not started.
            PolicyError: With code ``POLICY_FAULT`` when the policy raises, ``INVALID_ACTION`` when it answers with a
                wrong shape, a NaN or too many actions.
        """
        self._check_window(window)
        if not self.description.privileged:
            observations = [replace(o, state=None) for o in window.observations]
            window = replace(window, observations=observations)
        where = f"act at tick {window.seq} of episode {window.episode_id}"
        with self._blaming(where):
            answer = self._policy.act(window)
        chunk = answer if isinstance(answer, ActionChunk) else ActionChunk(actions=answer)  # type: ignore[arg-type]
        try:
            actions = check_chunk(chunk.actions)
        except InvalidRequestError as error:
            raise PolicyError(f"{self._label} in {where}: {error}", ErrorCode.INVALID_ACTION) from None
        if len(actions) > self.description.horizon:
            raise PolicyError(
                f"{self._label} in {where}: {len(actions)} actions, but it declares horizon {self.description.horizon}",
                ErrorCode.INVALID_ACTION,
            )
        return replace(chunk, actions=actions, phases=tuple(str(phase) for phase in chunk.phases))

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
        for observation in window.observations:
            for camera in self.description.cameras:
                image = observation.images.get(camera.name)
                if image is None:
                    raise InvalidRequestError(
                        f"{self._label} looks through camera '{camera.name}', but the observation of tick "
                        f"{observation.seq} has only {sorted(observation.images) or 'none'}",
                        ErrorCode.OBSERVATION_MISSING,
                    )
                wanted = (camera.height or image.shape[0], camera.width or image.shape[1])
                if image.shape[:2] != wanted:
                    raise InvalidRequestError(
                        f"{self._label} wants camera '{camera.name}' at {wanted[1]}x{wanted[0]} px, got "
                        f"{image.shape[1]}x{image.shape[0]}; leave the run's image size to the policy"
                    )

    @contextmanager
    def _blaming(self, where: str) -> Iterator[None]:
        """Turn whatever the policy raises, ``SystemExit`` included, into a `PolicyError`."""
        try:
            yield
        except (Exception, SystemExit) as error:
            self._log(f"{self._label} in {where}:\n{traceback.format_exc()}")
            if isinstance(error, PolicyError):
                raise
            text = str(error) or "no message"
            raise PolicyError(f"{self._label} raised {type(error).__name__} in {where}: {text}") from error
