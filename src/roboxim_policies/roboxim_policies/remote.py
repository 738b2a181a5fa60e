"""Remote policies: a wire joined with a convention.

The wire carries requests and raw numbers; the convention defines their meaning. `RemotePolicy` connects at its first
episode and again after every failure, so a server that dies loses its episodes but not the run.

A remote model cannot be hashed. Its identity consists of the user's ``version``, the server's metadata, and its replies
to a fixed request (`Probe`).
"""

from __future__ import annotations

import inspect
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from roboxim_core.closing import Closing
from roboxim_core.config import from_json, from_plain, to_json
from roboxim_core.conventions import (
    Convention,
    decode_actions,
    joined_answer,
    load_convention,
    observe,
)
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, PolicyError
from roboxim_core.plain_data.differences import differences
from roboxim_core.policies import EpisodeStart, Observation, ObservationWindow
from roboxim_core.proprioception import Proprioception
from roboxim_core.rotation.representations import Floats
from roboxim_policies.base import POLICIES, BasePolicy
from roboxim_policies.fitting import misfits
from roboxim_policies.wires import Metadata, Wire, find_wire
from roboxim_policies.wires.base import RECONNECT_S, TIMEOUT_S
from roboxim_policies.wires.openpi import OWN_SERVER
from roboxim_policies.wires.own import own_extras

SERVERS_OWN = "server"
"""Name of a convention that the server itself declares; RoboXim's own servers do."""
Version = str | int | float
"""Identity of a model as the user states it: ``pi05_libero`` or ``3``."""
PROBES = 3
"""Replies that a probe keeps."""
PROBE_INSTRUCTION = "pick up the red cube"


@dataclass(frozen=True, kw_only=True)
class Probe:
    """A model's replies to one fixed request, which identify the model."""

    replies: tuple[tuple[float, ...], ...]
    """Each reply's numbers, row by row. A model that samples answers otherwise each time."""

    def complaint(self, other: Probe) -> str:
        """Return why another probe must come from another model; empty: it may be the same.

        A model that repeats itself must repeat itself up to rounding (1e-3 of the largest number). The replies of a
        model that samples may differ three times as much from the other's as they differ among themselves.
        """
        own, others = self._array(), other._array()
        if own is None or others is None or own.shape[1] != others.shape[1]:
            sizes = sorted({len(reply) for reply in (*self.replies, *other.replies)})
            return f"its replies to the probe have other sizes ({sizes} numbers)"
        scale = max(float(np.abs(own).max()), float(np.abs(others).max()), 1e-6)
        within = max(_spread(own), _spread(others))
        apart = float(np.abs(own.mean(axis=0) - others.mean(axis=0)).max())
        allowed = 3.0 * within + 1e-3 * scale
        if apart <= allowed:
            return ""
        return f"its replies to the probe differ by {apart:.3g}, at most {allowed:.3g} is its own variation"

    def _array(self) -> Floats | None:
        if len({len(reply) for reply in self.replies}) != 1:
            return None
        return np.array(self.replies, dtype=float)


def _spread(replies: Floats) -> float:
    """Return the largest difference of a component among replies."""
    return float((replies.max(axis=0) - replies.min(axis=0)).max())


