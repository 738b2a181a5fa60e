"""Draw a filmstrip of every skill and of the tasks in `TASKS`: the expert, seen by the workspace camera.

A strip begins with the initial scene and ends after the settle phase, which the verdict is about. The line above it is
the episode's instruction. Nothing is staged: ``roboxim generate`` draws the same scenes with the same options. The
scenes were chosen because they show the skill clearly.

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
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.specs import CameraSpec
from roboxim_core.vision.cameras import project
from roboxim_recorder.bag import BagReader, BagTick
from roboxim_runs.episodes.caption import captioned
from roboxim_runs.episodes.task_choice import task_text
from roboxim_tasks.roles import task_objects
from roboxim_tasks.skills import SKILLS

Picture = npt.NDArray[np.uint8]

FOLDER = Path(__file__).parents[1] / "docs" / "images"
CAMERA = "workspace"
SIZE = 260
"""Side of a frame [px]."""
GAP = 4
STILL_M = 0.003
"""Distance below which an object or a button's cap counts as not moved [m]."""
ABOVE = 0.06
"""Fraction of a frame by which the objects are below its centre, because the hand comes from above."""


@dataclass(frozen=True, kw_only=True)
class Film:
    """The episodes of a task to film, and how to film them."""

    objects: tuple[str, ...] = ()
    """As ``--object`` of ``roboxim generate``."""
    colors: str = ""
    """As ``--colors``."""
    distractors: str = ""
    """As ``--distractors``."""
    seed: int
    """As ``--seed``."""
    episodes: tuple[int, ...] = (0,)
    """Episode indices. One episode gives a strip; several give their last frames."""
    purpose: str = "demo"
    zoom: float = 1.0
    """Zoom factor: the frame is cropped to 1/n of its side, around the objects that the instruction names."""
    frames: int = 0
    """Number of equidistant frames; 0: five frames, chosen by the target's motion (`moments`)."""


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
    "flip_switch": Film(colors="green", distractors="2", seed=0, zoom=1.5),
    "open_drawer": Film(distractors="2", seed=3, episodes=(1,), zoom=1.15),
    "close_drawer": Film(distractors="2", seed=4, episodes=(2,), zoom=1.15),
    "push_object": Film(objects=("sponge",), distractors="1", seed=8, zoom=1.3),
    "turn_upright": Film(objects=("milk_carton",), distractors="2", seed=11, zoom=1.5),
}
"""Films by skill."""
TASKS = {
    "pick_up_blocked": Film(seed=2, purpose="test", frames=6),
    "place_on_blocked": Film(seed=2, purpose="test", frames=6),
    "pick_cube_areas": Film(seed=2, purpose="test", episodes=(0, 1, 2, 3, 4)),
}
"""Films by task of ``config/tasks``."""


def main() -> None:
    """Film the skills and tasks named on the command line, or all."""
    if missing := set(SKILLS) - set(FILMS):
        sys.exit(f"no film of {', '.join(sorted(missing))}: add a scene that shows the skill to FILMS")
    for name in sys.argv[1:] or (*FILMS, *TASKS):
        folder, film = ("skills", FILMS[name]) if name in FILMS else ("tasks", TASKS[name])
        file = FOLDER / folder / f"{name}.jpg"
        file.parent.mkdir(parents=True, exist_ok=True)
        picture(name, film).save(file, quality=75, optimize=True)


def picture(name: str, film: Film) -> Image.Image:
    """Run a film's episodes and arrange their frames side by side, with the instruction above a strip."""
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

    If the target is still held on arrival, the end looks the same; then the second tick shows the hand on its way.
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
    """Crop the same square from the image of every tick, around the instruction's objects at these ticks."""
    camera = bag.info.scene.cameras[0]
    named = [thing.entity for thing in task_objects(bag.info.task)]
    points = [tick.state.entity(name).pose.position for tick in ticks for name in named]
    pixels = project(camera, camera.pose.inverse().apply(points))
    middle = (pixels.min(axis=0) + pixels.max(axis=0)) / 2 - (0, ABOVE * SIZE)
    left, top = np.clip(middle - SIZE / 2, 0, (camera.width - SIZE, camera.height - SIZE)).astype(int).tolist()
    return [tick.images[CAMERA][top : top + SIZE, left : left + SIZE] for tick in ticks]


def strip(frames: list[Picture], title: str = "", camera: CameraSpec | None = None) -> Image.Image:
    """Arrange frames side by side, under a line with the instruction and a compass of the robot's directions."""
    sheet = Image.new("RGB", (len(frames) * (SIZE + GAP) - GAP, SIZE), "white")
    for number, frame in enumerate(frames):
        sheet.paste(Image.fromarray(frame), (number * (SIZE + GAP), 0))
    return Image.fromarray(captioned(np.asarray(sheet), title, camera)) if title else sheet


if __name__ == "__main__":
    main()
