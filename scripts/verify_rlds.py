"""Read an exported dataset with TensorFlow Datasets, as a training script would, and check every step.

Needs tensorflow and tensorflow-datasets and nothing of RoboXim; `make verify-rlds DATASET=FOLDER` creates such an
environment. Exit codes: 0: no problems, 1: problems found, 2: no dataset found.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("CUDA_VISIBLE_DEVICES", "")
os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import numpy as np
import tensorflow_datasets as tfds

SEMANTICS_KEYS = {"control", "frame", "rotation", "gripper", "delta_base", "rate_hz"}
STATE = ["tcp.x", "tcp.y", "tcp.z", *(f"tcp.{axis}_axis.{of}" for axis in "xy" for of in "xyz"), "gripper.opening"]
"""The default state."""
LARGEST_TURN = 0.5
"""Maximum change of a component of the tool's axes in a step: twice the rotation limit of an action [rad]."""


def find_dataset(path: Path) -> Path:
    """Return the folder of the only dataset at or below a path; exit with 2 if there is not exactly one."""
    found = [p.parent for p in sorted(path.rglob("dataset_info.json")) if not p.parent.name.startswith(".")]
    if len(found) != 1:
        print(f"{path} holds {len(found)} datasets {[str(p) for p in found]}; name the folder of one", file=sys.stderr)
        raise SystemExit(2)
    return found[0]


def episode_problems(episode: dict[str, Any], steps: list[dict[str, Any]], shapes: dict[str, Any]) -> Iterator[str]:
    """Yield the problems of an episode.

    Args:
        episode: Its record.
        steps: Its steps.
        shapes: Key of an observation to its shape and whether it is a picture; ``action`` too.
    """
    if not steps:
        yield "it has no steps"
        return
    metadata = {key: value.numpy() for key, value in episode["episode_metadata"].items()}
    if not metadata["episode_id"]:
        yield "it has no id"
    semantics = json.loads(metadata.get("action_semantics") or "{}")  # empty: the dataset does not say it
    missing = SEMANTICS_KEYS - set(semantics)
    if semantics and missing:
        yield f"its action semantics lack {sorted(missing)}"
    flags = [(bool(s["is_first"]), bool(s["is_last"]), bool(s["is_terminal"])) for s in steps]
    last = len(steps) - 1
    if flags != [(index == 0, index == last, index == last) for index in range(len(steps))]:
        yield "is_first, is_last and is_terminal do not mark its first and last step"
    if not any(step["language_instruction"].decode().strip() for step in steps):
        yield "it has no instruction"
    if "language_subtask" in steps[0] and not all(step["language_subtask"].decode().strip() for step in steps):
        yield "a step has an empty subtask"
    rewards = [float(step["reward"]) for step in steps]
    if "success" in metadata and rewards != [0.0] * last + [float(metadata["success"])]:
        yield f"its rewards do not say that success is {bool(metadata['success'])}: {rewards}"
    usual = json.loads(metadata.get("state_layout") or "[]") == STATE
    if usual and last:
        turns = np.abs(np.diff([step["observation"]["state"][3:9] for step in steps], axis=0)).max()
        if turns > LARGEST_TURN:
            yield f"the rotation in its state jumps by {turns:.2f} from one step to the next"
    deltas = semantics.get("control") == "end_effector_delta" and shapes["action"][0] == (7,)
    for index, step in enumerate(steps):
        found = (*step_problems(step, shapes), *ranges(step, deltas=deltas, usual=usual))
        yield from (f"step {index}: {problem}" for problem in found)


def step_problems(step: dict[str, Any], shapes: dict[str, Any]) -> Iterator[str]:
    """Yield what is wrong with the arrays of a step."""
    for key, (shape, picture) in shapes.items():
        value = step["action"] if key == "action" else step["observation"][key]
        kind = np.uint8 if picture else np.float32
        if value.shape != shape or value.dtype != kind:
            yield f"{key} is {value.dtype} of shape {value.shape}, expected {np.dtype(kind)} of {shape}"
        elif picture and value.max() == value.min():
            yield f"{key} has a single colour"
        elif not picture and not np.isfinite(value).all():
            yield f"{key} is not finite"
    if float(step["discount"]) != 1.0:
        yield f"discount {step['discount']}"


def ranges(step: dict[str, Any], *, deltas: bool, usual: bool) -> Iterator[str]:
    """Yield the values of a step that are out of range.

    Args:
        step: The step.
        deltas: Whether its action is a motion of the end effector and the gripper.
        usual: Whether its state is the default one.
    """
    action, state = step["action"], step["observation"].get("state")
    if deltas and (np.abs(action[:3]).max() > 0.2 or np.abs(action[3:6]).max() > 1.0 or not 0 <= action[6] <= 1):
        yield f"an action out of range: {action}"
    if usual and state is not None:
        axes = state[3:9].reshape(2, 3)
        if np.abs(axes @ axes.T - np.eye(2)).max() > 1e-3 or not -0.01 <= state[9] <= 1.01:
            yield f"a state out of range: {state}"


def verify(path: Path) -> int:
    """Check a dataset, print its contents and problems, and return the number of problems."""
    builder = tfds.builder_from_directory(path)
    features = builder.info.features["steps"]
    shapes = {
        key: (tuple(feature.shape), isinstance(feature, tfds.features.Image))
        for key, feature in [*features["observation"].items(), ("action", features["action"])]
    }
    print(f"{builder.info.full_name}: images { {key: shape for key, (shape, picture) in shapes.items() if picture} }")
    problems: list[str] = []
    actions = []
    for split in builder.info.splits:
        episodes = lengths = 0
        instructions, subtasks = set(), set()
        for episode in builder.as_dataset(split=split):
            steps = list(episode["steps"].as_numpy_iterator())
            name = episode["episode_metadata"]["episode_id"].numpy().decode()
            problems += [f"{split}/{name}: {problem}" for problem in episode_problems(episode, steps, shapes)]
            actions += [step["action"] for step in steps]
            instructions |= {step["language_instruction"].decode() for step in steps}
            subtasks |= {step["language_subtask"].decode() for step in steps if "language_subtask" in step}
            episodes, lengths = episodes + 1, lengths + len(steps)
        expected = builder.info.splits[split].num_examples
        if episodes != expected:
            problems.append(f"{split}: {episodes} episodes, dataset_info.json says {expected}")
        print(
            f"{split}: {episodes} episodes, {lengths} steps, "
            f"{len(instructions)} instructions {sorted(instructions)[:3]}"
            + (f", {len(subtasks)} subtasks {sorted(subtasks)[:5]}" if subtasks else "")
        )
    if "train" not in builder.info.splits:
        problems.append("the split 'train' is missing")
    if actions:
        low, high = np.min(actions, axis=0), np.max(actions, axis=0)
        print("actions: " + ", ".join(f"{a:.4g}..{b:.4g}" for a, b in zip(low, high, strict=True)))
    for problem in problems[:20]:
        print(f"PROBLEM {problem}")
    print(f"{len(problems)} problems" if problems else "no problems found")
    return len(problems)


def main() -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("dataset", type=Path, help="the dataset's folder, or a parent folder without other datasets")
    return 1 if verify(find_dataset(parser.parse_args().dataset)) else 0


if __name__ == "__main__":
    sys.exit(main())
