"""Make a robot from a URDF or an MJCF, check it, draw it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from roboxim_cli import strict
from roboxim_cli.named import Named
from roboxim_cli.options import option, parse_side
from roboxim_core.plain_data.shell import shell_line


@strict.group()
def command() -> None:
    """Make a robot from a URDF or an MJCF, check it, draw it."""


def _numbers(ctx: click.Context, param: click.Parameter, text: str) -> tuple[float, ...]:
    try:
        return tuple(float(word) for word in text.replace(",", " ").split())
    except ValueError:
        raise click.BadParameter(f"expected numbers such as 1.5 or 1.5,1.5,2, got '{text}'") from None


def _names(ctx: click.Context, param: click.Parameter, text: str) -> tuple[str, ...]:
    return tuple(text.replace(",", " ").split())


@command.command("new", begins="making the robot")
@click.argument("source", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@click.option("--name", default="", help="Id of the robot; default: the file's name.")
@click.option("--base", default="", metavar="LINK", help="Root link of the arm; default: the first with a shape.")
@click.option("--flange", default="", metavar="LINK", help="Link that carries the gripper; default: the last one.")
@click.option(
    "--without", default="", metavar="LINK[,LINK]", callback=_names, help="Links beside the chain that are left out."
)
@click.option("--gripper", default="franka_hand", show_default=True, help="Gripper to mount.")
@click.option("--mount-xyz", default="0 0 0", callback=_numbers, help="Position of the gripper in the flange [m].")
@click.option("--mount-rpy", default="0 0 0", callback=_numbers, help="Its rotation: z out of the flange [rad].")
@click.option("--velocity", default="", callback=_numbers, help="Joint speeds [rad/s]; default: the URDF's.")
@click.option("--effort", default="", callback=_numbers, help="Joint torques [N m]; default: the URDF's.")
@click.option("--acceleration", default="", callback=_numbers, help="Joint accelerations [rad/s^2].")
@click.option("--jerk", default="", callback=_numbers, help="Joint jerks [rad/s^3]; default: acceleration in 50 ms.")
@click.option("--home", default="", callback=_numbers, help="Joint positions at home [rad]; default: searched for.")
@click.option("--cover", is_flag=True, help="Make collision shapes of the visual meshes.")
@option("out", default="config", help="Configuration folder; the robot goes to OUT/robots.")
def new(source: Path, name: str, out: Path, **given: Any) -> None:
    r"""Make a robot from a URDF, a xacro (needs xacrodoc), an MJCF or a recipe (YAML).

    Numbers of joints are one for all of them, or one for each: --acceleration 3.5,2.5,5,5,5,5,5. Options that are
    given replace the recipe's values.

    \b
    roboxim robot new my_arm.urdf --flange tool0 --acceleration 5 --out config
    roboxim robot new config/robots/fr3/recipe.yaml --out config
    ROBOXIM_CONFIG_PATH=config roboxim robot check my_arm
    """
    from roboxim_core.config import load_config
    from roboxim_runs.robots.derivation import derive
    from roboxim_runs.robots.recipe import RobotRecipe

    if source.suffix in (".yaml", ".yml"):
        stated = click.get_current_context().get_parameter_source
        changes = {key: value for key, value in given.items() if stated(key) is not ParameterSource.DEFAULT}
        recipe = replace(load_config(source, RobotRecipe), **changes | ({"name": name} if name else {}))
    else:
        stem = source.name.split(".")[0].lower().replace("-", "_")
        recipe = RobotRecipe(name=name or stem, urdf=str(source.resolve()), source=source.name, **given)
    file = derive(recipe, out / "robots", folder=source.resolve().parent, report=click.echo)
    click.echo(f"wrote {file} and {file.with_suffix('')}/")
    click.echo(f"next: ROBOXIM_CONFIG_PATH={shell_line(out)} roboxim robot check {recipe.name}")


@command.command("gripper", begins="making the gripper")
@click.argument("recipe", type=click.Path(path_type=Path, exists=True, dir_okay=False))
@option("out", default="config", help="Configuration folder; the gripper goes to OUT/grippers.")
def gripper(recipe: Path, out: Path) -> None:
    r"""Make a gripper from a RECIPE (YAML) that names its URDF, to be mounted on arms by `robot new`.

    \b
    roboxim robot gripper config/grippers/robotiq_2f85/recipe.yaml --out config
    """
    from roboxim_core.config import load_config
    from roboxim_runs.robots.gripper_derivation import GripperRecipe, derive_gripper

    file = derive_gripper(
        load_config(recipe, GripperRecipe), out / "grippers", folder=recipe.resolve().parent, report=click.echo
    )
    click.echo(f"wrote {file} and {file.with_suffix('')}/")


@command.command("check", begins="checking the robot")
@click.argument("robot", type=Named("robot"))
@click.option("--reach", type=click.Path(path_type=Path, dir_okay=False), help="Draw the reach map into this file.")
@option("episodes", default=5, help="Demonstrations of picking up a cube.")
def check(robot: str, reach: Path | None, episodes: int) -> None:
    """Prove that ROBOT's files fit together, and that it can work. The exit code is 1 when a proof fails."""
    from roboxim_runs.robots.check import prove

    failed = 0
    for proof in prove(robot, episodes=episodes):
        failed += not proof.holds
        sign = click.style("ok    ", fg="green") if proof.holds else click.style("FAILED", fg="red")
        click.echo(f"{sign}  {proof.name:<16} {proof.detail}")
    if reach is not None:
        from roboxim_runs.robots.sheet import draw_reach

        area = draw_reach(robot, reach)
        click.echo(f"a picture: {reach} ({area:.2f} m^2 with the tool down)")
    raise SystemExit(int(failed > 0))


@command.command("sheet", begins="drawing the robot")
@click.argument("robots", type=Named("robot"), nargs=-1)
@option("out", default="robots.png", help="File of the picture.")
@option("renderer", name="renderer_name")
@option("size", default="360", metavar="PX", help="Side of each picture.")
def sheet(robots: tuple[str, ...], out: Path, renderer_name: str, size: str) -> None:
    """Draw ROBOTS (default: all) at the table."""
    from roboxim_core.models.library import ModelLibrary
    from roboxim_runs.robots.sheet import draw_robots

    chosen = robots or ModelLibrary().robot_ids
    out.parent.mkdir(parents=True, exist_ok=True)
    draw_robots(chosen, parse_side(size), renderer_name).save(out)
    click.echo(f"a picture: {out} ({', '.join(chosen)})")
