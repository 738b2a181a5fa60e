"""The ``roboxim`` command: finds its subcommands by file name and imports only the one that runs."""

from __future__ import annotations

import errno
import importlib
import io
import os
import re
import signal
import sys
from functools import cache
from pathlib import Path
from types import FrameType

import click
from click.shell_completion import CompletionItem

from roboxim_cli import strict

DISK_ERRORS = {
    errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS, errno.ENOTDIR, errno.EEXIST, errno.ENOENT,
    errno.ELOOP, errno.EIO,
}  # fmt: skip
"""Errors of the system that a user can cause or mend, by a path or by the disk: they are said in one line."""
FOLDERS = ("commands", "ros")
"""Folders with a file for each subcommand, at any depth."""
SECTIONS = {
    "The main job": (
        "demo", "tasks", "generate", "merge", "export", "dataset", "pretrain", "train", "evaluate", "sweep", "report",
    ),
    "Experiments": ("experiment", "benchmark", "audit-benchmark", "correlate"),
    "Why a policy fails": ("explain", "compare-policies", "mine"),
    "Running the graph": ("up", "down", "node", "policy", "runs", "env", "doctor", "upgrade-check"),
    "Planning": ("planner",),
    "Recordings": ("show", "bag", "replay", "rerender", "view"),
    "Datasets": ("dataset",),
    "Objects and files": ("assets", "schema"),
    "In a browser": ("studio",),
    "Inspecting a running graph (spelled as in ros2)": (
        "node", "service", "topic", "action", "param", "interface",
    ),
}  # fmt: skip


@cache
def command_files() -> dict[str, Path]:
    """Return the files of the subcommands, by name; one whose name begins with ``_`` is none."""
    here = Path(__file__).parent
    files = {path.stem.replace("_", "-"): path for folder in FOLDERS for path in (here / folder).rglob("[a-z]*.py")}
    return dict(sorted(files.items()))


class LazyGroup(strict.Group):
    """The group of the subcommands in ``commands/`` and ``ros/``."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the names of the files."""
        return list(command_files())

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        """Import a subcommand."""
        path = command_files().get(cmd_name)
        if path is None:
            return None
        parts = path.relative_to(Path(__file__).parents[1]).with_suffix("").parts
        command: click.Command = importlib.import_module(".".join(parts)).command
        return command

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """Answer an unknown name with a suggestion."""
        name = args[0]
        if not name.startswith("-") and name not in self.list_commands(ctx):
            from roboxim_core.errors import one_of

            inside = " or ".join(f"'roboxim {group} {name}'" for group in self._groups_with(ctx, name))
            hint = f"did you mean {inside}?" if inside else one_of(self.list_commands(ctx), name)
            ctx.fail(f"no command '{name}'; {hint}")
        return super().resolve_command(ctx, args)

    def _groups_with(self, ctx: click.Context, name: str) -> list[str]:
        """Return the names of the subcommands that have a subcommand of this name."""
        groups = ((known, self.get_command(ctx, known)) for known in self.list_commands(ctx))
        return [
            known for known, group in groups if isinstance(group, strict.Group) and name in group.list_commands(ctx)
        ]

    def invoke(self, ctx: click.Context) -> object:
        """Run a subcommand. Its exit code ends the process; without standalone mode click would return the code."""
        try:
            return super().invoke(ctx)
        except click.exceptions.Exit as end:
            sys.exit(end.exit_code)

    def shell_complete(self, ctx: click.Context, incomplete: str) -> list[CompletionItem]:
        """Complete a subcommand's name without importing any."""
        names = [name for name in self.list_commands(ctx) if name.startswith(incomplete)]
        options = click.Command.shell_complete(self, ctx, incomplete)
        return [*(CompletionItem(name, help=short_help(name)) for name in names), *options]

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the subcommands by section, without importing them."""
        names = self.list_commands(ctx)
        listed = {name for section in SECTIONS.values() for name in section}
        sections = {**SECTIONS, "Other": tuple(name for name in names if name not in listed)}
        for title, members in sections.items():
            rows = [(name, short_help(name)) for name in members if name in names]
            if rows:
                with formatter.section(title):
                    formatter.write_dl(rows)


def short_help(name: str) -> str:
    """Return the first line of a subcommand's docstring, read from its file."""
    with open(command_files()[name]) as file:
        found = re.match(r'"""(.*?)\.?(""")?$', file.readline().rstrip())
    return found.group(1) if found else ""


