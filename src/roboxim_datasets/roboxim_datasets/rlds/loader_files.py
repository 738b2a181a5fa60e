"""Files beside an exported dataset: statistics, and configurations for common loaders."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from roboxim_datasets.dataset import gripper_components
from roboxim_datasets.rlds.format import RldsFeatures
from roboxim_datasets.rlds.tfrecord import decode_example, read_records
from roboxim_datasets.statistics import VectorStatistics

STATISTICS_FILE = "dataset_statistics.json"


def statistics_of(shards: Iterable[Path], features: RldsFeatures, action: Sequence[str]) -> dict[str, Any]:
    """Read shards back and summarise their actions and states, in the format that OpenVLA and Octo cache.

    Args:
        shards: TFRecord files.
        features: Features of their episodes.
        action: Names of the action's components.
    """
    size, state = features.action_size, "steps/observation/state"
    actions, states, episodes = VectorStatistics(size), VectorStatistics(features.vectors.get("state", 1)), 0
    for shard in shards:
        for payload in read_records(shard):
            example: dict[str, Any] = decode_example(payload, ("steps/action", state))
            actions.add(example["steps/action"].reshape(-1, size))
            if state in example:
                states.add(example[state].reshape(-1, features.vectors["state"]))
            episodes += 1
    return {
        "action": {**_summary(actions), "mask": _mask(action)},
        **({"proprio": _summary(states)} if states.count else {}),
        "num_transitions": actions.count,
        "num_trajectories": episodes,
    }


def _summary(statistics: VectorStatistics) -> dict[str, list[float]]:
    found = statistics.summary({"q01": 0.01, "q99": 0.99})
    return {name: found[name].tolist() for name in ("mean", "std", "min", "max", "q01", "q99")}


def loader_files(name: str, features: RldsFeatures, statistics: dict[str, Any]) -> dict[str, str]:
    """Return the files that help to load a dataset: name to text."""
    primary, wrist = _views(features)
    return {
        STATISTICS_FILE: json.dumps(statistics, indent=2) + "\n",
        "openvla_register.py": _REGISTER.format(name=name, primary=primary, wrist=wrist),
    }


def loading_text(name: str, version: str, features: RldsFeatures, action: Sequence[str]) -> str:
    """Return how a dataset is loaded, in Markdown; ``action`` has the names of the action's components."""
    primary, wrist = _views(features)
    flags = _mask(action)
    runs = [(flag, len(list(run))) for flag, run in groupby(flags)]
    mask = " + ".join(f"[{flag}]" + f" * {count}" * (count > 1) for flag, count in runs)
    gripper = "The gripper must not be\nnormalised" if not all(flags) else "No component is\nnamed after a gripper"
    return _LOADING.format(name=name, version=version, primary=primary, wrist=wrist, mask=mask, gripper=gripper)


def _mask(action: Sequence[str]) -> list[bool]:
    """Return for each component of the action whether it is normalised: all but the gripper."""
    grippers = gripper_components(action)
    return [at not in grippers for at in range(len(action))]


def _views(features: RldsFeatures) -> tuple[str | None, str | None]:
    """Return the image keys of the outer and of the wrist camera."""
    keys = sorted(features.images)
    wrist = next((key for key in keys if "wrist" in key), None)
    others = [key for key in keys if key != wrist] or keys
    return "image" if "image" in keys else next(iter(others), None), wrist


_REGISTER = '''"""Registers the dataset `{name}` with OpenVLA: import this and call `register()` before training."""


def register() -> None:
    """Add the dataset to OpenVLA's configurations; its actions need no transform."""
    from prismatic.vla.datasets.rlds.oxe.configs import OXE_DATASET_CONFIGS, ActionEncoding, StateEncoding
    from prismatic.vla.datasets.rlds.oxe.transforms import OXE_STANDARDIZATION_TRANSFORMS

    OXE_DATASET_CONFIGS["{name}"] = {{
        "image_obs_keys": {{"primary": {primary!r}, "secondary": None, "wrist": {wrist!r}}},
        "depth_obs_keys": {{"primary": None, "secondary": None, "wrist": None}},
        "state_obs_keys": ["state"],
        "state_encoding": StateEncoding.NONE,
        "action_encoding": ActionEncoding.EEF_POS,
    }}
    OXE_STANDARDIZATION_TRANSFORMS["{name}"] = lambda trajectory: trajectory
'''

_LOADING = """```python
import tensorflow_datasets as tfds
builder = tfds.builder_from_directory("{name}/{version}")   # this folder
```

A step has `observation/<image key or vector>`, `action`, `language_instruction`, `reward`, `discount`, `is_first`,
`is_last`, `is_terminal`, and under `sim/` what loaders ignore.

`dataset_statistics.json` holds mean, std, min, max, q01 and q99 of actions and states. {gripper} (mask `{mask}`).

OpenVLA: `openvla_register.py`, action normalisation `BOUNDS_Q99`. Octo needs only arguments:

```python
dataset_kwargs = dict(
    name="{name}", data_dir="...", image_obs_keys={{"primary": "{primary}", "wrist": {wrist!r}}},
    proprio_obs_key="state", language_key="language_instruction",
    action_normalization_mask={mask},
)
```
"""
