"""Put the configuration into the wheel of RoboXim; an editable installation reads that of the checkout."""

from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class ConfigurationHook(BuildHookInterface):
    """Add `config/` to roboxim_core, where `roboxim_core.config` looks for it."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add it to what is built, unless that is editable."""
        if version != "editable":
            build_data["force_include"]["config"] = "roboxim_core/config"
