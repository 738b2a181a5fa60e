"""A made-up episode as the graph would publish it, serialised by rclpy, without any node."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.serialization import serialize_message
from roboxim_interfaces import msg as ours
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, Image, JointState
from tf2_msgs.msg import TFMessage

from roboxim_core.actions import ActionSemantics
from roboxim_core.episode import EpisodeInfo, EpisodeResult, EpisodeStep
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, EntitySpec, PhysicalObject, RobotSpec, SceneSpec, TaskSpec
from roboxim_core.state import EntityState, RobotState, StateRecord
from roboxim_core.verdicts import Verdict
from roboxim_recorder.recording import EpisodeRecording
from roboxim_ros.messages.conversions import fill_image, fill_stamp, to_msg

CAMERAS = (CameraSpec(name="workspace", width=32, height=24, depth=True), CameraSpec(name="wrist", width=16, height=16))


@dataclass(frozen=True)
class FakeEpisode:
    """Everything of a made-up episode: what the graph publishes and what a reader must find."""

    index: int = 0
    steps: int = 5
    settle: int = 2
    outcome: str = "success"
    instruction: str = "Pick up the red cube"
    robot: str = "panda"
    color: str = "red"
    cell: str = ""

    @property
    def scene(self) -> SceneSpec:
        cube = EntitySpec(name="target", model="cube", modifiers={"color": "red", "scale": 1.5})
        return SceneSpec(robot=RobotSpec(model=self.robot), entities=(cube,), cameras=CAMERAS)

    @property
    def info(self) -> EpisodeInfo:
        target = PhysicalObject(entity="target", model="cube", name="cube", modifiers={"color": self.color})
        drawn = {"cell": self.cell} if self.cell else {}
        return EpisodeInfo(
            episode_id=f"demo-0-{self.index:05d}-0", run_seed=3, purpose="demo", index=self.index, attempt=0,
            task=TaskSpec(skill="pick_up", objects={"target": target}, instruction=self.instruction, drawn=drawn),
            scene=self.scene, semantics=ActionSemantics(), actor="expert", renderer="raster (test)",
            versions={"roboxim": "0.1.0"}, recorded={"lights": "[]"},
        )  # fmt: skip

    @property
    def last_seq(self) -> int:
        return self.steps + self.settle

    @property
    def result(self) -> EpisodeResult:
        verdict = Verdict(success=self.outcome == "success", predicates={"lift_m": 0.07})
        return EpisodeResult(
            episode_id=self.info.episode_id, index=self.index, outcome=self.outcome, steps=self.steps,
            reason="" if self.outcome == "success" else "not_lifted", last_seq=self.last_seq, verdict=verdict,
            instruction=self.instruction, skill="pick_up", final_state_hash=self.state(self.last_seq).state_hash,
        )  # fmt: skip

    def stamp_ns(self, seq: int) -> int:
        return seq * self.scene.tick_ns

    def label(self, seq: int) -> tuple[float, ...]:
        if seq == 0:
            return ()
        rng = np.random.default_rng((self.index, seq))
        moved = [*rng.uniform(-0.02, 0.02, 3), 1e-7, 0.0, 0.01 * seq, float(seq < 4)]
        return tuple(float(np.float32(value)) for value in moved)

    def state(self, seq: int) -> StateRecord:
        tcp = Pose(position=(0.4 + 0.01 * seq, 0.1, 0.3))
        joints = tuple(0.1 * i + 0.01 * seq for i in range(7))
        robot = RobotState(
            joint_names=tuple(f"j{i}" for i in range(7)), joint_positions=joints, joint_velocities=(0.0,) * 7,
            joint_commands=joints, pose_tcp_measured=tcp, pose_tcp_commanded=tcp, gripper_opening=1.0,
            gripper_command=1.0, finger_positions=(0.04, 0.04),
        )  # fmt: skip
        return StateRecord(
            episode_id=self.info.episode_id, seq=seq, stamp_ns=self.stamp_ns(seq), robot=robot,
            entities=(EntityState(name="target", pose=Pose(position=(0.5, 0.0, 0.02))),),
            action_executed=self.label(seq), state_hash=f"{self.index:016x}{seq:016x}",
        )  # fmt: skip

    def step(self, seq: int) -> EpisodeStep:
        phase = "start" if seq == 0 else "act" if seq <= self.steps else "settle"
        return EpisodeStep(
            episode_id=self.info.episode_id, seq=seq, stamp_ns=self.stamp_ns(seq), phase=phase,
            action_label=self.label(seq), action_executed=self.label(seq), verdict=Verdict(reason="not_lifted"),
        )  # fmt: skip

    def image(self, camera: str, seq: int) -> np.ndarray:
        spec = next(c for c in CAMERAS if c.name == camera)
        ramp = np.linspace(0, 200, spec.width * spec.height * 3).reshape(spec.height, spec.width, 3)
        return (ramp + 5 * seq + self.index).astype(np.uint8)

    def depth(self, seq: int) -> np.ndarray:
        return np.full((24, 32), 0.5 + 0.1 * seq, np.float32)

    def tick(self, seq: int) -> dict[str, Any]:
        """Topic to message of one tick, the step last."""
        stamp = self.stamp_ns(seq)
        found: dict[str, Any] = {
            "/clock": Clock(),
            "/joint_states": JointState(name=["j0"], position=[0.0], velocity=[0.0], effort=[0.0]),
            "/tf": TFMessage(transforms=[TransformStamped()]),
            "/sim/state": to_msg(self.state(seq), ours.StateRecord),
        }
        for camera in CAMERAS:
            found[f"/camera/{camera.name}/image"] = fill_image(Image(), self.image(camera.name, seq), "rgb8")
            found[f"/camera/{camera.name}/camera_info"] = CameraInfo(width=camera.width, height=camera.height)
        found["/camera/workspace/depth"] = fill_image(Image(), self.depth(seq), "32FC1")
        fill_stamp(found["/clock"].clock, stamp)
        fill_stamp(found["/tf"].transforms[0].header.stamp, stamp)
        for message in found.values():
            if hasattr(message, "header"):
                fill_stamp(message.header.stamp, stamp)
        crc = [zlib.crc32(m.data) if isinstance(m, Image) else 0 for m in found.values()]
        notice = ours.TickNotice(
            episode_id=self.info.episode_id,
            seq=seq,
            topics=[name[1:] for name in found],
            image_crc32=crc,
            reset=seq == 0,
        )
        fill_stamp(notice.stamp, stamp)
        return {"/sim/ticks": notice, **found, "/evaluator/step": to_msg(self.step(seq), ours.EpisodeStep)}

    def open(self, out: Path, **options: Any) -> EpisodeRecording:
        return EpisodeRecording(out, self.info, serialize_message(to_msg(self.info, ours.EpisodeInfo)), **options)

    def messages(self) -> Iterator[tuple[str, Any]]:
        for seq in range(self.last_seq + 1):
            yield from self.tick(seq).items()

    def close(self, recording: EpisodeRecording, keep: str = "keep", **changes: Any) -> str:
        result = replace(self.result, **changes)
        return recording.close(result, serialize_message(to_msg(result, ours.EpisodeResult)), keep)

    def record(self, out: Path, keep: str = "keep", **changes: Any) -> Path:
        """Record the whole episode, its result with changes, and return its bag."""
        recording = self.open(out)
        for topic, message in self.messages():
            recording.message(topic, serialize_message(message))
        return out / self.close(recording, keep, **changes)
