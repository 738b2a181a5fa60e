"""Pictures of scenes that no episode has run in: all cameras side by side, objects of the task marked by name."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont

from roboxim_bringup.cores import CorePlanner, CoreSegmentation
from roboxim_core.closing import Closing
from roboxim_core.config import load_yaml, named_config
from roboxim_core.config_folders import config_names
from roboxim_core.episode import Draw
from roboxim_core.errors import ConfigError, counted
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import drawn_entities
from roboxim_core.plain_data.pictures import load_scenery
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import CameraSpec, SceneSpec, TaskSpec
from roboxim_core.state import StateRecord
from roboxim_core.vision.cameras import load_camera
from roboxim_recorder.bag import BagReader
from roboxim_runs.episodes.caption import captioned
from roboxim_runs.episodes.task_choice import named_task
from roboxim_sim.rendering import make_renderer
from roboxim_sim.rendering.states import StateRenderer
from roboxim_sim.world import World
from roboxim_tasks.config import TaskMix, parse_task_config
from roboxim_tasks.demonstration.solvable import Solvability
from roboxim_tasks.roles import description, task_objects
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.sampling.visible import Visibility
from roboxim_tasks.task_config import TaskConfig

Box = tuple[float, float, float, float]
"""Left, top, right, bottom [px]."""
HEIGHT_PX = 384
"""Height of the pictures."""
FINER = 2
"""Pixels that are drawn for each one of a picture and averaged: thin edges do not sparkle."""
GAP_PX = 6
MARK = (220, 40, 40)


class ScenePainter(Closing):
    """Draws tasks as runs do, and pictures of scenes. A context manager; belongs to the thread that made it."""

    def __init__(self, renderer: str = "raster") -> None:
        """Make the cores that a run draws with, and a renderer by name."""
        self._library = ModelLibrary()
        self._seen = CoreSegmentation(self._library, renderer)
        solvable = Solvability(self._library, CorePlanner(self._library))
        self._generator = EpisodeGenerator(self._library, solvable, Visibility(self._seen))
        self._world = World(self._library)
        self._states = StateRenderer(make_renderer(renderer), self._library)

    def close(self) -> None:
        """Free everything."""
        self._seen.close()
        self._states.renderer.close()
        self._world.close()

    def draw(self, seed: SeedPath, config: TaskConfig | TaskMix) -> Draw:
        """Return the episode that a run has at a seed path.

        Raises:
            ConfigError: When the configuration names what does not exist.
            TaskError: ``RESET_INFEASIBLE`` when no scene meets the constraints.
        """
        return self._generator.draw(seed, config)

    def picture(self, scene: SceneSpec, task: TaskSpec | None = None, state: StateRecord | None = None) -> Image.Image:
        """Return a picture of a scene from all of its cameras.

        Args:
            scene: The scene.
            task: Its task, whose objects are marked; none: nothing is marked.
            state: State to draw; none: the scene when everything has come to rest.

        Raises:
            RoboximError: When the scene cannot be loaded or drawn.
        """
        cameras = scene.cameras or (replace(load_camera("workspace"), name="workspace"),)
        scene = replace(scene, cameras=tuple(self._enlarged(camera) for camera in cameras))
        state = state or self._world.load(scene)
        images = self._states.draw(scene, state)
        marks = {thing.entity: description(thing) for thing in task_objects(task)} if task else {}
        ids = {entity: number for number, entity in enumerate(drawn_entities(scene), start=1)}
        views = []
        for camera in scene.cameras:
            seen = images[camera.name]
            assert seen.segmentation is not None
            size = camera.width // FINER, camera.height // FINER
            view = Image.fromarray(seen.rgb).resize(size, Image.Resampling.BOX)
            labels: list[Box] = []
            for entity, label in marks.items():
                _mark(view, seen.segmentation[::FINER, ::FINER] == ids[entity], label, labels)
            views.append((camera.name, view))
        first = next((camera for camera in scene.cameras if camera.parent == "world"), None)
        sheet = np.asarray(_side_by_side(views))
        return Image.fromarray(captioned(sheet, task.instruction, first) if task else sheet)

    def _enlarged(self, camera: CameraSpec) -> CameraSpec:
        height = FINER * HEIGHT_PX
        width = FINER * round(camera.width * HEIGHT_PX / camera.height)
        if camera.intrinsics:
            scale = height / camera.height
            fx, fy, cx, cy = camera.intrinsics
            inner = (fx * scale, fy * scale, (cx + 0.5) * scale - 0.5, (cy + 0.5) * scale - 0.5)
            camera = replace(camera, intrinsics=inner)
        return replace(camera, width=width, height=height, segmentation=True)


def require_picture_name(file: Path) -> None:
    """Refuse a file whose name has no ending of a picture.

    Raises:
        ConfigError: Naming the endings.
    """
    if file.suffix.lower() not in (".png", ".jpg", ".jpeg", ".webp"):
        raise ConfigError(f"a picture is written as .png, .jpg or .webp, got {file}")


def save_sheet(pictures: Sequence[Image.Image], file: Path) -> None:
    """Write pictures as one, in up to three columns.

    Raises:
        ConfigError: When the file's name has no ending of a picture.
    """
    require_picture_name(file)
    file.parent.mkdir(parents=True, exist_ok=True)
    stacked(pictures, columns=min(3, -(-len(pictures) // 2))).save(file)


def stacked(pictures: Sequence[Image.Image], columns: int = 1) -> Image.Image:
    """Return pictures below one another, in columns."""
    width, height = (max(getattr(picture, side) for picture in pictures) for side in ("width", "height"))
    rows = -(-len(pictures) // columns)
    sheet = Image.new("RGB", (columns * (width + GAP_PX) - GAP_PX, rows * (height + GAP_PX) - GAP_PX), "white")
    for number, picture in enumerate(pictures):
        sheet.paste(picture, ((number % columns) * (width + GAP_PX), (number // columns) * (height + GAP_PX)))
    return sheet


def _side_by_side(views: Sequence[tuple[str, Image.Image]]) -> Image.Image:
    """Return views side by side, each with its camera's name in a corner."""
    font = ImageFont.load_default(14)
    for name, view in views:
        draw = ImageDraw.Draw(view)
        left, top, right, bottom = draw.textbbox((6, 4), name, font=font)
        draw.rectangle((left - 3, top - 2, right + 3, bottom + 2), fill=(255, 255, 255))
        draw.text((6, 4), name, fill=(25, 25, 25), font=font)
    return stacked([view for _, view in views], columns=len(views))


