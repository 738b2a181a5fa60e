"""Command-line options that several commands share."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from roboxim_cli.named import Models, Named

RENDERERS = ("photo", "raster", "tiny")
"""The built-in renderers; `doctor` reports which of them work on this machine."""
Decorator = Callable[[Any], Any]
Number = TypeVar("Number", int, float)
T = TypeVar("T")
POSITIVE = click.FloatRange(0, min_open=True)
"""Type of a number above 0."""


class Place(click.ParamType[Path | str]):
    """A path, or the URL of a store."""

    name = "path or URL"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path | str:
        """Return a URL as a text, and anything else as a path."""
        return str(value) if "://" in str(value) else Path(value)


def executor_options() -> list[Decorator]:
    """Return the options that choose what runs the episodes."""
    return [
        click.option(
            "--executor", type=click.Choice(["local", "ray"]), default="local", show_default=True,
            help="Run the workers on this machine, or on a Ray cluster; needs roboxim[ray].",
        ),
        click.option(
            "--address", default="", metavar="ADDRESS",
            help="Ray cluster, e.g. auto or ray://host:10001; default: one on this machine, for this run.",
        ),
        click.option(
            "--resources", default="", metavar="NAME=N,...",
            help="What a worker takes of a Ray node, e.g. CPU=2,GPU=0.25; default: CPU=1.",
        ),
    ]  # fmt: skip


def parse_resources(option: str, text: str) -> dict[str, float]:
    """Parse ``CPU=2,GPU=0.25``; ``cpu`` and ``gpu`` may be written in small letters.

    Raises:
        ConfigError: When the text is something else.
    """
    taken = _numbers(option, text, float, "N", "CPU=2,GPU=0.25")
    return {name.upper() if name.lower() in ("cpu", "gpu") else name: amount for name, amount in taken.items()}


def parse_counts(option: str, text: str) -> dict[str, int]:
    """Parse ``train=90,val=10``.

    Raises:
        ConfigError: When the text is something else.
    """
    return _numbers(option, text, int, "COUNT", "train=90,val=10")


def _numbers(option: str, text: str, kind: Callable[[str], Number], word: str, example: str) -> dict[str, Number]:
    """Parse ``NAME=NUMBER,...`` with finite numbers from 0.

    Raises:
        ConfigError: When the text is something else, or has a name twice.
    """
    from roboxim_core.errors import ConfigError

    found: dict[str, Number] = {}
    for part in filter(None, text.split(",")):
        name, _, number = (piece.strip() for piece in part.partition("="))
        try:
            value: Number | None = kind(number)
        except ValueError:
            value = None
        if not name or name in found or value is None or not 0 <= value < float("inf"):
            raise ConfigError(f"{option} is NAME={word},... with {word} from 0, e.g. {example}; got '{text}'")
        found[name] = value
    return found


def make_executor(executor: str, address: str, resources: str, workers: int, *, option: str = "--resources") -> Any:
    """Return what runs the episodes, or the trainings; none: the run's own choice, processes of this machine.

    Args:
        executor: ``local`` or ``ray``.
        address: Address of the Ray cluster; empty: one on this machine.
        resources: ``NAME=N,...``; empty: one CPU.
        workers: Number of workers.
        option: Name of the option with the resources, for errors.

    Raises:
        ConfigError: When Ray is not installed, or an option does not fit.
    """
    from roboxim_core.errors import ConfigError

    if executor == "local":
        if address or resources:
            raise ConfigError(f"--address and {option} are for --executor ray")
        return None
    from roboxim_runs.executors.ray_cluster import RayExecutor

    return RayExecutor(workers, address=address, resources=parse_resources(option, resources) or None, option=option)


def make_policy_servers(executor: str, address: str, resources: str, servers: int, out: Path) -> list[Any]:
    """Return what runs the policy servers of an evaluation; none: each worker has the policies itself.

    Args:
        executor: ``local`` or ``ray``.
        address: Address of the Ray cluster; empty: one on this machine.
        resources: What a server takes of a Ray node, ``NAME=N,...``; empty: nothing.
        servers: Number of servers of each policy; 0: one if ``resources`` are given.
        out: Folder of the evaluation.

    Raises:
        ConfigError: When Ray is not installed, or an option does not fit.
    """
    from roboxim_core.errors import ConfigError

    taken = parse_resources("--policy-resources", resources)
    if executor == "local":
        if taken:
            raise ConfigError("--policy-resources is for --executor ray; --policy-servers works without")
        from roboxim_runs.executors import LocalExecutor

        return [LocalExecutor(1, log_dir=out / ".policy-servers" / str(number)) for number in range(servers)]
    from roboxim_runs.executors.ray_cluster import RayExecutor

    wanted = {"CPU": 0.0, **taken}
    return [RayExecutor(1, address=address, resources=wanted) for _ in range(servers or bool(taken))]


def _joined(_: click.Context, __: click.Parameter, values: tuple[str, ...]) -> str:
    """Return the values of an option that repeats as one text with commas."""
    return ",".join(values)


SHARED: dict[str, dict[str, Any]] = {
    "task": dict(type=Named("task"), default="", show_default="pick_cube", help="Task of config/tasks or YAML file."),
    "skill": dict(
        type=Named("skill"), multiple=True, callback=_joined, metavar="NAME[,NAME]",
        help="A skill instead of a task, or several, which share the episodes; roboxim tasks list shows them.",
    ),
    "suite": dict(type=Named("suite"), default="", help="Suite of config/suites instead, e.g. core."),
    "object": dict(
        name="objects", type=Models("object"), multiple=True, metavar="[ROLE=]MODEL[,MODEL]",
        help="Object models of the target, or of another role; may be repeated.",
    ),
    "distractors": dict(default="", metavar="N|A-B", help="Distractors in the scene, e.g. 1-3."),
    "colors": dict(default="", metavar="A,B", help="Colours of the target, e.g. red,blue."),
    "camera": dict(
        name="cameras", multiple=True, metavar="NAME[=VIEW]",
        help="Camera, at the pose of its file of config/cameras or of another one; may be repeated.",
    ),
    "light": dict(
        name="lights", multiple=True, metavar="NAME",
        help="Lighting: a name in config/lights or a YAML file; may be repeated, one is drawn for each episode.",
    ),
    "texture": dict(
        name="textures", multiple=True, metavar="SURFACE=NAME",
        help="Texture of table, floor or wall, e.g. table=marble or table=./oak.jpg; may be repeated.",
    ),
    "look": dict(
        default="", metavar="SET[/LOOK]",
        help="Set of looks in config/looks, drawn for each episode, e.g. varied; or one: varied/oak_daylight.",
    ),
    "robot": dict(type=Named("robot"), default="", help="Arm in config/robots that stands in the scene instead."),
    "out": dict(type=click.Path(path_type=Path), show_default=True),
    "episodes": dict(type=click.IntRange(1), show_default=True),
    "seed": dict(type=click.IntRange(0), default=0, show_default=True, help="Seed of the run."),
    "workers": dict(type=click.IntRange(1), show_default=True, help="Processes."),
    "size": dict(default="as-configured", show_default=True, metavar="SIZE|WIDTHxHEIGHT"),
    "rate": dict(
        type=click.FloatRange(0), default=0.0, metavar="HZ",
        help="Control rate; 0: the policy's, or the task's if the policy acts at any rate.",
    ),
    "renderer": dict(
        type=Named("renderer", *RENDERERS), default="raster", show_default=True,
        help="raster (needs EGL), tiny (PyBullet's own), or photo (Blender; slow).",
    ),
    "depth": dict(is_flag=True, help="Also record depth."),
    "segmentation": dict(is_flag=True, help="Also record segmentation."),
    "shard": dict(
        default="", metavar="I/N",
        help="Run only the I-th of N parts of the episodes, in a folder of its own; roboxim merge joins them.",
    ),
    "store": dict(
        default="", metavar="URL",
        help="Upload bags and results, e.g. to s3://bucket/demos; OUT keeps the results. Needs roboxim[store].",
    ),
    "scale": dict(default="full", show_default=True, help="Scale of the file: smoke, laptop, night or full."),
    "trainer": dict(
        default="", metavar="NAME",
        help="Trainer: a name in the file or in config/trainers, or a YAML file; default: the file's first one.",
    ),
    "trainings": dict(
        type=click.IntRange(1), default=1, show_default=True, metavar="N",
        help="Trainings at a time; they share processors and GPUs. Results do not depend on it.",
    ),
    "repair": dict(
        is_flag=True, help="Repeat episodes whose bag or result is lost or damaged, instead of refusing to continue.",
    ),
}  # fmt: skip
"""Options that several commands have, which mean the same everywhere; a command may change the help and the default."""


TASK_CHANGES = ("object", "distractors", "colors", "camera", "light", "texture", "look", "robot")
"""Options that change a task."""
TASK_WORDS = ("task", "skill", "suite", *TASK_CHANGES)
"""Options that choose a task and change it, as `roboxim_runs.episodes.task_choice.task_text` takes them."""


ABSENT_IS_ZERO = dict(default=None, callback=lambda _context, _option, value: value or 0)
"""Settings of a count that is 0 when it is not given; a given 0 is refused, since it would mean the default."""


def option(*words: str, **changes: Any) -> Decorator:
    """Return a decorator that adds a shared option.

    Args:
        *words: Its name in `SHARED`, without dashes, after a short form such as ``-s`` if there is one.
        **changes: What differs in this command.
    """
    settings = {**SHARED[words[-1]], **changes}
    name = settings.pop("name", words[-1])
    return click.option(*words[:-1], f"--{words[-1]}", name, **settings)


def with_options(*decorators: Decorator) -> Decorator:
    """Return a decorator that adds options in the given order."""

    def decorate(command: Any) -> Any:
        for add in reversed(decorators):
            command = add(command)
        return command

    return decorate


def film_options() -> Decorator:
    """Return a decorator that adds the options of a report's films; their values are fields of `FilmOptions`."""
    return with_options(
        click.option(
            "--films", "scenes", type=click.IntRange(0), metavar="SCENES",
            help="Scenes whose films the report shows, with a page for each episode; 0: none.  [default: 6]",
        ),
        click.option(
            "--film-scenes", "only", metavar="I,J,...", help="Numbers of these scenes, instead of a choice by outcome."
        ),
        click.option(
            "--film-frames", "frames", type=click.IntRange(2), metavar="N",
            help="Frames of a film in the report; an episode's page has all.  [default: 24]",
        ),
        click.option(
            "--film-px", "height", type=click.IntRange(16), metavar="PX",
            help="Largest height of a film's frame in the report.  [default: 192]",
        ),
    )  # fmt: skip


