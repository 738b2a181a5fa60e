"""A convention in words: the request, the effect of an action, and notes for users.

The examples of actions are not written here: they are decoded by the convention itself.
"""

from __future__ import annotations

import math

import numpy as np

from roboxim_core.actions import ControlMode, DeltaBase, Ensemble, ReferenceFrame
from roboxim_core.conventions.convention import Convention, decode_actions
from roboxim_core.conventions.images import ImageInput, Layout, Resize
from roboxim_core.conventions.normalisation import NormalisationKind
from roboxim_core.conventions.outputs import SCALABLE, ActionOutput
from roboxim_core.conventions.states import StateField, StateInput, StatePart
from roboxim_core.errors import counted
from roboxim_core.rotation.representations import Floats, RotationRepresentation, decode, encode, gripper_down

_RESIZED = {
    Resize.PAD: "scaled to {size} with black bars where the shape differs",
    Resize.CROP: "cut to the shape of {size} in the middle and scaled",
    Resize.LANCZOS3: "stretched to {size} (lanczos3)",
    Resize.AREA: "stretched to {size} (mean of areas)",
    Resize.BILINEAR: "stretched to {size} (bilinear)",
    Resize.NONE: "of {size}; another size is refused",
}
_ROTATIONS = {
    RotationRepresentation.EULER_XYZ_EXTRINSIC: "roll, pitch, yaw about the fixed axes",
    RotationRepresentation.EULER_XYZ_INTRINSIC: "angles about x, then the turned y, then the turned z",
    RotationRepresentation.ROTATION_VECTOR: "rotation vector (axis times angle)",
    RotationRepresentation.ROTATION_6D: "first two columns of the rotation matrix",
    RotationRepresentation.ROTATION_6D_INTERLEAVED: "first two columns of the rotation matrix, read row by row",
    RotationRepresentation.ROTATION_6D_ROWS: "first two rows of the rotation matrix",
    RotationRepresentation.QUATERNION_XYZW: "quaternion x, y, z, w",
    RotationRepresentation.QUATERNION_WXYZ: "quaternion w, x, y, z",
    RotationRepresentation.NONE: "none",
}
_CONTROLS = {
    ControlMode.END_EFFECTOR_DELTA: "A motion of the tool centre point",
    ControlMode.END_EFFECTOR_ABSOLUTE: "A pose of the tool centre point in the robot's base",
    ControlMode.JOINT_POSITION: "Positions of the arm joints",
    ControlMode.JOINT_VELOCITY: "Velocities of the arm joints",
    ControlMode.JOINT_DELTA: "A motion of the arm joints",
}
_NORMALISED = {
    NormalisationKind.QUANTILES: "-1 and 1 are the dataset's 1 % and 99 % quantiles",
    NormalisationKind.BOUNDS: "-1 and 1 are the dataset's minimum and maximum",
    NormalisationKind.MEAN_STD: "0 is the dataset's mean, 1 one standard deviation above it",
}


def described(convention: Convention) -> str:
    """Return a description of a convention in plain text, of several paragraphs."""
    parts = [f"{convention.name}: {convention.description}".rstrip(": "), _timing(convention)]
    parts += [_titled("What the policy is sent", [*_pictures(convention), *_states(convention), *_texts(convention)])]
    parts += [_titled("What its answer means", [*_meaning(convention), *_gripper(convention)])]
    parts += [_titled("One action", examples(convention))]
    if convention.notes:
        parts.append(_titled("Note", [f"- {note}" for note in convention.notes]))
    if convention.proof:
        proof = convention.proof
        parts.append(_titled("Compared with a genuine client", [f"- {proof.client}, on {proof.date}"]))
    if convention.sources:
        parts.append(_titled("Sources", [f"- {source}" for source in convention.sources]))
    return "\n\n".join(parts)


