"""See a task, a scene or a recorded episode before anything runs."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import click

from roboxim_cli import strict
from roboxim_cli.options import TASK_CHANGES, option, with_options


@strict.command(begins="drawing")
@click.argument("what", metavar="TASK|SKILL|SCENE|BAG")
@with_options(*(option(name) for name in TASK_CHANGES))
@option("out", help="File of the picture; default: view.png, or the studio's window if it is installed.")
@option("seed", help="Seed of a task's scene.")
@option("renderer")
def command(what: str, out: Path | None, seed: int, renderer: str, **changes: Any) -> None:
    r"""Show a task, a scene or the start of a bag: a picture from all cameras with the named objects marked.

    \b
    roboxim view place_on --object apple --light evening
    roboxim view my_skill.py:Touch
    roboxim view kitchen --out kitchen.png
    roboxim view runs/demos/episodes/demo-0-00000-0

    On a terminal, the studio opens instead if it is installed, and neither --out nor a change of the task is given.
    """
    from roboxim_runs.scenes.pictures import picture_of, require_picture_name, save_sheet

    changed = any(changes.values())
    if out is None and not changed and sys.stdin.isatty() and sys.stdout.isatty() and importlib.util.find_spec("viser"):
        from roboxim_cli.commands.studio import command as studio

        studio.main([what], prog_name="roboxim studio", standalone_mode=False)
        return
    file = out or Path("view.png")
    require_picture_name(file)
    picture, text = picture_of(what, seed=seed, renderer=renderer, changes=changes)
    save_sheet([picture], file)
    click.echo(f"{text}\na picture: {file}")
