"""Generate demonstrations of a task, recorded as bags."""

from __future__ import annotations

from pathlib import Path

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
def command(
    task: str, skill: str, objects: tuple[str, ...], distractors: str, colors: str, out: Path, episodes: int, seed: int,
    workers: int, size: str, renderer: str, depth: bool, segmentation: bool, max_attempts: int, noise_mm: float,
    noise_mrad: float,
) -> None:  # fmt: skip
    r"""Generate demonstrations of a task with the expert; each becomes a bag in OUT/episodes.

    \b
    roboxim generate --episodes 100 --workers 2
    roboxim generate --task pick_cube_distractors --distractors 1-3 --out runs/distractors
    roboxim generate --skill place_on --object apple,cucumber --object support=tray --out runs/tray

    An index whose episode fails is drawn again, so as many as asked are kept; failed attempts are set apart with their
    reason in OUT/set_apart. Ctrl-C stops; the same command goes on. Noise is added to what is executed; what an
    imitator should have done is recorded beside it.
    """
    from PIL import Image

    from roboxim_bringup.jobs import Job, contact_sheet, failures, film, parse_size, registered_run, run_job, task_text
    from roboxim_bringup.progress import ProgressLine
    from roboxim_core.episode import EpisodeResult, RunConfig
    from roboxim_core.errors import ErrorCode, RoboximError

    width, height = parse_size(size)
    config = RunConfig(
        run_seed=seed, purpose="demo", actor="expert", keep="successful", max_attempts=max_attempts,
        task_config=task_text(task, skill=skill, objects=objects, distractors=distractors, colors=colors),
        image_width=width, image_height=height,
        depth=depth, segmentation=segmentation, output_dir=str(out.resolve()),
        noise_translation_m=noise_mm / 1000, noise_rotation_rad=noise_mrad / 1000,
    )  # fmt: skip
    picture = out / "first_demonstrations.png"

    def show(result: EpisodeResult, bar: ProgressLine) -> None:
        if result.outcome == "success" and not picture.exists():
            Image.fromarray(contact_sheet([film(out / result.bag)])).save(picture)
            bar.say(f"a first picture: {picture}")

    with registered_run("generate"):
        results = run_job(
            Job(config=config, episodes=episodes, workers=workers, renderer=renderer), "demonstrations", on_result=show
        )
    kept = [result for result in results if result.outcome == "success"]
    if kept:
        Image.fromarray(contact_sheet([film(out / result.bag) for result in kept[:4]])).save(picture)
    retried = sum(result.attempt > 0 for result in results)
    recovered = sum(result.recovered for result in kept)
    click.echo(f"{len(kept)} demonstrations in {out / 'episodes'} ({retried} of them after a failed attempt)")
    if recovered:
        click.echo(
            f"  {recovered} of them needed a second grasp; exports leave them out unless told to --keep-recovered"
        )
    for line in failures(results):
        click.echo(line)
    if not kept:
        raise RoboximError("no demonstration succeeded; the reasons above say what to change", ErrorCode.TASK_FAULT)
    click.echo(f"next: roboxim export rlds {out} {out}-rlds")
