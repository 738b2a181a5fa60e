"""The base class of wires: a session with a policy server in another process.

A wire carries requests and raw answers; it does not know what an action means (`roboxim_core.conventions` does). It
owns the deadlines and the encoding. Four rules hold for every wire:

- One operation has one deadline, regardless of its number of messages.
- **Every failure closes the connection.** A reply that comes after its deadline therefore has no reader, and never
  answers the next request.
- A closed connection is opened again at the next episode, with pauses that grow and end.
- A server that announces other metadata than at first is refused, because it may serve another model; so is one whose
  actions have other keys or other numbers of components than in its first answer. The number of actions may vary.
"""

from __future__ import annotations

import os
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Any, ClassVar
from urllib.parse import urlsplit

import numpy as np
import numpy.typing as npt

from roboxim_core.config import to_json
from roboxim_core.errors import ConfigError, ErrorCode, PolicyError, one_of, printable
from roboxim_core.limits import echo
from roboxim_core.policies import EpisodeStart
from roboxim_core.registry import Registry
from roboxim_policies.wires.errors import Deadline, died, fault, invalid

Request = Mapping[str, Any]
"""Request to a policy: NumPy arrays and texts by name, e.g. ``{"observation/image": ..., "prompt": "..."}``."""
Rows = npt.NDArray[np.float64]
"""Raw actions of a server, float64, shape (n, D)."""
Answer = dict[str, Rows]
"""Raw actions of a server by key; all have equal lengths. A server without keys for actions answers ``actions``."""
Metadata = dict[str, Any]
"""What a server says of itself: maps, lists, texts and numbers."""

TIMEOUT_S = 90.0
"""Default deadline of one answer [s]. A model that is compiled at its first call takes about a minute for it."""
RECONNECT_S = 10.0
"""Default time in which a refused connection is tried again [s]."""
FIRST_PAUSE_S = 0.25
LONGEST_TIMEOUT_S = 3_600.0


