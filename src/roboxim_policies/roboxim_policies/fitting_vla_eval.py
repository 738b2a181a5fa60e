"""What a model server of vla-eval declares, compared with a convention.

vla-eval's own orchestrator only warns of specifications that differ, and drops parameters that a benchmark's
constructor does not name. RoboXim refuses: numbers of another meaning would move the arm all the same. A declaration
that RoboXim does not know is refused by its name as well, since it may change what the numbers mean; the wire's option
``ignore`` names those that do not matter.

Source: PyPI vla-eval 0.8.0, specs.py (formats), model_servers/serve.py (keys of the greeting), model_servers/*.py and
benchmarks/*.py (``observation_params``, the arguments that a server sets of the benchmark's constructor).
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from roboxim_core.actions import ControlMode
from roboxim_core.conventions import Convention
from roboxim_core.conventions.states import StateField, StatePart
from roboxim_core.limits import echo
from roboxim_core.rotation.representations import RotationRepresentation
from roboxim_policies.wires import Metadata

GREETING = (
    "harness_version", "protocol_version", "model_server", "capabilities", "observation_params", "action_spec",
    "observation_spec",
)  # fmt: skip
"""Keys of a server's greeting."""
OF_THE_RUN = (
    "seed", "env_seed", "num_steps_wait", "max_steps", "max_episode_steps", "ep_len", "success_mode",
    "deterministic_episodes",
)  # fmt: skip
"""Parameters that say how the training benchmark runs its episodes, not what numbers mean. RoboXim's tasks say it."""
DEFAULT_FORMAT = "raw"
"""The format of what a server does not declare."""

_QUATERNIONS = (RotationRepresentation.QUATERNION_XYZW, RotationRepresentation.QUATERNION_WXYZ)
_EULER = (RotationRepresentation.EULER_XYZ_EXTRINSIC, RotationRepresentation.EULER_XYZ_INTRINSIC)
ROTATION_FORMATS = {
    "axis_angle": (RotationRepresentation.ROTATION_VECTOR,),
    "euler_xyz": _EULER,
    "rotation_6d": (RotationRepresentation.ROTATION_6D,),
    "rot6d": (RotationRepresentation.ROTATION_6D,),
    "rot6d_contiguous": (RotationRepresentation.ROTATION_6D,),
    "rot6d_interleaved": (RotationRepresentation.ROTATION_6D_INTERLEAVED,),
    "quaternion": _QUATERNIONS,
    "quaternion_xyzw": (RotationRepresentation.QUATERNION_XYZW,),
}
"""Formats of an action's rotation."""
CONTROL_FORMATS = {
    "delta_xyz": (ControlMode.END_EFFECTOR_DELTA,),
    "absolute_xyz": (ControlMode.END_EFFECTOR_ABSOLUTE,),
    "joint_positions": (ControlMode.JOINT_POSITION,),
    "joint_pos_abs": (ControlMode.JOINT_POSITION,),
    "joint_position": (ControlMode.JOINT_POSITION,),
    "joint_delta_pos": (ControlMode.JOINT_DELTA,),
    "joint_delta": (ControlMode.JOINT_DELTA,),
    "joint_velocity": (ControlMode.JOINT_VELOCITY, ControlMode.JOINT_DELTA),
}
"""Formats of an action's position or joints, with the controls that they mean."""
GRIPPER_FORMATS = ("binary_close_positive", "binary_close_negative", "binary_close_01", "continuous_01")
STATE_FORMATS = {
    "eef_pos3_axisangle3_gripper2": ((RotationRepresentation.ROTATION_VECTOR,), 2),
    "eef_pos3_euler3_gripper2": (_EULER, 2),
    "eef_pos3_quat4_gripper1": (_QUATERNIONS, 1),
    "base_frame_eef_pos3_quat4_gripper2": (_QUATERNIONS, 2),
    # X-VLA's proprioception of 20 numbers, which its server makes itself of a position and a rotation vector
    "rot6d_interleaved_proprio_20d": ((RotationRepresentation.ROTATION_VECTOR,), 2),
}
"""Formats of a state: representations of its rotation, and count of its gripper's numbers."""
PICTURE, LANGUAGE, JOINTS = "rgb_hwc_uint8", "language", "joint_positions"
ARM_MODES = {
    "arm_pd_ee_delta_pose": ControlMode.END_EFFECTOR_DELTA,
    "arm_pd_ee_target_delta_pose": ControlMode.END_EFFECTOR_DELTA,
    "arm_pd_ee_base_pose": ControlMode.END_EFFECTOR_ABSOLUTE,
    "arm_pd_ee_target_base_pose": ControlMode.END_EFFECTOR_ABSOLUTE,
    "arm_pd_joint_delta_pos": ControlMode.JOINT_DELTA,
    "arm_pd_joint_pos": ControlMode.JOINT_POSITION,
}
"""Beginning of a ManiSkill ``control_mode`` to the control that it means."""


