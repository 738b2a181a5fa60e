"""Run two policies in the same scenes, and find the moment that decides by swapping them."""

from __future__ import annotations

import click

from roboxim_cli import strict
from roboxim_cli.commands.answers._policies import policy_options
from roboxim_cli.options import option, print_json
from roboxim_core.errors import counted


@strict.command(begins="comparing policies")
@click.argument("first", metavar="A")
@click.argument("second", metavar="B")
@policy_options
@option("task")
@option("episodes", default=10, help="Number of scenes.")
@option("seed")
@option("size", help="Image size of cameras for which a policy states none.")
@click.option("--json", "as_json", is_flag=True, help="Print JSON.")
def command(
    first: str, second: str, checkpoints: tuple[str, ...], policy_options: tuple[str, ...], task: str, episodes: int,
    seed: int, size: str, as_json: bool,
) -> None:  # fmt: skip
    r"""Run policies A and B in the same scenes, and find the moment that decides.

    \b
    roboxim compare-policies old=bc new=bc --checkpoint old=runs/bc_1 --checkpoint new=runs/bc_2 --task pick_cube
    roboxim compare-policies expert bc --checkpoint runs/bc --episodes 20

    Where one succeeds and the other fails, both are swapped at a tick, from exactly the same state: the first tick from
    which the loser succeeds decides.
    """
    import contextlib
    import dataclasses

    from roboxim_cli.commands.answers._policies import chosen
    from roboxim_cli.options import parse_size
    from roboxim_cli.progress import ProgressLine
    from roboxim_core.episode import RunConfig
    from roboxim_eval.answers.moments import SceneComparison, summary
    from roboxim_runs.answers.comparing import CompareRun, compare
    from roboxim_runs.answers.trying import TryBench
    from roboxim_runs.episodes.task_choice import task_text

    one, two = chosen([first, second], checkpoints, policy_options)
    width, height = parse_size(size)
    config = CompareRun(
        task_config=task_text(task), scenes=episodes, seed=seed, run=RunConfig(image_width=width, image_height=height)
    )

    seen: list[SceneComparison] = []

    def print_scene(scene: SceneComparison) -> None:
        seen.append(scene)
        ends = ["succeeds" if success else "fails" for success in scene.outcome]
        text = f"scene {scene.scene}: {one.name} {ends[0]}, {two.name} {ends[1]}"
        if scene.diverge_at is not None:
            text += f"; they differ from tick {scene.diverge_at}"
        if scene.decides_at is not None:
            text += f"; tick {scene.decides_at} of {scene.ticks} decides: {scene.phase}"
        if scene.rescued_until is not None:
            text += f"; rescued until tick {scene.rescued_until}"
        if line is None:
            click.echo(text, err=True)
        else:
            line.say(text)

    def show_part(number: int, part: str) -> None:
        if line is not None:
            line.update(number, f"scene {number}: {part}")

    with contextlib.ExitStack() as stack:
        line = None if as_json else stack.enter_context(ProgressLine("comparing policies", episodes, unit="scenes"))
        bench = stack.enter_context(TryBench())
        try:
            found = compare(
                bench, bench.actor(one), bench.actor(two), config, on_scene=print_scene, on_part=show_part
            )  # fmt: skip
        except BaseException:  # of a policy, or Ctrl-C: what was compared counts
            for sentence in summary((one.name, two.name), seen) if seen else ():
                click.echo(sentence, err=True)
            raise
        if line is not None:
            line.update(episodes)
        runs = bench.runs
    sentences = summary((one.name, two.name), found)
    if as_json:
        scenes = [dataclasses.asdict(scene) for scene in found]
        print_json({"scenes": scenes, "sentences": sentences, "runs": runs})
        return
    for sentence in sentences:
        click.echo(sentence)
    click.echo(counted(runs, "run"))
