"""Generate demonstrations of a task, recorded as bags."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from roboxim_bringup.options import episode_options

if TYPE_CHECKING:
    from collections.abc import Sequence

    from roboxim_core.episode import EpisodeResult


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
    from roboxim_bringup.run_folder import RunFolder
    from roboxim_core.episode import RunConfig
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

    before = RunFolder(out).results()
    with registered_run("generate"):
        results = run_job(
            Job(config=config, episodes=episodes, workers=workers, renderer=renderer), "demonstrations", on_result=show
        )
    kept = [result for result in results if result.outcome == "success"]
    if kept:
        Image.fromarray(contact_sheet([film(out / result.bag) for result in kept[:4]])).save(picture)
    click.echo(_summary(before, results, out))
    recovered = sum(result.recovered for result in kept)
    if recovered:
        click.echo(
            f"  {recovered} of them needed a second grasp; exports leave them out unless told to --keep-recovered"
        )
    for line in failures(results):
        click.echo(line)
    if not kept:
        raise RoboximError(
            "no demonstration succeeded; the reasons above say what to change; then choose another --out or remove "
            f"this one (rm -r {out})",
            ErrorCode.TASK_FAULT,
        )
    click.echo(f"next: roboxim export rlds {out} {out}-rlds")


def _summary(before: Sequence[EpisodeResult], results: Sequence[EpisodeResult], out: Path) -> str:
    """Say what is there now, and what of it was there before.

    Args:
        before: The results that the folder had.
        results: Those of the indices that were asked for.
        out: The run's folder.
    """
    made = [result for result in results if result not in before]
    kept = sum(result.outcome == "success" for result in results)
    more = sum(result.outcome == "success" for result in before if result.index >= len(results))
    text = f"{kept} demonstration{'' if kept == 1 else 's'} in {out / 'episodes'}"
    notes = []
    if made and len(made) < len(results):
        notes.append(f"{len(results) - len(made)} of {len(results)} episodes were there before")
    if more:
        notes.append(f"{more} more there, of an earlier command that asked for more")
    retried = sum(result.attempt > 0 for result in results if result.outcome == "success")
    if retried:
        notes.append(f"{retried} after a failed attempt")
    if notes:
        text += f" ({'; '.join(notes)})"
    return text if made else f"{text}; they were there already, nothing was run"
