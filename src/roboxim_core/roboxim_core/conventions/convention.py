"""The value `Convention`, its loading, and the conversions that it defines.

A convention defines the requests to one family of policies and the meaning of their answers. The same file defines how
training data for such a policy is written, so that training and evaluation agree.

| part | from what to what |
| --- | --- |
| `observe` | observation window -> request: plain dict of pictures, state vectors and the prompt |
| `decode_actions` | the policy's numbers -> actions of the meaning `Convention.semantics`, with no state of the arm |
| `to_actions` | the policy's numbers -> actions of the meaning `Convention.run_semantics` |
| `from_actions` | RoboXim's actions -> the policy's numbers (exports, known-answer servers, round trips) |

Non-obvious: in a chunk of deltas to the *measured* state, action k is added to the state measured at tick k, which is
not known when the chunk arrives. A policy therefore declares `Convention.semantics` and returns decoded actions; the
episode loop converts each one at its own tick. `to_actions` and `from_actions` take the state before every action
for the same reason.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from roboxim_core import actions, limits
from roboxim_core.actions import ActionContext, ActionSemantics, ActionTransform
from roboxim_core.actions.gripper import GripperSwitch
from roboxim_core.actions.lag import MotionLag
from roboxim_core.actions.transforms import convert_rows
from roboxim_core.config import from_plain, load_yaml, named_config
from roboxim_core.conventions.frames import Frames
from roboxim_core.conventions.images import ImageInput
from roboxim_core.conventions.outputs import ActionOutput
from roboxim_core.conventions.proof import Proof
from roboxim_core.conventions.states import ArmReadings, StateInput
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, one_of
from roboxim_core.policies import MAX_HORIZON, CameraRequirement, Observation, ObservationWindow
from roboxim_core.rotation.representations import Floats
from roboxim_core.specs import Scalar

Request = dict[str, Any]
"""Key to uint8 or float array, string, or scalar."""


@dataclass(frozen=True, kw_only=True)
class Chunking(actions.Chunking):
    """How many actions an answer has, and how they are executed; a run may override both."""

    horizon: int = 1
    """Largest number of actions of an answer that are used; a server may answer more."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InvalidRequestError: As `roboxim_core.actions.Chunking`, or when more actions are executed than an answer
            has.
        """
        super().__post_init__()
        limits.require_range("horizon", self.horizon, 1, MAX_HORIZON)
        limits.require_range("execute", self.execute, 0, self.horizon)

    @property
    def execution(self) -> actions.Chunking:
        """How the episode loop executes the answers, without the horizon."""
        return actions.Chunking(
            execute=self.execute, ensemble=self.ensemble, ensemble_decay=self.ensemble_decay, late_rows=self.late_rows
        )


@dataclass(frozen=True, kw_only=True)
class PromptInput:
    """The instruction in the request."""

    key: str = "prompt"
    """Key in the request."""
    lower: bool = False
    """Whether it is written in lower case."""
    template: str = "{instruction}"
    """Text around it."""

    def __post_init__(self) -> None:
        """Check the template.

        Raises:
            InvalidRequestError: When the template lacks ``{instruction}``.
        """
        if "{instruction}" not in self.template:
            raise InvalidRequestError(f"prompt: template must contain {{instruction}}, got {self.template!r}")

    def text(self, instruction: str) -> str:
        """Return the prompt of an instruction."""
        return self.template.replace("{instruction}", instruction.lower() if self.lower else instruction)


@dataclass(frozen=True, kw_only=True)
class Convention:
    """Requests to a family of policies, and the meaning of its answers: a YAML file of ``config/conventions``."""

    name: str = ""
    """Name; by default the file's name without suffix."""
    description: str = ""
    """What the convention is for, one sentence."""
    sources: tuple[str, ...] = ()
    """Where its numbers come from."""
    notes: tuple[str, ...] = ()
    """What a user should know: traps, and differences that no conversion removes."""
    rate_hz: float
    """Control rate of the policy [Hz]; 0: any."""
    window: int = 1
    """Observations in a request. From 2 on, pictures and states have one more axis in front, newest last."""
    pad_mask_key: str = ""
    """Key of the mask of a window, bool, True for real observations and False for padding; empty: none is sent."""
    images: tuple[ImageInput, ...] = ()
    """Pictures."""
    states: tuple[StateInput, ...] = ()
    """State vectors."""
    prompt: PromptInput = PromptInput()
    """The instruction."""
    extras: dict[str, Scalar] = field(default_factory=dict)
    """Constants that are sent with every request, e.g. ``unnorm_key``."""
    frames: Frames = Frames()
    """Frames of states and actions."""
    action: ActionOutput = ActionOutput()
    """The answer."""
    chunking: Chunking = Chunking()
    """Length and execution of an answer."""
    proof: Proof | None = None
    """Comparison with a genuine client; none: not compared."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            InvalidRequestError: On a rate or window out of range, or a key that occurs twice.
        """
        limits.require_range("rate_hz", self.rate_hz, 0.0, 1_000.0)
        limits.require_range("window", self.window, 1, limits.WINDOW)
        keys = [image.key for image in self.images] + [state.key for state in self.states]
        keys += [self.prompt.key, *self.extras, *([self.pad_mask_key] if self.pad_mask_key else [])]
        for key in keys:
            if not key or keys.count(key) > 1:
                raise InvalidRequestError(f"key {limits.echo(key)} of the request is empty or occurs twice")

    def __hash__(self) -> int:
        """Return the hash; equal values have equal hashes."""
        return hash((self.name, self.rate_hz, self.images, self.states, self.frames, self.chunking))

    @property
    def semantics(self) -> ActionSemantics:
        """Meaning of decoded actions. A policy that speaks this convention declares it."""
        return self.action.semantics(self.rate_hz)

    @property
    def run_semantics(self) -> ActionSemantics:
        """Meaning that `to_actions` converts to.

        It is what the simulator executes, see `ActionSemantics.executed`.
        """
        return self.semantics.executed(self.rate_hz)

    @property
    def cameras(self) -> tuple[CameraRequirement, ...]:
        """The cameras that a policy of this convention requires, each once, with the size to render."""
        found = {
            image.camera: CameraRequirement(name=image.camera, width=image.render_width, height=image.render_height)
            for image in reversed(self.images)
        }
        return tuple(reversed(found.values()))


