"""Measure this machine's rates, by which experiments are planned."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from roboxim_cli import strict
from roboxim_cli.named import Named
from roboxim_cli.options import option

if TYPE_CHECKING:
    from roboxim_eval.experiments import ExperimentConfig, Rates


@strict.command("calibrate", begins="measuring this machine")
@click.option("--experiment", type=Named("experiment"), default="skill_object", show_default=True, help="Whose tasks.")
@click.option("--scale", default="laptop", show_default=True, help="Its scale, which states the image size.")
@click.option("--episodes", type=click.IntRange(2), default=8, show_default=True, help="Demonstrations.")
@click.option("--rollouts", type=click.IntRange(1), default=4, show_default=True, help="Rollouts.")
@click.option("--steps", type=click.IntRange(20), default=60, show_default=True, help="Training steps.")
@click.option("--workers", type=click.IntRange(1), help="Processes that run episodes; default: 2 or fewer.")
@option("trainings", help="Also measure so many trainings at a time.")
def command(
    experiment: str, scale: str, episodes: int, rollouts: int, steps: int, workers: int | None, trainings: int
) -> None:
    """Measure this machine's rates by a small run of every stage, and store them for plan and list."""
    import tempfile

    from roboxim_cli.options import parse_size
    from roboxim_cli.printer import EventPrinter
    from roboxim_runs.experiments.calibration.measuring import CalibrationConfig, calibrate
    from roboxim_runs.experiments.calibration.rates import store_rates, stored_rates
    from roboxim_runs.experiments.files import checked_design, known_as, load_experiment, write_mixes

    config = load_experiment(experiment, scale)
    design = checked_design(experiment, config)
    size = parse_size(config.image_size)
    with tempfile.TemporaryDirectory(prefix="roboxim-mixes-") as folder:
        mix = write_mixes(design, Path(folder))[0].rename(Path(folder) / f"{known_as(experiment)}.yaml")
        more: dict[str, Any] = {} if workers is None else {"workers": workers}
        settings = CalibrationConfig(
            mix=mix, size=size if isinstance(size, tuple) else (size, size), episodes=episodes, rollouts=rollouts,
            steps=steps, trainings=trainings, **more,
        )  # fmt: skip
        with EventPrinter() as printer:
            rates = calibrate(settings, on_event=printer)
    if before := stored_rates(rates.size, rates.experiment):
        rates = rates.learned(*before.side_by_side, *rates.side_by_side)  # other numbers of trainings at a time
    hourly = 3600 / rates.demonstration_s
    click.echo(f"demonstrations   {hourly:.0f} an hour, {rates.demonstration_bytes / 1e6:.1f} MB each")
    click.echo(f"exports          {rates.export_s:.2f} s, {rates.dataset_bytes / 1e6:.2f} MB each")
    click.echo(f"training         {rates.steps_per_s:.1f} steps a second")
    for number, rate in rates.training_rates.items():
        if number > 1:
            click.echo(f"{number} trainings      {rate.steps_per_s:.1f} steps a second each ({rate.source})")
    click.echo(
        f"rollouts         {rates.success_s:.1f} s if successful, else {rates.failure_s:.1f} s; "
        f"{rates.rollout_bytes / 1e6:.1f} MB each"
    )
    click.echo(f"proofs           {rates.proof_s:.2f} s each")
    click.echo(
        f"start of a stage {rates.start_s:.0f} s generation, {rates.train_start_s:.0f} s training, "
        f"{rates.evaluate_start_s:.0f} s evaluation ({rates.first_evaluate_s:.0f} s more for the first), "
        f"{rates.proof_start_s:.0f} s proof"
    )
    click.echo(f"stored in {store_rates(rates)}")


def probed(name: str, config: ExperimentConfig, known: Rates | None, trainings: int) -> Rates:
    """Return rates of this machine for an experiment that include a number of trainings at a time.

    What is not known is measured, for about a minute, and stored; so are the rates of this experiment if only another
    one's are known. The probe's lines go to the error stream.

    Args:
        name: Name of the experiment, or a path.
        config: The experiment at its scale.
        known: This machine's rates; none: never measured.
        trainings: Number of trainings at a time.
    """
    import sys
    import tempfile
    from contextlib import redirect_stdout

    from roboxim_cli.options import parse_size
    from roboxim_cli.printer import EventPrinter
    from roboxim_runs.experiments.calibration.measuring import CalibrationConfig, calibrate, calibrate_trainings
    from roboxim_runs.experiments.calibration.rates import store_rates
    from roboxim_runs.experiments.files import checked_design, known_as, write_mixes

    stem = known_as(name)
    own = known is not None and known.experiment == stem
    measured = known is not None and trainings in known.training_rates
    if known is not None and own and measured:
        return known
    size = parse_size(config.image_size)
    what = "" if measured else f", {trainings} trainings at a time" if trainings > 1 else ""
    click.echo(
        f"no rates of this machine for {stem}, images of {config.image_size}{what}: measuring, about a minute", err=True
    )
    with tempfile.TemporaryDirectory(prefix="roboxim-mixes-") as folder:
        mix = write_mixes(checked_design(name, config), Path(folder))[0].rename(Path(folder) / f"{stem}.yaml")
        settings = CalibrationConfig.probe(
            mix, size if isinstance(size, tuple) else (size, size), trainings=1 if measured else trainings
        )
        with redirect_stdout(sys.stderr), EventPrinter() as printer:
            if known is not None and own:
                rates = known.learned(calibrate_trainings(settings, on_event=printer))
            else:
                rates = calibrate(settings, on_event=printer)
                if known is not None:
                    rates = rates.learned(*known.side_by_side, *rates.side_by_side)
    store_rates(rates)
    return rates
