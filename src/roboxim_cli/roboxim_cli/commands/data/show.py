"""Show why an episode ended as it did: its film, actions and conditions."""

from __future__ import annotations

from pathlib import Path

import click

from roboxim_cli import strict
from roboxim_cli.options import option


@strict.command(begins="reading the episode")
@click.argument("place", metavar="EPISODE", type=click.Path(exists=True, path_type=Path))
@click.argument("number", type=click.IntRange(0), required=False)
@click.option("--policy", default="", metavar="NAME", help="Policy of an evaluation; default: the one under test.")
@click.option(
    "--expert/--no-expert", default=None,
    help="Plan with the expert in the same scene, and show it next to the episode; default: in a page, unless an "
    "expert is in the evaluation.",
)  # fmt: skip
@option("out", help="Write a page with the film to this file, e.g. why.html, instead of text.")
def command(place: Path, number: int | None, policy: str, expert: bool | None, out: Path | None) -> None:
    r"""Show why an episode ended as it did.

    \b
    roboxim show runs/evaluation 7                # episode 7 of the policy under test, in the terminal
    roboxim show runs/evaluation 7 --policy random --out why.html
    roboxim show runs/evaluation/bc/episodes/eval-0-00007-0 --out why.html

    EPISODE is a bag, or the folder of a run or an evaluation with the episode's NUMBER. The page has the film in full
    length and rate, in step with actions, gripper, joints and each condition against its bound; what the policy
    printed; what the scene held; and what others did in the same scene.
    """
    import tempfile
    from dataclasses import replace

    from roboxim_core.errors import RoboximError
    from roboxim_core.whole_files import write_whole
    from roboxim_eval.film_options import FilmOptions
    from roboxim_eval.report.episode import episode_page, episode_text
    from roboxim_recorder.bag import BagReader
    from roboxim_runs.episodes.showing import expert_way, shown_episode
    from roboxim_runs.evaluation.finding import find_episode

    found = find_episode(place, number, policy)
    info, note = BagReader(found.bag).info, ""
    if expert is None:
        actors = [info, *(BagReader(other.bag).info for other in found.others)]
        expert = out is not None and not any(one.actor_privileged for one in actors)
    with tempfile.TemporaryDirectory() as folder:
        if expert:
            try:
                found = replace(found, others=(expert_way(info, Path(folder)), *found.others))
            except RoboximError as error:
                note = f"The expert's way could not be planned: {error}"
        films = FilmOptions() if out else None
        page = shown_episode(found.bag, films=films, others=found.others, name=found.policy)
    page = replace(page, nobody=note or page.nobody)
    if out is None:
        click.echo(episode_text(page))
        return
    write_whole(out, episode_page(page))
    click.echo(f"{out}: {page.explanation or page.outcome}")