def load_convention(name: str) -> Convention:
    """Load a convention by its name in ``config/conventions``, or from the path of a YAML file.

    Statistics and responses that the file names are read, so the result depends on no other file.

    Raises:
        ConfigError: When there is no such convention (the message suggests names), or its file is invalid.
    """
    path = named_config("conventions", name)
    data = load_yaml(path)
    convention = from_plain({} if data is None else data, Convention, source=str(path))
    action = convention.action
    try:
        if action.normalisation:
            action = replace(action, normalisation=action.normalisation.resolved(path.parent))
        if action.response:
            action = replace(action, response=action.response.resolved())
    except InvalidRequestError as error:
        raise ConfigError(f"{path} is not valid: action: {error}") from None
    convention = replace(convention, action=action)
    return convention if convention.name else replace(convention, name=path.stem)


def observe(
    convention: Convention, window: ObservationWindow | Sequence[Observation], instruction: str = ""
) -> Request:
    """Return the request for an observation window: what a wire sends, whatever the wire.

    Args:
        convention: The convention.
        window: The window, or its observations, newest last. A longer one is cut; a shorter one is padded by repeating
            the first observation.
        instruction: The instruction, if a sequence is given.

    Returns:
        Key to value, flat: pictures (uint8), states (float32 or float64, shape (size,)), the prompt, the mask, and the
        constants. With ``window`` from 2 on, pictures and states have the shape (window, ...).

    Raises:
        InvalidRequestError: When an observation lacks a camera (with code ``OBSERVATION_MISSING``) or joints.
    """
    if isinstance(window, ObservationWindow):
        seen, real, instruction = list(window.observations), list(window.pad_mask), window.instruction
    else:
        seen, real = list(window), [True] * len(window)
    missing = max(convention.window - len(seen), 0)
    seen = [seen[0]] * missing + seen[-convention.window :]
    real = [False] * missing + real[-convention.window :]
    request: Request = {image.key: _stacked(convention, image, seen) for image in convention.images}
    readings = ArmReadings.of([observation.proprio for observation in seen]) if convention.states else None
    for state in convention.states:
        assert readings is not None
        rows = state.rows(readings, convention.frames)
        request[state.key] = rows if convention.window > 1 else rows[0]
    request[convention.prompt.key] = convention.prompt.text(instruction)
    if convention.pad_mask_key:
        request[convention.pad_mask_key] = np.array(real, dtype=bool)
    return request | convention.extras


def _stacked(convention: Convention, image: ImageInput, seen: Sequence[Observation]) -> npt.NDArray[np.uint8]:
    pictures: list[npt.NDArray[np.uint8]] = []
    for index, observation in enumerate(seen):
        if index and observation is seen[index - 1]:  # padding
            pictures.append(pictures[-1])
            continue
        if image.camera not in observation.images:
            names = one_of(observation.images, image.camera)
            raise InvalidRequestError(
                f"convention '{convention.name}' needs camera '{image.camera}'; {names}",
                ErrorCode.OBSERVATION_MISSING,
            )
        pictures.append(image.prepare(observation.images[image.camera]))
    return np.stack(pictures) if convention.window > 1 else pictures[-1]


