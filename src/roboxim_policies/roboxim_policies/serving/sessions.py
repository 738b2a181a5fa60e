"""Sessions of a served policy: requests of a convention in, the policy's numbers out.

A policy keeps state during an episode, so each session has its own instance; instances are used again.

Some wires carry one action in each answer, and their clients ask at every tick (vla-eval's, OpenVLA's). A session on
such a wire executes the policy's chunks itself, by the policy's `Chunking`, so the policy is called as often as in the
simulator's process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from roboxim_core.actions import ActionContext, ActionPlan, GripperRule, GripperSwitch
from roboxim_core.conventions import (
    ActionOutput,
    Chunking,
    ControllerResponse,
    Convention,
    GripperOutput,
    ImageInput,
    Layout,
    Resize,
    StateField,
    StateInput,
    StatePart,
    from_actions,
)
from roboxim_core.errors import ConfigError, InvalidRequestError
from roboxim_core.policies import EpisodeStart, Observation, ObservationWindow, Policy, PolicyDescription
from roboxim_core.policy_guard import GuardedPolicy
from roboxim_core.poses import Pose
from roboxim_core.proprioception import Proprioception
from roboxim_core.rotation.representations import Floats, RotationRepresentation, encode
from roboxim_policies.serving.instances import Instances
from roboxim_policies.wires.own import OwnExtras, extras_in
from roboxim_policies.wires.parts import last_part

MAX_SESSIONS = 32
"""Largest number of sessions at the same time."""
JUMP = 2.0
"""A tool that moves this many times the largest motion of an action, from one request to the next, was set back."""


def own_convention(description: PolicyDescription, size: int = 256) -> Convention:
    """Return a policy's own convention: its cameras as they are, RoboXim's state, its actions.

    Args:
        description: The policy's description.
        size: Side of the pictures of cameras for which the policy names no size [px].
    """
    meaning = description.semantics
    return Convention(
        name=f"{description.name} (its own)",
        description=f"RoboXim's policy '{description.name}' as roboxim policy serve offers it.",
        rate_hz=meaning.rate_hz,
        window=description.window,
        images=tuple(
            ImageInput(
                camera=camera.name, key=f"observation/images/{camera.name}",
                width=camera.width or size, height=camera.height or size,
                render_width=camera.width, render_height=camera.height,
                resize=Resize.NONE if camera.width and camera.height else Resize.LANCZOS3,
            )
            for camera in description.cameras
        ),
        states=(
            StateInput(
                key="observation/state",
                parts=(
                    StatePart(field=StateField.TCP_POSITION),
                    StatePart(field=StateField.TCP_ROTATION, rotation=RotationRepresentation.ROTATION_6D),
                    StatePart(field=StateField.GRIPPER),
                ),
            ),
        ),
        action=ActionOutput(
            control=meaning.control, frame=meaning.frame, rotation=meaning.rotation, delta_base=meaning.delta_base,
            max_translation_m=meaning.max_translation_m, max_rotation_rad=meaning.max_rotation_rad,
            gripper=_gripper_of(description.gripper),
            response=ControllerResponse(gain=(1.0,) * 6, lag=description.lag) if description.lag else None,
        ),
        chunking=Chunking(horizon=description.horizon, **_execution_of(description)),
    )  # fmt: skip


def _gripper_of(rule: GripperRule) -> GripperOutput:
    """Return the output of openings that a rule steadies."""
    return GripperOutput(
        binary=rule.binary, dead_zone=rule.band / 2, agree=rule.agree, hold=rule.hold, on_change=rule.on_change
    )


def _execution_of(description: PolicyDescription) -> dict[str, Any]:
    """Return how a policy's chunks are executed, as fields of a convention's chunking."""
    chunking = description.chunking
    return {**vars(chunking), "execute": min(chunking.execute, description.horizon)}


class Sessions:
    """The sessions of a policy."""

    def __init__(
        self, make: Callable[[], Policy], *, convention: Convention | None = None, size: int = 256,
        single: bool = False,
    ) -> None:  # fmt: skip
        """Make a first instance of the policy.

        Args:
            make: Makes an instance.
            convention: Meaning of requests and answers; None: `own_convention`.
            size: See `own_convention`.
            single: Whether an answer has one action, that of the request's tick.

        Raises:
            ConfigError: When the policy is privileged, needs cameras that the convention does not have, or has actions
                that the convention cannot express.
        """
        first = GuardedPolicy(make())
        self.description = first.description
        if self.description.privileged:
            raise ConfigError(
                f"policy '{self.description.name}' is privileged: it reads the task, the scene and the state, which no "
                "wire carries; serve one that acts on observations"
            )
        self.is_own = convention is None
        self.convention = convention or own_convention(self.description, size)
        converts = self.description.semantics.differing(self.convention.semantics)  # each action by its own pose
        self.single = single or bool(converts)
        if self.single:
            self.convention = replace(self.convention, chunking=Chunking())
        cameras = [image.camera for image in self.convention.images]
        missing = [camera.name for camera in self.description.cameras if camera.name not in cameras]
        if missing:
            raise ConfigError(
                f"policy '{self.description.name}' needs camera {', '.join(missing)}, the convention "
                f"'{self.convention.name}' has {', '.join(cameras) or 'none'}"
            )
        _require_convertible(self.description, self.convention)
        self._instances = Instances(first, lambda: GuardedPolicy(make()), max_instances=MAX_SESSIONS)

    @contextmanager
    def session(self) -> Iterator[Session]:
        """Yield a session with its own instance.

        Raises:
            UnavailableError: When there are too many.
        """
        with self._instances.taken() as guard:
            yield Session(guard, self.convention, single=self.single, own=self.is_own)

    def close(self) -> None:
        """Forget the instances."""
        self._instances.close()


def _require_convertible(description: PolicyDescription, convention: Convention) -> None:
    """Refuse a convention of another rate, or of joints where the policy moves the end effector.

    Raises:
        ConfigError: With the way round.
    """
    source, target = description.semantics, convention.semantics
    if "rate_hz" in source.differing(target):
        raise ConfigError(
            f"policy '{description.name}' acts at {source.rate_hz:g} Hz, the convention '{convention.name}' at "
            f"{target.rate_hz:g} Hz; serve it in a copy of the convention with rate_hz: {source.rate_hz:g} to a client "
            "of this rate, or without --convention"
        )
    if source.control.is_joint_space != target.control.is_joint_space:
        raise ConfigError(
            f"policy '{description.name}' acts by '{source.control}', the convention '{convention.name}' by "
            f"'{target.control}', which only the robot's kinematics convert; choose another convention"
        )


class Session:
    """One client's episodes."""

    def __init__(self, guard: GuardedPolicy, convention: Convention, *, single: bool = False, own: bool = True) -> None:
        """Use an instance of the policy.

        Args:
            guard: The policy behind its guard.
            convention: Meaning of requests and answers.
            single: Whether an answer has one action; the session then executes the policy's chunks.
            own: Whether the convention is the policy's own. Its client then applies the policy's gripper rule.
        """
        self._guard = guard
        self._convention = convention
        self._single, self._own = single, own
        self._instruction = ""
        self._announced: tuple[str, str, int] | None = None
        self._prompt: str | None = None
        self._episode = ""
        self._seq = 0
        self._count = 0
        self._plan: ActionPlan | None = None
        self._switch: GripperSwitch | None = None
        self._last: Floats | None = None
        self._commanded: float | None = None

    def begin(self, instruction: str = "", *, episode_id: str = "", seed: int = 0) -> None:
        """Announce an episode; it begins with the next request.

        Args:
            instruction: The instruction; empty: that of the request.
            episode_id: Its id; empty: a number.
            seed: Seed of the policy's own randomness.
        """
        self._announced = instruction, episode_id, seed

    def answer(self, request: Mapping[str, Any], *, guess: bool = False) -> Floats:
        """Return the convention's numbers of the policy's next actions, shape (n, D).

        Args:
            request: A request of the convention.
            guess: Whether the wire has no episodes. One then begins with a new instruction, and when the tool is
                elsewhere than an action can have moved it.

        Raises:
            InvalidRequestError: When the request is not one of the convention.
            PolicyError: When the policy raises or answers with invalid actions.
        """
        prompt = request.get(self._convention.prompt.key)
        if not isinstance(prompt, str):
            raise InvalidRequestError(
                f"the request has no instruction '{self._convention.prompt.key}', only {sorted(map(str, request))}"
            )
        own = extras_in(request, self._convention.window)
        measured = [item.proprio for item in own.observations] if own else self._proprioception(request)
        self._enter(prompt, own, measured[-1], guess=guess)
        window = self._window(request, own, measured)
        actions = self._row(window) if self._single else np.asarray(self._guard.act(window).actions, dtype=float)
        self._seq += 1 if own is not None else len(actions)  # a client without ticks of its own executes all of them
        numbers = self._numbers(actions, measured[-1])
        self._last = np.array([*measured[-1].tcp_position, len(numbers)])
        return numbers

    def _enter(self, prompt: str, own: OwnExtras | None, measured: Proprioception, *, guess: bool) -> None:
        """Begin an episode if the request is the first of one."""
        instruction, episode_id, seed = self._announced or ("", "", 0)
        if own is not None:
            known = self._episode == own.episode_id and own.seq >= self._seq
            episode_id, seed = own.episode_id, seed if own.seed is None else own.seed
        else:
            known = prompt == self._prompt and not (guess and self._jumped(measured))
        if known and self._announced is None:
            return
        self._count += 1
        self._announced, self._prompt, self._seq = None, None, 0
        self._instruction = instruction or prompt
        self._episode, named = "", episode_id or f"session-{self._count}"
        self._guard.reset(EpisodeStart(episode_id=named, instruction=self._instruction, seed=seed))
        self._episode, self._prompt = named, prompt
        description = self._guard.description
        self._commanded = None
        self._plan = ActionPlan(description.chunking, description.semantics)
        self._switch = None if self._own else GripperSwitch(description.gripper, measured.gripper_opening)

    def _jumped(self, measured: Proprioception) -> bool:
        """Return whether the tool is elsewhere than the actions since the last request can have moved it."""
        if self._last is None:
            return False
        max_jump = JUMP * self._guard.description.semantics.max_translation_m * self._last[3]
        return bool(np.linalg.norm(np.array(measured.tcp_position) - self._last[:3]) > max_jump)

    def _row(self, window: ObservationWindow) -> Floats:
        """Return the action of the window's tick, shape (1, D); calls the policy only when its chunk is executed."""
        assert self._plan is not None
        if self._plan.due(window.seq):
            chunk = self._guard.act(window)
            self._plan.add(window.seq, 0, chunk.actions, chunk.phases)
        planned = self._plan.action(window.seq)
        assert planned is not None
        row = np.array(planned.action, dtype=float)
        polarity = self._guard.description.semantics.gripper
        self._commanded = polarity.opening(float(row[-1]))
        if self._switch is not None:
            self._commanded = self._switch.step(self._commanded)
            row[-1] = polarity.number(self._commanded)
        return row[None]

    def _window(
        self, request: Mapping[str, Any], own: OwnExtras | None, proprio: list[Proprioception]
    ) -> ObservationWindow:
        size = self._convention.window
        pictures = {image.camera: self._pictures(image, request) for image in self._convention.images}
        if own is not None:
            stamps = [(item.seq, item.stamp_ns) for item in own.observations]
            mask, self._seq = own.pad_mask, own.seq
        else:
            stamps = [(max(self._seq - size + 1 + i, 0), 0) for i in range(size)]
            mask = tuple(self._seq - size + 1 + i >= 0 for i in range(size))
        observations = [
            Observation(
                seq=stamps[i][0], stamp_ns=stamps[i][1], proprio=proprio[i],
                images={camera: frames[i] for camera, frames in pictures.items()},
            )
            for i in range(size)
        ]  # fmt: skip
        return ObservationWindow(
            instruction=self._instruction, observations=observations, pad_mask=mask, episode_id=self._episode,
            seq=self._seq, commanded_opening=self._commanded if own is None else own.commanded_opening,
        )  # fmt: skip

    def _pictures(self, image: ImageInput, request: Mapping[str, Any]) -> list[np.ndarray[Any, Any]]:
        value = request.get(image.key)
        size = self._convention.window
        if not isinstance(value, np.ndarray) or value.dtype != np.uint8:
            raise InvalidRequestError(
                f"the request needs a uint8 picture '{image.key}', has {sorted(map(str, request))}"
            )
        frames = [value] if size == 1 and value.ndim == 3 else list(np.atleast_1d(value))
        if image.layout == Layout.CHW:
            frames = [np.moveaxis(frame, 0, 2) if frame.ndim == 3 else frame for frame in frames]
        if len(frames) != size or any(frame.ndim != 3 or frame.shape[2] != 3 or not frame.size for frame in frames):
            raise InvalidRequestError(
                f"'{image.key}' must have {size} RGB pictures, in the layout '{image.layout}', got {value.shape}"
            )
        frames = [image.turned(frame) for frame in frames]
        return [self._sized(image.camera, frame) for frame in frames]

    def _sized(self, camera: str, picture: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        """Return a picture at the size that the policy states for the camera, if it states one."""
        want = next((want for want in self._guard.description.cameras if want.name == camera), None)
        if want is None or not want.width or not want.height:
            return picture
        return ImageInput(camera=camera, key=camera, width=want.width, height=want.height).prepare(picture)

    def _proprioception(self, request: Mapping[str, Any]) -> list[Proprioception]:
        """Return the arm's state at each of the request's ticks."""
        convention, size = self._convention, self._convention.window
        found: list[dict[str, Any]] = [{} for _ in range(size)]
        for state in convention.states:
            value = request.get(state.key)
            if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
                raise InvalidRequestError(f"the request needs the state '{state.key}', has {sorted(map(str, request))}")
            joints = convention.action.joints
            values, length = np.asarray(value, dtype=float), state.size(joints)
            if values.size != size * length or not np.isfinite(values).all():
                raise InvalidRequestError(
                    f"'{state.key}' must have {size * length} finite numbers, got {values.size}, of which "
                    f"{np.isfinite(values).sum()} are finite"
                )
            try:
                readings = state.split(values.reshape(size, length), convention.frames, joints)
            except InvalidRequestError as error:
                raise InvalidRequestError(f"'{state.key}' of the request: {error}") from None
            fields = {part.field for part in state.parts}
            for i, item in enumerate(found):
                if StateField.TCP_POSITION in fields and np.isfinite(readings.tcp_positions[i]).all():
                    item["tcp_position"] = tuple(readings.tcp_positions[i].tolist())
                if StateField.TCP_ROTATION in fields:
                    rotation = encode(readings.tcp_rotations[i], RotationRepresentation.ROTATION_6D)
                    item["tcp_rotation_6d"] = tuple(rotation.tolist())
                if StateField.GRIPPER in fields and np.isfinite(readings.openings[i]):
                    item["gripper_opening"] = float(readings.openings[i])
                if readings.joint_positions.shape[1]:
                    item["joint_positions"] = tuple(readings.joint_positions[i].tolist())
                if readings.joint_velocities.shape[1]:
                    item["joint_velocities"] = tuple(readings.joint_velocities[i].tolist())
        return [_proprioception(item) for item in found]

    def _numbers(self, actions: Floats, proprio: Proprioception) -> Floats:
        """Return the convention's numbers of the policy's actions.

        The client's commanded pose is not known; the measured one stands for it. Where a conversion needs it, there is
        one action in each answer (`Sessions.single`).
        """
        source, target = self._guard.description.semantics, self._convention.semantics
        if not source.differing(target):
            return self._convention.action.encode(actions, self._convention.frames)
        pose = Pose.from_arrays(np.array(proprio.tcp_position), proprio.tcp_rotation)
        joints = proprio.joint_positions or None
        context = ActionContext(
            pose_commanded=pose, pose_measured=pose, joints_commanded=joints, joints_measured=joints
        )
        return from_actions(self._convention, actions, context, source=source)


def _proprioception(known: dict[str, Any]) -> Proprioception:
    count = max(len(known.get("joint_positions", ())), len(known.get("joint_velocities", ())))
    names = tuple(f"joint{i + 1}" for i in range(count))
    zeros = (0.0,) * count
    return Proprioception(**{"joint_names": names, "joint_positions": zeros, "joint_velocities": zeros, **known})


def request_of(
    convention: Convention, images: Mapping[str, Any], state: Any, text: str, apart: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Return the request of a convention for a client that names pictures otherwise.

    A picture is found by its key, then by its key's last part, then as a wrist picture, then by the order.

    Args:
        convention: The convention.
        images: The client's pictures.
        state: The client's one state vector, or None.
        text: The instruction.
        apart: States that the client sends beside that vector, by the last part of their key; None where it does not.

    Raises:
        InvalidRequestError: When pictures are missing.
    """
    request: dict[str, Any] = {convention.prompt.key: text}
    named = {last_part(item.key): item.key for item in convention.states}
    separate = {named[key]: value for key, value in (apart or {}).items() if key in named and value is not None}
    request |= {key: np.ravel(np.asarray(value, dtype=float)) for key, value in separate.items()}
    left = dict(images)
    for image in convention.images:
        near = [image.key, last_part(image.key), image.camera]
        wrist = "wrist" in image.camera or "wrist" in image.key
        found = next((key for key in near if key in left), None)
        found = found or next((key for key in left if ("wrist" in key) == wrist), None)
        if found is None:
            raise InvalidRequestError(
                f"the request has no picture for camera '{image.camera}', only {', '.join(images) or 'none'}"
            )
        request[image.key] = left.pop(found)
    if convention.states and state is not None:
        values, start = np.ravel(np.asarray(state, dtype=float)), 0
        for item in (item for item in convention.states if item.key not in separate):
            end = start + item.size(convention.action.joints)
            request[item.key] = values[start:end]
            start = end
    return request
