"""Draw the film of the README, and a filmstrip of every skill and of the tasks in `TASKS`: the expert, seen whole.

A strip begins with the initial scene and ends after the settle phase, which the verdict is about. The line above it is
the episode's instruction. Nothing is staged: ``roboxim generate --look varied`` draws the same scenes with the same
options, and ``roboxim evaluate --policy expert --suite core`` those of the film. The scenes were chosen because they
show the skill clearly. Frames are drawn at twice their size, as ``roboxim view`` does.

Usage: ``python scripts/film_skills.py [NAME ...]``; writes ``docs/images/core.webp``, below it ``skills/<skill>.jpg``
and ``tasks/<task>.jpg``, and fails when the expert does.
"""

from __future__ import annotations

import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.specs import CameraSpec
from roboxim_recorder.bag import BagReader, BagTick
from roboxim_runs.episodes.caption import captioned
from roboxim_runs.episodes.task_choice import task_text
from roboxim_tasks.skills import SKILLS

Picture = npt.NDArray[np.uint8]

FOLDER = Path(__file__).parents[1] / "docs" / "images"
CAMERA = "workspace"
SIZE = 260
"""Side of a frame [px]."""
FINER = 2
"""Frames are drawn so many times larger, and reduced."""
GAP = 4
STILL_M = 0.003
"""Distance below which an object or a button's cap counts as not moved [m]."""
CORE = (18, 17, 26, 24, 19, 23, 14, 25)
"""Episodes of the suite core in the film, in two rows."""
EVERY = 2
"""Ticks per picture of the film."""


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
    frames: int = 0
    """Number of equidistant frames; 0: five frames, chosen by the target's motion (`moments`)."""


FILMS = {
    "pick_up": Film(objects=("apple",), colors="green", distractors="3", seed=0),
    "place_on": Film(objects=("cucumber",), distractors="2", seed=0),
    "place_left_of": Film(objects=("cube", "reference=mug"), colors="orange", distractors="1", seed=5),
    "place_right_of": Film(objects=("soda_can", "reference=bowl"), colors="green", distractors="1", seed=3),
    "place_in_front_of": Film(objects=("banana", "reference=bowl"), distractors="1", seed=9),
    "place_behind": Film(objects=("onion", "reference=plate"), distractors="1", seed=11),
    "stack": Film(objects=("cube", "support=wooden_block"), colors="yellow", distractors="2", seed=6),
    "put_into": Film(objects=("lemon",), distractors="2", seed=3),
    "rotate": Film(objects=("knife",), distractors="2", seed=3),
    "push_button": Film(colors="green", distractors="3", seed=0),
    "flip_switch": Film(colors="green", distractors="2", seed=0),
    "turn_knob": Film(colors="blue", distractors="2", seed=0),
    "open_drawer": Film(distractors="2", seed=3, episodes=(1,)),
    "close_drawer": Film(distractors="2", seed=4, episodes=(2,)),
    "open_door": Film(distractors="2", seed=3, episodes=(1,)),
    "close_door": Film(distractors="2", seed=4, episodes=(1,)),
    "push_object": Film(objects=("sponge",), distractors="1", seed=8),
    "turn_upright": Film(objects=("milk_carton",), distractors="2", seed=11),
}
"""Films by skill."""
TASKS = {
    "pick_up_blocked": Film(seed=2, purpose="test", frames=6),
    "place_on_blocked": Film(seed=2, purpose="test", frames=6),
    "pick_cube_areas": Film(seed=2, purpose="test", episodes=(0, 1, 2, 3, 4)),
}
"""Films by task of ``config/tasks``."""


def main() -> None:
    """Film what the command line names, or everything."""
    if missing := set(SKILLS) - set(FILMS):
        sys.exit(f"no film of {', '.join(sorted(missing))}: add a scene that shows the skill to FILMS")
    for name in sys.argv[1:] or ("core", *FILMS, *TASKS):
        if name == "core":
            save_core(FOLDER / "core.webp")
            continue
        folder, film = ("skills", FILMS[name]) if name in FILMS else ("tasks", TASKS[name])
        file = FOLDER / folder / f"{name}.jpg"
        file.parent.mkdir(parents=True, exist_ok=True)
        picture(name, film).save(file, quality=80, optimize=True)


