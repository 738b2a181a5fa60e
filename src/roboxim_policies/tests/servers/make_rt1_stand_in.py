"""Makes a SavedModel with RT-1-X's interface, and an encoder: `make_rt1_stand_in.py FOLDER`, in RT-1-X's environment.

The policy's state counts its steps, as RT-1-X's counts the frames of its history. Its actions say what it received, so
that a test can tell: world_vector is (steps before, mean of the picture / 255, first number of the embedding), and the
gripper closes from the third step on. The encoder's embedding begins with the number of characters / 100.
"""

import sys
from pathlib import Path

import tensorflow as tf
from tf_agents.policies import policy_saver, tf_policy
from tf_agents.specs import tensor_spec
from tf_agents.trajectories import policy_step, time_step_spec

OBSERVATION = {
    "image": tensor_spec.BoundedTensorSpec((256, 320, 3), tf.uint8, 0, 255, name="image"),
    "natural_language_embedding": tensor_spec.TensorSpec((512,), tf.float32, name="natural_language_embedding"),
}
ACTION = {
    "world_vector": tensor_spec.BoundedTensorSpec((3,), tf.float32, -2.0, 2.0, name="world_vector"),
    "rotation_delta": tensor_spec.BoundedTensorSpec((3,), tf.float32, -1.5708, 1.5708, name="rotation_delta"),
    "gripper_closedness_action": tensor_spec.BoundedTensorSpec((1,), tf.float32, -1.0, 1.0, name="gripper"),
    "terminate_episode": tensor_spec.BoundedTensorSpec((3,), tf.int32, 0, 1, name="terminate_episode"),
}


class Policy(tf_policy.TFPolicy):
    """The stand-in."""

    def __init__(self):
        super().__init__(
            time_step_spec(OBSERVATION), ACTION,
            policy_state_spec={"seq_idx": tensor_spec.TensorSpec((1,), tf.int32, name="seq_idx")},
            automatic_state_reset=False,
        )  # fmt: skip

    def _variables(self):
        return ()

    def _action(self, time_step, policy_state, seed):
        done = tf.cast(policy_state["seq_idx"], tf.float32)
        mean = tf.reduce_mean(tf.cast(time_step.observation["image"], tf.float32), axis=(1, 2, 3))[:, None] / 255.0
        zeros = tf.zeros_like(mean)
        action = {
            "world_vector": tf.concat([done, mean, time_step.observation["natural_language_embedding"][:, :1]], axis=1),
            "rotation_delta": tf.concat([zeros, zeros, zeros], axis=1),
            "gripper_closedness_action": tf.where(done >= 2.0, 1.0, -1.0),
            "terminate_episode": tf.cast(tf.concat([zeros, zeros + 1, zeros], axis=1), tf.int32),
        }
        return policy_step.PolicyStep(action, {"seq_idx": policy_state["seq_idx"] + 1}, ())

    def _distribution(self, time_step, policy_state):
        raise NotImplementedError


class Encoder(tf.Module):
    """Embeds a text as 512 numbers, the first of which is its length."""

    @tf.function(input_signature=[tf.TensorSpec([None], tf.string)])
    def __call__(self, texts):
        lengths = tf.cast(tf.strings.length(texts), tf.float32)[:, None] / 100.0
        return tf.concat([lengths, tf.zeros([tf.shape(texts)[0], 511])], axis=1)


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    policy_saver.PolicySaver(Policy(), batch_size=None).save(str(folder / "model"))
    tf.saved_model.save(Encoder(), str(folder / "encoder"))
