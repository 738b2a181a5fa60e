"""The main job: generate, record, export, train, evaluate."""

from __future__ import annotations

import contextlib
import shlex
import subprocess
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import click

from roboxim_cli import strict
from roboxim_cli.options import option


@dataclass(frozen=True, kw_only=True)
class Scale:
    """Size of the demo. A smaller demo has fewer scenes, not easier ones."""

    demonstrations: int
    """Demonstrations to generate."""
    rollouts: int
    """Rollouts of each policy (bc and random)."""
    steps: int
    """Training steps."""
    size: str = "128"
    """Image size."""
    minutes: str
    """Total time on 2 cores, as text."""
    generation: list[str] = field(default_factory=list)
    """Further options of ``roboxim generate``."""


SCALES = {
    "default": Scale(demonstrations=100, rollouts=24, steps=1200, minutes="about 5 minutes"),
    "smoke": Scale(demonstrations=3, rollouts=2, steps=12, size="96", minutes="about 1 minute"),
    "large": Scale(
        demonstrations=300, rollouts=50, steps=4000, minutes="an estimated 20 to 30 minutes",
        generation=["--noise-mm", "6", "--noise-mrad", "20"],
    ),
}  # fmt: skip


@strict.command()
@option("out", default="runs/demo", help="Folder of the demo.")
@option("seed", help="Seed of everything.")
@option("workers", default=2)
@click.option(
    "--smoke", is_flag=True, help="Check in about a minute that everything works; the policy learns nothing useful."
)
@click.option("--large", is_flag=True, help="Use the larger documented setting, 20 to 30 minutes.")
@option("renderer", default="", help="Default: raster where GL works, else tiny with a notice.")
def command(out: Path, seed: int, workers: int, smoke: bool, large: bool, renderer: str) -> None:
    r"""Run the main job: "Pick up the <colour> cube" from demonstrations to a report.

    \b
    roboxim demo                 # or: make demo
    roboxim demo --large         # more demonstrations, larger images, longer training

    Each step is a command, printed before it runs; you can also run the commands one by one. Ctrl-C stops the demo; the
    same command continues it.
    """
    scale = SCALES["smoke" if smoke else "large" if large else "default"]
    renderer = renderer or _renderer()
    click.echo(
        f"The main job, {scale.minutes} on 2 cores: {scale.demonstrations} demonstrations, {scale.steps} training "
        f"steps, {scale.rollouts} rollouts.\nTo fit that time, the demo uses few demonstrations and images of "
        f"{scale.size} px. The scenes vary in full: the cube anywhere in 20 x 30 cm at any yaw, "
        "the start anywhere in a 12 cm box, in twelve rooms."
    )
    demos, dataset, trained, evaluation = out / "demos", out / "rlds", out / "bc", out / "evaluation"
    lerobot = out / "lerobot"
    common = ["--seed", str(seed), "--workers", str(workers), "--renderer", renderer, "--size", scale.size]
    common += ["--look", "varied"]
    rollouts = str(scale.rollouts)
    started = time.monotonic()
    _step("generate", "--out", str(demos), "--episodes", str(scale.demonstrations), *scale.generation, *common)
    _step("export", "rlds", str(demos), "--out", str(dataset))
    _step("export", "lerobot", str(demos), "--out", str(lerobot), "--for", "act")
    _step("train", "bc", str(dataset), "--out", str(trained), "--steps", str(scale.steps))
    _step(
        "evaluate", "--policy", "bc", "--checkpoint", str(trained), "--policy", "random", "--out", str(evaluation),
        "--episodes", rollouts, *common,
    )  # fmt: skip
    minutes, seconds = divmod(round(time.monotonic() - started), 60)
    click.echo(f"\nDone in {minutes} min {seconds} s. Results:")
    for path, what in (
        (evaluation / "report.html", "the report: success rates, films of episodes; open it in a browser"),
        (demos / "first_demonstrations.png", "pictures of the first demonstrations"),
        (demos / "episodes", "the demonstrations, one MCAP bag each (Foxglove opens them)"),
        (dataset, "the RLDS dataset, for Octo and OpenVLA"),
        (_card("rlds", dataset), "its card: what it holds, how it was made, how to load it"),
        (lerobot, "the LeRobot dataset, for ACT, Diffusion, SmolVLA and pi0"),
        (_card("lerobot", lerobot), "its card"),
        (trained, "the trained policy"),
    ):
        click.echo(f"  {path}: {what}")


def _card(format: str, target: Path) -> Path:
    """Return the card of a dataset that was exported with the defaults."""
    from roboxim_datasets.card import card_path
    from roboxim_recorder.export import EXPORTERS

    exporter = EXPORTERS[format]()
    return card_path(exporter.path(target, exporter.config()))


def _renderer() -> str:
    """Choose raster where it works, else tiny, and print the reason."""
    from roboxim_sim.rendering import available_renderers

    raster = available_renderers(["raster"])["raster"]
    if raster.available:
        return "raster"
    click.echo(f"raster does not work here: {raster.detail}\nThe demo continues with PyBullet's own renderer, tiny.")
    return "tiny"


CLOSING_S = 60.0
"""Time that a stopped step has to save its state [s]."""


def _step(*arguments: str) -> None:
    """Print a roboxim command as a user would type it, and run it in a new process."""
    click.echo(f"\n$ roboxim {shlex.join(arguments)}")
    with subprocess.Popen([sys.executable, "-m", "roboxim_cli", *arguments]) as step:
        try:
            code = step.wait()
        except BaseException as end:
            if not isinstance(end, KeyboardInterrupt):  # Ctrl-C reaches the step too
                step.terminate()
            with contextlib.suppress(subprocess.TimeoutExpired, KeyboardInterrupt):
                step.wait(CLOSING_S)
            if step.poll() is None:
                step.kill()
            raise
    if code:
        raise SystemExit(code)
