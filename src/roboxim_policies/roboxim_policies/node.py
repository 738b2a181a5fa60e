"""The policy node: serves one policy under a namespace, ``policy`` by default."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.context import Context

from roboxim_core.policies import Policy
from roboxim_core.policy_guard import GuardedPolicy
from roboxim_policies.base import load_policy
from roboxim_ros.host import NodeHost, wait_for_stop
from roboxim_ros.node import RoboximNode
from roboxim_ros.policy_service import PolicyService


class PolicyNode(RoboximNode):
    """The node that serves ``describe_policy``, ``reset_policy`` and ``act`` in its namespace.

    An exception of the policy becomes an error in the answer and a traceback in the log; the node continues.
    """

    def __init__(
        self,
        policy: str | Policy = "random",
        *,
        context: Context,
        namespace: str = "policy",
        parameters: dict[str, Any] | None = None,
        **options: Any,
    ) -> None:
        """Load the policy and serve it.

        Args:
            policy: A policy, or an argument of `load_policy`: a registered name, ``module:Class``, ``file.py:Class``.
            context: An initialised rclpy context.
            namespace: Namespace of the services, e.g. ``policy`` or ``/w0/policy``.
            parameters: Overrides of parameters, by name.
            **options: Keyword arguments of the policy's class.

        Raises:
            ConfigError: When there is no such policy or it does not take the options.
            PolicyError: When the policy gives no valid description.
        """
        super().__init__("policy", context=context, namespace=namespace, parameters=parameters)
        made = load_policy(policy, **options) if isinstance(policy, str) else policy
        self.guard = GuardedPolicy(made, log=lambda text: self.get_logger().error(text))
        PolicyService(self, self.guard)


def serve(
    policy: str | Policy,
    namespace: str = "policy",
    *,
    domain_id: int | None = None,
    on_ready: Callable[[PolicyNode], None] = lambda node: None,
    should_stop: Callable[[], bool] = lambda: False,
    **options: Any,
) -> int:
    """Serve a policy in this process until a signal arrives or ``should_stop`` returns True.

    Args:
        policy: See `PolicyNode`.
        namespace: Namespace of its services.
        domain_id: ROS domain; None: the environment's.
        on_ready: Called with the node once it serves.
        should_stop: Called five times per second; True stops the node.
        **options: Keyword arguments of the policy's class.

    Returns:
        The signal that ended it, or 0.

    Raises:
        ConfigError: When there is no such policy or it does not take the options.
        PolicyError: When it does not describe itself.
    """
    with NodeHost(domain_id=domain_id) as host:
        node = host.add(lambda context: PolicyNode(policy, context=context, namespace=namespace, **options))
        return wait_for_stop(lambda: should_stop() or not host.alive(), on_waiting=lambda: on_ready(node))
