"""The policy options of commands that run single episodes in this process."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from roboxim_runs.policies.specs import ChosenPolicy


def policy_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add ``--checkpoint`` and ``--option``, as `evaluate` has them."""
    for decorate in (
        click.option(
            "--option", "policy_options", multiple=True, metavar="[NAME.]KEY=VALUE",
            help="Argument of policy NAME, or of the first policy; may be repeated.",
        ),
        click.option(
            "--checkpoint", "checkpoints", multiple=True, metavar="[NAME=]PATH",
            help="Checkpoint (file or folder) of policy NAME, or of the policies that take one; may be repeated.",
        ),
    ):  # fmt: skip
        function = decorate(function)
    return function


def chosen(policies: Sequence[str], checkpoints: Sequence[str], options: Sequence[str]) -> list[ChosenPolicy]:
    """Return the policies that were named.

    Raises:
        ConfigError: When one is unknown or does not take its options.
    """
    from roboxim_runs.policies.specs import choose_policies

    return choose_policies(policies, checkpoints, options)
