"""Choose the best of many checkpoints in few scenes, and measure it in fresh ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from roboxim_cli import strict
from roboxim_cli.options import option, print_json


@strict.command(begins="sweeping")
@click.argument("checkpoints", nargs=-1, required=True, type=click.Path(exists=True, path_type=Path))
@option("task")
@option("suite")
@option("camera")
@click.option("--first", type=click.IntRange(1), default=8, show_default=True, help="Scenes of the first round.")
@click.option(
    "--fresh", type=click.IntRange(1), default=40, show_default=True, help="Scenes that the winner alone plays."
)
@option("out", default="runs/sweep", help="Folder of everything.")
@option("seed")
@option("workers", default=2)
@option("size", help="Image size of cameras for which a policy states none.")
@option("renderer")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(checkpoints: tuple[Path, ...], first: int, fresh: int, size: Any, as_json: bool, **options: Any) -> None:
    r"""Choose the best of several CHECKPOINTS by successive halving, and measure it in fresh scenes.

    \b
    roboxim sweep runs/bc-0 runs/bc-1 runs/act --task pick_cube
    roboxim sweep runs/night/train/*/checkpoint.npz --task skill_object_baseline --first 18 --fresh 90

    All play FIRST scenes, the better half twice as many, and so on. The winner's rate in the scenes that chose it is
    too high, so its rate is measured in FRESH other scenes. Ctrl-C stops; the same command continues.
    """
    import json

    from roboxim_cli.options import parse_size
    from roboxim_cli.printer import EventPrinter
    from roboxim_eval.answers.halving import HalvingConfig, sentences
    from roboxim_runs.evaluation.run import EvaluationConfig
    from roboxim_runs.evaluation.sweeping import RESULT, checkpoint_policies, sweep

    policies = checkpoint_policies(checkpoints)
    config = EvaluationConfig(policies=policies, size=parse_size(size), **options)
    with EventPrinter() as printer:
        result = sweep(policies, config, HalvingConfig(first=first, fresh=fresh), on_event=printer)
    if as_json:
        print_json(json.loads((Path(config.out) / RESULT).read_text()))
        return
    for sentence in sentences(result.choice, result.fresh):
        click.echo(sentence)
    click.echo(f"{result.choice.rollouts + result.fresh.episodes} rollouts; {Path(config.out) / RESULT}")
