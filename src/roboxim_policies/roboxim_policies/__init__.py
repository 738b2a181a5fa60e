"""The policy side: the base class and server of policies, the shipped ones, and the training of ``bc``."""

from roboxim_policies.base import POLICIES, BasePolicy, load_policy

__all__ = ["POLICIES", "BasePolicy", "load_policy"]