def declared_misfits(metadata: Metadata, convention: Convention, ignore: Collection[str] = ()) -> list[str]:
    """Return in words what a server declares otherwise than a convention says, or what RoboXim does not understand.

    Args:
        metadata: The server's greeting.
        convention: The convention.
        ignore: Names of declarations that are not compared.
    """
    found = [_unknown(key, metadata[key]) for key in metadata if key not in (*GREETING, *ignore)]
    parts = {name: metadata.get(name) for name in ("capabilities", "observation_params", "action_spec")}
    parts["observation_spec"] = metadata.get("observation_spec")
    for name, part in parts.items():
        if part is not None and not isinstance(part, dict):
            found.append(f"its '{name}' is no map: {echo(part)}")
    maps = {name: part if isinstance(part, dict) else {} for name, part in parts.items()}
    found += [_unknown(f"capabilities: {key}", value) for key, value in maps["capabilities"].items()
              if key not in ignore]  # fmt: skip
    params = {key: value for key, value in maps["observation_params"].items() if key not in ignore}
    found += param_misfits(params, convention)
    specs = {key: value for key, value in maps["action_spec"].items() if key not in ignore}
    found += _action_misfits(specs, convention, is_absolute=params.get("absolute_action") is True)
    specs = {key: value for key, value in maps["observation_spec"].items() if key not in ignore}
    return found + _observation_misfits(specs, convention)


def param_misfits(params: Mapping[str, Any], convention: Convention) -> list[str]:
    """Return in words what a server's ``observation_params`` demand otherwise than a convention says."""
    found = []
    for key, value in params.items():
        if key in OF_THE_RUN or value is None:
            continue
        match key:
            case "send_state":
                if value is True and not convention.states:
                    found.append("it needs a state, the convention sends none")
            case "send_wrist_image":
                if value is True and not any("wrist" in image.key for image in convention.images):
                    found.append("it needs a wrist picture, the convention sends none")
            case "absolute_action":
                found += _absolute(value, convention)
            case "quat_no_antipodal":
                if value is False and any(_is_vector(part) for state in convention.states for part in state.parts):
                    found.append(
                        "it takes rotation vectors shorter than pi (quat_no_antipodal: false), the convention's state "
                        "follows robosuite's quaternion and may be longer"
                    )
            case "control_mode":
                found += _arm_mode(str(value), convention)
            case _:
                found.append(_unknown(f"observation_params: {key}", value))
    return found


def _unknown(name: str, value: Any) -> str:
    return (
        f"it declares {echo(name)} = {echo(value)}, which RoboXim does not understand; if it does not change what "
        f"numbers mean, name it with --option ignore={name.rpartition(': ')[2]}"
    )


def _absolute(value: Any, convention: Convention) -> list[str]:
    control = convention.action.control
    if bool(value) == (control == ControlMode.END_EFFECTOR_ABSOLUTE):
        return []
    kind = "absolute poses" if value else "no absolute poses"
    return [f"its actions are {kind} (absolute_action: {echo(value)}), the convention's '{control}'"]


def _arm_mode(mode: str, convention: Convention) -> list[str]:
    """Compare a control mode of ManiSkill by its arm's part, e.g. ``arm_pd_ee_base_pose_..._gripper_...``."""
    arm = mode.partition("_gripper")[0]
    known = [name for name in ARM_MODES if arm == name or arm.startswith(f"{name}_align")]
    if not known:
        return [_unknown("observation_params: control_mode", mode)]
    control = ARM_MODES[known[0]]
    if control == convention.action.control:
        return []
    return [f"its actions are '{control}' (control_mode: {echo(mode)}), the convention's '{convention.action.control}'"]


