"""Draws a filmstrip of every skill, and of the tasks in `TASKS`: the expert, seen by the workspace camera.

A strip begins with the scene as it was drawn and ends after the settle phase, which is what the verdict is about. The
instruction above it is the one that was given. Nothing is staged: the scenes are those that ``roboxim generate`` draws
with the same options, chosen so that one sees what the skill is.

Usage: ``python scripts/film_skills.py [NAME ...]``; writes ``docs/images/skills/<skill>.jpg`` and
``docs/images/tasks/<task>.jpg``, and fails when the expert does.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from roboxim_bringup.core_graph import CoreGraph
from roboxim_bringup.runs.caption import captioned
from roboxim_bringup.task_choice import task_text
from roboxim_core.cameras import project
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.specs import CameraSpec
from roboxim_recorder.bag import BagReader, BagTick
from roboxim_tasks.roles import task_objects
from roboxim_tasks.skills import SKILLS

Picture = npt.NDArray[np.uint8]

FOLDER = Path(__file__).parents[1] / "docs" / "images"
CAMERA = "workspace"
SIZE = 260
"""Side of a frame [px]."""
GAP = 4
STILL_M = 0.003
"""What has come less far than this has not moved, a button's cap included [m]."""
ABOVE = 0.06
"""By how much of a frame the objects are below its middle: the hand comes from above."""


@dataclass(frozen=True, kw_only=True)
class Film:
    """Which episodes of a task are filmed, and how."""

    objects: tuple[str, ...] = ()
    """As ``--object`` of ``roboxim generate``."""
    colors: str = ""
    """As ``--colors``."""
    distractors: str = ""
    """As ``--distractors``."""
    seed: int
    """As ``--seed``."""
    episodes: tuple[int, ...] = (0,)
    """Indices; of one episode there is a strip, of several the last frames."""
    purpose: str = "demo"
    zoom: float = 1.0
    """The camera's picture is cut to one part in so many a side, around what the instruction names."""
    frames: int = 0
    """Number of frames, equally far apart; 0: five, about the way of the target (`moments`)."""


FILMS = {
    "pick_up": Film(objects=("apple",), colors="green", distractors="3", seed=0, zoom=1.4),
    "place_on": Film(objects=("cucumber",), distractors="2", seed=0, zoom=1.5),
    "place_left_of": Film(objects=("cube", "reference=mug"), colors="orange", distractors="1", seed=5, zoom=1.5),
    "place_right_of": Film(objects=("soda_can", "reference=bowl"), colors="green", distractors="1", seed=3, zoom=1.3),
    "place_in_front_of": Film(objects=("banana", "reference=bowl"), distractors="1", seed=9, zoom=1.4),
    "place_behind": Film(objects=("onion", "reference=plate"), distractors="1", seed=11, zoom=1.3),
    "stack": Film(objects=("cube", "support=wooden_block"), colors="yellow", distractors="2", seed=6, zoom=1.4),
    "put_into": Film(objects=("lemon",), distractors="2", seed=3, zoom=1.5),
    "rotate": Film(objects=("knife",), distractors="2", seed=3, zoom=1.7),
    "push_button": Film(colors="green", distractors="3", seed=0, zoom=1.5),
    "open_drawer": Film(distractors="2", seed=3, episodes=(1,), zoom=1.15),
    "close_drawer": Film(distractors="2", seed=4, episodes=(2,), zoom=1.15),
    "push_object": Film(objects=("sponge",), distractors="1", seed=8, zoom=1.3),
    "turn_upright": Film(objects=("milk_carton",), distractors="2", seed=11, zoom=1.5),
}
"""Skill to its film."""
TASKS = {
    "pick_up_blocked": Film(seed=2, purpose="test", frames=6),
    "place_on_blocked": Film(seed=2, purpose="test", frames=6),
    "pick_cube_areas": Film(seed=2, purpose="test", episodes=(0, 1, 2, 3, 4)),
}
"""Task of ``config/tasks`` to its film."""


def main() -> None:
    """Film what is named on the command line, or everything."""
    if missing := set(SKILLS) - set(FILMS):
        sys.exit(f"no film of {', '.join(sorted(missing))}: say in FILMS which scene shows the skill")
    for name in sys.argv[1:] or (*FILMS, *TASKS):
        folder, film = ("skills", FILMS[name]) if name in FILMS else ("tasks", TASKS[name])
        file = FOLDER / folder / f"{name}.jpg"
        file.parent.mkdir(parents=True, exist_ok=True)
        picture(name, film).save(file, quality=75, optimize=True)