def examples(convention: Convention) -> list[str]:
    """Return lines ``[numbers]  effect``, one for each component of motion, for opening and for closing."""
    action = convention.action
    names = convention.semantics.component_names([f"joint {index + 1}" for index in range(action.joints)])
    rows = []
    for index in range(len(names) - 1):
        raw = _quiet(convention)
        raw[_place(convention, index)] = _example_number(convention, index)
        rows.append((raw, _effect(convention, decode_actions(convention, raw)[0], index, names[index])))
    for number, effect in ((action.gripper.open, "opens the gripper"), (action.gripper.closed, "closes the gripper")):
        raw = _quiet(convention)
        raw[_place(convention, len(names) - 1)] = number
        rows.append((raw, effect))
    shown = ["[" + ", ".join(f"{number:.4g}" for number in raw) + "]" for raw, _ in rows]
    width = max(map(len, shown))
    return [f"{numbers:<{width}}  {effect}" for numbers, (_, effect) in zip(shown, rows, strict=True)]


def _timing(convention: Convention) -> str:
    rate = f"{convention.rate_hz:g} Hz" if convention.rate_hz else "any rate"
    chunking = convention.chunking
    many = f"answers with up to {chunking.horizon} actions" if chunking.horizon > 1 else "answers with one action"
    text = f"The policy acts at {rate} and {many}"
    used = chunking.rows_per_request(chunking.horizon)
    if chunking.ensemble == Ensemble.NEWEST:
        return text + (
            "." if used == chunking.horizon else f", of which {used} {'is' if used == 1 else 'are'} executed."
        )
    when = "at every tick" if used == 1 else f"every {used} ticks"
    weights = ""
    if chunking.ensemble == Ensemble.EXPONENTIAL:
        weights = f", with weights exp(-{chunking.ensemble_decay:g} i), i = 0 for the oldest,"
    return f"{text}. It is asked {when}, and the mean of the predictions for a tick{weights} is executed."


def _pictures(convention: Convention) -> list[str]:
    return [f"{image.key}: {_picture(image)}{_windowed(convention)}" for image in convention.images]


def _picture(image: ImageInput) -> str:
    steps = [f"camera {image.camera}"]
    if image.render_width and image.render_height:
        steps.append(f"rendered at {image.render_width} x {image.render_height} px")
    if image.mirror:
        steps.append("left and right exchanged")
    if image.upside_down:
        steps.append("top and bottom exchanged")
    if image.jpeg_quality:
        steps.append(f"through JPEG of quality {image.jpeg_quality}")
    steps.append(_RESIZED[image.resize].format(size=f"{image.width} x {image.height} px"))
    if image.crop_area < 1.0:
        steps.append(f"the middle {100 * image.crop_area:g} % of its area, scaled up again")
    channels = "channels first" if image.layout == Layout.CHW else "channels last"
    return ", ".join(steps) + f"; RGB, uint8, {channels}{'' if image.upside_down else ', upright'}"


def _windowed(convention: Convention) -> str:
    return f"; the last {convention.window} of them, oldest first" if convention.window > 1 else ""


def _states(convention: Convention) -> list[str]:
    return [f"{state.key}: {_state(convention, state)}{_windowed(convention)}" for state in convention.states]


def _state(convention: Convention, state: StateInput) -> str:
    count = state.size(convention.action.joints)
    numbers = counted(count, "number")
    return f"{numbers} ({state.dtype}): " + "; ".join(_state_part(convention, part) for part in state.parts)


def _state_part(convention: Convention, part: StatePart) -> str:
    match part.field:
        case StateField.TCP_POSITION:
            x, y, z = convention.frames.base_origin_m
            origin = f", where the robot's base is at ({x:g}, {y:g}, {z:g})" if any((x, y, z)) else " in the base"
            text = f"position of the tool centre point [{_unit('m', part)}]{origin}"
        case StateField.TCP_ROTATION:
            text = f"rotation of the tool: {_ROTATIONS[part.rotation]}"
        case StateField.JOINT_POSITIONS:
            text = f"arm joint positions [{_unit('rad', part)}]"
        case StateField.JOINT_VELOCITIES:
            text = f"arm joint velocities [{_unit('rad/s', part)}]"
        case StateField.GRIPPER:
            text = f"gripper: {_listed(part.open)} open, {_listed(part.closed)} closed"
        case StateField.CONSTANT:
            text = f"always {_listed(part.values)}"
    return text + (f", component {_listed(part.components)}" if part.components else "")


