"""Hatch build hook that adds `config/` and stand-alone servers to a wheel, unless the installation is editable."""

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ConfigurationHook(BuildHookInterface):
    """Add `config/` to roboxim_core, and stand-alone servers to roboxim_policies, which look for them there."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add both to the build, unless the build is editable."""
        if version != "editable":
            build_data["force_include"]["config"] = "roboxim_core/config"
            build_data["force_include"]["src/roboxim_policies/servers"] = "roboxim_policies/stand_alone"