class Wire(ABC):
    """A session with one server. Not thread-safe: each worker has its own.

    A subclass implements `_open`, `_ask` and `_shut`, and `_begin` if its protocol has episodes. They may raise any
    error; the session is then closed.
    """

    schemes: ClassVar[tuple[str, ...]] = ()
    """Schemes of the URLs of this wire, the usual one first, e.g. ``("ws", "wss")``."""
    port: ClassVar[int] = 8000
    """The servers' usual port."""
    takes_key: ClassVar[bool] = False
    """Whether the protocol has a key."""

    def __init__(
        self, url: str, *, timeout_s: float = TIMEOUT_S, reconnect_s: float = RECONNECT_S, key_env: str = ""
    ) -> None:
        """Describe the server without connecting to it.

        Args:
            url: Its address, e.g. ``ws://127.0.0.1:8000``.
            timeout_s: Deadline of each operation: to connect, to begin an episode, to answer [s].
            reconnect_s: Time in which a refused connection is tried again [s].
            key_env: Environment variable with the server's key, so that no record holds the key itself.

        Raises:
            ConfigError: On a wrong URL, time or variable.
        """
        self.url = self._checked_url(url)
        if not 0 < timeout_s <= LONGEST_TIMEOUT_S:
            raise ConfigError(f"timeout_s must be above 0 and at most {LONGEST_TIMEOUT_S:g} s, got {timeout_s}")
        if not 0 <= reconnect_s <= LONGEST_TIMEOUT_S:
            raise ConfigError(f"reconnect_s must be from 0 to {LONGEST_TIMEOUT_S:g} s, got {reconnect_s}")
        if key_env and not self.takes_key:
            raise ConfigError(f"the wire '{self.name()}' has no key; leave key_env out")
        if key_env and not os.environ.get(key_env):
            raise ConfigError(f"the environment variable {key_env} is not set; it must hold the server's key")
        self.timeout_s = timeout_s
        self.reconnect_s = reconnect_s
        self.key = os.environ[key_env] if key_env else ""
        self.pause: Callable[[float], object] = threading.Event().wait
        """Waits for a time [s] before a further try to connect."""
        self.prompt_key = "prompt"
        """Key of the instruction in requests."""
        self.action_keys: tuple[str, ...] = ("actions",)
        """Keys of the actions in answers, on wires whose answers are maps that the model chooses."""
        self.ignored: tuple[str, ...] = ()
        """Names of what the server declares that are not compared with the convention."""
        self._metadata: Metadata | None = None
        self._components: dict[str, int] = {}
        self._is_open = False

    @classmethod
    def name(cls) -> str:
        """Return the registered name of the wire."""
        return next((name for name in WIRES if WIRES[name] is cls), cls.__name__)

    @property
    def server(self) -> str:
        """The server, for messages."""
        return f"the {self.name()} server at {self.url}"

    def connect(self, *, reconnect_wait_s: float | None = None, deadline: Deadline | None = None) -> Metadata:
        """Return the server's metadata; open the session if it is closed.

        Args:
            reconnect_wait_s: Time in which a refused connection is tried again [s]; None: ``reconnect_s``.
            deadline: Deadline; None: ``timeout_s`` from now.

        Raises:
            PolicyError: ``POLICY_DIED`` when there is no server, or no answer before the deadline, ``POLICY_FAULT``
                when the server breaks the protocol or announces other metadata than before.
        """
        if self._is_open and self._alive() and self._metadata is not None:
            return self._metadata
        self.close()
        reconnect_wait_s = self.reconnect_s if reconnect_wait_s is None else reconnect_wait_s
        metadata = self._opened(reconnect_wait_s, deadline or Deadline(self.timeout_s))
        if self._metadata is not None and to_json(metadata) != to_json(self._metadata):
            self.close()
            raise fault(
                f"{self.server} announces other metadata than at first, so it may serve another model: "
                f"{to_json(metadata)[:300]} instead of {to_json(self._metadata)[:300]}; evaluate it in a new folder"
            )
        self._metadata = metadata
        return metadata

    def reset(self, start: EpisodeStart) -> None:
        """Begin an episode; opens the session if it is closed.

        Raises:
            PolicyError: As `connect`, and when the server refuses the episode.
        """
        deadline = Deadline(self.timeout_s)
        self.connect(deadline=deadline)
        with _Closing(self):
            self._begin(start, deadline)

    def ask(self, request: Request) -> Answer:
        """Return the server's actions for a request, as it sent them.

        Raises:
            PolicyError: ``POLICY_DIED`` when the connection is lost, ``POLICY_LATE`` after the deadline,
                ``POLICY_FAULT`` when the server reports an error or breaks the protocol, ``INVALID_ACTION`` when its
                actions are not finite numbers, or have other components than at first. The session is then closed.
        """
        if not self._is_open:
            raise died(f"the session with {self.server} is closed; an episode must begin with reset")
        with _Closing(self):
            answer = self._ask(request, Deadline(self.timeout_s))
            components = {key: rows.shape[1] for key, rows in answer.items()}
            self._components = self._components or components
            if components != self._components:
                raise invalid(
                    f"{self.server} answers other actions than at first, so it may serve another model: the numbers "
                    f"of components are {echo(components)} instead of {echo(self._components)}; evaluate it in a new "
                    "folder"
                )
            return answer

    def close(self) -> None:
        """Close the session; it can be opened again."""
        self._is_open = False
        self._shut()

    def _opened(self, reconnect_wait_s: float, deadline: Deadline) -> Metadata:
        """Open the session, again and again for a time while the connection is refused."""
        pause, waited = FIRST_PAUSE_S, 0.0
        while True:
            try:
                with _Closing(self):
                    metadata = self._open(deadline)
                    self._is_open = True
                    return metadata
            except PolicyError as error:
                if error.code == ErrorCode.POLICY_LATE:  # a machine that is switched off sends no refusal
                    raise died(f"{self.server} cannot be reached: {error}") from None
                if error.code != ErrorCode.POLICY_DIED or waited + pause > reconnect_wait_s:
                    raise
            self.pause(pause)
            waited += pause
            pause *= 2

    @classmethod
    def _checked_url(cls, url: str) -> str:
        text = url if "://" in str(url) else f"{cls.schemes[0]}://{url}"
        try:
            parts = urlsplit(text)
            host, port = parts.hostname, parts.port
        except ValueError as error:
            raise ConfigError(f"url '{url}' is not an address: {error}") from None
        if parts.scheme not in cls.schemes:
            hint = REFUSED.get("lerobot", "") if parts.scheme == "grpc" else one_of(cls.schemes, parts.scheme)
            raise ConfigError(f"url '{url}': the scheme '{parts.scheme}' is not of this wire; {hint}")
        if not host or any(character.isspace() or ord(character) < 32 for character in text):
            raise ConfigError(f"url '{url}' names no host; write e.g. {cls.schemes[0]}://127.0.0.1:{cls.port}")
        if "@" in parts.netloc:
            raise ConfigError("a url with a user or a password would be recorded; pass a key with key_env instead")
        if port is None and parts.scheme == cls.schemes[0]:
            parts = parts._replace(netloc=f"{parts.netloc}:{cls.port}")
        return parts.geturl()

    def _alive(self) -> bool:
        """Tell whether the open session still has its connection."""
        return True

    @abstractmethod
    def _open(self, deadline: Deadline) -> Metadata:
        """Connect, and return the server's metadata."""

    def _begin(self, start: EpisodeStart, deadline: Deadline) -> None:  # noqa: B027 - most protocols have no episodes
        """Begin an episode."""

    @abstractmethod
    def _ask(self, request: Request, deadline: Deadline) -> Answer:
        """Send a request and return the actions of its reply."""

    @abstractmethod
    def _shut(self) -> None:
        """Close the connection at once, in any state; must not raise."""


