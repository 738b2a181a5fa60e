"""Check, compare and convert datasets."""

from __future__ import annotations

import importlib
from pathlib import Path

import click

_PREFIX = "_dataset_"


class _Subcommands(click.Group):
    """A group with one subcommand for each ``_dataset_<name>.py`` beside this file, imported when it runs."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the files, with the subcommands that are registered here."""
        files = Path(__file__).parent.glob(f"{_PREFIX}*.py")
        return sorted({*super().list_commands(ctx), *(file.stem.removeprefix(_PREFIX) for file in files)})

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a subcommand."""
        registered = super().get_command(ctx, cmd_name)
        if registered is not None or cmd_name not in self.list_commands(ctx):
            return registered
        command: click.Command = importlib.import_module(f"{__package__}.{_PREFIX}{cmd_name}").command
        return command


@click.group(cls=_Subcommands)
def command() -> None:
    """Check, compare and convert datasets."""
