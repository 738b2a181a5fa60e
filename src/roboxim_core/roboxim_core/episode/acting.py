"""From a policy's answers to the action of each tick: chunks, latency, conversion to the executed meaning, gripper."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from roboxim_core.actions import (
    ActionArray,
    ActionContext,
    ActionPlan,
    ActionSemantics,
    ActionTransform,
    GripperSwitch,
    MotionLag,
    hold_action,
)
from roboxim_core.actions.transforms import Target, action_of
from roboxim_core.episode.records import RunConfig
from roboxim_core.errors import ErrorCode, InvalidRequestError, PolicyError
from roboxim_core.policies import ActionChunk, PolicyDescription
from roboxim_core.specs import SceneSpec
from roboxim_core.state import StateRecord


@dataclass(frozen=True, kw_only=True, eq=False)
class TickAction:
    """The executed action of a tick."""

    action: ActionArray
    """float32, shape (D,), of the executed meaning."""
    phase: str = ""
    """Phase that the actor gave it."""
    held: bool = False
    """Whether the robot holds still because no answer has arrived."""


def holding_action(state: StateRecord, semantics: ActionSemantics) -> ActionArray:
    """Return the action that keeps the commanded joints and gripper.

    Args:
        state: The state before the action.
        semantics: Meaning of the action, one that the simulator executes.
    """
    if not semantics.control.is_joint_space:
        return hold_action(state.robot.gripper_command)
    target = Target(joints=state.robot.joint_commands, opening=state.robot.gripper_command)
    return action_of(target, semantics, ActionContext.of(state)).astype(np.float32)


class Acting:
    """The actions of one episode. The episode loop adds answers and takes one action per tick."""

    def __init__(
        self, description: PolicyDescription, config: RunConfig, scene: SceneSpec, semantics: ActionSemantics
    ) -> None:
        """Start an episode.

        Args:
            description: The policy's description.
            config: Configuration of the run.
            scene: The scene, with the episode's control rate.
            semantics: Meaning in which the simulator executes, see `ActionSemantics.executed`.
        """
        self.semantics = semantics
        self._description = description
        self._config = config
        self._scene = scene
        self._declared = replace(description.semantics, rate_hz=scene.control_rate_hz)
        self._plan = ActionPlan(config.chunking(description.chunking), self._declared, one_at_a_time=config.real_time)
        same_motion = replace(self._declared, gripper=semantics.gripper) == semantics
        self._transform = None if same_motion else ActionTransform.between(self._declared, semantics)
        self._rule = config.gripper(description.gripper)
        self._switch: GripperSwitch | None = None
        self._lag = MotionLag(description.lag)
        self.delays: list[int] = []
        """Delay of each answer [ticks]."""

    def due(self, seq: int) -> bool:
        """Return whether a request to the policy is due at a tick."""
        return self._plan.due(seq)

    def finished(self, seq: int) -> bool:
        """Return whether the actor has finished and left no action for a tick."""
        return self._plan.finished(seq)

    def add(self, chunk: ActionChunk, state: StateRecord, took_s: float) -> None:
        """Add an answer.

        Args:
            chunk: The checked answer.
            state: The tick of its observation.
            took_s: Wall time that it took [s]; used in real time only.

        Raises:
            PolicyError: With code ``INVALID_ACTION`` when the number of joints is not the robot's.
        """
        self._require_joints(chunk.actions, state)
        delay = self._config.latency_ticks
        if self._config.real_time:
            delay += math.ceil(took_s * self._scene.control_rate_hz)
        self.delays.append(delay)
        self._plan.add(state.seq, delay, chunk.actions, chunk.phases, done=chunk.done)

    def action(self, state: StateRecord) -> TickAction:
        """Return the action that follows a state; hold still if no answer has arrived.

        Raises:
            PolicyError: With code ``INVALID_ACTION`` when an action's numbers have no meaning, e.g. no rotation.
        """
        planned = self._plan.action(state.seq)
        if planned is None:
            self._lag.rest()
            return TickAction(action=holding_action(state, self.semantics), held=True)
        action = self._switched(self._converted(self._lag.step(planned.action), state), state)
        return TickAction(action=action, phase=planned.phase)

    def _converted(self, action: ActionArray, state: StateRecord) -> ActionArray:
        """Return an action in the executed meaning; motion numbers that need no conversion are not touched."""
        if self._declared == self.semantics:
            return action
        if self._transform is None:
            converted = action.copy()
            converted[-1] = self._declared.gripper.opening(float(action[-1]))
            return converted
        try:
            context = ActionContext.of(state, self._scene.robot.pose)
            return self._transform.apply(action, context).astype(np.float32)
        except InvalidRequestError as error:
            raise PolicyError(
                f"policy '{self._description.name}' at tick {state.seq}: {error}", ErrorCode.INVALID_ACTION
            ) from None

    def _switched(self, action: ActionArray, state: StateRecord) -> ActionArray:
        """Return an action with the gripper command of the gripper rule."""
        if not self._rule.binary:
            return action
        self._switch = self._switch or GripperSwitch(self._rule, state.robot.gripper_command)
        action = action.copy()
        action[-1] = self._switch.step(float(action[-1]))
        return action

    def _require_joints(self, actions: ActionArray, state: StateRecord) -> None:
        if not self._declared.control.is_joint_space:
            return
        names = state.robot.joint_names
        if actions.shape[1] != len(names) + 1:
            raise PolicyError(
                f"policy '{self._description.name}' answered {actions.shape[1]} numbers, but "
                f"'{self._declared.control}' of the robot '{self._scene.robot.model}' takes {len(names) + 1}: "
                f"{', '.join(names)}, gripper; choose a task with the robot that the policy was trained with",
                ErrorCode.INVALID_ACTION,
            )