def _mark(view: Image.Image, mask: npt.NDArray[np.bool_], label: str, labels: list[Box]) -> None:
    """Draw a frame around what a mask covers, with a label; nothing where the camera does not see it.

    Args:
        view: The picture.
        mask: What the object covers.
        label: Its name.
        labels: Where labels are already, which is extended.
    """
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return
    draw, font = ImageDraw.Draw(view), ImageFont.load_default(15)
    box = (int(columns[0]) - 4, int(rows[0]) - 4, int(columns[-1]) + 4, int(rows[-1]) + 4)
    draw.rectangle(box, outline=MARK, width=2)
    wide = draw.textlength(label, font=font)
    x = min(max(box[0], 0), view.width - wide - 6)
    above, below = box[1] - 20, box[3] + 2
    places = [(x, y, x + wide + 6, y + 18) for y in (above, below, box[1] + 2, above - 20, below + 20)]
    inside = [place for place in places if place[1] >= 0 and place[3] <= view.height]
    place = next((place for place in inside if not any(_overlap(place, other) for other in labels)), inside[0])
    labels.append(place)
    y = place[1]
    draw.rectangle(place, fill=MARK)
    draw.text((x + 3, y), label, fill=(255, 255, 255), font=font)


def _overlap(one: Box, other: Box) -> bool:
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]


def picture_of(
    what: str, *, seed: int = 0, renderer: str = "raster", changes: Mapping[str, Any] | None = None
) -> tuple[Image.Image, str]:
    """Return a picture of a task, a scene or a bag, and a line that says what it shows.

    Args:
        what: Name or YAML file of a task, name of a skill or its file, name or YAML file of a scene, or path of a bag.
        seed: Seed of a task's scene.
        renderer: Renderer by name.
        changes: What changes a task, as `task_text` takes it; refused with a scene or a bag.

    Raises:
        ConfigError: When there is no such thing.
        RoboximError: When it cannot be drawn.
    """
    given = {name: value for name, value in (changes or {}).items() if value}
    with ScenePainter(renderer) as painter:
        path = Path(what)
        is_bag = path.exists() and path.suffix not in (".yaml", ".yml", ".py")
        is_scene = what in config_names("scenes") or (path.suffix in (".yaml", ".yml") and _is_scene(path))
        if given and (is_bag or is_scene):
            raise ConfigError(f"{what} is {'a bag' if is_bag else 'a scene'}, and {', '.join(given)} changes a task")
        if is_bag:
            reader = BagReader(path)
            first = next(iter(reader.ticks()))
            return painter.picture(reader.info.scene, reader.info.task, first.state), reader.info.task.instruction
        if is_scene:
            scene = load_scenery(named_config("scenes", what), SceneSpec)
            return painter.picture(scene), f"scene {what}: {counted(len(scene.entities), 'object')}"
        text, _ = named_task(what, others=config_names("scenes"), **given)
        drawn = painter.draw(SeedPath(run_seed=seed, purpose="demo", index=0), parse_task_config(text))
        return painter.picture(drawn.scene, drawn.task), drawn.task.instruction


def _is_scene(path: Path) -> bool:
    """Tell whether a YAML file is a scene: it has a robot or entities, and neither a skill nor cells."""
    keys = set(load_yaml(path) or ()) if path.is_file() else set()
    return bool(keys & {"robot", "entities", "table"}) and not keys & {"skill", "cells"}
