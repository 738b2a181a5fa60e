"""Policies that the calling process defines, e.g. a notebook; the process serves them to the simulators of a run."""

from __future__ import annotations

import copy
import hashlib
import inspect
import secrets
import sys
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from roboxim_core.config import to_plain
from roboxim_core.errors import ConfigError
from roboxim_core.policies import Policy
from roboxim_policies.identity import policy_files
from roboxim_policies.serving.shared import SharedServer, SharedSessions
from roboxim_runs.events import OnEvent
from roboxim_runs.executors import Work
from roboxim_runs.policies.servers import behind_server

OF_THIS_PROCESS = secrets.token_hex(8)
"""Identifies code that has no source: another process may have another one of the same name."""


@dataclass(frozen=True, kw_only=True)
class OwnPolicy:
    """A policy that the caller gave as an object: a class, or an instance of one."""

    given: Any
    """The class or the instance."""
    _made: list[Policy] = field(default_factory=list)

    @property
    def cls(self) -> type[Policy]:
        """The class."""
        return self.given if isinstance(self.given, type) else type(self.given)

    @property
    def spec(self) -> str:
        """Its name, ``module:Class``."""
        return f"{self.cls.__module__}:{self.cls.__qualname__}"

    @property
    def is_instance(self) -> bool:
        """Whether the caller made it."""
        return not isinstance(self.given, type)

    def make(self) -> Policy:
        """Return a policy for one more simulator: the caller's instance, then copies of it.

        Raises:
            ConfigError: When the instance cannot be copied.
        """
        if not self.is_instance:
            return self.cls()
        if not self._made:
            self._made.append(self.given)
            return self._made[0]
        return self._copy()

    def require_copies(self) -> None:
        """Refuse an instance of which several workers cannot have one each.

        Raises:
            ConfigError: Saying why it cannot be copied.
        """
        if self.is_instance and getattr(self.given, "another", lambda: None)() is None:
            self._copy()

    def _copy(self) -> Policy:
        try:
            copied: Policy = copy.deepcopy(self.given)
        except Exception as error:  # a user's object may raise anything
            raise ConfigError(
                f"policy '{self.cls.__name__}' cannot be copied for a second worker ({type(error).__name__}: {error}); "
                "give workers=1, or the class a method another() that returns a policy with the same model"
            ) from error
        return copied

    def files(self) -> dict[str, str]:
        """Return hashes of the code that defines it, see `roboxim_policies.identity.policy_files`.

        The values of an instance are not part of it: its class's ``version`` can distinguish two of them.
        """
        name = f"<{self.cls.__qualname__}>"
        if getattr(sys.modules.get(self.cls.__module__), "__file__", None):
            found = policy_files(self.spec, self.cls, {})
        else:
            try:
                found = {name: _hash(inspect.getsource(self.cls))}
            except (OSError, TypeError):  # typed into an interpreter that keeps no source
                found = {name: _hash(f"{OF_THIS_PROCESS} {id(self.cls)}")}
        version = getattr(self.given, "version", "")
        return {**found, f"version of {name}": str(version)} if version else found


def _hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def own_policy(given: Any) -> OwnPolicy:
    """Return a policy that is a class or an instance.

    Raises:
        ConfigError: When it is neither, or sees what a policy under test must not see.
    """
    if not callable(getattr(given, "act", None)) or not callable(getattr(given, "describe", None)):
        raise ConfigError(
            f"a policy is a text such as 'bc' or 'my_policy.py:MyPolicy', a PolicySpec, or a subclass of BasePolicy or "
            f"an instance of one; got {given!r}"
        )
    own = OwnPolicy(given=given)
    if getattr(given, "privileged", False):
        raise ConfigError(
            f"policy '{own.cls.__name__}' is privileged: it reads the task, the scene and the state, which are not "
            "sent to a policy of the caller's process; write it to a file and name it, e.g. 'my_policy.py:MyPolicy'"
        )
    return own


class OwnServer:
    """Serves a policy of this process to the workers of a run; a context manager."""

    def __init__(self, policy: OwnPolicy) -> None:
        """Make the policy.

        Args:
            policy: The policy.

        Raises:
            Exception: What the policy's class raises.
        """
        self._key = secrets.token_urlsafe(24)
        self._server = SharedServer(SharedSessions(policy.make), key=self._key, port=0)

    def __enter__(self) -> OwnServer:
        """Listen."""
        self._server.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop serving."""
        self._server.__exit__()

    def with_notices(self, on_event: OnEvent) -> OnEvent:
        """Return the receiver of events: this server has nothing to say."""
        return on_event

    def prepared(self, work: Work, number: int, closing: threading.Event) -> Work:
        """Return the work of an episode worker whose policy is behind this server; see `PolicyServers.prepared`."""
        return behind_server(work, self._server.url, _description(self._server), self._key)


def _description(server: SharedServer) -> Mapping[str, Any]:
    found: Mapping[str, Any] = to_plain(server.sessions.description)
    return found