class RemotePolicy(BasePolicy, Closing):
    """A policy on a server, reached over a wire and understood by a convention."""

    def __init__(self, wire: Wire, convention: str | Convention, *, version: Version, name: str = "") -> None:
        """Join a wire and a convention. Connects only if the convention is the server's own.

        Args:
            wire: The wire to the server.
            convention: A name in ``config/conventions``, the path of a YAML file, JSON, or ``server``: as
                the server says.
            version: What the model is, e.g. ``pi05_libero@2025-09``: the server may not state it.
            name: Name for reports.

        Raises:
            ConfigError: When there is no such convention, or ``version`` is empty.
            PolicyError: When the convention is the server's own and the server does not declare one.
        """
        if not str(version):
            raise ConfigError(
                "a remote policy needs version=, e.g. --option version=pi05_libero: RoboXim cannot hash a model that a "
                "server holds, and reports must say which one it was"
            )
        if convention == SERVERS_OWN:
            convention = declared_convention(wire)
        elif isinstance(convention, str) and convention.startswith("{"):
            convention = from_json(convention, Convention, source="the convention")
        self.convention = load_convention(convention) if isinstance(convention, str) else convention
        self.wire = wire
        self.wire.prompt_key = self.convention.prompt.key
        self.wire.action_keys = self.convention.action.keys
        self.name = name or wire.name()
        self.version = str(version)
        self.cameras = self.convention.cameras
        self.window = self.convention.window
        self.horizon = self.convention.chunking.horizon
        self.semantics = self.convention.semantics
        self.chunking = self.convention.chunking.execution
        self.gripper = self.convention.action.gripper.rule
        self.lag = self.convention.action.lag
        self._fits: Metadata | None = None
        self._seed = 0
        self._most_rows = 0
        self._without_states = replace(self.convention, states=())

    def connect(self) -> Metadata:
        """Return the server's metadata, after a check that the convention fits them.

        Raises:
            PolicyError: When the server cannot be reached, or declares something else than the convention says.
        """
        metadata = self.wire.connect()
        if metadata is not self._fits:
            self.require_fitting(metadata)
            self._fits = metadata
        return metadata

    def require_fitting(self, metadata: Metadata) -> None:
        """Refuse a server that declares something else than the convention says.

        Raises:
            PolicyError: ``POLICY_FAULT``, naming every difference.
        """
        found = misfits(self.wire.name(), metadata, self.convention, self.wire.ignored)
        if found:
            self.wire.close()
            raise PolicyError(
                f"{self.wire.server} does not fit the convention '{self.convention.name}': {'; '.join(found)}. Choose "
                "the convention that its model was trained in"
            )

    def reset(self, start: EpisodeStart) -> None:
        """Begin an episode; connects if there is no connection.

        Raises:
            PolicyError: ``POLICY_DIED`` when there is no session: the server cannot be reached, is another one than at
                first, or does not fit the convention. Otherwise as the wire says, when the server refuses the episode.
        """
        try:
            self.connect()
        except PolicyError as error:  # in any case the model was not called
            raise PolicyError(str(error), ErrorCode.POLICY_DIED) from None
        self._seed = start.seed
        self.wire.reset(start)

    def act(self, window: ObservationWindow) -> Floats:
        """Ask the server.

        Raises:
            PolicyError: When the server does not answer in time, answers with an error, or with unusable actions.
        """
        return self.decoded(self.raw(window))

    def raw(self, window: ObservationWindow) -> Floats:
        """Return the server's numbers for a window, all of them, shape (n, D).

        Raises:
            PolicyError: As `act`.
        """
        answer = self.wire.ask(self.request(window))
        try:
            rows = answer["actions"] if set(answer) == {"actions"} else joined_answer(self.convention, answer)
        except InvalidRequestError as error:
            raise self._invalid(str(error)) from None
        self._most_rows = max(self._most_rows, len(rows))
        return rows

    def notices(self) -> tuple[str, ...]:
        """Return notes for the user about the answers so far, e.g. after `probe`."""
        chunking = self.convention.chunking
        if self._most_rows <= chunking.horizon:
            return ()
        return (
            f"{self.wire.server} answers {self._most_rows} actions; the first {chunking.horizon} are used (horizon of "
            f"the convention '{self.convention.name}')",
        )

    def request(self, window: ObservationWindow) -> dict[str, Any]:
        """Return the request for a window."""
        if OWN_SERVER not in (self._fits or {}):
            return observe(self.convention, window)
        # RoboXim's own server gets the measurements as they are, all of them.
        return {**observe(self._without_states, window), OWN_SERVER: {**own_extras(window), "seed": self._seed}}

    def decoded(self, raw: Floats) -> Floats:
        """Return the actions that are executed, of the meaning ``semantics``.

        Args:
            raw: The server's numbers, shape (n, D).

        Only the first ``horizon`` ones are used, as the families' own clients do; see `notices`.

        Raises:
            PolicyError: ``INVALID_ACTION`` when there are too few, or they have no meaning.
        """
        chunking = self.convention.chunking
        if len(raw) < chunking.execute and OWN_SERVER not in (self._fits or {}):  # a policy's own chunks may be shorter
            raise self._invalid(
                f"the answer has {len(raw)} actions, the convention executes {chunking.execute}; the model may be "
                "another one, or the convention's chunking is wrong"
            )
        try:
            return decode_actions(self.convention, raw[: chunking.horizon])
        except InvalidRequestError as error:
            raise self._invalid(str(error)) from None

    def probe(self) -> Probe:
        """Return the server's replies to the fixed request, each as the first of an episode.

        Raises:
            PolicyError: As `act`.
        """
        replies = []
        for _ in range(PROBES):
            self.connect()
            self._seed = 0
            self.wire.reset(EpisodeStart(episode_id="probe", instruction=PROBE_INSTRUCTION, seed=0))
            replies.append(tuple(float(f"{number:.9g}") for number in self.raw(probe_window(self.convention)).ravel()))
        return Probe(replies=tuple(replies))

    def facts(self) -> dict[str, Any]:
        """Return what identifies the policy beside its options, as plain data for ``run.json``.

        Raises:
            PolicyError: When the server cannot be reached or does not fit the convention.
        """
        return {
            "wire": self.wire.name(),
            "convention": json.loads(to_json(self.convention)),
            "metadata": self.connect(),
        }

    def close(self) -> None:
        """Close the session."""
        self.wire.close()

    def _invalid(self, text: str) -> PolicyError:
        self.wire.close()
        return PolicyError(f"{self.wire.server}: {text}", ErrorCode.INVALID_ACTION)