def parse_films(options: dict[str, Any], default: Any = None) -> Any:
    """Take the values of `film_options` out of a command's options, and return how films are shown.

    Args:
        options: The command's options, from which these are removed.
        default: The values of those that were not given; none: RoboXim's.
    """
    from dataclasses import replace

    from roboxim_eval.film_options import FilmOptions

    given = {name: options.pop(name, None) for name in ("scenes", "only", "frames", "height")}
    if given["only"] is not None:
        given["only"] = tuple(filter(None, (part.strip() for part in given["only"].split(","))))
    known = {name: value for name, value in given.items() if value is not None}
    return replace(default or FilmOptions(), **known)


def task_options() -> list[Decorator]:
    """Return the options that choose a task and change it."""
    return [option(name) for name in TASK_WORDS]


def episode_options(*, episodes: int, out: str) -> Decorator:
    """Return a decorator that adds the options of every run of episodes.

    Args:
        episodes: Number of a task of one skill, for the help.
        out: Default folder.
    """
    return with_options(
        *task_options(),
        option("out", default=out, help="Run's folder."),
        option(
            "episodes", **ABSENT_IS_ZERO, show_default=f"{episodes}; of a mix, its own number",
            help="Number of episodes.",
        ),
        option("seed"),
        option(
            "workers", default=min(2, os.cpu_count() or 1), show_default="cores, at most 2",
            help="Processes, each with its own graph.",
        ),
        option("size", help="Image size of cameras for which the policy states none."),
        *(option(name) for name in ("rate", "renderer", "depth", "segmentation", "repair", "shard", "store")),
        *executor_options(),
    )  # fmt: skip


