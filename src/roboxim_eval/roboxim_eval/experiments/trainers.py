"""Trainers of an experiment: how a policy is trained on a dataset, and how its checkpoints are evaluated.

A trainer is an entry of an experiment's ``trainers``, or a separate file, ``config/trainers/NAME.yaml``.
"""

from __future__ import annotations

import string
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from roboxim_core.config import from_plain
from roboxim_core.errors import ConfigError

TRAINERS = "trainers"
"""Folder of ``config`` with trainers."""
RLDS = "rlds"
"""Format of datasets unless a trainer names another one."""
FORMAT = "format"
"""Key of a trainer's ``dataset`` that names the format; the others are options of its export."""
IN_COMMAND = ("dataset", "out", "seed", "steps")
IN_OPTIONS = ("checkpoint", "dataset", "convention", "condition", "replicate")
IN_SERVE = ("checkpoint", "dataset", "condition", "replicate")
"""Placeholders of a trainer's texts."""


@dataclass(frozen=True, kw_only=True)
class TrainerConfig:
    """How to train a policy."""

    LEFT_OUT_AT_DEFAULT: ClassVar[tuple[str, ...]] = ("dataset", "options", "serve")
    """Later fields, see `roboxim_core.config.LEFT_OUT`: cards and stages without them keep their hashes."""

    command: str = ""
    """Command with ``{dataset}``, ``{out}``, ``{seed}`` and ``{steps}``; empty: the policies are trained elsewhere."""
    policy: str = ""
    """Policy that runs a checkpoint, as for ``roboxim evaluate --policy``; empty: named by ``--policy``."""
    steps: int = 0
    """Training steps."""
    until: str = ""
    """Arguments that end the same training after ``{until}`` steps, e.g. ``--until {until}``, for the checkpoints of a
    learning curve; the command without them continues it. Empty: the trainer has no such arguments, so there is no
    curve."""
    dataset: dict[str, Any] = field(default_factory=dict)
    """Datasets that it reads: ``format`` (``rlds`` by default) and options of that format's export, by the names that
    ``roboxim.export_rlds`` and ``export_lerobot`` take them by, e.g. ``{format: lerobot, version: "3.0"}``."""
    options: dict[str, Any] = field(default_factory=dict)
    """Arguments of the policy, as for ``roboxim evaluate --option``. Texts may hold ``{checkpoint}`` (folder of the
    training), ``{dataset}`` (folder of its dataset), ``{convention}`` (the convention's file in that dataset),
    ``{condition}`` and ``{replicate}``. Empty: ``checkpoint`` alone."""
    serve: str = ""
    """Command that serves a ``{checkpoint}`` at the ``url`` of the options while it is evaluated, for policies that run
    in an environment of their own; empty: the policy needs no server."""

    def __post_init__(self) -> None:
        """Check the texts.

        Raises:
            ConfigError: When a placeholder is missing or unknown, or keys do not go together.
        """
        if self.steps < 0:
            raise ConfigError(f"steps must be >= 0, got {self.steps}")
        if self.until and "{until}" not in self.until:
            raise ConfigError(f"until: needs {{until}}, got '{self.until}'")
        if self.command:
            _require_placeholders("command", self.command, IN_COMMAND)
            for name in ("dataset", "out", "seed"):
                if f"{{{name}}}" not in self.command:
                    raise ConfigError(f"command: needs {{{name}}}, got '{self.command}'")
        texts = [*_texts(self.options), self.serve]
        for text in _texts(self.options):
            _require_placeholders("options", text, IN_OPTIONS)
        if self.serve:
            _require_placeholders("serve", self.serve, IN_SERVE)
            if "{checkpoint}" not in self.serve:
                raise ConfigError(f"serve: needs {{checkpoint}}, got '{self.serve}'")
            if not isinstance(self.options.get("url"), str):
                raise ConfigError("serve: needs options.url, the address at which the command serves the checkpoint")
        if self.options and not self.policy:
            raise ConfigError("options: are arguments of a policy; name it with policy")
        if self.options and self.command and not any("{checkpoint}" in text for text in texts):
            raise ConfigError(
                "options: none has {checkpoint}, so that every training would be evaluated with the same policy; write "
                "e.g. checkpoint: '{checkpoint}'"
            )
        if not isinstance(self.format, str):
            raise ConfigError(f"dataset: format must be a name, e.g. {RLDS} or lerobot, got {self.format!r}")

    @property
    def is_own(self) -> bool:
        """Whether it is one of RoboXim's own trainers, which start from random weights and use RoboXim's axes."""
        return self.command.startswith("roboxim train ")

    @property
    def format(self) -> str:
        """Format of its datasets."""
        name: str = self.dataset.get(FORMAT, RLDS)
        return name

    @property
    def export(self) -> dict[str, Any]:
        """Options of its datasets' export."""
        return {key: value for key, value in self.dataset.items() if key != FORMAT}

    def filled_options(self, **values: str) -> dict[str, Any]:
        """Return the policy's arguments for a checkpoint.

        Args:
            **values: Value of each placeholder of `IN_OPTIONS`.
        """
        filled: dict[str, Any] = _filled(self.options, values)
        return filled or {"checkpoint": values["checkpoint"]}


def trainer_config(data: Any, *, source: str) -> TrainerConfig:
    """Build a trainer from the plain data of its own file.

    Raises:
        ConfigError: When keys are wrong; names each with its path and line.
    """
    config: TrainerConfig = from_plain({} if data is None else data, TrainerConfig, source=source)
    return config


def _texts(value: Any) -> Iterable[str]:
    """Yield the texts of plain data."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        for item in value.values():
            yield from _texts(item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _texts(item)


def _filled(value: Any, values: Mapping[str, str]) -> Any:
    """Return plain data with the placeholders of its texts replaced."""
    if isinstance(value, str):
        return value.format(**values)
    if isinstance(value, Mapping):
        return {key: _filled(item, values) for key, item in value.items()}
    return [_filled(item, values) for item in value] if isinstance(value, list | tuple) else value


def _require_placeholders(key: str, text: str, known: tuple[str, ...]) -> None:
    """Refuse a text with other placeholders than the known ones.

    Raises:
        ConfigError: Naming the first one, or what is wrong with the text's braces.
    """
    expected = f"expected {', '.join(f'{{{name}}}' for name in known)}; a brace itself is written twice"
    try:
        names = [name for _, name, _, _ in string.Formatter().parse(text) if name is not None]
        unknown = [name for name in names if name not in known]
        if not unknown:
            text.format(**{name: 0 if name in ("seed", "steps") else "" for name in known})
    except ValueError as error:
        raise ConfigError(f"{key}: {error} in '{text}'; {expected}") from None
    if unknown:
        raise ConfigError(f"{key}: unknown placeholder '{unknown[0]}' in '{text}'; {expected}")
