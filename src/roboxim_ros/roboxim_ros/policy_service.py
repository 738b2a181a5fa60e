"""The policy boundary: the encoding of ``DescribePolicy``, ``ResetPolicy`` and ``Act``, with server and client.

`PolicyService` serves a policy from a node, behind the core's guard, whether it is the expert or a user's policy.
`PolicyClient` calls a policy. Both sides check answers with `roboxim_core.policy_guard.checked_answer`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from roboxim_interfaces.msg import CameraImage
from roboxim_interfaces.msg import Observation as ObservationMsg
from roboxim_interfaces.msg import PolicyDescription as PolicyDescriptionMsg
from roboxim_interfaces.msg import Proprioception as ProprioceptionMsg
from roboxim_interfaces.msg import SceneSpec as SceneSpecMsg
from roboxim_interfaces.msg import StateRecord as StateRecordMsg
from roboxim_interfaces.msg import TaskSpec as TaskSpecMsg
from roboxim_interfaces.srv import Act, DescribePolicy, ResetPolicy
from sensor_msgs.msg import Image

from roboxim_core.errors import ErrorCode, PolicyError, RequestTimeoutError, RoboximError, UnavailableError
from roboxim_core.policies import ActionChunk, EpisodeStart, Observation, ObservationWindow, PolicyDescription
from roboxim_core.policy_guard import GuardedPolicy, checked_answer
from roboxim_core.proprioception import Proprioception
from roboxim_core.specs import SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_ros.clients import Clients
from roboxim_ros.messages.conversions import fill_image, from_msg, image_from_msg, to_msg
from roboxim_ros.node import RoboximNode

DESCRIBE_TIMEOUT_S = 60.0
"""Longest wait for a policy's description [s]; the policy may still be loading its weights."""


def encode_start(start: EpisodeStart) -> ResetPolicy.Request:
    """Encode the request that starts an episode."""
    return ResetPolicy.Request(
        episode_id=start.episode_id,
        instruction=start.instruction,
        seed=start.seed,
        task=[to_msg(start.task, TaskSpecMsg)] if start.task else [],
        scene=[to_msg(start.scene, SceneSpecMsg)] if start.scene else [],
    )


def decode_start(request: Any, *, privileged: bool) -> EpisodeStart:
    """Decode the request that starts an episode.

    Args:
        request: The request.
        privileged: Whether to convert the task and the scene; false: they are left out.

    Raises:
        InvalidRequestError: On an invalid task or scene.
    """
    return EpisodeStart(
        episode_id=request.episode_id,
        instruction=request.instruction,
        seed=int(request.seed),
        task=from_msg(request.task[0], TaskSpec) if privileged and request.task else None,
        scene=from_msg(request.scene[0], SceneSpec) if privileged and request.scene else None,
    )


def encode_window(window: ObservationWindow) -> Act.Request:
    """Encode the request for actions. A repeated frame is converted once, and each image copied once."""
    done: dict[int, ObservationMsg] = {}
    for observation in window.observations:
        if id(observation) not in done:
            done[id(observation)] = _encode_observation(observation)
    return Act.Request(
        episode_id=window.episode_id,
        seq=window.seq,
        instruction=window.instruction,
        observations=[done[id(observation)] for observation in window.observations],
        pad_mask=list(window.pad_mask),
        commanded_opening=[] if window.commanded_opening is None else [window.commanded_opening],
    )


def decode_window(request: Any, *, privileged: bool) -> ObservationWindow:
    """Decode a request for actions. Images share the request's memory and are read-only.

    Args:
        request: The request.
        privileged: Whether to convert the state records; false: they are left out.

    Raises:
        InvalidRequestError: On an image whose data does not fit its size or encoding, or on proprioception that is not
            finite.
    """
    return ObservationWindow(
        instruction=request.instruction,
        observations=[_decode_observation(item, privileged) for item in request.observations],
        pad_mask=tuple(bool(real) for real in request.pad_mask),
        episode_id=request.episode_id,
        seq=int(request.seq),
        commanded_opening=next(iter(request.commanded_opening), None),
    )


def _encode_observation(observation: Observation) -> ObservationMsg:
    return ObservationMsg(
        seq=observation.seq,
        stamp_ns=observation.stamp_ns,
        images=[
            CameraImage(camera=name, image=fill_image(Image(), image, "rgb8"))
            for name, image in observation.images.items()
        ],
        proprio=to_msg(observation.proprio, ProprioceptionMsg),
        state=[] if observation.state is None else [to_msg(observation.state, StateRecordMsg)],
    )


def _decode_observation(item: Any, privileged: bool) -> Observation:
    return Observation(
        seq=int(item.seq),
        stamp_ns=int(item.stamp_ns),
        images={image.camera: image_from_msg(image.image) for image in item.images},
        proprio=from_msg(item.proprio, Proprioception),
        state=from_msg(item.state[0], StateRecord) if privileged and item.state else None,
    )


def fill_answer(response: Act.Response, chunk: ActionChunk) -> None:
    """Encode checked actions into the response."""
    response.horizon = len(chunk.actions)
    response.actions = chunk.actions.ravel().tolist()
    response.done = chunk.done
    response.phases = list(chunk.phases)