def experiment_options(key: str) -> Decorator:
    """Return a decorator that adds the options of a run of experiments.

    Args:
        key: What names a policy's condition, e.g. ``CONDITION[.R]``.
    """
    return with_options(
        option("out", required=True, help="Folder of the run."), option("scale"), option("trainer"),
        click.option(
            "--policy", "policies", multiple=True, metavar=f"{key}=SPEC",
            help="Policy of a condition, or of its replicate R, that was trained elsewhere; may be repeated.",
        ),
        click.option(
            "--option", "policy_options", multiple=True, metavar=f"{key}.KEY=VALUE",
            help="Argument of such a policy, e.g. leave_out.0.checkpoint=PATH; may be repeated.",
        ),
        click.option("--only", default="", metavar="KINDS", help="Kinds of stages: generate,export,train,evaluate."),
        option("workers", show_default=False, help="Processes that run episodes; default: 2 or fewer."),
        option("trainings"), option("renderer"),
        click.option(
            "--fresh", is_flag=True,
            help="Evaluate in fresh scenes: draw their seed, unless OUT has one ('experiment attest').",
        ),
        click.option(
            "--scene-seed", type=click.IntRange(0), default=0, metavar="N",
            help="Seed of the scenes, e.g. that of a published run in fresh scenes; default: the public one.",
        ),
        click.option(
            "--trained", type=click.Path(path_type=Path, exists=True, file_okay=False), metavar="RUN",
            help="Run whose trainings are evaluated: with --fresh a finished one, with --shard the whole experiment's.",
        ),
        click.option(
            "--training-resources", default="", metavar="NAME=N,...",
            help="What a training takes of a Ray node, e.g. CPU=8,GPU=1; default: CPU=1.",
        ),
        *executor_options(),
    )  # fmt: skip