def _texts(convention: Convention) -> list[str]:
    prompt = convention.prompt
    case = " in lower case" if prompt.lower else ""
    around = "" if prompt.template == "{instruction}" else f", as {prompt.template!r}"
    lines = [f"{prompt.key}: the instruction{case}{around}"]
    if convention.pad_mask_key:
        lines.append(f"{convention.pad_mask_key}: for each observation, whether it is real (True) or padding (False)")
    return lines + [f"{key}: always {value!r}" for key, value in convention.extras.items()]


def _meaning(convention: Convention) -> list[str]:
    action, frames = convention.action, convention.frames
    several = (
        f" under the keys {', '.join(action.keys)}" if len(action.keys) > 1 else f" under the key {action.keys[0]}"
    )
    lines = [f"{action.raw_size} numbers{several}. {_CONTROLS[action.control]}{_base(convention)}."]
    if action.normalisation:
        lines.append(f"The numbers are normalised: {_NORMALISED[action.normalisation.kind]}.")
    if not action.control.is_joint_space:
        lines.append(f"Rotation: {_ROTATIONS[action.rotation]}.")
    if not frames.is_plain:
        axes = ", ".join(
            f"{axis} is RoboXim's {own_axis}" for axis, own_axis in zip("xyz", frames.base_axes, strict=True)
        )
        lines.append(f"Axes: {axes}.")
    named = (("translations", "translation_range"), ("rotations", "rotation_range"), ("joints", "joint_range"))
    for what, name in named:
        if bounds := getattr(action, name):
            lines.append(f"Numbers of {what} are clipped to {bounds[0]:g} .. {bounds[1]:g}.")
    if action.control.is_joint_space:
        return [*lines, "The limits of the robot's joints apply; what exceeds them is clipped and counted."]
    if action.response:
        lines += _response(action)
    limits = f"{1e3 * action.max_translation_m:.4g} mm and {action.max_rotation_rad:.4g} rad"
    return [*lines, f"At most {limits} per tick are executed; more is clipped and counted."]


def _response(action: ActionOutput) -> list[str]:
    """Return the effect of a controller's response, with the numbers of the x axis."""
    assert action.response is not None
    gain, lag = action.response.gain[0], action.response.lag[0]
    full = 1e3 * action.translation_scale_m
    lines = [
        f"A number of 1 commands {full:.4g} mm or {action.rotation_scale_rad:.4g} rad. The controller of the training "
        f"moves {gain:.0%} of that per tick in steady motion, and {gain * (1 - lag):.0%} in the first tick (along x). "
        "RoboXim's arm moves as it does."
    ]
    if action.response.description:
        lines.append(f"Controller: {action.response.description}")
    if action.response.error_mm:
        lines.append(
            f"Error of a tick against it: {action.response.error_mm:g} mm, {action.response.error_mrad:g} mrad (RMS)."
        )
    return lines


def _base(convention: Convention) -> str:
    action = convention.action
    if action.delta_base == DeltaBase.NONE:
        return ""
    along = ""
    if not action.control.is_joint_space:
        along = (
            " along the tool's axes" if action.frame == ReferenceFrame.TOOL else " along the axes of the robot's base"
        )
    kind = "joints" if action.control.is_joint_space else "pose"
    state = "measured" if action.delta_base == DeltaBase.MEASURED else "commanded"
    return f"{along}, added to the {state} {kind}"


