"""Whether a server's metadata fit a convention.

Each wire's metadata declare other things. What they do not declare, ``roboxim policy check`` judges by the answers.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Collection
from typing import Any

from roboxim_core.actions import ControlMode
from roboxim_core.config import to_json
from roboxim_core.conventions import Convention
from roboxim_core.plain_data.differences import differences
from roboxim_policies.fitting_vla_eval import declared_misfits
from roboxim_policies.wires import Metadata
from roboxim_policies.wires.openpi import OWN_SERVER
from roboxim_policies.wires.parts import last_part

ACTION_SPACES = {
    "joint_position": (ControlMode.JOINT_POSITION,),
    "joint_velocity": (ControlMode.JOINT_VELOCITY, ControlMode.JOINT_DELTA),
    "cartesian_position": (ControlMode.END_EFFECTOR_ABSOLUTE,),
    "cartesian_velocity": (ControlMode.END_EFFECTOR_DELTA,),
}
"""RoboArena's ``action_space``. DROID's velocities are motions per step, hence also joint deltas."""


def misfits(wire: str, metadata: Metadata, convention: Convention, ignore: Collection[str] = ()) -> list[str]:
    """Return in words what a server declares otherwise than a convention says; empty: it fits.

    Args:
        wire: Registered name of the wire; one without checks fits every convention.
        metadata: The server's metadata.
        convention: The convention.
        ignore: Names of declarations of vla-eval's servers that are not compared.
    """
    if OWN_SERVER in metadata:
        return _own(metadata[OWN_SERVER], convention)
    if wire == "vla_eval":
        return declared_misfits(metadata, convention, ignore)
    check = _CHECKS.get(wire)
    return check(metadata, convention) if check else []


def _openpi(metadata: Metadata, convention: Convention) -> list[str]:
    return _roboarena(metadata, convention) + _starvla(metadata, convention) + _stand_alone(metadata, convention)


def _own(declared: Any, convention: Convention) -> list[str]:
    served = declared.get("convention") if isinstance(declared, dict) else None
    if not isinstance(served, dict):
        return []
    words = ("name", "description", "sources", "notes", "chunking")  # a server may keep the chunk itself
    found = differences(json.loads(to_json(served)), json.loads(to_json(convention)), ignore=words)
    return [f"the server serves in its convention '{served.get('name')}' ({found}); use convention=server"] * bool(
        found
    )


def _roboarena(metadata: Metadata, convention: Convention) -> list[str]:
    found = []
    space = metadata.get("action_space")
    if space in ACTION_SPACES and convention.action.control not in ACTION_SPACES[space]:
        found.append(f"its actions are '{space}', the convention's are '{convention.action.control}'")
    wrist = [image for image in convention.images if "wrist" in image.key]
    others = len(convention.images) - len(wrist)
    if metadata.get("needs_wrist_camera") is True and not wrist:
        found.append("it needs a wrist camera, the convention sends none")
    wanted = metadata.get("n_external_cameras")
    if isinstance(wanted, int) and others < wanted:
        found.append(f"it needs {wanted} external cameras, the convention sends {others}")
    if metadata.get("needs_stereo_camera") is True and not any("right" in image.key for image in convention.images):
        found.append("it needs stereo cameras, the convention sends no right one")
    size = metadata.get("image_resolution")
    if isinstance(size, list) and len(size) == 2:
        found += [
            f"its pictures are {size[1]} x {size[0]} px, '{image.key}' is {image.width} x {image.height} px"
            for image in convention.images
            if [image.height, image.width] != size
        ]
    return found


def _starvla(metadata: Metadata, convention: Convention) -> list[str]:
    found = []
    chunk = metadata.get("action_chunk_size")
    if isinstance(chunk, int) and chunk < convention.chunking.execute:
        found.append(f"it answers {chunk} actions, the convention executes {convention.chunking.execute}")
    size = metadata.get("training_obs_image_size")
    if isinstance(size, list) and len(size) == 2:
        found += [
            f"it was trained with pictures of {size[0]} x {size[1]} px, '{image.key}' is {image.width} x "
            f"{image.height} px"
            for image in convention.images
            if sorted([image.height, image.width]) != sorted(size)
        ]
    if metadata.get("state_keys") and not convention.states:
        found.append("it needs a state, the convention sends none")
    return found


def _stand_alone(metadata: Metadata, convention: Convention) -> list[str]:
    """Check what RoboXim's stand-alone servers (of Octo, RT-1-X) declare."""
    inputs = metadata.get("inputs")
    if "model_server" not in metadata or not isinstance(inputs, dict):
        return []
    found = []
    for image in convention.images:
        size = inputs.get(image.key)
        if size is None:
            found.append(f"it takes the pictures {', '.join(sorted(inputs))}, the convention sends '{image.key}'")
        elif isinstance(size, list) and size[:2] != [image.height, image.width]:
            found.append(
                f"its '{image.key}' is {size[1]} x {size[0]} px, the convention's {image.width} x {image.height} px"
            )
    window = metadata.get("window")
    if isinstance(window, int) and convention.window > window:
        found.append(f"it takes {window} frames at most, the convention sends {convention.window}")
    datasets, key = metadata.get("unnorm_keys"), convention.extras.get("unnorm_key")
    if isinstance(datasets, list) and key is not None and key not in datasets:
        found.append(
            f"it has no statistics of '{key}' to un-normalise with, only those of {', '.join(map(str, datasets))}"
        )
    return found


def _groot(metadata: Metadata, convention: Convention) -> list[str]:
    config = metadata.get("modality_config")
    config = config if isinstance(config, dict) else {}

    def keys(group: str) -> list[str]:
        item = config.get(group)
        return [last_part(str(key)) for key in item.get("modality_keys", ())] if isinstance(item, dict) else []

    found = []
    if len(keys("action")) > 1:
        action_keys = [last_part(key) for key in convention.action.keys]
        unknown = [key for key in action_keys if key not in keys("action")]
        if unknown:
            found.append(f"its actions are {', '.join(keys('action'))}; the convention reads {', '.join(action_keys)}")
    sent = {
        "video": [last_part(image.key) for image in convention.images],
        "state": [last_part(state.key) for state in convention.states],
    }
    for group, group_keys in sent.items():
        missing = [key for key in keys(group) if key not in group_keys]
        if missing:
            found.append(
                f"it needs the {group} {', '.join(missing)}; the convention sends {', '.join(group_keys) or 'none'}"
            )
    return found


_CHECKS: dict[str, Callable[[Metadata, Convention], list[str]]] = {
    "openpi": _openpi,
    "groot": _groot,
}
