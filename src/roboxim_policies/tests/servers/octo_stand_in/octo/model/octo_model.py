"""A stand-in for Octo's OctoModel, with its interface and no network.

Its actions say what it received: x is the mean of the newest primary picture / 255, y is 1 if a wrist picture was
there, z is the number of real frames, the three angles are noise drawn with the key, the gripper is 1.5 for texts with
"open", else -0.5. The statistics are applied as Octo does. ``load_pretrained`` reads the statistics of a folder.
"""

import json
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

HORIZON = 4


class OctoModel:
    """The stand-in."""

    def __init__(self, dataset_statistics: Any):
        self.dataset_statistics = dataset_statistics
        self.example_batch = {
            "observation": {
                "image_primary": np.zeros((1, 2, 256, 256, 3), np.uint8),
                "image_wrist": np.zeros((1, 2, 128, 128, 3), np.uint8),
                "timestep_pad_mask": np.ones((1, 2), bool),
            }
        }
        self.traced = []
        self._sampled = jax.jit(self._sample)

    @classmethod
    def load_pretrained(cls, checkpoint_path: str, step: int | None = None) -> "OctoModel":
        """Read the statistics of a checkpoint's folder."""
        text = (Path(checkpoint_path) / "dataset_statistics.json").read_text()
        return cls(jax.tree_util.tree_map(np.array, json.loads(text), is_leaf=lambda part: not isinstance(part, dict)))

    def create_tasks(self, goals: Any = None, texts: list[str] | None = None) -> Any:
        """Return the tasks' tokens: here the characters."""
        assert goals is None
        assert texts is not None
        tokens = np.zeros((len(texts), 16), np.int32)
        for row, text in zip(tokens, texts, strict=True):
            codes = [ord(character) for character in text.split()[0][:16]]
            row[: len(codes)] = codes
        return {"language_instruction": {"input_ids": tokens, "attention_mask": tokens != 0}}

    def sample_actions(
        self, observations: Any, tasks: Any, unnormalization_statistics: Any = None, rng: Any = None
    ) -> Any:
        """Return actions of shape (batch, HORIZON, 7)."""
        return self._sampled(observations, tasks, unnormalization_statistics, rng)

    def _sample(self, observations: Any, tasks: Any, statistics: Any, rng: Any) -> Any:
        self.traced.append({key: value.shape for key, value in observations.items()})
        assert observations["timestep_pad_mask"].dtype == bool
        pictures = observations.get("image_primary", jnp.zeros((1, 1, 1, 1, 3)))
        batch = pictures.shape[0]
        mean = pictures[:, -1].astype(jnp.float32).mean(axis=(1, 2, 3)) / 255.0
        wrist = jnp.full(batch, float("image_wrist" in observations))
        frames = observations["timestep_pad_mask"].sum(axis=1).astype(jnp.float32)
        first = jnp.stack([mean, wrist, frames], axis=1)
        noise = jax.random.normal(rng, (batch, HORIZON, 3))
        letters = tasks["language_instruction"]["input_ids"][:, :4]
        opens = (letters == jnp.array([ord(c) for c in "open"])).all(axis=1)
        gripper = jnp.where(opens, 1.5, -0.5)
        actions = jnp.concatenate(
            [
                jnp.repeat(first[:, None], HORIZON, axis=1),
                noise,
                jnp.repeat(gripper[:, None, None], HORIZON, axis=1),
            ],
            axis=2,
        )
        if statistics is None:
            return actions
        return jnp.where(statistics["mask"], actions * statistics["std"] + statistics["mean"], actions)
