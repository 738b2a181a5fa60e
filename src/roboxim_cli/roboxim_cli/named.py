"""Option types with known names, for tab completion and for refusing unknown names before heavy imports."""

from __future__ import annotations

import contextlib
from typing import Any

import click
from click.shell_completion import CompletionItem

from roboxim_cli.catalog import PART_OF, fresh_catalog, names_of
from roboxim_core.config_folders import config_names, is_path
from roboxim_core.errors import ConfigError, RoboximError, one_of


class Named(click.ParamType[str]):
    """The name of a skill, task, object, camera, renderer, policy or convention."""

    name = "name"

    def __init__(self, kind: str, *names: str) -> None:
        """Complete the names of a kind.

        Args:
            kind: As for `roboxim_cli.catalog.names_of`.
            names: Further names.
        """
        self.kind = kind
        self._names = names

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Refuse unknown names. A policy may also be a class or a file, a task a file.

        Raises:
            ConfigError: When the name is unknown; the message suggests the nearest.
        """
        text = str(value)
        if self.kind == "skill" and ".py" in text:
            return text  # a skill of a file, which whoever loads it checks
        if not text or is_path(text) or ":" in text or "=" in text or text.endswith(".py"):
            return text
        known = self._known()
        for name in text.split(",") if self.kind == "skill" else (text,):
            if known and name.strip() not in known and not self._is_refused(name):
                hint = _as_benchmark(name) if self.kind == "experiment" else ""
                raise ConfigError(f"unknown {self.kind} '{name}'; {hint or one_of(known, name)}")
        return text

    def _is_refused(self, text: str) -> bool:
        """Tell whether the name is a policy server's that RoboXim refuses; whoever finds the policy says why."""
        if self.kind != "policy":
            return False
        from roboxim_policies.wires import REFUSED

        return text.replace("-", "_") in REFUSED

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:
        """Return the names that begin with the typed text; in a list or after ``ROLE=``, with its last part."""
        head, separator, last = incomplete.rpartition("," if "," in incomplete else "=")
        with contextlib.suppress(RoboximError):
            names = sorted({*names_of(self.kind), *self._names})
            return [CompletionItem(head + separator + name) for name in names if name.startswith(last)]
        return []

    def _known(self) -> list[str]:
        """Return all valid names, or none when they are not certain."""
        if self.kind == "renderer":  # plug-ins may add renderers, which the catalog does not hold
            return []
        if self.kind not in PART_OF:
            return names_of(self.kind)
        kept = (fresh_catalog(PART_OF[self.kind]) or {}).get("skills" if self.kind == "skill" else "policies", {})
        return sorted({*kept, *self._names}) if kept else []


def _as_benchmark(name: str) -> str:
    """Return how a benchmark is run and planned whose name was given for an experiment's; empty: it is no benchmark."""
    if name not in config_names("benchmark"):
        return ""
    return f"it is a benchmark: roboxim benchmark {name}, or roboxim experiment plan --benchmark {name}"


class Models(Named):
    """``[ROLE=]MODEL[,MODEL]``: object models of a role."""

    name = "models"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        """Refuse unknown objects.

        Raises:
            ConfigError: When an object is unknown; the message suggests the nearest.
        """
        text = str(value)
        known = names_of(self.kind)
        for model in (part.strip() for part in text.rpartition("=")[2].split(",")):
            if model and model not in known:
                raise ConfigError(f"--object {text}: unknown object '{model}'; {one_of(known, model)}")
        return text
