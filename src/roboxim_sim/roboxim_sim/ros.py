"""The standard ROS interfaces of a simulator and an arm: `simulation_interfaces`, trajectory and gripper actions."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

from control_msgs.action import FollowJointTrajectory, GripperCommand
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from simulation_interfaces.action import SimulateSteps
from simulation_interfaces.msg import Result, SimulationState, SimulatorFeatures
from simulation_interfaces.srv import (
    DeleteEntity,
    GetEntities,
    GetEntityState,
    GetSimulationState,
    GetSimulatorFeatures,
    ResetSimulation,
    SetEntityState,
    SetSimulationState,
    SpawnEntity,
    StepSimulation,
)

from roboxim_core import limits
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError, RoboximError
from roboxim_core.poses import Pose
from roboxim_core.specs import EntitySpec
from roboxim_ros.messages.conversions import pose_from_msg
from roboxim_sim.controllers import ArmController, GripperController, Turn, published_states
from roboxim_sim.conversions import entity_state_msg, model_of_uri, vector
from roboxim_sim.name_filter import name_filter
from roboxim_sim.ports import SimServer

RESULT_OF_CODE = {
    ErrorCode.UNKNOWN_ENTITY: Result.RESULT_NOT_FOUND,
    ErrorCode.UNKNOWN_MODEL: Result.RESULT_NOT_FOUND,
    ErrorCode.NO_SCENE: Result.RESULT_INCORRECT_STATE,
    ErrorCode.LEASE_HELD: Result.RESULT_INCORRECT_STATE,
}
FEATURES = (
    SimulatorFeatures.SPAWNING,
    SimulatorFeatures.DELETING,
    SimulatorFeatures.ENTITY_STATE_GETTING,
    SimulatorFeatures.ENTITY_STATE_SETTING,
    SimulatorFeatures.SIMULATION_RESET,
    SimulatorFeatures.SIMULATION_STATE_GETTING,
    SimulatorFeatures.SIMULATION_STATE_SETTING,
    SimulatorFeatures.STEP_SIMULATION_SINGLE,
    SimulatorFeatures.STEP_SIMULATION_MULTIPLE,
    SimulatorFeatures.STEP_SIMULATION_ACTION,
)


class StandardServices:
    """The services of `simulation_interfaces` that apply to a lockstep tabletop simulation."""

    def __init__(self, node: SimServer) -> None:
        """Offer the services on a node."""
        self._node, self._world = node, node.world
        for kind, name, handler in (
            (ResetSimulation, "reset_simulation", self._reset),
            (GetEntities, "get_entities", self._get_entities),
            (GetEntityState, "get_entity_state", self._get_entity_state),
            (SetEntityState, "set_entity_state", self._set_entity_state),
            (SpawnEntity, "spawn_entity", self._spawn),
            (DeleteEntity, "delete_entity", self._delete),
            (GetSimulationState, "get_simulation_state", self._get_state),
            (SetSimulationState, "set_simulation_state", self._set_state),
        ):
            node.serve(kind, f"sim/{name}", _answering_ok(handler))
        node.serve(GetSimulatorFeatures, "sim/get_simulator_features", self._features)
        # A reentrant group: stepping yields to the executor, so that requests that stop it are received.
        node.serve(StepSimulation, "sim/step_simulation", self._step, callback_group=ReentrantCallbackGroup())

    def _features(self, _: Any, response: Any) -> None:
        response.features.features = list(FEATURES)
        response.features.spawn_formats = ["roboxim"]
        info = {**self._node.renderer_info, "episode_id": self._world.episode_id}
        response.features.custom_info = json.dumps(info)

    def _reset(self, request: Any, response: Any) -> None:
        if request.scope not in (request.SCOPE_DEFAULT, request.SCOPE_ALL):
            response.result.result = Result.RESULT_FEATURE_UNSUPPORTED
            response.result.error_message = "the world is always rebuilt completely; use SCOPE_ALL"
            return
        self._world.require_free("reset the simulation")
        self._node.load(self._world.first_scene)

    async def _step(self, request: Any, response: Any) -> None:
        deadline = time.monotonic() + self._node.config.motion_timeout_s
        for record in self._world.steps(int(request.steps)):
            if record is not None:
                self._node.publish(record)
            elif time.monotonic() > deadline:
                raise self._node.overtime()
            await Turn(self._node)
        response.result.result = Result.RESULT_OK

    def _get_entities(self, request: Any, response: Any) -> None:
        filters = request.filters
        if filters.categories or filters.tags.tags or filters.bounds.type:
            response.result.result = Result.RESULT_FEATURE_UNSUPPORTED
            response.result.error_message = "only the name filter is supported"
            return
        pattern = name_filter(filters.filter)
        response.entities = [e.name for e in self._world.record.entities if pattern.search(e.name)]

    def _get_entity_state(self, request: Any, response: Any) -> None:
        record = self._world.record
        self._world.require_entity(request.entity)
        response.state = entity_state_msg(record.stamp_ns, record.entity(request.entity))

    def _set_entity_state(self, request: Any, response: Any) -> None:
        state = request.state
        record = self._world.set_entity_state(
            request.entity, _pose_in_world(state), vector(state.twist.linear), vector(state.twist.angular)
        )
        self._node.publish(record)

    def _spawn(self, request: Any, response: Any) -> None:
        taken = {entity.name for entity in self._world.scene.entities}
        if request.entity_namespace:
            response.result.result = response.NAMESPACE_INVALID
            response.result.error_message = "entities have no ROS interfaces of their own; leave entity_namespace empty"
            return
        if request.entity_resource.resource_string and not request.entity_resource.uri:
            response.result.result = response.UNSUPPORTED_FORMAT
            response.result.error_message = "resource_string is not read; give a uri, e.g. cube or roboxim://cube"
            return
        code = response.NO_RESOURCE  # if the next step fails
        try:
            model, modifiers = model_of_uri(request.entity_resource.uri)
            name = request.name or model
            if name in taken and request.allow_renaming:
                name = next(f"{name}_{n}" for n in range(1, len(taken) + 2) if f"{name}_{n}" not in taken)
            if name in taken:
                response.result.result = response.NAME_NOT_UNIQUE
                response.result.error_message = f"the name '{name}' is taken"
                return
            code = response.NAME_INVALID
            limits.require_name("entity", name, self._world.reserved_names)
            code = response.INVALID_POSE
            pose = _pose_in_world(request.initial_pose)
            entity = EntitySpec(name=name, model=model, modifiers=modifiers, pose=pose)
            code = response.NO_RESOURCE
            self._world.library.entity_model(entity)
        except (ConfigError, InvalidRequestError) as error:
            response.result.result = code
            response.result.error_message = str(error)
            return
        self._world.spawn_entity(entity)
        try:
            self._node.scene_changed()
        except Exception:  # e.g. a texture that does not exist
            self._world.delete_entity(name)
            self._node.scene_changed()
            raise
        response.entity_name = name

    def _delete(self, request: Any, response: Any) -> None:
        self._world.delete_entity(request.entity)
        self._node.scene_changed()

    def _get_state(self, request: Any, response: Any) -> None:
        if not self._world.loaded:
            response.state.state = SimulationState.STATE_STOPPED
        elif self._world.moving:
            response.state.state = SimulationState.STATE_PLAYING
        else:
            response.state.state = SimulationState.STATE_PAUSED

    def _set_state(self, request: Any, response: Any) -> None:
        wanted = request.state.state
        if wanted == SimulationState.STATE_PAUSED and self._world.moving:
            self._world.stop_motion()
        elif wanted == SimulationState.STATE_PAUSED and self._world.loaded:
            response.result.result = response.ALREADY_IN_TARGET_STATE
        elif wanted == SimulationState.STATE_STOPPED:
            self._world.require_free("reset the simulation")
            self._node.load(self._world.first_scene)
        else:
            response.result.result = response.INCORRECT_TRANSITION
            response.result.error_message = "time moves on request only (step_simulation, tick, actions): always paused"


def _pose_in_world(stamped: Any) -> Pose:
    """Return the pose of a message with a header.

    Raises:
        InvalidRequestError: When it is in another frame than the world, is not finite, or is no rotation.
    """
    if stamped.header.frame_id not in ("", "world"):
        raise InvalidRequestError(f"poses are given in frame 'world', got '{stamped.header.frame_id}'")
    return pose_from_msg(stamped.pose)


def _answering_ok(handler: Callable[[Any, Any], None]) -> Callable[[Any, Any], None]:
    """Return a handler whose response reports success, unless the handler sets another result or raises."""

    def answer(request: Any, response: Any) -> None:
        response.result.result = Result.RESULT_OK
        handler(request, response)

    return answer


class MotionActions:
    """The trajectory, gripper and stepping actions. They advance time themselves and run only outside an episode."""

    def __init__(self, node: SimServer) -> None:
        """Offer the actions on a node."""
        self._node, self._world = node, node.world
        arm, gripper = ArmController(node), GripperController(node)
        self._servers = [
            node.serve_action(FollowJointTrajectory, "arm_controller/follow_joint_trajectory", arm.follow),
            node.serve_action(GripperCommand, "gripper_controller/gripper_cmd", gripper.grip),
            node.serve_action(SimulateSteps, "sim/simulate_steps", self._simulate),
        ]

    def destroy(self) -> None:
        """Destroy the servers."""
        for server in self._servers:
            server.destroy()

    async def _simulate(self, goal: ServerGoalHandle) -> Any:
        result = SimulateSteps.Result()
        result.result.result = Result.RESULT_OK
        total, done = int(goal.request.steps), 0
        try:
            async for _ in published_states(self._node, goal, self._world.ticks(total)):
                done = min(done + self._world.steps_per_tick, total)
                goal.publish_feedback(SimulateSteps.Feedback(completed_steps=done, remaining_steps=total - done))
            if done < total:
                goal.canceled()
            else:
                goal.succeed()
        except RoboximError as error:
            goal.abort()
            result.result.result = RESULT_OF_CODE.get(error.code, Result.RESULT_OPERATION_FAILED)
            result.result.error_message = f"{error.code.name}: {error}"
        return result
