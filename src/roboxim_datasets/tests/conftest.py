"""Made-up episodes and datasets."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from roboxim_core.actions import ActionSemantics
from roboxim_datasets.dataset import Dataset, Description, Features
from roboxim_datasets.episode import Episode, ImageSize, Step, Wanted
from roboxim_datasets.formats import FORMATS

ACTION = ("dx", "dy", "dz", "droll", "dpitch", "dyaw", "gripper")
VECTORS = {"state": ("tcp.x", "tcp.y"), "joints": ("j0.position",)}
DESCRIPTION = Description(
    features=Features(
        cameras={"workspace": ImageSize(height=32, width=48)},
        keys={"workspace": "image"},
        action=ACTION,
        vectors=VECTORS,
        signals={"sim.action_executed": ACTION, "sim.force": ("force.z",)},
    ),
    fps=10.0,
    robot="panda",
    semantics=ActionSemantics(),
)


def make_episode(index: int, length: int = 3, **changes: object) -> Episode:
    """Return an episode whose numbers and images depend on its index."""

    def read(wanted: Wanted):
        rng = np.random.default_rng(index)
        for at in range(length):
            ramp = np.linspace(0, 200, 32 * 48 * 3).reshape(32, 48, 3)
            yield Step(
                index=at,
                images={camera: (ramp + 10 * at + index).astype(np.uint8) for camera in wanted.cameras},
                proprio={name: rng.normal(size=len(names)).astype(np.float32) for name, names in VECTORS.items()},
                action=rng.normal(size=7).astype(np.float32),
                action_executed=rng.normal(size=7).astype(np.float32),
                signals={"sim.force": np.float32([at])},
                reward=float(at == length - 1),
            )

    ids = {"run_seed": 3, "index": index, "attempt": 0}
    texts = {name: name for name in ("file_path", "actor", "task", "final_state_hash")}
    episode = Episode(
        episode_id=f"demo-{index}", length=length, instruction=f"Pick up cube {index}", semantics=ActionSemantics(),
        cameras=DESCRIPTION.features.cameras, success=True, robot="panda", fps=10.0, vectors=VECTORS,
        signals={"sim.force": ("force.z",)}, metadata={**ids, "skill": "pick_up", **texts}, read=read,
    )  # fmt: skip
    return replace(episode, **changes)


@pytest.fixture
def episode_of() -> Callable[..., Episode]:
    """Makes an episode: ``episode_of(index, length=3)``."""
    return make_episode


@pytest.fixture
def description() -> Description:
    """What the made-up datasets consist of."""
    return DESCRIPTION


@pytest.fixture
def write() -> Callable[..., Dataset]:
    """Writes and opens a dataset: ``write(folder, train=[0, 1], val=[2], format="rlds", **options)``."""

    def make(
        folder: Path, train: Sequence[int | Episode] = (0, 1, 2), val: Sequence[int | Episode] = (), *,
        format: str = "rlds", description: Description = DESCRIPTION, **options: object,
    ) -> Dataset:  # fmt: skip
        made = FORMATS[format]()
        if format == "rlds":
            options = {"encoding": "png", **options}
        settings = made.options(**options)
        with made.create(folder, description, settings, identity="", overwrite=False) as writer:
            for split, episodes in (("train", train), ("val", val)):
                for episode in episodes:
                    writer.add(split, make_episode(episode) if isinstance(episode, int) else episode)
            writer.complete({"export.json": json.dumps({"format": format, "options": options})})
        return made.open(made.path(folder, settings))

    return make
