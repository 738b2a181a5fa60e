"""List the skills and tasks, and print the tasks of a seed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from roboxim_cli import strict
from roboxim_cli.options import is_given, option, print_json, task_options, with_options
from roboxim_core.errors import counted


@strict.group()
def command() -> None:
    """List the skills and tasks, and print the tasks of a seed."""


@command.command("list")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def list_tasks(as_json: bool) -> None:
    """List the skills with the objects that suit them, and the tasks of config/tasks and of your own folders.

    A task with an invalid file is reported as an error at the end, after the others.
    """
    from roboxim_cli.catalog import catalog
    from roboxim_core.errors import ConfigError

    known = catalog("tasks")
    skills, tasks, broken = known["skills"], known["tasks"], known["broken"]
    if as_json:
        print_json({"skills": skills, "tasks": tasks, "broken": broken})
    else:
        _show(skills, tasks)
    if broken:
        raise ConfigError("\n".join(broken.values()))


def _show(skills: dict[str, Any], tasks: dict[str, Any]) -> None:
    click.secho("skills (roboxim generate --skill NAME --object MODEL)", bold=True)
    for name, entry in skills.items():
        click.echo(f"  {name:<20} {entry['instruction']}")
        for role, suited in entry["roles"].items():
            click.echo(f"  {'':<20}   {role}: {', '.join(suited)}")
    click.secho("tasks (roboxim generate --task NAME)", bold=True)
    for name, task in tasks.items():
        count = f", {counted(task['episodes'], 'episode')}" if task["episodes"] else ""
        click.echo(f"  {name:<28} {', '.join(task['skills'])}{count}")
        click.echo(f"  {'':<28}   {task['about']}")


@command.command("show")
@click.argument("name", metavar="TASK|SUITE|SKILL")
def show(name: str) -> None:
    r"""Describe a task, a suite or a skill: objects, scene, cameras, what varies, when it has succeeded.

    \b
    roboxim tasks show place_on
    roboxim tasks show core
    roboxim tasks show my_task.yaml
    """
    from roboxim_runs.scenes.words import task_lines

    for line in task_lines(name):
        click.echo(line)


@command.command("sample")
@with_options(*task_options(), option("seed"))
@option("episodes", default=10, help="Number of tasks.")
@click.option("--first", type=click.IntRange(0), default=0, show_default=True, help="Index of the first task.")
@click.option(
    "--purpose", type=click.Choice(["demo", "eval", "train", "test"]), default="demo", show_default=True,
    help="Purpose of the episodes; each purpose has its own tasks.",
)  # fmt: skip
@click.option("--json", "as_json", is_flag=True, help="Print JSON, one task per line.")
@click.option("--picture", is_flag=True, help="Draw the scenes from all cameras, and mark the named objects.")
@option("out", default="tasks.png", help="File of the picture, which it implies.")
@option("renderer", help="Renderer of the picture, which it implies.")
def sample(
    seed: int, episodes: int, first: int, purpose: str, as_json: bool, picture: bool, out: Path, renderer: str,
    **choice: Any,
) -> None:  # fmt: skip
    r"""Print the tasks of a seed, exactly as generate and evaluate run them.

    \b
    roboxim tasks sample --seed 7
    roboxim tasks sample --skill place_on --object apple,knife --episodes 5
    roboxim tasks sample --skill stack --episodes 4 --picture
    """
    from roboxim_core.config import digest, to_json
    from roboxim_core.models.library import ModelLibrary
    from roboxim_core.seeds import SeedPath
    from roboxim_runs.episodes.task_choice import task_text
    from roboxim_tasks.config import parse_task_config
    from roboxim_tasks.roles import description, task_distractors
    from roboxim_tasks.sampling.episodes import EpisodeGenerator

    generator = EpisodeGenerator(ModelLibrary())
    config = parse_task_config(task_text(**choice))
    for index in range(first, first + episodes):
        drawn = generator.sample(SeedPath(run_seed=seed, purpose=purpose, index=index), config)
        if as_json:
            click.echo(to_json(drawn))
            continue
        others = ", ".join(description(thing) for thing in task_distractors(drawn))
        click.echo(
            f"{index:>4}  {digest(drawn)}  {drawn.instruction}" + (f"   (also there: {others})" if others else "")
        )
        chosen = "  ".join(f"{name}: {value}" for name, value in drawn.drawn.items())
        if chosen:
            click.echo(f"{'':>24}{chosen}")
    if picture or is_given("out") or is_given("renderer"):
        from roboxim_runs.scenes.pictures import ScenePainter, save_sheet

        click.echo("drawing ...", err=True)
        with ScenePainter(renderer) as painter:
            seeds = (SeedPath(run_seed=seed, purpose=purpose, index=index) for index in range(first, first + episodes))
            draws = (painter.draw(path, config) for path in seeds)
            save_sheet([painter.picture(drawn.scene, drawn.task) for drawn in draws], out)
        click.echo(f"a picture: {out}", err=as_json)