METADATA_VALUES = 10_000
"""Largest number of values in a server's metadata."""


def plain_metadata(value: Any) -> Metadata:
    """Return a server's metadata as plain data that JSON can carry.

    Raises:
        PolicyError: When they are not a map, or have too many values.
    """
    count = 0

    def plain(part: Any, depth: int) -> Any:
        nonlocal count
        count += 1
        if count > METADATA_VALUES or depth > 20:
            raise fault(f"the server's metadata have more than {METADATA_VALUES} values or 20 levels")
        if isinstance(part, dict):
            return {_text(key): plain(item, depth + 1) for key, item in part.items()}
        if isinstance(part, list | tuple | np.ndarray):
            return [plain(item, depth + 1) for item in (part.tolist() if isinstance(part, np.ndarray) else part)]
        if isinstance(part, np.generic):
            part = part.item()
        if isinstance(part, float) and not np.isfinite(part):
            return str(part)
        return part if part is None or isinstance(part, bool | int | float) else _text(part)

    if not isinstance(value, dict):
        raise fault(f"the server's metadata must be a map, got {type(value).__name__}")
    return {_text(key): plain(item, 0) for key, item in value.items()}


def _text(value: Any) -> str:
    return printable(value.decode("utf-8", "replace") if isinstance(value, bytes) else value)


class _Closing:
    """Closes the session when its block raises."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        if kind is not None:
            self._wire.close()


WIRES: Registry[type[Wire]] = Registry("wire")
"""Wires by name. Entry point group of plug-ins: ``roboxim.wire``."""

REFUSED = {
    "lerobot": "LeRobot's policy server (gRPC) exchanges pickles, which let each side run code in the other "
    "(CVE-2026-25874); serve the checkpoint with vla-eval's LeRobot model server and use the wire 'vla_eval'",
    "groot_n1": "GR00T N1, and N1.5 before August 2025, exchange torch.save pickles, which let each side run code in "
    "the other; update Isaac-GR00T to 029b2dfbe40d or later, whose server speaks MessagePack, and use the wire 'groot'",
}
"""Protocols that RoboXim does not speak, with the reason and the way round."""


@WIRES.conformance
def is_a_wire_with_typed_arguments(name: str, item: type[Wire]) -> None:
    """Refuse a wire that is not a complete subclass, or whose arguments lack type annotations."""
    import inspect

    assert isinstance(item, type), "it is not a class; derive one from Wire"
    assert issubclass(item, Wire), "it is not derived from roboxim_policies.wires.Wire"
    assert not inspect.isabstract(item), f"it is abstract: write {', '.join(sorted(item.__abstractmethods__))}"
    assert item.schemes, "it names no scheme of its URLs, e.g. schemes = ('ws', 'wss')"
    for parameter in inspect.signature(item, eval_str=True).parameters.values():
        assert parameter.annotation is not parameter.empty, f"argument '{parameter.name}' has no type"
        required = parameter.default is parameter.empty and parameter.name != "url"
        assert not required, f"argument '{parameter.name}' has no default; only the url may be required"


@WIRES.conformance
def a_refused_port_ends_as_policy_died(name: str, item: type[Wire]) -> None:
    """Refuse a wire that does not report a closed port, or that keeps a thread."""
    import socket

    with socket.socket() as taken:  # bound, but not listening: connections are refused
        taken.bind(("127.0.0.1", 0))
        wire = item(f"{item.schemes[0]}://127.0.0.1:{taken.getsockname()[1]}", timeout_s=20.0, reconnect_s=0.0)
        before = threading.active_count()
        code = None
        try:
            wire.reset(EpisodeStart(episode_id="check", instruction="", seed=0))
        except PolicyError as error:
            code = error.code
        finally:
            wire.close()
    assert code == ErrorCode.POLICY_DIED, f"an episode on a refused port must end as POLICY_DIED, it was {code}"
    assert threading.active_count() <= before, "close left a thread"