def declared_convention(wire: Wire) -> Convention:
    """Return the convention that a server declares in its metadata.

    Raises:
        PolicyError: When the server cannot be reached, or declares none.
    """
    own = wire.connect().get(OWN_SERVER)
    declared = own.get("convention") if isinstance(own, dict) else None
    if not isinstance(declared, dict):
        raise PolicyError(
            f"{wire.server} declares no convention; only RoboXim's own servers do. "
            "Name the convention that its model was trained in, e.g. convention=libero, or the one that it was served "
            "in (roboxim policy serve --convention)"
        )
    try:
        return from_plain(declared, Convention, source=f"the convention that {wire.server} declares")
    except ConfigError as error:
        raise PolicyError(str(error)) from None


def probe_window(convention: Convention) -> ObservationWindow:
    """Return the fixed observation window of the probe: smooth pictures, the arm in its working pose."""
    images = {}
    for image in convention.images:
        height, width = image.render_height or 256, image.render_width or 256
        rows, columns = np.mgrid[0:height, 0:width]
        pixels = [columns * 255 // width, rows * 255 // height, (rows + columns) * 255 // (width + height)]
        images[image.camera] = np.stack(pixels, axis=2).astype(np.uint8)
    joints: tuple[float, ...] = (0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4)
    joints = (*joints, *(0.0,) * max(convention.action.joints - 7, 0))[: max(convention.action.joints, 1)]
    proprio = Proprioception(
        tcp_position=(0.5, 0.0, 0.3),
        tcp_rotation_6d=(1.0, 0.0, 0.0, 0.0, -1.0, 0.0),
        joint_names=tuple(f"joint{i + 1}" for i in range(len(joints))),
        joint_positions=joints,
        joint_velocities=(0.0,) * len(joints),
        gripper_opening=1.0,
    )
    observation = Observation(seq=0, stamp_ns=0, images=images, proprio=proprio)
    return ObservationWindow(
        instruction=PROBE_INSTRUCTION,
        observations=[observation] * convention.window,
        pad_mask=(False,) * (convention.window - 1) + (True,),
        episode_id="probe",
        seq=0,
    )


def probe_from_plain(data: Any) -> Probe:
    """Return a probe that ``run.json`` holds.

    Raises:
        ConfigError: When it is damaged.
    """
    return from_plain(data, Probe, source="the probe in run.json")


def changed_facts(stored: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    """Return how a server's facts differ from stored ones; empty: they do not. A convention's prose does not count."""
    return differences(_without_prose(stored), _without_prose(now))


def _without_prose(facts: Mapping[str, Any]) -> dict[str, Any]:
    prose = ("description", "sources", "notes")
    convention = {key: value for key, value in facts.get("convention", {}).items() if key not in prose}
    return {**facts, "convention": convention}


@POLICIES.register("remote")
def remote_policy(
    wire: str, url: str, convention: str, version: Version, *, timeout_s: float = TIMEOUT_S,
    reconnect_s: float = RECONNECT_S, key_env: str = "",
) -> RemotePolicy:  # fmt: skip
    """A policy behind any wire, e.g. a plug-in's.

    Args:
        wire: Registered name of the wire.
        url: Address of the server.
        convention: What the model's numbers mean: a name that ``roboxim policy conventions`` lists, the path of a
            YAML file, or ``server``: the server's own.
        version: What the model is, e.g. ``pi05_libero``, since RoboXim cannot hash a model that a server holds.
        timeout_s: Deadline of an answer [s].
        reconnect_s: Time in which a refused connection is tried again [s].
        key_env: Environment variable with the server's key.

    Raises:
        ConfigError: On a wrong argument.
    """
    made = find_wire(wire)(url, timeout_s=timeout_s, reconnect_s=reconnect_s, key_env=key_env)
    return RemotePolicy(made, convention, version=version)


SERVED_BY = {
    "openpi": "openpi, RoboArena, StarVLA, RoboXim's own of Octo and RT-1-X, or `roboxim policy serve --wire openpi`",
    "vla_eval": "vla-eval",
    "openvla": "OpenVLA or OpenVLA-OFT (`POST /act`)",
    "groot": "Isaac-GR00T, N1.5 to N1.7",
    "xvla": "X-VLA (`POST /act`)",
}
"""Wire to the servers that speak it. Each is a policy by its wire's name."""


def behind(wire: type[Wire], servers: str) -> Callable[..., RemotePolicy]:
    """Return the factory of policies behind a wire; it takes the wire's arguments beside the convention and version.

    Args:
        wire: The wire's class.
        servers: The servers that speak it, in words.
    """

    def make(url: str, convention: str, version: Version, **options: Any) -> RemotePolicy:
        return RemotePolicy(wire(url, **options), convention, version=version)

    own = inspect.signature(make, eval_str=True)
    first = [own.parameters[name] for name in ("url", "convention", "version")]
    more = [part for part in inspect.signature(wire, eval_str=True).parameters.values() if part.name != "url"]
    if not wire.takes_key:
        more = [part for part in more if part.name != "key_env"]
    make.__signature__ = own.replace(parameters=first + more)  # type: ignore[attr-defined]
    make.__name__ = f"{wire.name()}_policy"
    make.__doc__ = f"""A policy behind a server of {servers}.

    Args:
        url: Address of the server, e.g. ``{wire.schemes[0]}://127.0.0.1:{wire.port}``.
        convention: What the model's numbers mean: a name that ``roboxim policy conventions`` lists, the path of a
            YAML file, or ``server``: the server's own.
        version: What the model is, e.g. ``pi05_libero``, since RoboXim cannot hash a model that a server holds.
        **options: Arguments of `{wire.__name__}`.

    Raises:
        ConfigError: On a wrong argument.
    """
    return make


for _name, _servers in SERVED_BY.items():
    POLICIES.register(_name)(behind(find_wire(_name), _servers))
