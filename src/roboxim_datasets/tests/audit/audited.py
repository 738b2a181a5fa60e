"""Made-up episodes for the tests of the audit: an arm that reaches, grasps and lifts, filmed by two cameras."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from roboxim_core.actions import ActionSemantics
from roboxim_core.poses import Pose
from roboxim_core.proprioception import ProprioField, component_names
from roboxim_datasets.audit import Approach, AuditEpisode, Auditor, AuditResult, Meaning, Truth
from roboxim_datasets.episode import Episode, ImageSize, Step, Wanted

STEPS = 60
JOINTS = tuple(f"joint{i}" for i in range(7))
FIELDS = (
    ProprioField.TCP_POSITION,
    ProprioField.TCP_ROTATION_6D,
    ProprioField.GRIPPER_OPENING,
    ProprioField.JOINT_POSITIONS,
)


class KnownArm:
    """An arm whose poses are those of the made-up episodes."""

    lower, upper, velocity = np.full(7, -3.0), np.full(7, 3.0), np.full(7, 1e3)

    def fk(self, joints: Any) -> Pose:
        """Return the position that an episode has with these joints; elsewhere the origin."""
        return Pose(position=_places().get(np.asarray(joints, np.float32).tobytes(), (0.0, 0.0, 0.0)))


@lru_cache(maxsize=1)
def _places() -> dict[bytes, Any]:
    """Return joints to position in the made-up episodes."""
    made = [arrays(seed) for seed in range(101)]
    return {
        joints.tobytes(): tuple(place.tolist())
        for values in made
        for joints, place in zip(values["joint_positions"], values["tcp_position"], strict=True)
    }


@lru_cache(maxsize=256)
def arrays(seed: int, steps: int = STEPS) -> dict[str, Any]:
    """Return a reach with the noise that demonstrations have: actions, proprioception and images; do not change it."""
    rng = np.random.default_rng(seed)
    reach = np.sin(np.linspace(0, 2 * np.pi, steps))[:, None] * rng.uniform(0.01, 0.013, 3) * rng.choice([-1, 1], 3)
    speed = reach + rng.normal(0, 0.003, (steps, 3)).clip(-0.006, 0.006)
    position = np.array([0.45, 0.0, 0.25]) + np.cumsum(np.vstack([np.zeros(3), speed[:-1]]), axis=0)
    turn = rng.normal(0, 0.01, (steps, 3))
    command = np.where(np.arange(steps) < steps // 2, 1.0, 0.0)
    opening = np.interp(np.arange(steps), [0, steps // 2 + 1, steps // 2 + 5, steps], [1.0, 1.0, 0.4, 0.4])
    matrices = [Rotation.from_quat([1.0, 0.0, 0.0, 0.0])]
    for euler in turn[:-1]:
        matrices.append(Rotation.from_euler("xyz", euler) * matrices[-1])
    rotation = np.array([turned.as_matrix()[:, :2].T.reshape(-1) for turned in matrices])
    joints = rng.normal(0, 0.3, 7) + np.cumsum(rng.normal(0, 0.01, (steps, 7)), axis=0)
    return {
        "actions": np.column_stack([speed, turn, command]).astype(np.float32),
        "tcp_position": position.astype(np.float32),
        "tcp_rotation_6d": rotation.astype(np.float32),
        "gripper_opening": opening[:, None].astype(np.float32),
        "joint_positions": joints.astype(np.float32),
        "images": {
            "workspace": [film(0.6 * place + 0.2, shift) for place, shift in zip(position, opening, strict=True)],
            "wrist": [film(-place, shift) for place, shift in zip(position, opening, strict=True)],
        },
    }


def film(place: np.ndarray, shift: float, side: int = 32) -> np.ndarray:
    """Return an image whose pattern moves with the hand."""
    rows, columns = np.mgrid[0:side, 0:side] / side
    wave = np.sin(90 * (columns + place[1])) * np.cos(90 * (rows + place[2]))
    wave += np.sin(60 * (rows + place[0] + 0.02 * shift))
    return np.repeat((90 + 40 * wave)[:, :, None], 3, axis=2).astype(np.uint8)


def episode(seed: int = 0, instruction: str = "Pick up the cube", **changes: Any) -> Episode:
    """Return a clean episode, or one with other arrays."""
    values = arrays(seed) | {name: changes.pop(name) for name in list(changes) if name in arrays(0, 8)}
    steps, stamps = len(values["actions"]), changes.pop("stamps", None)
    names = {str(field): component_names((field,), JOINTS) for field in FIELDS}

    def read(wanted: Wanted) -> Iterator[Step]:
        for k in range(steps):
            yield Step(
                index=k,
                images={camera: values["images"][camera][k] for camera in wanted.cameras},
                proprio={name: values[name][k] for name in names},
                action=values["actions"][k],
                action_executed=values["actions"][k],
                stamp_s=stamps[k] if stamps is not None else None,
            )

    made = Episode(
        episode_id=f"demo-0-{seed:05d}-0", length=steps, instruction=instruction,
        semantics=ActionSemantics(), cameras={name: ImageSize(height=32, width=32) for name in values["images"]},
        success=True, robot="panda", joint_names=JOINTS, fps=10.0, vectors=names,
        metadata={"run_seed": 0, "index": seed, "task": '{"instruction": "Pick up the cube", "skill": "pick_up"}'},
        read=read,
    )  # fmt: skip
    return replace(made, **changes)


def truth(steps: int = STEPS, **changes: Any) -> Truth:
    """Return the ground truth of a clean episode, or another one."""
    return replace(
        Truth(
            solved=(False,) * steps + (True,),
            approaches=(Approach(distance_m=tuple(np.linspace(0.4, 0.0, 30).tolist()), path_m=0.42, closings=1),),
            meaning=Meaning(ever=True),
            sightings=(),
            pairs=(),
        ),
        **changes,
    )


def audit(*episodes: Episode | AuditEpisode, checks: tuple[str, ...] = ()) -> AuditResult:
    """Audit episodes, those without a split as of ``train``."""
    auditor = Auditor(checks)
    for number, item in enumerate(episodes):
        made = item if isinstance(item, AuditEpisode) else AuditEpisode(name=f"e{number}", split="train", episode=item)
        auditor.add(made)
    return auditor.result()


def found(check: str, *episodes: Any) -> tuple[str, ...]:
    """Return the episodes in which a check finds a fault."""
    return audit(*episodes, checks=(check,)).check(check).faulty_episodes


def unchecked(check: str, *episodes: Any) -> str:
    """Return the only reason why a check could not be made."""
    result = audit(*episodes, checks=(check,)).check(check)
    (reason,) = result.unchecked
    assert result.status == "unchecked"
    return reason


def with_truth(name: str = "e0", **changes: Any) -> AuditEpisode:
    """Return a clean episode with ground truth."""
    return AuditEpisode(name=name, split="", episode=episode(), truth=truth(**changes))


def texts(check: str, *episodes: Any) -> list[str]:
    """Return what a check says."""
    return [finding.text for finding in audit(*episodes, checks=(check,)).check(check).findings]
