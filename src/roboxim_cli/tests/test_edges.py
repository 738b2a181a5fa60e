"""Numbers, names and sizes at their edges, for every option of every command: taken or refused, never a traceback."""

from __future__ import annotations

import click
import pytest
from click.testing import CliRunner

from roboxim_cli.main import group
from roboxim_core.errors import RoboximError

NUMBERS = (
    "0",
    "-1",
    "1",
    "-0",
    "1e400",
    "-1e400",
    "nan",
    "inf",
    "1e-320",
    "10000000000000000000000",
    "1_0",
    "\u0663",
    "0x10",
)
NAMES = (
    "",
    " ",
    "-",
    "--",
    ".",
    "..",
    "/",
    "\u2028",
    "\u202e",
    "\U0001f916",
    "x" * 5000,
    "a,,b",
    "=",
    "a=",
    "=b",
    "a=b=c",
)
SIZES = ("0x0", "1x", "-1x-1", "9999999999x1", "x", "1/0", "0/1", "1/2/3", "2/1")
VALUES = ("\udcff", *NUMBERS, *NAMES, *SIZES)
"""Values given to every option, the first one as a terminal's bytes that are no UTF-8."""


def leaves(command=group, path=()):
    """Yield every command that is no group, with its words."""
    if not isinstance(command, click.Group):
        yield " ".join(path), command
        return
    context = click.Context(command)
    for name in command.list_commands(context):
        yield from leaves(command.get_command(context, name), (*path, name))


LEAVES = dict(leaves())


def refused(do):
    """Do something; return what it was refused with, or none. Any other error is passed on."""
    try:
        do()
    except (click.ClickException, click.exceptions.Exit, click.exceptions.Abort, RoboximError) as error:
        return error
    return None


def arguments(command):
    """Return a value for each of a command's required arguments."""
    return [
        "missing.yaml" if not isinstance(param.type, click.Choice) else str(param.type.choices[0])
        for param in command.params
        if isinstance(param, click.Argument) and param.required
    ]


@pytest.mark.thorough
@pytest.mark.parametrize("name", LEAVES)
def test_values_at_their_edges_are_taken_or_refused_as_they_are_parsed(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = LEAVES[name]
    for param in command.params:
        if not isinstance(param, click.Option) or param.is_flag:
            continue
        for value in VALUES:
            words = [f"{param.opts[0]}={value}" if param.opts[0].startswith("--") else f"{param.opts[0]}{value}"]
            given = words + arguments(command)

            def parse(given=given):
                with command.make_context(name, list(given)):
                    pass

            try:
                error = refused(parse)
            except Exception as fault:
                raise AssertionError(f"roboxim {name} {param.opts[0]} {value[:60]!r}: {fault!r}") from fault
            if isinstance(error, click.ClickException):
                assert len(error.format_message()) < 3000, (
                    f"roboxim {name} {param.opts[0]}: its error repeats the value"
                )


@pytest.mark.parametrize(
    "words",
    [
        ("tasks", "sample", "--seed", "-1"),
        ("tasks", "sample", "--episodes", "0"),
        ("generate", "--episodes", "-3", "--out", "run"),
        ("generate", "--workers", "0", "--out", "run"),
        ("generate", "--workers", "99999999", "--shard", "3/2", "--out", "run"),
        ("generate", "--size", "0", "--out", "run"),
        ("evaluate", "--episodes", "nan", "--policy", "zero"),
        ("evaluate", "--policy", "", "--out", "run"),
        ("evaluate", "--policy", "x" * 5000, "--out", "run"),
        ("generate", "--task", "x" * 5000, "--out", "run"),
        ("generate", "--task", "", "--out", "run"),
        ("generate", "--out", ""),
        ("dataset", "info", "x" * 5000),
        ("merge", "", "--out", "run"),
        ("experiment", "unpack", "", "--out", "run"),
    ],
    ids=lambda words: " ".join(words)[:60],
)
def test_commands_refuse_what_has_no_meaning_in_a_sentence(words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(group, words)
    assert result.exit_code
    assert isinstance(result.exception, (SystemExit, RoboximError, OSError)), result.exception  # `main` says these
    assert len(result.output) < 5000
    assert not list(tmp_path.iterdir())
