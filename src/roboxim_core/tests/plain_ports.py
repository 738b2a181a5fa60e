"""Ports of the episode loop, implemented in plain Python."""

import numpy as np

from roboxim_core.episode import Draw, EpisodeRunner, Ports, RunConfig
from roboxim_core.errors import ErrorCode, TaskError
from roboxim_core.policies import ActionChunk, Observation, PolicyDescription
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, SceneSpec, TaskSpec, WorkspaceSpec
from roboxim_core.state import RobotState, StateRecord
from roboxim_core.verdicts import NOT_HELD, Verdict

ROBOT = RobotState(
    joint_names=(), joint_positions=(), joint_velocities=(), joint_commands=(), pose_tcp_measured=Pose(),
    pose_tcp_commanded=Pose(), gripper_opening=1.0, gripper_command=0.25,
)  # fmt: skip


class World:
    """Scene, sim, judge and recorder in one; success when x has travelled far enough and not slid back."""

    renderer = "none"

    def __init__(self, goal=3.0, slides_back=False):
        self.goal, self.slides_back = goal, slides_back
        self.log, self.steps, self.closed, self.executed = [], [], [], []
        self.infeasible_attempts = 0
        self.entities, self.settled = (), ()
        self.begins_at, self.leaves_at, self.held = 0.0, -1, True

    def draw(self, seed, task_config):
        if seed.attempt < self.infeasible_attempts:
            raise TaskError("no room", ErrorCode.RESET_INFEASIBLE)
        task = TaskSpec(skill="go", objects={}, instruction=f"go {seed.index}")
        scene = SceneSpec(
            cameras=(CameraSpec(name="workspace"), CameraSpec(name="wrist")), entities=self.entities,
            workspace=WorkspaceSpec(on_leave="fail"),
        )  # fmt: skip
        return Draw(task=task, scene=scene, max_steps=8)

    def load(self, episode_id, scene, semantics):
        self.semantics = semantics
        self.x, self.scene = self.begins_at, scene
        return StateRecord(episode_id=episode_id, seq=0, stamp_ns=0, robot=ROBOT, entities=self.settled)

    def tick(self, episode_id, seq, action):
        assert not self.unwritten, "the simulator goes on before the recorder has the tick"
        self.executed.append(action)
        moved = float(action[0])
        self.x += moved if moved or not self.slides_back else -5.0
        return StateRecord(
            episode_id=episode_id, seq=seq, stamp_ns=seq, robot=ROBOT, action_executed=tuple(map(float, action)),
            left_workspace=seq == self.leaves_at,
        )  # fmt: skip

    def observe(self, state, cameras):
        images = {name: np.full((2, 2, 3), state.seq, np.uint8) for name in cameras}
        return Observation(seq=state.seq, stamp_ns=state.stamp_ns, images=images)

    def release(self, episode_id):
        self.log.append("release")

    def start(self, episode_id, task, state):
        self.ever = False
        return self.judge(state)

    def judge(self, state):
        solved = self.x >= self.goal
        success = solved and self.held
        self.ever |= success
        reason = "" if success else NOT_HELD if solved else "not_there"
        return Verdict(success=success, success_ever=self.ever, reason=reason)

    def open(self, info):
        self.log.append("open")
        self.info = info
        self.steps = []
        self.unwritten = False

    def step(self, step):
        self.steps.append(step)
        self.unwritten = True

    def wait_written(self):
        self.unwritten = False

    def close(self, result, keep, received=()):
        self.closed.append((result, keep))
        self.received = received
        return f"{keep}/{result.episode_id}"

    def abort(self):
        self.log.append("abort")


class Actor:
    def __init__(self, act=None, **description):
        self.description = PolicyDescription(**{"name": "test", **description})
        self.windows, self.starts = [], []
        self._act = act or (lambda window: np.array([[1.0, 0, 0, 0, 0, 0, 1.0]], np.float32))

    def describe(self):
        return self.description

    def reset(self, start):
        self.starts.append(start)

    def act(self, window):
        self.windows.append(window)
        answer = self._act(window)
        return answer if isinstance(answer, ActionChunk) else ActionChunk(actions=answer)


def run(world, actor, repeat=(), **config):
    ports = Ports(scenes=world, sim=world, actor=actor, judge=world, recorder=world, clock=lambda: 0.0)
    return EpisodeRunner(ports, RunConfig(**{"output_dir": "/out", "settle_ticks": 2, **config}), repeat=repeat)
