"""Serves RT-1-X over openpi's wire: `rt1.py --checkpoint FOLDER --encoder FOLDER`.

It runs in an environment with TensorFlow and tf-agents (`make policy-rt1`). The checkpoint is the SavedModel of
Open X-Embodiment (rt_1_x_tf_trained_for_002272480_step), the encoder of instructions Universal Sentence Encoder Large 5
as a SavedModel.

A request has `image`, uint8, 256 x 320 px, and `prompt`. The SavedModel keeps the history of 15 frames itself, in its
policy state. Each connection has its own state, which is reset at each episode and each new instruction. Of a request
with several frames the newest counts. The reply has `world_vector` (3), `rotation_delta` (3) and
`gripper_closedness_action` (1), as the model gives them.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent))
from openpi_server import Model, arguments, picture_of, serve, text_of

SHAPE = (256, 320, 3)
"""Height, width and channels of the picture."""
ACTIONS = {"world_vector": 3, "rotation_delta": 3, "gripper_closedness_action": 1}
HISTORY = 15
MAX_TEXTS = 256


class Rt1(Model):
    """RT-1-X. Requests of different connections are answered one after another: the SavedModel has no batches."""

    metadata = {"model_server": "rt1", "inputs": {"image": list(SHAPE)}, "window": HISTORY}

    def __init__(self, policy: Any, encoder: Any) -> None:
        """Use a policy and an encoder.

        Args:
            policy: Has ``initial_state()``, and ``step(image, embedding, state)``, which returns a map of actions and
                the new state.
            encoder: Returns the embedding of an instruction, float32, shape (512,).
        """
        self._policy, self._encoder = policy, encoder
        self._embeddings: dict = {}

    def begin(self, seed: int) -> tuple:
        """Return the state without a history, for no instruction yet."""
        return self._policy.initial_state(), None

    def check(self, request: dict) -> None:
        """Refuse a request without a picture or an instruction.

        Raises:
            RequestError: Naming what is wrong.
        """
        text_of(request)
        picture_of(request, "image", HISTORY, SHAPE)

    def act(self, requests: list) -> list:
        """Return one action for each request."""
        return [self._one(request, *state) for request, state in requests]

    def _one(self, request: dict, state: Any, before: str | None) -> tuple:
        text = text_of(request)
        if before not in (None, text):  # a new instruction is a new episode
            state = self._policy.initial_state()
        if text not in self._embeddings:
            if len(self._embeddings) >= MAX_TEXTS:
                self._embeddings.clear()
            self._embeddings[text] = np.asarray(self._encoder(text), np.float32)
        image = picture_of(request, "image", HISTORY, SHAPE)[-1]
        action, state = self._policy.step(image, self._embeddings[text], state)
        rows = {key: np.asarray(action[key], np.float32).reshape(1, size) for key, size in ACTIONS.items()}
        return rows, (state, text)


class SavedPolicy:
    """A SavedModel of tf-agents."""

    def __init__(self, folder: str) -> None:
        """Load it."""
        import tf_agents.specs
        from tf_agents.policies import py_tf_eager_policy
        from tf_agents.trajectories import time_step

        self._policy = py_tf_eager_policy.SavedModelPyTFEagerPolicy(
            model_path=folder, load_specs_from_pbtxt=True, use_tf_function=True
        )
        self._transition = time_step.transition
        spec = tf_agents.specs.from_spec(self._policy.time_step_spec.observation)
        self._zeros = tf_agents.specs.zero_spec_nest(spec)

    def initial_state(self) -> Any:
        """Return the state without a history."""
        return self._policy.get_initial_state(batch_size=1)

    def step(self, image: np.ndarray, embedding: np.ndarray, state: Any) -> tuple:
        """Return the actions by name, and the new state."""
        observation = {**self._zeros, "image": image, "natural_language_embedding": embedding}
        found = self._policy.action(self._transition(observation, reward=np.zeros((), np.float32)), state)
        return found.action, found.state


def load_encoder(folder: str) -> Any:
    """Return a function from an instruction to its embedding."""
    import tensorflow
    import tensorflow_text  # noqa: F401 - registers operations of the encoder's graph

    encoder = tensorflow.saved_model.load(folder)
    return lambda text: np.asarray(encoder([text])[0])


def require_saved_model(folder: str, what: str, option: str) -> None:
    """Refuse a folder without a SavedModel.

    Raises:
        SystemExit: The message says what to do.
    """
    if not (Path(folder) / "saved_model.pb").is_file():
        sys.exit(f"{folder} has no saved_model.pb; name the folder of {what} with {option}")


def main() -> int:
    """Parse the command line and serve."""
    parser = arguments(__doc__)
    environment = os.environ
    parser.add_argument(
        "--checkpoint", default=environment.get("RT1_CHECKPOINT", ""),
        help="folder of the SavedModel; default: $RT1_CHECKPOINT",
    )  # fmt: skip
    parser.add_argument(
        "--encoder", default=environment.get("RT1_ENCODER", ""),
        help="folder of the encoder's SavedModel; default: $RT1_ENCODER",
    )  # fmt: skip
    options = parser.parse_args()
    if not options.checkpoint:
        parser.error(
            "name the weights: --checkpoint FOLDER or RT1_CHECKPOINT, the unpacked "
            "rt_1_x_tf_trained_for_002272480_step of Open X-Embodiment"
        )
    if not options.encoder:
        parser.error(
            "name the encoder of instructions: --encoder FOLDER or RT1_ENCODER, the unpacked Universal Sentence "
            "Encoder Large 5"
        )
    require_saved_model(options.checkpoint, "RT-1-X's SavedModel", "--checkpoint")
    require_saved_model(options.encoder, "the encoder's SavedModel", "--encoder")
    model = Rt1(SavedPolicy(options.checkpoint), load_encoder(options.encoder))
    return serve(model, options.host, options.port, all_users=options.all_users)


if __name__ == "__main__":
    sys.exit(main())
