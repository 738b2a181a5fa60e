"""Render the documentation's camera images: one frame with every renderer, views, lights and scenes."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from render_scene import example_poses, example_scene
from roboxim_core.config import load_config, named_config
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import render_world
from roboxim_core.specs import CameraSpec, LookSpec, SceneSpec
from roboxim_core.vision.cameras import load_camera
from roboxim_core.vision.looks import Lighting
from roboxim_sim.rendering import make_renderer
from roboxim_sim.rendering.camera_effects import draw_frames

RENDERERS = ("tiny", "raster", "photo")
VIEWS = ("workspace_left", "workspace_front", "workspace_right", "pose_1", "pose_2", "pose_3", "pose_4", "pose_5")
SCENES = ("empty_table", "kitchen", "laboratory", "workshop")
LIGHTS = ("noon", "evening", "overcast", "two_lamps")
Tile = npt.NDArray[np.uint8]


def shoot(scene: SceneSpec, cameras: Sequence[CameraSpec], renderer: str = "raster") -> list[Tile]:
    """Return the camera images of the example scene."""
    library = ModelLibrary()
    scene = replace(scene, cameras=tuple(cameras))
    poses, views = example_poses(scene, library)
    made = make_renderer(renderer)
    made.load(render_world(scene, library))
    frames = draw_frames(made, 0, poses, views)
    made.close()
    return [frames[camera.name].rgb for camera in cameras]


def sheet(rows: Sequence[Sequence[tuple[str, Tile]]]) -> Image.Image:
    """Combine labelled tiles of equal size into one image."""
    height, width = rows[0][0][1].shape[:2]
    picture = Image.new("RGB", (width * max(map(len, rows)), height * len(rows)), "white")
    for y, row in enumerate(rows):
        for x, (label, tile) in enumerate(row):
            image = Image.fromarray(tile)
            draw = ImageDraw.Draw(image)
            box = draw.textbbox((6, 4), label)
            draw.rectangle((box[0] - 4, box[1] - 3, box[2] + 4, box[3] + 3), fill=(255, 255, 255))
            draw.text((6, 4), label, fill=(20, 20, 20))
            picture.paste(image, (x * width, y * height))
    return picture


def look_of(scene: str) -> LookSpec:
    """Return the look of a scene of ``config/scenes``."""
    return load_config(named_config("scenes", scene), SceneSpec).look


def furnished(scene: SceneSpec, name: str) -> SceneSpec:
    """Return a scene with the look and the furniture of another one."""
    other = load_config(named_config("scenes", name), SceneSpec)
    return replace(scene, look=other.look, entities=(*scene.entities, *other.entities))


def main() -> None:
    """Render and save."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    parser.add_argument("--only", choices=["renderers", "views", "looks"], help="render only one of the images")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    scene = example_scene(384)

    def wanted(name: str) -> bool:
        return options.only in (None, name)

    if wanted("renderers"):
        shots = {name: shoot(scene, scene.cameras, name) for name in RENDERERS}
        rows = [[(name, shots[name][i]) for name in RENDERERS] for i in range(2)]
        sheet(rows).save(options.out / "renderers.jpg", quality=88)
    if wanted("views"):
        scene = replace(scene, look=look_of("empty_table"))
        tiles = list(zip(VIEWS, shoot(scene, [load_camera(name) for name in VIEWS]), strict=True))
        sheet([tiles[:4], tiles[4:]]).save(options.out / "camera_views.jpg", quality=85)
    if wanted("looks"):
        camera = replace(load_camera("whole"), width=384, height=384)
        first = [(name, shoot(furnished(scene, name), [camera])[0]) for name in SCENES]
        second = []
        for name in LIGHTS:
            preset = load_config(named_config("lights", name), Lighting)
            look = replace(look_of("empty_table"), lights=preset.lights)
            look = replace(look, ambient=preset.ambient or look.ambient)
            second.append((name, shoot(replace(scene, look=look), [camera])[0]))
        sheet([first, second]).save(options.out / "looks.jpg", quality=85)


if __name__ == "__main__":
    main()