def save_core(file: Path) -> None:
    """Save the film of the suite core: eight episodes at once, each under its instruction."""
    film, text, tiles = Film(seed=0, purpose="eval"), task_text(suite="core"), []
    for index in CORE:
        with tempfile.TemporaryDirectory() as folder:
            bag = run(text, film, index, folder)
            frames = [tick.images[CAMERA] for tick in bag.ticks((CAMERA,)) if tick.seq % EVERY == 0]
            tiles.append([titled(frame, bag.info.task.instruction) for frame in frames])
    pictures = []
    for k in range(max(map(len, tiles))):
        now = [np.pad(tile[min(k, len(tile) - 1)], ((0, GAP), (0, GAP), (0, 0)), constant_values=255) for tile in tiles]
        rows = [np.concatenate(now[i : i + len(CORE) // 2], axis=1) for i in (0, len(CORE) // 2)]
        pictures.append(Image.fromarray(np.concatenate(rows)[:-GAP, :-GAP]))
    more = [*pictures[1:], *[pictures[-1]] * 8]
    pictures[0].save(file, save_all=True, append_images=more, duration=100 * EVERY, loop=0, quality=60, method=4)


def picture(name: str, film: Film) -> Image.Image:
    """Run a film's episodes and arrange their frames side by side, with the instruction above a strip."""
    task, skill = ("", name) if name in FILMS else (name, "")
    text = task_text(
        task, skill=skill, objects=film.objects, distractors=film.distractors, colors=film.colors, look="varied"
    )
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
            frames += [reduced(ticks[pick].images[CAMERA]) for pick in picks]
    if len(film.episodes) > 1:
        return strip(frames)
    return strip(frames, bag.info.task.instruction, bag.info.scene.cameras[0])


def run(text: str, film: Film, index: int, folder: str) -> BagReader:
    """Run an episode of the expert to the end of its motion, and return its bag."""
    with CoreGraph(Path(folder)) as cores:
        config = RunConfig(
            run_seed=film.seed, purpose=film.purpose, task_config=text, output_dir=folder, cameras=(CAMERA,),
            image_width=FINER * SIZE, image_height=FINER * SIZE, stop_on_success=False,
        )  # fmt: skip
        result = EpisodeRunner(cores.ports, config).run_index(index)
    sys.stdout.write(f"{result.skill}: {result.instruction}: {result.outcome} {result.reason}, {result.steps} ticks\n")
    if result.outcome != "success":
        sys.exit(f"{result.skill}, seed {film.seed}, episode {index}: no film of a failure; choose another scene")
    return BagReader(Path(folder, result.bag))


def titled(frame: Picture, text: str) -> Picture:
    """Return a reduced frame under a low line of text."""
    line = Image.new("RGB", (SIZE, 28), "white")
    ImageDraw.Draw(line).text((2, 4), text, "black", ImageFont.load_default(15))
    return np.concatenate([np.asarray(line), reduced(frame)])


def reduced(picture: Picture) -> Picture:
    """Return a picture at the size of a frame, each pixel the mean of those that were drawn for it."""
    return np.asarray(Image.fromarray(picture).resize((SIZE, SIZE), Image.Resampling.BOX))


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


def strip(frames: list[Picture], title: str = "", camera: CameraSpec | None = None) -> Image.Image:
    """Arrange frames side by side, under a line with the instruction and a compass of the robot's directions."""
    sheet = Image.new("RGB", (len(frames) * (SIZE + GAP) - GAP, SIZE), "white")
    for number, frame in enumerate(frames):
        sheet.paste(Image.fromarray(frame), (number * (SIZE + GAP), 0))
    return Image.fromarray(captioned(np.asarray(sheet), title, camera)) if title else sheet


if __name__ == "__main__":
    main()
