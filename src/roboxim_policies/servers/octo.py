"""Serves Octo over openpi's wire: `octo.py --checkpoint FOLDER --source OCTO --source DLIMP`.

It runs in an environment with Octo's requirements (`make policy-octo`). Octo's own code, and that of dlimp, which it
imports, are not on PyPI: clone octo-models/octo at 241fb3514b7c and kvablack/dlimp, and name both with --source.

A request has `image_primary` or `image_wrist`, or both, as uint8 of shape (frames, height, width, 3);
`timestep_pad_mask`, False for frames that only fill the history; `prompt`; and `unnorm_key`, the dataset whose
statistics un-normalise the actions. The reply has all predicted actions; the convention says how many are executed.

Each episode has its own random keys, drawn from the seed that RoboXim sends, so episodes repeat regardless of other
connections.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from openpi_server import Model, RequestError, arguments, picture_of, serve, text_of

MASK = "timestep_pad_mask"
MAX_TASKS = 256
"""Number of instructions whose encodings are kept."""


class Octo(Model):
    """A model of Octo 1.0 or 1.5, loaded with ``OctoModel.load_pretrained``."""

    def __init__(self, model: Any, *, unnorm_key: str = "", batch: int = 1) -> None:
        """Read what the model was trained with.

        Args:
            model: The ``OctoModel``.
            unnorm_key: Dataset whose statistics are used for requests that name none; empty: they must name one,
                unless the model has a single one.
            batch: Number of connections whose requests are computed at once. The model always computes so many.

        Raises:
            ValueError: When the model has no statistics of ``unnorm_key``.
        """
        self.model, self.batch = model, batch
        example = model.example_batch["observation"]
        self.shapes = {key: tuple(v.shape[2:]) for key, v in example.items() if key.startswith("image_")}
        mask = example[MASK]
        self.window, self._mask_type = int(mask.shape[1]), mask.dtype
        found = model.dataset_statistics or {}
        found = {"": found} if "action" in found else found  # a fine-tune has those of its one dataset
        self.statistics = {name: _statistics(part["action"]) for name, part in found.items() if "action" in part}
        if unnorm_key and unnorm_key not in self.statistics:
            raise ValueError(
                f"the checkpoint has no statistics of '{unnorm_key}'; it has those of {self._names()}. Choose one of "
                "them with --unnorm-key"
            )
        only = next(iter(self.statistics), "") if len(self.statistics) == 1 else ""
        self.unnorm_key = unnorm_key or only
        self._tasks: dict = {}
        self.metadata = {
            "model_server": "octo",
            "inputs": {key: list(shape) for key, shape in self.shapes.items()},
            "window": self.window,
            "unnorm_keys": sorted(self.statistics),
        }

    def begin(self, seed: int) -> tuple:
        """Return the seed, and the number of actions drawn so far."""
        return seed % 2**32, 0

    def check(self, request: dict) -> None:
        """Refuse a request whose pictures, mask, instruction or dataset the model cannot use.

        Raises:
            RequestError: Naming what is wrong.
        """
        text_of(request)
        self._key(request)
        self._observation(request)

    def act(self, requests: list) -> list:
        """Return all predicted actions, un-normalised, (horizon, D), for each request."""
        groups: dict = {}
        for place, (request, _) in enumerate(requests):
            observation = self._observation(request)
            shapes = tuple(sorted((key, value.shape) for key, value in observation.items()))
            groups.setdefault(shapes, []).append((place, observation))
        replies: dict = {}
        for members in groups.values():
            rows = self._sampled([(requests[place], observation) for place, observation in members])
            for (place, _), actions in zip(members, rows, strict=True):
                seed, drawn = requests[place][1]
                replies[place] = ({"actions": actions}, (seed, drawn + 1))
        return [replies[place] for place in range(len(requests))]

    def _sampled(self, members: list) -> list:
        """Sample the actions of requests with pictures of the same shapes."""
        import jax

        inputs = []
        for (request, (seed, drawn)), observation in members:
            key = jax.random.fold_in(jax.random.PRNGKey(seed), drawn)
            statistics = self.statistics[self._key(request)]
            inputs.append((observation, self._task(text_of(request)), statistics, key))

        def sample(observation: Any, task: Any, statistics: Any, key: Any) -> Any:
            return self.model.sample_actions(observation, task, unnormalization_statistics=statistics, rng=key)[0]

        if self.batch == 1:
            found = [sample(*entry) for entry in inputs]
        else:  # always the same number, so that one compilation serves all
            padded = inputs + [inputs[-1]] * (self.batch - len(inputs))
            stacked = jax.tree_util.tree_map(lambda *parts: np.stack(parts), *padded)
            found = list(np.asarray(jax.vmap(sample)(*stacked)))[: len(inputs)]
        return [
            _clipped(np.array(actions, dtype=np.float32), entry[2]["mask"])
            for actions, entry in zip(found, inputs, strict=True)
        ]

    def _observation(self, request: dict) -> dict:
        """Return the model's observation, with a batch of one. A camera that is absent is left out.

        A black picture in its place would be attended to.
        """
        cameras = [key for key in self.shapes if key in request]
        unknown = [key for key in request if str(key).startswith("image_") and key not in self.shapes]
        if unknown or not cameras:
            raise RequestError(
                f"the request has the pictures {unknown or 'none'}; the model takes {', '.join(self.shapes)}"
            )
        pictures = {key: picture_of(request, key, self.window, self.shapes[key]) for key in cameras}
        frames = {len(value) for value in pictures.values()}
        mask = np.atleast_1d(np.asarray(request.get(MASK, np.ones(max(frames), bool))))
        if mask.dtype.kind not in "biuf" or mask.ndim != 1 or frames != {len(mask)}:
            raise RequestError(f"'{MASK}' has {mask.size} values, the pictures have {sorted(frames)} frames")
        return {**{key: value[None] for key, value in pictures.items()}, MASK: mask[None].astype(self._mask_type)}

    def _task(self, text: str) -> Any:
        if text not in self._tasks:
            if len(self._tasks) >= MAX_TASKS:
                self._tasks.clear()
            self._tasks[text] = self.model.create_tasks(texts=[text])
        return self._tasks[text]

    def _key(self, request: dict) -> str:
        key = request.get("unnorm_key", self.unnorm_key)
        if not isinstance(key, str) or key not in self.statistics:
            raise RequestError(
                f"no statistics of the dataset '{key}'; the checkpoint has those of {self._names()}. Name one in the "
                "convention (extras: {unnorm_key: ...}), or with --unnorm-key"
            )
        return str(key)

    def _names(self) -> str:
        return ", ".join(sorted(self.statistics)) or "no dataset"


def _statistics(action: dict) -> dict:
    """Return mean, standard deviation and mask; numbers whose mask is False are not normalised."""
    mean, std = (np.asarray(action[key], np.float32) for key in ("mean", "std"))
    return {"mean": mean, "std": std, "mask": np.asarray(action.get("mask", np.ones(len(mean))), bool)}


def _clipped(actions: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return actions whose gripper, the last number, is within [0, 1] unless it is un-normalised.

    The diffusion head's samples reach beyond.
    """
    if not mask[-1]:
        actions[:, -1] = np.clip(actions[:, -1], 0.0, 1.0)
    return actions