def _action_misfits(specs: Mapping[str, Any], convention: Convention, *, is_absolute: bool) -> list[str]:
    found = []
    parts = [part for part in specs.values() if isinstance(part, dict)]
    sizes = [part.get("dims") for part in parts]
    # StarVLA's server declares its gripper alone
    if set(specs) != {"gripper"} and parts and all(isinstance(size, int) and size > 0 for size in sizes):
        total = sum(size for size in sizes if isinstance(size, int))
        if total != convention.action.raw_size:
            found.append(f"its actions have {total} numbers, the convention's {convention.action.raw_size}")
    for name, part in specs.items():
        word = part.get("format", DEFAULT_FORMAT) if isinstance(part, dict) else None
        if not isinstance(word, str):
            found.append(f"its action_spec '{echo(name)}' has no format: {echo(part)}")
        elif word == "delta_xyz" and is_absolute:
            continue  # X-VLA declares both; its benchmark goes by absolute_action, which is compared
        elif word != DEFAULT_FORMAT:
            found += _format(f"action_spec: {name}", word, convention)
    return found


def _format(name: str, word: str, convention: Convention) -> list[str]:
    """Compare the format of a part of the action."""
    action = convention.action
    if word in ROTATION_FORMATS:
        fits = action.rotation in ROTATION_FORMATS[word]
        return [] if fits else [f"its rotations are '{word}', the convention's '{action.rotation}'"]
    if word in CONTROL_FORMATS:
        fits = action.control in CONTROL_FORMATS[word]
        return [] if fits else [f"its actions are '{word}', the convention's '{action.control}'"]
    if word in GRIPPER_FORMATS:
        return _gripper(word, convention)
    if word in {str(kind) for kind in RotationRepresentation}:  # as RoboXim calls it
        return [] if word == action.rotation else [f"its rotations are '{word}', the convention's '{action.rotation}'"]
    return [_unknown(name, word)]


def _gripper(word: str, convention: Convention) -> list[str]:
    gripper = convention.action.gripper
    closes_high, from_0_to_1 = gripper.closed > gripper.open, {gripper.open, gripper.closed} == {0.0, 1.0}
    fits = {
        "binary_close_positive": closes_high,
        "binary_close_negative": not closes_high,
        "binary_close_01": closes_high and from_0_to_1,
        "continuous_01": from_0_to_1,
    }[word]
    if fits:
        return []
    return [f"its gripper is '{word}', in the convention {gripper.open:g} opens and {gripper.closed:g} closes"]


def _observation_misfits(specs: Mapping[str, Any], convention: Convention) -> list[str]:
    found, pictures = [], []
    for name, part in specs.items():
        word = part.get("format", DEFAULT_FORMAT) if isinstance(part, dict) else None
        if word == PICTURE:
            pictures.append(str(name))
        elif word in STATE_FORMATS or word == JOINTS:
            found += _state(str(word), convention)
        elif word not in (DEFAULT_FORMAT, LANGUAGE):
            found.append(_unknown(f"observation_spec: {name}", part if word is None else word))
    if len(pictures) > len(convention.images):
        image_keys = ", ".join(image.key for image in convention.images) or "none"
        found.append(f"it needs the pictures {', '.join(pictures)}, the convention sends {image_keys}")
    return found


def _state(word: str, convention: Convention) -> list[str]:
    """Compare the format of the state, which a server may take from any of the states that are sent."""
    if not convention.states:
        return [f"it needs a state '{word}', the convention sends none"]
    if any(_has_format(state.parts, word) for state in convention.states):
        return []
    if _has_format(tuple(part for state in convention.states for part in state.parts), word):
        return []
    return [f"its state is '{word}', the convention's is another (roboxim policy describe {convention.name})"]


def _has_format(parts: tuple[StatePart, ...], word: str) -> bool:
    fields = [part.field for part in parts]
    if word == JOINTS:
        return StateField.JOINT_POSITIONS in fields
    if fields != [StateField.TCP_POSITION, StateField.TCP_ROTATION, StateField.GRIPPER]:
        return False
    rotations, fingers = STATE_FORMATS[word]
    return parts[1].rotation in rotations and len(parts[2].open) == fingers


def _is_vector(part: StatePart) -> bool:
    return part.field == StateField.TCP_ROTATION and part.rotation == RotationRepresentation.ROTATION_VECTOR
