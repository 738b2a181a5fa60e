"""Policies: their base class and server, the policies that ship with RoboXim, and the training of ``bc``."""

from roboxim_policies import builtin, remote, reworded  # importing a module registers its policies
from roboxim_policies.base import POLICIES, BasePolicy, load_policy

__all__ = ["POLICIES", "BasePolicy", "builtin", "load_policy", "remote", "reworded"]