def load(checkpoint: str, sources: list, step: int | None) -> Any:
    """Load a checkpoint with Octo's own code.

    Raises:
        SystemExit: When the sources or the checkpoint are missing; the message says what to do.
    """
    for source in sources:
        if not Path(source).is_dir():
            sys.exit(f"--source {source} is not a folder; name a clone of octo-models/octo, and one of kvablack/dlimp")
        sys.path.insert(0, str(Path(source).resolve()))
    if not checkpoint.startswith("hf://") and not (Path(checkpoint) / "config.json").is_file():
        sys.exit(
            f"{checkpoint} is no checkpoint of Octo: it has no config.json. Name the folder that holds config.json, "
            "dataset_statistics.json, example_batch.msgpack and a folder for each step, or "
            "hf://rail-berkeley/octo-small-1.5"
        )
    try:
        from octo.model.octo_model import OctoModel
    except ImportError as error:
        sys.exit(
            f"Octo's code cannot be imported ({error}). Clone octo-models/octo at 241fb3514b7c and kvablack/dlimp, and "
            "name both: --source octo --source dlimp (make: SOURCE='octo dlimp')"
        )
    named = checkpoint if checkpoint.startswith("hf://") else str(Path(checkpoint).resolve())
    return OctoModel.load_pretrained(named, step=step)


def main() -> int:
    """Parse the command line and serve."""
    parser = arguments(__doc__)
    environment = os.environ
    parser.add_argument(
        "--checkpoint", default=environment.get("OCTO_CHECKPOINT", ""),
        help="folder of a checkpoint, or hf://rail-berkeley/octo-small-1.5; default: $OCTO_CHECKPOINT",
    )  # fmt: skip
    parser.add_argument(
        "--source", action="append", default=[],
        help="folder of Octo's code, and of dlimp's; may be repeated; default: $OCTO_SOURCE, separated by spaces",
    )  # fmt: skip
    parser.add_argument("--step", type=int, help="step of the checkpoint (default: the last)")
    parser.add_argument("--unnorm-key", default="", help="dataset for requests that name none, e.g. bridge_dataset")
    parser.add_argument("--batch", type=int, default=1, help="connections that are computed at once (default: 1)")
    options = parser.parse_args()
    if not options.checkpoint:
        parser.error("name the weights: --checkpoint FOLDER or hf://rail-berkeley/octo-small-1.5, or OCTO_CHECKPOINT")
    sources = options.source or environment.get("OCTO_SOURCE", "").split()
    model = load(options.checkpoint, sources, options.step)
    try:
        served = Octo(model, unnorm_key=options.unnorm_key, batch=options.batch)
    except ValueError as error:
        parser.error(str(error))
    return serve(served, options.host, options.port, all_users=options.all_users)


if __name__ == "__main__":
    sys.exit(main())