def _gripper(convention: Convention) -> list[str]:
    gripper = convention.action.gripper
    text = f"Gripper, the last number: {gripper.open:g} open, {gripper.closed:g} closed"
    if not gripper.binary:
        return [f"{text}, every opening between."]
    if gripper.on_change:
        text += "; it moves when two consecutive numbers differ by more than half the range"
    else:
        text += f"; it opens or closes fully, decided at {gripper.middle:g}"
    if gripper.dead_zone:
        text += f", and stays within {gripper.dead_zone:g} of that"
    if gripper.agree > 1:
        text += f", after {gripper.agree} actions that agree"
    if gripper.hold > 1:
        text += f", and then stays for {gripper.hold} actions"
    return [f"{text}."]


def _place(convention: Convention, index: int) -> int:
    return convention.action.order[index] if convention.action.order else index


def _quiet(convention: Convention) -> Floats:
    """Return numbers of no motion, with the gripper's number in the middle."""
    action = convention.action
    raw = np.zeros(action.raw_size)
    if action.control == ControlMode.END_EFFECTOR_ABSOLUTE:  # numbers that are all 0 may be no rotation
        down = encode(gripper_down(), action.rotation, gripper_down())
        return np.asarray(action.encode([0.0, 0.0, 0.0, *down, 0.5], convention.frames)[0])
    if action.normalisation:
        raw = action.normalisation.apply(raw[None])[0]
    raw[_place(convention, action.natural_size - 1)] = action.gripper.middle
    return raw


def _example_number(convention: Convention, index: int) -> float:
    """Return an example number for a component: the end of its range, or one that gives a round effect."""
    action = convention.action
    if action.control.is_joint_space:
        bounds, number = action.joint_range, 0.1 / abs(action.joint_scale)
    elif index < 3:
        bounds, number = action.translation_range, 0.01 / abs(action.translation_scale_m)
    else:
        bounds, number = action.rotation_range, 0.1 / abs(action.rotation_scale_rad)
    if action.normalisation:
        return 1.0
    return bounds[1] if bounds else number


def _effect(convention: Convention, row: Floats, index: int, name: str) -> str:
    """Return the effect of a decoded action with one number, in words."""
    action = convention.action
    if action.control.is_joint_space:
        value = row[index]
        if action.control == ControlMode.JOINT_VELOCITY:
            return f"moves joint {index + 1} at {value:.4g} rad/s"
        verb = "turns" if action.control.is_relative else "puts"
        return f"{verb} joint {index + 1} {'by' if action.control.is_relative else 'at'} {value:.4g} rad"
    if action.control == ControlMode.END_EFFECTOR_ABSOLUTE:
        return f"sets {name} of the tool's pose"
    shift = row[:3]
    if index < 3:
        axis = int(np.argmax(np.abs(shift)))
        direction = _DIRECTIONS[axis][0 if shift[axis] > 0 else 1] if action.frame != ReferenceFrame.TOOL else ""
        where = f" ({direction})" if direction else ""
        return f"moves {1e3 * abs(shift[axis]):.4g} mm along {'-' if shift[axis] < 0 else '+'}{'xyz'[axis]}{where}"
    if action.rotation not in SCALABLE:
        return f"sets {name} of the rotation"
    vector = decode(row[3:-1], action.rotation).as_rotvec()
    axis = int(np.argmax(np.abs(vector)))
    sign = "-" if vector[axis] < 0 else "+"
    angle = abs(float(vector[axis]))
    return f"turns {angle:.4g} rad ({math.degrees(angle):.3g} degrees) about {sign}{'xyz'[axis]}"


_DIRECTIONS = (("forwards", "backwards"), ("to the left", "to the right"), ("up", "down"))


def _unit(unit: str, part: StatePart) -> str:
    return unit if part.scale == 1.0 else f"{unit} x {part.scale:g}"


def _listed(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:g}" for value in values)


def _titled(title: str, lines: list[str]) -> str:
    return "\n".join([title, *(f"  {line}" for line in lines)])