def picture(name: str, film: Film) -> Image.Image:
    """Run a film's episodes and lay their frames side by side; a strip is headed by its instruction."""
    task, skill = ("", name) if name in FILMS else (name, "")
    text = task_text(task, skill=skill, objects=film.objects, distractors=film.distractors, colors=film.colors)
    frames: list[Picture] = []
    for index in film.episodes:
        with tempfile.TemporaryDirectory() as folder:
            bag = run(text, film, index, folder)
            ticks = list(bag.ticks((CAMERA,)))
            if len(film.episodes) > 1:
                picks = [len(ticks) - 1]
            elif film.frames:
                picks = np.linspace(0, len(ticks) - 1, film.frames).round().astype(int).tolist()
            else:
                picks = moments(ticks)
            frames += cut(bag, [ticks[pick] for pick in picks])
    if len(film.episodes) > 1:
        return strip(frames)
    return strip(frames, bag.info.task.instruction, bag.info.scene.cameras[0])


def run(text: str, film: Film, index: int, folder: str) -> BagReader:
    """Run an episode of the expert to the end of its motion, and return its bag."""
    with CoreGraph(Path(folder)) as cores:
        side = round(SIZE * film.zoom)
        config = RunConfig(
            run_seed=film.seed, purpose=film.purpose, task_config=text, output_dir=folder, cameras=(CAMERA,),
            image_width=side, image_height=side, stop_on_success=False,
        )  # fmt: skip
        result = EpisodeRunner(cores.ports, config).run_index(index)
    sys.stdout.write(f"{result.skill}: {result.instruction}: {result.outcome} {result.reason}, {result.steps} ticks\n")
    if result.outcome != "success":
        sys.exit(f"{result.skill}, seed {film.seed}, episode {index}: no film of a failure; choose another scene")
    return BagReader(Path(folder, result.bag))


def moments(ticks: list[BagTick]) -> list[int]:
    """Choose five ticks: the start; the target about to move, half-way, just arrived; the end.

    What is still held when it has arrived looks the same at the end; then the second one is of the hand on its way.
    """
    targets = [tick.state.entity("target") for tick in ticks]
    ways = np.array([(*target.pose.position, *target.joint_positions) for target in targets])
    last = len(ticks) - 1
    leaves = max(int(np.argmax(np.linalg.norm(ways - ways[0], axis=1) > STILL_M)) - 1, 0)
    arrives = last + 1 - int(np.argmax(np.linalg.norm(ways - ways[last], axis=1)[::-1] > STILL_M))
    half = (leaves + arrives) // 2
    hands = [np.array(ticks[tick].state.robot.pose_tcp_measured.position) for tick in (arrives, last)]
    if np.linalg.norm(hands[1] - hands[0]) < 2 * STILL_M:
        return [0, leaves // 2, leaves, half, last]
    return [0, leaves, half, arrives, last]


def cut(bag: BagReader, ticks: list[BagTick]) -> list[Picture]:
    """Cut the same square of every tick's picture, around where the instruction's objects are at these ticks."""
    camera = bag.info.scene.cameras[0]
    named = [thing.entity for thing in task_objects(bag.info.task)]
    points = [tick.state.entity(name).pose.position for tick in ticks for name in named]
    pixels = project(camera, camera.pose.inverse().apply(points))
    middle = (pixels.min(axis=0) + pixels.max(axis=0)) / 2 - (0, ABOVE * SIZE)
    left, top = np.clip(middle - SIZE / 2, 0, (camera.width - SIZE, camera.height - SIZE)).astype(int).tolist()
    return [tick.images[CAMERA][top : top + SIZE, left : left + SIZE] for tick in ticks]


def strip(frames: list[Picture], title: str = "", camera: CameraSpec | None = None) -> Image.Image:
    """Lay frames side by side, under a line with the instruction and a compass of the robot's directions."""
    sheet = Image.new("RGB", (len(frames) * (SIZE + GAP) - GAP, SIZE), "white")
    for number, frame in enumerate(frames):
        sheet.paste(Image.fromarray(frame), (number * (SIZE + GAP), 0))
    return Image.fromarray(captioned(np.asarray(sheet), title, camera)) if title else sheet


if __name__ == "__main__":
    main()
