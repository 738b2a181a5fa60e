"""RoboXim as a benchmark of vla-eval: its orchestrator, and with it all of its model servers, drive RoboXim's tasks.

    benchmarks:
      - benchmark: "roboxim.vla_eval:RoboXimBenchmark"
        episodes_per_task: 20
        params: {tasks: [pick_cube], convention: vla_eval_libero, seed: 0}

``convention: server`` is that of the policy that ``roboxim policy serve --wire vla-eval`` serves.

Needs the extra ``vla-eval``.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from vla_eval.benchmarks.base import StepBenchmark, StepResult
from vla_eval.specs import GRIPPER_01, GRIPPER_CLOSE_NEG, GRIPPER_CLOSE_POS, IMAGE_RGB, LANGUAGE, RAW, DimSpec

from roboxim_core.actions import ControlMode
from roboxim_core.config import from_json
from roboxim_core.conventions import Convention, decode_actions, load_convention, observe
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError
from roboxim_core.policies import ObservationWindow
from roboxim_core.rotation.representations import RotationRepresentation
from roboxim_policies.fitting_vla_eval import param_misfits
from roboxim_policies.remote import SERVERS_OWN
from roboxim_policies.wires.openpi import OWN_SERVER
from roboxim_policies.wires.own import own_extras
from roboxim_policies.wires.parts import last_part
from roboxim_policies.wires.vla_eval import observation
from roboxim_runs.environments.session import EpisodeSession, SessionConfig

ROTATIONS = {
    RotationRepresentation.ROTATION_VECTOR: "axis_angle",
    RotationRepresentation.EULER_XYZ_EXTRINSIC: "euler_xyz",
    RotationRepresentation.QUATERNION_XYZW: "quaternion_xyzw",
    RotationRepresentation.ROTATION_6D_INTERLEAVED: "rot6d_interleaved",
}
"""vla-eval's words; another representation is declared as RoboXim calls it."""


