"""Print shell exports that let your own nodes, or ros2, take part in a run."""

from __future__ import annotations

import shlex

import click

from roboxim_bringup.attach import run_option
from roboxim_cli import strict


@strict.command()
@run_option
@click.option("--shell", type=click.Choice(["sh", "fish"]), default="sh", show_default=True, help="For which shell.")
def command(run_id: str | None, shell: str) -> None:
    r"""Print shell exports that let your own nodes, or ROS 2's own ros2 command, take part in a run.

    \b
    eval "$(roboxim env)"
    roboxim env --shell fish | source
    """
    from roboxim_ros.runs import find_run

    for name, value in find_run(run_id).environment.items():
        quoted = shlex.quote(value)
        click.echo(f"export {name}={quoted}" if shell == "sh" else f"set -gx {name} {quoted}")
    click.echo("unset ROS_LOCALHOST_ONLY" if shell == "sh" else "set -e ROS_LOCALHOST_ONLY")
