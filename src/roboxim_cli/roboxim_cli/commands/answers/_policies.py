"""The options that give policies their arguments, and the policies that commands of single episodes choose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from roboxim_cli.options import with_options

if TYPE_CHECKING:
    from roboxim_runs.policies.specs import ChosenPolicy


policy_options = with_options(
    click.option(
        "--checkpoint", "checkpoints", multiple=True, metavar="[NAME=]PATH",
        help="Checkpoint (file or folder) of policy NAME, or of the policies that take one; may be repeated.",
    ),
    click.option(
        "--option", "policy_options", multiple=True, metavar="[NAME.]KEY=VALUE",
        help="Argument of policy NAME, or of the first policy; may be repeated.",
    ),
)  # fmt: skip
"""Adds ``--checkpoint`` and ``--option``, which give the named policies their arguments."""


def chosen(policies: Sequence[str], checkpoints: Sequence[str], options: Sequence[str]) -> list[ChosenPolicy]:
    """Return the policies that were named.

    Raises:
        ConfigError: When one is unknown or does not take its options.
    """
    from roboxim_runs.policies.specs import choose_policies

    return choose_policies(policies, checkpoints, options)
