"""Made-up demonstrations, and a configuration that learns them in seconds, for the tests of trainings."""

import numpy as np

from roboxim_core.actions import ActionSemantics
from roboxim_core.policies import EpisodeStart, Observation, ObservationWindow
from roboxim_core.proprioception import Proprioception
from roboxim_policies.bc.config import BCConfig
from roboxim_policies.learning.data import Demonstration, Demonstrations, assemble
from roboxim_policies.learning.policy import LearnedPolicy

CONFIG = BCConfig(
    steps=300, learning_rate=3e-3, batch=16, warmup_steps=10, ema_decay=0.9, chunk=4, execute=2,
    channels=8, keypoints=8, hidden=32, image_sizes={"workspace": 32, "wrist": 16}, brightness=0.05,
    checkpoint_every=100,
)  # fmt: skip
COLORS = {"red": (220, 30, 30), "blue": (30, 30, 220)}


def episode(rng: np.random.Generator, color: str, steps: int = 8) -> Demonstration:
    """Return an episode: images with a square per colour, actions along x to the named one, then a closing gripper.

    Nothing but the words and the picture tells the direction: the arm is measured where it began until the gripper
    closes.
    """
    places = dict(zip(COLORS, rng.permutation([4, 22]), strict=True))
    picture = np.full((32, 32, 3), 128, np.uint8)
    for name, column in places.items():
        row = rng.integers(2, 24)
        picture[row : row + 6, column : column + 6] = COLORS[name]
    direction = 1.0 if places[color] > 10 else -1.0
    actions = np.zeros((steps, 7), np.float32)
    actions[:, 0] = 0.02 * direction
    actions[:, 6] = np.arange(steps) < steps - 2
    measured = [
        Proprioception(tcp_position=(0.5 if opening else 0.5 + 0.12 * direction, 0.0, 0.0), gripper_opening=opening)
        for opening in actions[:, 6].tolist()
    ]
    proprio = np.stack([each.vector() for each in measured])
    images = {"workspace": np.stack([picture] * steps), "wrist": np.stack([picture[::2, ::2]] * steps)}
    return Demonstration(images=images, proprio=proprio, actions=actions, instruction=f"Pick up the {color} cube")


def data(count: int = 24) -> Demonstrations:
    rng = np.random.default_rng(0)
    return assemble(
        [episode(rng, ("red", "blue")[i % 2]) for i in range(count)],
        camera_sizes={"workspace": (32, 32), "wrist": (16, 16)},
        semantics=ActionSemantics(),
        robot="panda",
    )


def first_action(policy: LearnedPolicy, demonstration: Demonstration, instruction: str) -> np.ndarray:
    policy.reset(EpisodeStart(episode_id="e", instruction=instruction, seed=0))
    images = {name: frames[0] for name, frames in demonstration.images.items()}
    x, *_, opening = demonstration.proprio[0].tolist()
    proprio = Proprioception(tcp_position=(x, 0.0, 0.0), gripper_opening=opening)
    observation = Observation(seq=0, stamp_ns=0, images=images, proprio=proprio)
    answer = policy.act(
        ObservationWindow(instruction=instruction, observations=[observation], pad_mask=(True,), episode_id="e", seq=0)
    )
    assert answer.shape == (2, 7)
    return answer[0]


def held_episode(opened_to: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    """Return proprioception and actions: the gripper closes to 0.5, turns by 90 degrees, rises, and opens."""
    rows, actions = [], []
    for step in range(24):
        yaw = np.deg2rad(-90) * np.clip((step - 10) / 6, 0, 1)
        c, s = float(np.cos(yaw)), float(np.sin(yaw))
        opening = 1.0 if step < 6 else 0.5 if step < 19 else opened_to
        at = Proprioception(
            tcp_position=(0.5, 0.0, 0.02 + 0.01 * max(0, step - 8)), tcp_rotation_6d=(c, s, 0.0, s, -c, 0.0),
            gripper_opening=opening,
        )  # fmt: skip
        rows.append(at.vector())
        rise = 0.01 if step >= 8 else 0.0
        actions.append([0.0, 0.0, rise, 0.0, 0.0, 0.0, 1.0 if step < 5 else 0.0 if step < 18 else opened_to])
    return np.stack(rows), np.array(actions, np.float32)


def assembled(*episodes: tuple[np.ndarray, np.ndarray], semantics: ActionSemantics | None = None) -> Demonstrations:
    return assemble(
        [
            Demonstration(
                images={"wrist": np.zeros((len(a), 16, 16, 3), np.uint8)}, proprio=p, actions=a, instruction="x"
            )
            for p, a in episodes
        ],
        camera_sizes={"wrist": (16, 16)},
        semantics=semantics or ActionSemantics(),
    )
