"""Commands and groups of ``roboxim``: an option that does not repeat is given once.

Every command is made by `command` or `group` of this module, or is a command of such a group.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import click

SHOWN = 80
"""Length to which errors cut longer words of a command line [characters]."""
NAMED = {"--out", "--task", "--skill", "--policy", "--suite", "--scene"}
"""Options whose value is a name or a folder; an empty one would stand for the default, or for the present folder."""
LONG_WORD = re.compile(rf"\S{{{3 * SHOWN},}}")


class Strict(click.Command):
    r"""A command that refuses an option given twice. A line ``\b`` of its help keeps the lines below it."""

    def __init__(self, name: str | None = None, *, help: str | None = None, **attributes: Any) -> None:
        """Make the command; arguments as of click."""
        super().__init__(name, help=help.replace("\\b\n", "\b\n") if help else help, **attributes)

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Refuse repeated options, then parse.

        Raises:
            UsageError: Naming an option that was given twice, or a value that is none of its kind, e.g. NaN.
        """
        try:
            return self._parse_once(ctx, args)
        except click.UsageError as error:
            error.__dict__["message"] = LONG_WORD.sub(lambda word: f"{word[0][:SHOWN]}...", error.message)
            raise

    def _parse_once(self, ctx: click.Context, args: list[str]) -> list[str]:
        values, _, given = self.make_parser(ctx).parse_args(args=list(args))
        empty = [option.opts[-1] for option in given if values.get(str(option.name)) == "" and NAMED & set(option.opts)]
        if empty:
            raise click.UsageError(
                f"{empty[0]} is empty, like an unset variable; name one, or leave {empty[0]} out", ctx
            )
        seen: set[str | None] = set()
        for option in given:
            if not isinstance(option, click.Option) or option.multiple or option.count:
                continue
            if option.name in seen:
                names = " or ".join(other.opts[-1] for other in self.params if other.name == option.name)
                raise click.UsageError(f"{names} was given twice; it takes one value", ctx)
            seen.add(option.name)
        left = super().parse_args(ctx, args)
        for param in self.params:
            value = ctx.params.get(str(param.name))
            for number in value if isinstance(value, tuple) else (value,):
                if isinstance(number, float) and not math.isfinite(number):  # no range of click's refuses NaN
                    raise click.BadParameter(f"{number} is no finite number.", ctx, param)
        return left


class Command(Strict):
    """A command that may announce itself."""

    def __init__(self, name: str | None = None, *, begins: str = "", **attributes: Any) -> None:
        """Make the command.

        Args:
            name: Its name.
            begins: What a command with slow imports prints at once on the error stream.
            **attributes: As of click.
        """
        super().__init__(name, **attributes)
        self.begins = begins

    def invoke(self, ctx: click.Context) -> Any:
        """Print what begins, and run the command."""
        if self.begins:
            click.echo(f"{self.begins} ...", err=True)
        return super().invoke(ctx)


class Group(Strict, click.Group):
    """A group of strict commands."""

    command_class = Command
    group_class = type

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Answer an unknown subcommand with the known ones, or with the command of ``roboxim`` that has the name."""
        name, root = args[0], ctx.find_root().command
        if not name.startswith("-") and self.get_command(ctx, name) is None:
            from roboxim_core.errors import one_of

            at_the_top = isinstance(root, click.Group) and root is not self and name in root.list_commands(ctx)
            hint = f"did you mean 'roboxim {name}'?" if at_the_top else one_of(self.list_commands(ctx), name)
            ctx.fail(f"no command '{name}' in '{ctx.command_path}'; {hint}")
        return super().resolve_command(ctx, args)


def command(name: str | None = None, *, cls: type[Command] = Command, **attributes: Any) -> Callable[[Any], Command]:
    """Return a decorator that makes a function a command; arguments as of `Command`."""
    return click.command(name, cls=cls, **attributes)


def group(name: str | None = None, *, cls: type[Group] = Group, **attributes: Any) -> Callable[[Any], Group]:
    """Return a decorator that makes a function a group of commands; arguments as of click."""
    return click.group(name, cls=cls, **attributes)
