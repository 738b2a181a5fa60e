"""Numbers, names and sizes at their edges, for every option of every command: taken or refused, never a traceback."""

from __future__ import annotations

import signal
import sys

import click
import pytest
from click.testing import CliRunner

from roboxim_cli.main import group, main
from roboxim_core.errors import InvalidRequestError, RoboximError
from roboxim_datasets.formats import FORMATS
from roboxim_recorder.export import EXPORTERS

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


SIGNED = {"--threshold", "--ensemble-decay"}
"""Options whose value may be below 0."""


def number_options():
    """Yield each command that takes a number, with it."""
    for name, command in LEAVES.items():
        for param in command.params:
            if isinstance(param.type, click.types.IntParamType | click.types.FloatParamType):
                yield name, param


def configuration(name):
    """Return the configuration whose fields are options of a command without ranges of their own."""
    kind, word, *rest = name.split()
    if kind == "export":
        return EXPORTERS[word]().config
    assert (kind, word) == ("dataset", "convert"), f"roboxim {name} has a number without a range"
    return FORMATS[rest[0]]().options


def test_every_number_is_finite_and_in_a_range(tmp_path, monkeypatch):
    monkeypatch.setattr("roboxim_cli.named.fresh_catalog", lambda _: None)
    found = list(number_options())
    assert len(found) > 100
    for name, param in found:
        others = [one for one in LEAVES[name].params if isinstance(one, click.Option) and one.required]
        rest = [word for one in others if one is not param for word in (one.opts[0], filler(one))]
        places = [
            str(tmp_path if getattr(one.type, "dir_okay", True) else __file__)
            if isinstance(one.type, click.Path)
            else filler(one)
            for one in LEAVES[name].params
            if isinstance(one, click.Argument) and one.required
        ]
        ranged = isinstance(param.type, click.IntRange | click.FloatRange)
        for value in ("nan", "inf", "-inf", *([] if param.opts[0] in SIGNED or not ranged else ["-1"])):
            if isinstance(param, click.Option):
                words = [*rest, param.opts[0], value, *places]
            else:
                words = [*rest, *places, "--", value]
            with pytest.raises(click.BadParameter) as refusal:
                LEAVES[name].make_context(name, words)
            assert refusal.value.param is param, f"roboxim {name}: {refusal.value.format_message()}"
            assert refusal.value.exit_code == 2
        if not ranged and param.opts[0] not in SIGNED:
            with pytest.raises(InvalidRequestError):
                configuration(name)(**{param.name: -1})


AT_THE_DOOR = ("0", "-1", str(2**63), "9" * 5000, "1e400", "nan", "inf", "", "x" * 5000, "\u202e\U0001f916", "\udcff")
"""Values with which the commands themselves are called."""


class Started(BaseException):
    """The command took the value and began its work."""


def start(*_, **__):
    """Stand for the beginning of long work: a process, a connection, a node."""
    raise Started


@pytest.fixture
def stopped_at_the_door(monkeypatch, runtime):
    """Let commands check what they are given, and end where they would begin processes, connections or drawing."""
    here = runtime / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    for name in ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME"):
        monkeypatch.setenv(name, str(runtime))
    for place in (
        "subprocess.Popen.__init__", "os.fork", "os.kill", "socket.socket.listen", "socket.socket.connect",
        "multiprocessing.Process.start", "rclpy.init", "roboxim_sim.rendering.make_renderer",
        "viser.ViserServer.__init__",
    ):  # fmt: skip
        monkeypatch.setattr(place, start)
    before = signal.signal(signal.SIGALRM, start), signal.getsignal(signal.SIGTERM)
    yield here
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before[0])
    signal.signal(signal.SIGTERM, before[1])


def filler(param):
    """Return a harmless value of a required parameter."""
    if isinstance(param.type, click.Choice):
        return str(param.type.choices[0])
    if not isinstance(param.type, click.types.IntParamType | click.types.FloatParamType):
        return "missing"
    return str(max(1, getattr(param.type, "min", None) or 1))


def calls(name):
    """Yield an option, a value, and the words of a call of a command with them."""
    params = LEAVES[name].params
    given = [filler(param) for param in params if isinstance(param, click.Argument) and param.required]
    for param in params:
        if not isinstance(param, click.Option) or param.is_flag:
            continue
        others = [one for one in params if isinstance(one, click.Option) and one.required and one is not param]
        rest = [word for one in others for word in (one.opts[0], filler(one))]
        for value in AT_THE_DOOR:
            word = f"{param.opts[0]}={value}" if param.opts[0].startswith("--") else f"{param.opts[0]}{value}"
            yield param.opts[0], value, [*name.split(), *rest, word, *given]


@pytest.mark.slow
@pytest.mark.timeout(0)  # it takes the alarm itself
@pytest.mark.parametrize("name", LEAVES)
def test_every_command_refuses_an_edge_in_a_line_or_begins(name, stopped_at_the_door, monkeypatch, capfd):
    """The last one with bytes that are no UTF-8; a command that computes for 30 s has begun."""
    for option, value, words in calls(name):
        monkeypatch.setattr(sys, "argv", ["roboxim", *words])
        case = f"roboxim {name} {option} {ascii(value[:20])}"
        signal.alarm(30)
        try:
            main()
            code = 0
        except Started:
            code = 0
        except SystemExit as error:
            code = error.code
        except BaseException as error:
            raise AssertionError(f"{case}: {error!r}") from error
        finally:
            signal.alarm(0)
        said = capfd.readouterr().err
        assert "Traceback" not in said, case
        assert len(said) < 4000, f"{case}: {said[:300]}"
        assert not code or said.strip(), f"{case}: it says nothing"


@pytest.mark.parametrize(
    "words",
    [
        ("tasks", "sample", "--seed", "-1"),
        ("tasks", "sample", "--episodes", "0"),
        ("generate", "--episodes", "-3", "--out", "run"),
        ("generate", "--episodes", str(2**63), "--out", "run"),
        ("assets", "sheet", "--out", "sheet"),
        ("dataset", "view", "missing", "--out", "9" * 3000),
        ("gymnasium", "serve", "--host", "\U0001f916"),
        ("generate", "--workers", "0", "--out", "run"),
        ("compare-policies", "zero", "random", "--episodes", "1000000000000"),
        ("correlate", __file__, __file__, "--names", "a,a"),
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
