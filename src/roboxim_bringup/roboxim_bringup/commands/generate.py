"""Generate demonstrations of a task, recorded as bags."""

from __future__ import annotations

from typing import Any

import click

from roboxim_bringup.options import episode_options


@click.command()
@episode_options(episodes=50, out="runs/demos")
@click.option("--max-attempts", default=5, show_default=True, help="Attempts per index until one succeeds.")
@click.option(
    "--noise-mm",
    default=3.0,
    show_default=True,
    help="Noise in free motions, deviation per axis and tick [mm].",
)
@click.option("--noise-mrad", default=10.0, show_default=True, help="The same for rotations [mrad].")
def command(size: str, **options: Any) -> None:
    r"""Generate demonstrations of a task with the expert; each becomes a bag in OUT/episodes.

    \b
    roboxim generate --episodes 100 --workers 2
    roboxim generate --task pick_cube_distractors --distractors 1-3 --out runs/distractors
    roboxim generate --skill place_on --object apple,cucumber --object support=tray --out runs/tray

    An index whose episode fails is drawn again, so as many as asked are kept; failed attempts are set apart with their
    reason in OUT/set_apart. Ctrl-C stops; the same command goes on. Noise is added to what is executed; what an
    imitator should have done is recorded beside it.
    """
    from roboxim_bringup.options import parse_size
    from roboxim_bringup.printer import EventPrinter
    from roboxim_bringup.runs.episodes import failures
    from roboxim_bringup.runs.generation import GenerationConfig, generate

    config = GenerationConfig(size=parse_size(size), **options)
    with EventPrinter() as printer:
        result = generate(config, on_event=printer)
    click.echo(result.summary)
    if result.recovered:
        click.echo(
            f"  {result.recovered} of them needed a second grasp; exports leave them out unless told to "
            "--keep-recovered"
        )
    for line in failures(result.results):
        click.echo(f"  {line}")
    result.require_any()
    click.echo(f"next: roboxim export rlds {result.out} {result.out}-rlds")
