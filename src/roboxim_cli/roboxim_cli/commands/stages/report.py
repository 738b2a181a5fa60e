"""Write an evaluation's report again, or compare evaluations of the past side by side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from roboxim_cli import strict
from roboxim_cli.options import film_options, option, parse_films


@strict.command(begins="writing the report")
@click.argument("folders", nargs=-1, required=True, type=click.Path(exists=True, file_okay=False, path_type=Path))
@option("out", default=None, show_default=False, help="Folder of a comparison's report.  [default: runs/comparison]")
@film_options()
def command(folders: tuple[Path, ...], out: Path | None, **films: Any) -> None:
    r"""Write the report of an evaluation again, or one that compares several evaluations.

    \b
    roboxim report runs/evaluation                      # writes runs/evaluation/report.html
    roboxim report runs/evaluation --films 20           # with films and pages of 20 scenes
    roboxim report runs/monday runs/tuesday             # side by side, paired where scenes are equal

    Scenes are equal where robot, objects, their places, cameras and lights are, whatever the seeds of the runs.
    """
    from roboxim_core.errors import ConfigError
    from roboxim_runs.evaluation.comparing import compare_evaluations
    from roboxim_runs.evaluation.report import report_of, stored_record

    first = stored_record(folders[0])
    film = parse_films(films, first.film)
    if len(folders) > 1:
        page, comparison = compare_evaluations(folders, out or Path("runs/comparison"), film=film)
    else:
        if out is not None:
            raise ConfigError("the report of one evaluation is written into its own folder; leave out --out")
        result = report_of(folders[0], replace(first, film=film))
        page = result.report or folders[0]
        comparison = "\n".join(filter(None, (*result.doubts, result.comparison)))
    if comparison:
        click.echo(comparison)
    click.echo(f"report: {page}")
