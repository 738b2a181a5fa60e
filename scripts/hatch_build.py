"""Hatch build hook that adds `config/` to RoboXim's wheel; an editable installation reads the checkout's."""

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ConfigurationHook(BuildHookInterface):
    """Add `config/` to roboxim_core, where `roboxim_core.config` looks for it."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add `config/` to the build, unless the build is editable."""
        if version != "editable":
            build_data["force_include"]["config"] = "roboxim_core/config"
