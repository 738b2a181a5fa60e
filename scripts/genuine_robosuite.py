"""Genuine robosuite: LIBERO's cameras, and how far its arm moves.

`scripts/genuine_clients.py` uses it in the environment ``verify-conventions``; it imports nothing of RoboXim.
"""

from __future__ import annotations

import os
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np

AGENTVIEW_M = [0.6586131746834771, 0.0, 1.6103500240372423]
"""Position of LIBERO's camera ``agentview`` in the frame of the table suites [m]."""
AGENTVIEW_WXYZ = [0.6380177736282349, 0.3048497438430786, 0.30484986305236816, 0.6380177736282349]
"""Its rotation."""
BASE = np.array([-0.66, 0.0, 0.912])
"""LIBERO's robot base in the frame of the table suites [m]."""
CUBE_Y = 0.15
"""Where the scene's cube lies, to the robot's left [m]."""
REST = [0.0] * 6 + [-1.0]
COMPONENTS = ("x", "y", "z", "about x", "about y", "about z")


def make_robosuite(*, pictures: bool) -> Any:
    """Return robosuite's Panda at a table, with LIBERO's controller at 20 Hz."""
    import robosuite
    from robosuite.controllers import load_controller_config

    env = robosuite.make(
        "Lift", robots="Panda", controller_configs=load_controller_config(default_controller="OSC_POSE"),
        has_renderer=False, has_offscreen_renderer=pictures, use_camera_obs=pictures,
        camera_names=["agentview", "robot0_eye_in_hand"], camera_heights=256, camera_widths=256, control_freq=20,
        horizon=1_000_000, ignore_done=True,
    )  # fmt: skip
    env.reset()
    return env


def observed_scene(env: Any) -> dict[str, np.ndarray]:
    """Place the cube and the camera, and return robosuite's observation with the base's position."""
    simulated, model = env.sim, env.sim.model
    base = simulated.data.get_body_xpos("robot0_base")
    camera = model.camera_name2id("agentview")
    model.cam_pos[camera] = np.array(AGENTVIEW_M) - BASE + base
    model.cam_quat[camera] = AGENTVIEW_WXYZ
    joint = env.cube.joints[0]
    height = simulated.data.get_joint_qpos(joint)[2]
    simulated.data.set_joint_qpos(joint, [base[0] + 0.55, CUBE_Y, height, 1, 0, 0, 0])
    simulated.forward()
    env.step(np.array(REST))
    seen = env._get_observations(force_update=True)
    cube = simulated.data.get_joint_qpos(joint)[:3] - base
    return {**seen, "base": base, "cube_in_base": cube}


def tool(env: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return position [m] and rotation matrix of the controller's end effector."""
    controller = env.robots[0].controller
    controller.update(force=True)
    return controller.ee_pos.copy(), controller.ee_ori_mat.copy()


def moved(env: Any, actions: np.ndarray, start: np.ndarray) -> np.ndarray:
    """Execute actions from rest at a start.

    Args:
        env: robosuite's environment.
        actions: Shape (n, 6).
        start: Displacement of the start from robosuite's initial pose [m].

    Returns:
        Translation [m] and rotation vector [rad] of each step, shape (n, 6).
    """
    from scipy.spatial.transform import Rotation

    env.reset()
    for _ in range(10):
        env.step(np.array(REST))
    home = tool(env)[0]
    for _ in range(40):
        env.step(np.array([*np.clip((home + start - tool(env)[0]) * 8, -1, 1), 0, 0, 0, -1]))
    for _ in range(8):
        env.step(np.array(REST))
    position, rotation = tool(env)
    rows = []
    for action in actions:
        env.step(np.array([*action, -1.0]))
        new_position, new_rotation = tool(env)
        rows.append([*(new_position - position), *Rotation.from_matrix(new_rotation @ rotation.T).as_rotvec()])
        position, rotation = new_position, new_rotation
    return np.array(rows)


def constant_actions(env: Any) -> dict[str, list[float]]:
    """Return the motion of each of 14 steps for a constant number, in mm or mrad per unit: the mean of both signs.

    A translation begins 10 cm before the initial pose, so that it ends before the joints' limits.
    """
    found = {}
    for index, name in enumerate(COMPONENTS):
        steps = []
        for size in (1.0, -1.0) if index < 3 else (0.2, -0.2):
            actions, start = np.zeros((14, 6)), np.zeros(3)
            actions[:, index] = size
            if index < 3:
                start[index] = -0.1 * size
            steps.append(moved(env, actions, start)[:, index] * 1e3 / size)
        found[name] = np.mean(steps, axis=0).tolist()
    return found


def pulses(rng: np.random.Generator, index: int, count: int) -> np.ndarray:
    """Return actions of one component: pulses of 3 to 25 steps and alternating signs that stay near the start."""
    sizes, reach, unit = ((0.3, 1.0), 0.13, 0.0125) if index < 3 else ((0.05, 0.4), 0.5, 0.11)
    numbers, sign, place = np.zeros(count), rng.choice([-1, 1]), 0.0
    step = 0
    while step < count:
        size = rng.uniform(*sizes)
        room = max(3, int((reach - sign * place) / (size * unit)))
        length = min(int(rng.integers(3, 26)), room)
        numbers[step : step + length] = sign * size
        place, step, sign = place + sign * size * unit * length, step + length, -sign
    actions = np.zeros((count, 6))
    actions[:, index] = numbers
    return actions


def identified_response(
    env: Any, constant: dict[str, list[float]], *, episodes: int = 16, steps: int = 64
) -> list[dict[str, Any]]:
    """Identify the first-order response of each component.

    The gain is the motion of the last four steps of constant actions. The lag is fitted to pulses, and validated with
    pulses of other episodes.

    Args:
        env: robosuite's environment.
        constant: Result of `constant_actions`.
        episodes: Number of episodes of pulses; a third of them validate.
        steps: Steps of an episode.

    Returns:
        For each component ``gain``, ``lag``, ``error`` (root mean square of a step, in mm or mrad), ``motion`` (that of
        the motion) and ``error_in_full`` (if every delta were executed in full within its step).
    """
    from scipy.optimize import least_squares
    from scipy.signal import lfilter

    rng = np.random.default_rng(3)
    found = []
    for index, component in enumerate(COMPONENTS):
        scale = 0.05 if index < 3 else 0.5
        gain = float(np.mean(constant[component][-4:])) / (1e3 * scale)
        runs = []
        for _ in range(episodes):
            start = np.array([rng.uniform(-0.1, 0.1), rng.uniform(-0.15, 0.15), rng.uniform(-0.08, 0.1)])
            actions = pulses(rng, index, steps)
            runs.append((actions[:, index] * scale, moved(env, actions, start)[:, index]))
        train, held = runs[: -episodes // 3], runs[-episodes // 3 :]

        def missed(lag: Any, runs: list[Any], gain: float = gain) -> np.ndarray:
            return np.concatenate([gain * lfilter([1 - float(lag[0])], [1, -float(lag[0])], u) - y for u, y in runs])

        lag = least_squares(missed, [0.5], args=(train,)).x
        found.append(
            {
                "component": component, "gain": gain, "lag": float(lag[0]), "error": rms(missed(lag, held)),
                "motion": rms(np.concatenate([y for _, y in held])),
                "error_in_full": rms(np.concatenate([u - y for u, y in held])),
            }
        )  # fmt: skip
    return found


def rms(values: np.ndarray) -> float:
    """Return the root mean square, times 1,000."""
    return float(np.sqrt(np.mean(values**2)) * 1e3)