def experiment_run(make: Callable[..., T], options: dict[str, Any]) -> tuple[T, Any, Any]:
    """Return a run's configuration, and what runs its episodes and its trainings.

    Args:
        make: Class of the configuration.
        options: Values of `experiment_options`, and further fields of the configuration.

    Raises:
        ConfigError: When an option is wrong.
    """
    from roboxim_runs.experiments.run_config import KINDS
    from roboxim_runs.experiments.trained.policies import named_policies

    executor, address = options.pop("executor"), options.pop("address")
    resources, training_resources = options.pop("resources"), options.pop("training_resources")
    policies = named_policies(options.pop("policies"), options.pop("policy_options"))
    kinds = tuple(word.strip() for word in options.pop("only").split(",") if word) or KINDS
    given = {name: value for name, value in options.items() if name != "workers" or value is not None}
    config: Any = make(policies=policies, only=kinds, **given)
    runs_on = make_executor(executor, address, resources, config.workers)
    trains_on = make_executor(executor, address, training_resources, config.trainings, option="--training-resources")
    return config, runs_on, trains_on


def report_options() -> Decorator:
    """Return a decorator that adds what the report of a run or of a card is made of, and where it is written."""
    return with_options(
        click.argument("folder", type=click.Path(path_type=Path, exists=True), required=False),
        click.option(
            "--from", "card", type=click.Path(path_type=Path, exists=True, dir_okay=False), metavar="CARD",
            help="A card.json alone instead of a run's folder.",
        ),
        option("out", help="File of the page that --from writes; default: none."),
        click.option(
            "--markdown", type=click.Path(path_type=Path), help="Also write sentences and tables to this file.",
        ),
    )  # fmt: skip


def check_report_options(folder: Path | None, card: Path | None, out: Path | None, *, of: str) -> None:
    """Check values of `report_options`.

    Args:
        folder: The folder.
        card: The card.
        out: File of the page.
        of: What the folder is of, e.g. ``benchmark``.

    Raises:
        ConfigError: When they contradict each other.
    """
    from roboxim_core.errors import ConfigError

    if (folder is None) == (card is None):
        raise ConfigError(f"name the folder of a {of}, or a card with --from CARD")
    if folder is not None and out is not None:
        raise ConfigError("the report of a run is written into its own folder; leave out --out")


def parse_size(text: str) -> tuple[int, int]:
    """Parse an image size: ``128`` or ``128x96`` (width x height), or ``as-configured`` (0, 0).

    Raises:
        ConfigError: When the text is neither.
    """
    from roboxim_core.errors import ConfigError

    if text == "as-configured":
        return 0, 0
    sides = [_side(part) for part in text.split("x")]
    if len(sides) > 2 or 0 in sides:
        raise ConfigError(f"an image size is SIZE or WIDTHxHEIGHT with 16 to 4096 px, got '{text}'")
    return sides[0], sides[-1]


def parse_side(text: str) -> int:
    """Parse the side of a square picture [px].

    Raises:
        ConfigError: When the text is not one number from 16 to 4096.
    """
    from roboxim_core.errors import ConfigError

    if not (side := _side(text)):
        raise ConfigError(f"the size of a square picture is one number from 16 to 4096 px, got '{text}'")
    return side


def _side(text: str) -> int:
    """Parse the side of a picture [px]; 0: the text is no number from 16 to 4096."""
    side = int(text) if re.fullmatch("[0-9]{1,5}", text) else 0
    return side if 16 <= side <= 4096 else 0


def is_given(name: str) -> bool:
    """Tell whether an option of the present command was given on the command line."""
    return click.get_current_context().get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE


def require_ending(file: Path, *endings: str) -> None:
    """Refuse a file to write whose name does not say a format.

    Raises:
        ConfigError: When it has none of the endings.
    """
    from roboxim_core.errors import ConfigError

    if file.suffix not in endings:
        raise ConfigError(f"--out must end in {', '.join(endings)}, got {file}")


def print_json(value: Any) -> None:
    """Print plain data and dataclasses as JSON, as the option ``--json`` of several commands asks."""
    click.echo(json.dumps(value, indent=2, default=dataclasses.asdict))
