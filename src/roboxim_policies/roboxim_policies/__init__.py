"""Policies: their base class and server, the policies that ship with RoboXim, and the training of ``bc``."""

from roboxim_policies.base import POLICIES, BasePolicy, load_policy

__all__ = ["POLICIES", "BasePolicy", "load_policy"]
