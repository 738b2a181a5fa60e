"""Answers requests of several simulators in batches, if the policy supports it.

Waiting simulators send their requests at nearly the same time. A model answers several requests in little more time
than one, so the requests that arrive while it computes form its next batch.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any

from roboxim_core.errors import PolicyError
from roboxim_core.policies import EpisodeStart, ObservationWindow, Policy, PolicyDescription

MAX_BATCH = 64
"""Largest number of requests of a batch."""
SHARE = 0.5
"""Longest wait for the requests of further simulators, as a share of the last batch's time."""
LONGEST_WAIT_S = 0.1
"""Longest such wait [s]."""


@dataclass(frozen=True, eq=False)
class _Request:
    """A request that waits for its answer."""

    policy: Policy
    window: ObservationWindow
    answer: Future[Any] = field(default_factory=Future)


class Batcher:
    """Calls ``act_batch`` of a policy's class with the waiting requests, in its own thread."""

    def __init__(self, kind: type[Any]) -> None:
        """Start the thread.

        Args:
            kind: The policies' class, see `roboxim_policies.base.BasePolicy.act_batch`.
        """
        self._kind = kind
        self._changed = threading.Condition()
        self._waiting: list[_Request] = []
        self._members = 0
        self._closed = False
        self._took_s = 0.0
        self.sizes: list[int] = []
        """Sizes of the last batches."""
        self._thread = threading.Thread(target=self._run, name="batches", daemon=True)
        self._thread.start()

    def join(self) -> None:
        """Count one simulator more; a batch waits a little for all of them."""
        self._count(1)

    def leave(self) -> None:
        """Count one simulator less."""
        self._count(-1)

    def _count(self, change: int) -> None:
        with self._changed:
            self._members += change
            self._changed.notify_all()

    def act(self, policy: Policy, window: ObservationWindow) -> Any:
        """Return the policy's answer; waits for the batch that has it.

        Raises:
            PolicyError: When the batcher is closed, or ``act_batch`` does not return one answer for each request.
            BaseException: What the policy raises.
        """
        request = _Request(policy, window)
        with self._changed:
            if self._closed:
                raise PolicyError("the server stops")
            self._waiting.append(request)
            self._changed.notify_all()
        return request.answer.result()

    def close(self) -> None:
        """End the thread; requests that wait are refused."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._thread.join()

    def _run(self) -> None:
        while batch := self._next():
            began = time.monotonic()
            self._answer(batch)
            self._took_s = time.monotonic() - began

    def _answer(self, batch: Sequence[_Request]) -> None:
        """Give each request its answer; after an error ask for each alone, so that only the wrong one fails."""
        try:
            answers = list(self._kind.act_batch([r.policy for r in batch], [r.window for r in batch]))
            if len(answers) != len(batch):
                raise PolicyError(
                    f"act_batch of {self._kind.__name__} must return one answer for each of the {len(batch)} requests, "
                    f"got {len(answers)}"
                )
        except BaseException as error:  # a policy may raise anything, and its callers wait
            if len(batch) == 1:
                batch[0].answer.set_exception(error)
                return
            for request in batch:
                self._answer([request])
            return
        self.sizes = [*self.sizes[-99:], len(batch)]
        for request, answer in zip(batch, answers, strict=True):
            request.answer.set_result(answer)

    def _next(self) -> list[_Request]:
        """Wait for requests, and a little for those of the other simulators; return none when closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closed)
            wait_s = min(SHARE * self._took_s, LONGEST_WAIT_S)
            self._changed.wait_for(lambda: len(self._waiting) >= min(self._members, MAX_BATCH) or self._closed, wait_s)
            batch, self._waiting = self._waiting[:MAX_BATCH], self._waiting[MAX_BATCH:]
            if self._closed:
                for request in (*batch, *self._waiting):
                    request.answer.set_exception(PolicyError("the server stops"))
                return []
            return batch


class Batched:
    """A policy whose `act` goes through a batcher."""

    def __init__(self, policy: Policy, batcher: Batcher) -> None:
        """Store both."""
        self._policy, self._batcher = policy, batcher

    def describe(self) -> PolicyDescription:
        """Describe the policy."""
        return self._policy.describe()

    def reset(self, start: EpisodeStart) -> None:
        """Start an episode of the policy."""
        self._policy.reset(start)

    def act(self, window: ObservationWindow) -> Any:
        """Return the policy's answer."""
        return self._batcher.act(self._policy, window)