def decode_answer(response: Any, description: PolicyDescription) -> ActionChunk:
    """Decode and check the response with actions.

    Args:
        response: The response.
        description: The policy's description.

    Raises:
        PolicyError: With code ``INVALID_ACTION`` when the response is not a chunk of actions of the declared size.
    """
    horizon, numbers = int(response.horizon), np.asarray(response.actions, np.float32)
    if horizon < 1 or numbers.size % horizon:
        raise PolicyError(
            f"policy '{description.name}' answered horizon {horizon} with {numbers.size} numbers; expected a multiple",
            ErrorCode.INVALID_ACTION,
        )
    chunk = ActionChunk(actions=numbers.reshape(horizon, -1), done=bool(response.done), phases=tuple(response.phases))
    return checked_answer(chunk, description)


class PolicyService:
    """Serves a guarded policy from a node: ``describe_policy``, ``reset_policy``, ``act``."""

    def __init__(self, node: RoboximNode, guard: GuardedPolicy, namespace: str = "") -> None:
        """Offer the three services.

        Args:
            node: The node that serves.
            guard: The policy behind its guard.
            namespace: Namespace of the services below the node's, e.g. ``expert``; empty: the node's own.
        """
        self.guard = guard
        self._alone = threading.Lock()
        prefix = f"{namespace}/" if namespace else ""
        node.serve(DescribePolicy, f"{prefix}describe_policy", self._on_describe)
        node.serve(ResetPolicy, f"{prefix}reset_policy", self._on_reset)
        node.serve(Act, f"{prefix}act", self._on_act)
        node.offer(f"{prefix}act", self._act, inline=guard.any_thread)

    def _on_describe(self, _: DescribePolicy.Request, response: DescribePolicy.Response) -> None:
        response.description = to_msg(self.guard.description, PolicyDescriptionMsg)

    def _on_reset(self, request: ResetPolicy.Request, _: ResetPolicy.Response) -> None:
        start = decode_start(request, privileged=self.guard.description.privileged)
        with self._alone:
            self.guard.reset(start)

    def _on_act(self, request: Act.Request, response: Act.Response) -> None:
        fill_answer(response, self._act(decode_window(request, privileged=self.guard.description.privileged)))

    def _act(self, window: ObservationWindow) -> ActionChunk:
        """Request actions from the policy, in the node's thread, or in the caller's if the policy allows it."""
        with self._alone:
            return self.guard.act(window)


class PolicyClient:
    """A client of a policy's three services. Every failure of a call counts as the policy's fault."""

    def __init__(self, clients: Clients, namespace: str, timeout_s: float) -> None:
        """Use the policy of a namespace.

        Args:
            clients: The clients.
            namespace: Namespace of the policy, relative, e.g. ``expert``.
            timeout_s: Longest wait for an answer [s].
        """
        self._clients = clients
        self._namespace = namespace
        self._timeout_s = timeout_s
        self._description: PolicyDescription | None = None

    def describe(self) -> PolicyDescription:
        """Return the policy's description.

        Raises:
            UnavailableError: When no policy serves the namespace.
            InvalidRequestError: When the description is not valid.
        """
        answer = self._clients.call(
            DescribePolicy,
            f"{self._namespace}/describe_policy",
            DescribePolicy.Request(),
            timeout_s=DESCRIBE_TIMEOUT_S,
        )
        self._description = from_msg(answer.description, PolicyDescription)
        return self._description

    def reset(self, start: EpisodeStart) -> None:
        """Start an episode.

        Raises:
            PolicyError: With the failure's code, e.g. ``POLICY_LATE``, ``POLICY_DIED``.
        """
        self._call(ResetPolicy, "reset_policy", encode_start(start))

    def act(self, window: ObservationWindow) -> ActionChunk:
        """Return the next actions.

        Raises:
            PolicyError: With the failure's code, e.g. ``POLICY_LATE``, ``POLICY_DIED``, ``INVALID_ACTION``.
        """
        description = self._description or self.describe()
        name, deadline = f"{self._namespace}/act", time.monotonic() + self._timeout_s
        with _policys_faults():
            call = self._clients.send_local(name, window)
            if call is not None:
                answer = checked_answer(self._clients.value_of(call, name, self._timeout_s), description)
                if time.monotonic() > deadline:  # the policy ran in this thread, which could not give up earlier
                    label = f"policy '{description.name}'"
                    raise RequestTimeoutError(f"{label} did not answer within {self._timeout_s:g} s")
                return answer
        return decode_answer(self._call(Act, "act", encode_window(window)), description)

    def _call(self, srv_type: Any, name: str, request: Any) -> Any:
        with _policys_faults():
            return self._clients.call(
                srv_type, f"{self._namespace}/{name}", request, timeout_s=self._timeout_s, wait_s=self._timeout_s
            )


@contextmanager
def _policys_faults() -> Iterator[None]:
    """Turn every error of a call into a `PolicyError`."""
    try:
        yield
    except RequestTimeoutError as error:
        raise PolicyError(str(error), ErrorCode.POLICY_LATE) from None
    except UnavailableError as error:
        raise PolicyError(str(error), ErrorCode.POLICY_DIED) from None
    except RoboximError as error:
        raise PolicyError(str(error), error.code) from None