@strict.group(
    cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"]},
    invoke_without_command=True, no_args_is_help=True,
)  # fmt: skip
@click.option("--version", "show_version", is_flag=True, help="Print the version and end.")
@click.option("--json", "as_json", is_flag=True, help="With --version: versions of packages and formats, as JSON.")
@click.option(
    "--events", type=click.Path(path_type=Path, dir_okay=False, writable=True), metavar="FILE",
    help="Append the command's progress to FILE, one JSON object a line, for programs.",
)  # fmt: skip
@click.pass_context
def group(ctx: click.Context, show_version: bool, as_json: bool, events: Path | None) -> None:
    """Generate, record and evaluate robot manipulation on a ROS 2 node graph."""
    if as_json and not show_version:
        ctx.fail("--json belongs to --version here; a command's own --json follows the command's name")
    if show_version:
        click.echo(versions_text(as_json))
        ctx.exit()
    if ctx.invoked_subcommand is None:
        ctx.fail("Missing command.")
    if events is not None:
        os.environ["ROBOXIM_EVENTS"] = str(events.absolute())  # EventPrinter writes into it


def versions_text(as_json: bool) -> str:
    """Return RoboXim's version; as JSON also those of Python, the packages that results depend on, and formats."""
    from importlib import metadata

    if not as_json:
        return f"roboxim {metadata.version('roboxim')}"
    import json
    import platform

    from roboxim_eval.node import versions
    from roboxim_runs.storage.compatibility import FORMATS

    return json.dumps(
        {
            **{"roboxim": metadata.version("roboxim"), "python": platform.python_version()},
            **{"system": f"{platform.system()} {platform.machine()}", "packages": versions(), "formats": FORMATS},
        },
        indent=2,
    )


def _terminate(number: int, _: FrameType | None) -> None:
    """End as on Ctrl-C: cancel goals, end workers, close files."""
    sys.exit(128 + number)


LONGEST_WORD = 200
"""Characters of a word of the command line that an error repeats whole."""


def _shortened(text: str) -> str:
    """Return an error in which long words of the command line are cut off."""
    words = {part for word in sys.argv for part in (word, word[2:], word.partition("=")[2]) if len(part) > LONGEST_WORD}
    for word in sorted(words, key=len, reverse=True):
        text = text.replace(word, f"{word[:40]}... ({len(word)} characters)")
    return text


def main() -> None:
    """Run the command line. Exit codes: 0, 1 for an error, 2 for wrong usage or configuration, 130 for Ctrl-C."""
    from roboxim_ros.environment import start_clean

    start_clean()
    parent = os.environ.pop("ROBOXIM_PARENT", None)
    if parent is not None:
        from roboxim_bringup.process import die_with_parent

        die_with_parent(int(parent))
    from roboxim_core.errors import ConfigError, InvalidRequestError, RoboximError

    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # an argument may be bytes that are no UTF-8
    signal.signal(signal.SIGTERM, _terminate)
    try:
        group.main(prog_name="roboxim", standalone_mode=False)
    except click.ClickException as error:
        error.message = _shortened(error.message)  # type: ignore[misc]
        error.show()
        sys.exit(error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        click.echo("interrupted", err=True)
        sys.exit(130)
    except RoboximError as error:
        wrong_usage = isinstance(error, ConfigError | InvalidRequestError)
        message = _shortened(str(error))
        click.echo(f"error: {message}" if wrong_usage else f"error: {message} [{error.code.name}]", err=True)
        sys.exit(2 if wrong_usage else 1)
    except ModuleNotFoundError as error:
        from roboxim_core.plain_data.extras import explained

        if (missing := explained(error)) is None:
            raise
        click.echo(f"error: {missing}", err=True)
        sys.exit(2)
    except BrokenPipeError:  # e.g. piped into head
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except OSError as error:
        if error.errno == errno.ENAMETOOLONG:
            click.echo(f"error: '{str(error.filename)[:40]}...' is too long for a file's name or path", err=True)
            sys.exit(2)
        if error.errno == errno.EISDIR:
            click.echo(f"error: {error.filename} is a folder; expected the name of a file", err=True)
            sys.exit(2)
        if error.errno not in DISK_ERRORS:
            raise
        path = f"{error.filename}: " if error.filename else ""
        full = error.errno in (errno.ENOSPC, errno.EDQUOT)
        advice = "free some space, and run again" if full else "check the path and its permissions, or choose another"
        click.echo(f"error: {path}{error.strerror}; {advice} [DISK]", err=True)
        sys.exit(1)