class RoboXimBenchmark(StepBenchmark):  # type: ignore[misc]  # vla-eval has no types
    """Tasks of RoboXim; episode ``episode_idx`` of a task is the one that ``roboxim evaluate`` gives for that index.

    Non-obvious behaviours:

    - Observations and actions are those of a RoboXim *convention*, so a model that was trained on LIBERO gets LIBERO's
      pictures, state and units. ``roboxim policy describe NAME`` explains one.
    - An action is one row: vla-eval's servers keep the chunk themselves.
    - The last step includes one second in which the robot holds still before the verdict.
    - With ``convention: server`` an observation has the measurements as they are, the episode and its seed beside what
      the convention asks for, so that a policy acts as in ``roboxim evaluate``.
    - Real-time modes hold by a null action, which exists for deltas and velocities without normalisation only.
    """

    render_backends: ClassVar[frozenset[str]] = frozenset({"gpu", "cpu"})

    def __init__(
        self,
        tasks: Sequence[str] = ("pick_cube",),
        convention: str = "vla_eval_libero",
        seed: int = 0,
        max_steps: int = 0,
        renderer: str = "raster",
        out: str = "",
        send_wrist_image: bool = True,
        send_state: bool = True,
        server_convention: str = "",
        absolute_action: bool | None = None,
        quat_no_antipodal: bool | None = None,
        control_mode: str | None = None,
        send_video_history: bool | None = None,
    ) -> None:
        """Read the convention; the tasks are read when they begin.

        Args:
            tasks: Tasks of ``config/tasks``, or YAML files.
            convention: A name in ``config/conventions``, a YAML file, or ``server``: that of RoboXim's own server.
            seed: Seed of the run.
            max_steps: Actions per episode; 0: as the tasks say.
            renderer: ``raster`` or ``tiny``.
            out: Folder for bags of the episodes; empty: nothing is recorded.
            send_wrist_image: Whether pictures of wrist cameras are sent.
            send_state: Whether the state is sent.
            server_convention: The convention of RoboXim's own server as JSON; vla-eval fills it in from the server's
                ``observation_params``.
            absolute_action: Whether the actions are absolute poses, as a model server declares; none: it does not.
            quat_no_antipodal: Whether the state's rotation vector follows robosuite's quaternion, likewise.
            control_mode: Mode of ManiSkill's controller, likewise.
            send_video_history: Whether earlier pictures are sent, likewise; RoboXim cannot.

        Raises:
            ConfigError: When there is no such convention, it says otherwise than the model server, or it is ``server``
                and the server declares none.
        """
        super().__init__()
        self._tasks = [tasks] if isinstance(tasks, str) else list(tasks)
        self._own = convention == SERVERS_OWN
        self._convention = _declared(server_convention) if self._own else load_convention(convention)
        declared = {"absolute_action": absolute_action, "quat_no_antipodal": quat_no_antipodal,
                    "control_mode": control_mode, "send_video_history": send_video_history}  # fmt: skip
        if found := param_misfits(declared, self._convention):
            raise ConfigError(
                f"the model server does not fit the convention '{self._convention.name}': {'; '.join(found)}. Choose "
                "the convention that its model was trained in (params: convention)"
            )
        self._seed, self._max_steps, self._renderer, self._out = seed, max_steps, renderer, out
        sent = {"send_wrist_image": send_wrist_image, "send_state": send_state}
        self._leave_out = [name for name, send in sent.items() if not send]
        self._name = ""
        self._session: EpisodeSession | None = None

    @classmethod
    def configure_render(cls, mode: str) -> dict[str, str]:
        """Change nothing: the renderer finds a GPU itself, and needs none."""
        return {}

    def get_tasks(self) -> list[dict[str, Any]]:
        """Return one entry per task."""
        return [{"name": task, "suite": "roboxim", "task": task} for task in self._tasks]

    def reset(self, task: dict[str, Any]) -> ObservationWindow:
        """Begin an episode."""
        if self._session is None or self._name != task["task"]:
            self.cleanup()
            self._session, self._name = self._make_session(task["task"]), task["task"]
        return self._session.start(self._seed, int(task.get("episode_idx", 0)))

    def step(self, action: dict[str, Any]) -> StepResult:
        """Execute one action of the convention."""
        given = np.atleast_2d(np.asarray(action.get("actions", action.get("action")), dtype=float))
        if given.shape[0] != 1:
            raise InvalidRequestError(
                f"an action is one row of {self._convention.action.raw_size} numbers, got shape {given.shape}; let the "
                "model server keep its chunk (chunk_size)",
                ErrorCode.INVALID_ACTION,
            )
        assert self._session is not None
        row = decode_actions(self._convention, given)[0]
        answer = self._session.step(row)
        self._recorder.record_step(action=given[0].astype(np.float32))
        if not isinstance(answer, EpisodeResult):
            return StepResult(obs=answer, reward=0.0, done=False, info={})
        if answer.outcome == "error":
            raise InvalidRequestError(f"{answer.reason}: {answer.message}", ErrorCode.INVALID_ACTION)
        return StepResult(obs=None, reward=float(answer.outcome == "success"), done=True, info={"result": answer})

    def make_obs(self, raw_obs: ObservationWindow, task: dict[str, Any]) -> dict[str, Any]:
        """Return what the model server receives."""
        convention = self._convention
        sent = observation(observe(convention, raw_obs), convention.prompt.key, leave_out=self._leave_out)
        if self._own:
            assert self._session is not None
            sent[OWN_SERVER] = {**own_extras(raw_obs), "seed": self._session.begun.seed}
        return sent

    def get_step_result(self, step_result: StepResult) -> dict[str, Any]:
        """Return success, and why not."""
        result: EpisodeResult | None = step_result.info.get("result")
        if result is None:
            return {"success": False, "reason": "not_ended"}
        return {"success": result.outcome == "success", "reason": result.reason, "clipped": result.clipped}

    def get_metadata(self) -> dict[str, Any]:
        """Return the limit of actions and what is evaluated."""
        limit = self._max_steps or max(self._make_session(task).max_steps for task in self._tasks)
        return {"max_steps": limit, "convention": self._convention.name, "seed": self._seed}

    def get_hold_action(self, last_action: dict[str, Any] | None) -> dict[str, Any]:
        """Return the action that keeps the arm where it is, with the last gripper.

        Raises:
            NotImplementedError: When the convention's actions have no null action.
        """
        action = self._convention.action
        if not action.control.is_relative or action.normalisation is not None:
            raise NotImplementedError(f"convention '{self._convention.name}' has no null action")
        row = np.zeros(action.raw_size, np.float32)
        row[-1] = action.gripper.open if last_action is None else np.atleast_2d(last_action["actions"])[0, -1]
        return {"actions": row}

    def get_action_spec(self) -> dict[str, DimSpec]:
        """Declare the convention's actions in vla-eval's words, so that it warns of a server of another kind."""
        action = self._convention.action
        if action.control.is_joint_space:
            return {"joints": DimSpec("joints", action.raw_size - 1, str(action.control)), "gripper": self._gripper()}
        relative = action.control == ControlMode.END_EFFECTOR_DELTA
        return {
            "position": DimSpec("position", 3, "delta_xyz" if relative else "absolute_xyz"),
            "rotation": DimSpec("rotation", action.rotation.size, ROTATIONS.get(action.rotation, str(action.rotation))),
            "gripper": self._gripper(),
        }

    def get_observation_spec(self) -> dict[str, DimSpec]:
        """Declare the convention's pictures and state."""
        spec = {
            last_part(image.key): IMAGE_RGB
            for image in self._convention.images
            if not ("send_wrist_image" in self._leave_out and "wrist" in image.key)
        }
        if self._convention.states and "send_state" not in self._leave_out:
            spec["state"] = RAW
        return {**spec, "language": LANGUAGE}

    def cleanup(self) -> None:
        """Free physics and renderer."""
        if self._session is not None:
            self._session.close()
        self._session = None

    def _gripper(self) -> DimSpec:
        gripper = self._convention.action.gripper
        if {gripper.open, gripper.closed} == {0.0, 1.0} and gripper.open > gripper.closed:
            return GRIPPER_01
        return GRIPPER_CLOSE_POS if gripper.closed > gripper.open else GRIPPER_CLOSE_NEG

    def _make_session(self, task: str) -> EpisodeSession:
        convention = self._convention
        return EpisodeSession(SessionConfig(
            task=task, semantics=convention.semantics, gripper=convention.action.gripper.rule,
            lag=convention.action.lag, cameras=convention.cameras, max_steps=self._max_steps, renderer=self._renderer,
            out=self._out,
        ))  # fmt: skip


def _declared(convention: str) -> Convention:
    """Return the convention that RoboXim's own server declares.

    Raises:
        ConfigError: When there is none, or it is damaged.
    """
    if not convention:
        raise ConfigError(
            "convention: server needs a server that declares its convention, and this one does not: only `roboxim "
            "policy serve --wire vla-eval` without --convention does. Name the convention that the model was trained "
            "in, e.g. convention: vla_eval_libero, or the one that it is served in"
        )
    return from_json(convention, Convention, source="the convention that the server declares")
