"""Generate demonstrations of a task, recorded as bags."""

from __future__ import annotations

from typing import Any

import click

from roboxim_cli import strict
from roboxim_cli.options import episode_options
from roboxim_core.plain_data.shell import shell_line


@strict.command(begins="generating")
@episode_options(episodes=50, out="runs/demos")
@click.option(
    "--max-attempts", type=click.IntRange(1), default=5, show_default=True, help="Largest number of attempts per index."
)
@click.option(
    "--first-try",
    is_flag=True,
    help="Draw an index again if its demonstration needed a second grasp, which exports leave out: counts stay exact.",
)
@click.option(
    "--noise-mm",
    type=click.FloatRange(0, 1000),
    default=3.0,
    show_default=True,
    help="Standard deviation of the noise in free motions, per axis and tick [mm].",
)
@click.option(
    "--noise-mrad",
    type=click.FloatRange(0, 1000),
    default=10.0,
    show_default=True,
    help="Standard deviation of the rotation noise [mrad].",
)
@click.option(
    "--noise-descents",
    type=click.FloatRange(0, 1),
    default=0.0,
    show_default=True,
    metavar="SHARE",
    help="Share of this noise on descents, until 5 cm before a grasp and 3 cm before a place.",
)
def command(size: str, executor: str, address: str, resources: str, **options: Any) -> None:
    r"""Generate demonstrations of a task with the expert; each becomes a bag in OUT/episodes.

    \b
    roboxim generate --episodes 100 --workers 2
    roboxim generate --task pick_cube_distractors --distractors 1-3 --out runs/distractors
    roboxim generate --skill place_on --object apple,cucumber --object support=tray --out runs/tray

    An index whose episode fails is drawn again, so that OUT has as many demonstrations as requested. Failed attempts go
    to OUT/set_apart with their reasons. Ctrl-C stops; the same command continues. Noise is added to the executed
    actions; the actions that an imitator should learn are recorded beside them.
    """
    from roboxim_cli.options import make_executor, parse_size
    from roboxim_cli.printer import EventPrinter
    from roboxim_runs.episodes.generation import GenerationConfig, generate
    from roboxim_runs.episodes.run import failures

    config = GenerationConfig(size=parse_size(size), **options)
    runs_on = make_executor(executor, address, resources, config.workers)
    with EventPrinter() as printer:
        result = generate(config, on_event=printer, executor=runs_on)
    click.echo(result.summary)
    if result.recovered:
        click.echo(
            f"  {result.recovered} of them needed a second grasp; exports leave them out without --keep-recovered"
        )
    for line in failures(result.results):
        click.echo(f"  {line}")
    result.require_any()
    source, dataset = config.store or result.out, f"{result.out}-rlds"
    click.echo("next: " + shell_line("roboxim", "export", "rlds", source, "--out", dataset))