def joined_answer(convention: Convention, answer: Mapping[str, npt.ArrayLike]) -> Floats:
    """Return the policy's numbers from an answer with one or several keys.

    Args:
        convention: The convention.
        answer: Key to array of shape (n, d) or (d,), without a batch axis; a key of one number per action may have the
            shape (n,).

    Returns:
        float64, shape (n, `ActionOutput.raw_size`).

    Raises:
        InvalidRequestError: With code ``INVALID_ACTION`` when a key is missing or lengths differ.
    """
    parts = []
    for key in convention.action.keys:
        if key not in answer:
            raise InvalidRequestError(
                f"the answer has no '{key}'; {one_of([str(k) for k in answer], key)}", ErrorCode.INVALID_ACTION
            )
        part = np.asarray(answer[key], dtype=float)
        several = len(convention.action.keys) > 1
        parts.append(part.reshape(-1, 1) if several and part.ndim <= 1 else np.atleast_2d(part))
    if len({len(part) for part in parts}) > 1:
        raise InvalidRequestError(
            f"the parts of the answer have different lengths: {[part.shape for part in parts]}",
            ErrorCode.INVALID_ACTION,
        )
    return np.concatenate(parts, axis=1)


def decode_actions(convention: Convention, raw: npt.ArrayLike) -> Floats:
    """Return actions of the meaning `Convention.semantics`; a policy that declares it returns these.

    Args:
        convention: The convention.
        raw: The policy's numbers, shape (n, D) or (D,).

    Returns:
        float64, shape (n, D'). The last component is the opening that the gripper's number demands, 1 = open; the
        episode loop applies `GripperOutput.rule` to the actions that it executes.

    Raises:
        InvalidRequestError: With code ``INVALID_ACTION`` on a wrong shape, or numbers without meaning.
    """
    return convention.action.decode(raw, convention.frames)


def to_actions(
    convention: Convention,
    raw: npt.ArrayLike,
    track: Sequence[ActionContext] | ActionContext,
    gripper: GripperSwitch | None = None,
    lag: MotionLag | None = None,
) -> Floats:
    """Return actions of the meaning `Convention.run_semantics`, as the simulator executes them.

    Args:
        convention: The convention.
        raw: The policy's numbers, shape (n, D) or (D,).
        track: State of the arm before each action; or before the first one alone, if each next state is the commanded
            one (deltas to the measured state are then refused from the second action on).
        gripper: State of the gripper's rule in the running episode; None: the rule begins with these actions and an
            open gripper.
        lag: State of the lag in the running episode; None: the motions do not lag.

    Returns:
        float64, shape (n, 7), or (n, joints + 1) in joint space.

    Raises:
        InvalidRequestError: As `decode_actions`, or when the track lacks a field.
    """
    rows = decode_actions(convention, raw)
    switch = gripper or GripperSwitch(convention.action.gripper.rule)
    rows[:, -1] = [switch.step(float(opening)) for opening in rows[:, -1]]
    if lag:
        rows = np.stack([lag.step(row) for row in rows])
    return _converted(rows, track, convention.semantics, convention.run_semantics)


def from_actions(
    convention: Convention,
    actions: npt.ArrayLike,
    track: Sequence[ActionContext] | ActionContext,
    *,
    source: ActionSemantics | None = None,
) -> Floats:
    """Return the policy's numbers that mean given actions, e.g. of a whole episode; the inverse of `to_actions`.

    A number outside of its range is returned unchanged: it shows that the convention cannot express the action. A lag
    is
    not inverted: the numbers are those of a steady motion.

    Args:
        convention: The convention.
        actions: Shape (n, D) or (D,).
        track: As for `to_actions`. Between end effector and joint space it must contain the kinematics, or the joints
            after each action.
        source: Meaning of the actions; None: `Convention.run_semantics`. Its rate must be the convention's.

    Returns:
        float64, shape (n, `ActionOutput.raw_size`).

    Raises:
        InvalidRequestError: When the track lacks a field, or a pose cannot be reached.
        EvaluationError: With code ``SEMANTICS_MISMATCH`` when the rates differ.
    """
    rows = np.atleast_2d(np.asarray(actions, dtype=float))
    rows = _converted(rows, track, source or convention.run_semantics, convention.semantics)
    return convention.action.encode(rows, convention.frames)


def _converted(
    rows: Floats, track: Sequence[ActionContext] | ActionContext, source: ActionSemantics, target: ActionSemantics
) -> Floats:
    if not source.differing(target):
        return rows
    if isinstance(track, ActionContext):
        return ActionTransform.between(source, target).apply_chunk(rows, track)
    return convert_rows(rows, source, target, track)
