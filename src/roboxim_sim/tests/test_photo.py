"""The `photo` renderer fulfils the renderers' contract. Needs Blender (`make photo`) and is slow."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from roboxim_core.errors import ErrorCode, InvalidRequestError, SimError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import render_world
from roboxim_core.poses import Pose, look_at
from roboxim_core.specs import CameraSpec, EntitySpec, LightSpec, LookSpec, SceneSpec
from roboxim_core.vision.renderer import Renderer
from roboxim_sim.rendering import make_renderer
from roboxim_sim.rendering.photo import PYTHON_VARIABLE, PhotoRenderer

EYE = look_at((1.1, 0.4, 0.5), (0.45, 0.0, 0.0))
CAMERA = CameraSpec(
    name="eye", width=96, height=64, depth=True, segmentation=True, intrinsics=(90.0, 100.0, 40.0, 35.0), pose=EYE
)
CUBE = EntitySpec(name="cube", model="cube", pose=Pose(position=(0.45, 0.0, 0.0225)))
SCENE = SceneSpec(entities=(CUBE,), cameras=(CAMERA,))
POSES = {"cube": CUBE.pose}


def test_the_error_without_blender_explains_the_installation(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(PYTHON_VARIABLE, str(tmp_path / "python"))
    with pytest.raises(SimError, match="make photo") as caught:
        make_renderer("photo")
    assert caught.value.code == ErrorCode.RENDERER_UNAVAILABLE


def test_the_error_names_a_python_without_blender_and_its_output(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(PYTHON_VARIABLE, sys.executable)
    with pytest.raises(SimError, match="(?s)does not start.*No module named 'bpy'") as caught:
        make_renderer("photo")
    assert caught.value.code == ErrorCode.RENDERER_UNAVAILABLE


@pytest.fixture(scope="module")
def photo() -> Iterator[Renderer]:
    try:
        made = PhotoRenderer(samples=2)
    except SimError as error:
        pytest.skip(str(error))
    yield made
    made.close()


@pytest.mark.slow
def test_depth_and_ids_equal_those_of_raster(photo: Renderer) -> None:
    world = render_world(SCENE, ModelLibrary())
    raster = make_renderer("raster")
    raster.load(world)
    expected = raster.render(POSES, [(CAMERA, EYE)])["eye"]
    raster.close()
    photo.load(world)
    seen = photo.render(POSES, [(CAMERA, EYE)])["eye"]
    same = seen.segmentation == expected.segmentation
    assert same.mean() > 0.99
    robot = seen.segmentation == world.entity_names.index("robot") + 1  # raster draws a distant robot coarser
    errors = np.abs(seen.depth - expected.depth)
    assert np.percentile(errors[same & ~robot & np.isfinite(expected.depth)], 99) < 1e-4
    assert np.percentile(errors[same & robot], 90) < 0.01
    assert set(np.unique(seen.segmentation)) == set(np.unique(expected.segmentation))
    assert np.abs(seen.rgb.astype(float).mean(axis=(0, 1)) - expected.rgb.mean(axis=(0, 1))).max() < 25


@pytest.mark.slow
def test_images_are_the_same_in_any_order_process_and_number_of_threads(photo: Renderer) -> None:
    world = render_world(SCENE, ModelLibrary())
    photo.load(world)
    first = photo.render(POSES, [(CAMERA, EYE)])["eye"]
    photo.render({"cube": Pose(position=(0.6, 0.1, 0.1))}, [(replace(CAMERA, width=40, intrinsics=()), EYE)])
    second = photo.render(POSES, [(CAMERA, EYE)])["eye"]
    other = PhotoRenderer(samples=2, threads=1)
    other.load(world)
    third = other.render(POSES, [(CAMERA, EYE)])["eye"]
    other.close()
    assert np.array_equal(first.rgb, second.rgb)
    assert np.array_equal(first.rgb, third.rgb)
    assert np.array_equal(first.depth, third.depth)


@pytest.mark.slow
def test_lights_and_backgrounds_follow_the_scene(photo: Renderer) -> None:
    def mean(**look: object) -> np.ndarray:
        scene = replace(SCENE, look=LookSpec(**look))
        photo.load(render_world(scene, ModelLibrary()))
        return photo.render(POSES, [(replace(CAMERA, depth=False, segmentation=False), EYE)])["eye"].rgb.mean((0, 1))

    dark = mean(lights=(), ambient=(0.1, 0.1, 0.1))
    lamp = mean(lights=(LightSpec(kind="lamp", position=(0.5, 0.5, 1.0), color=(1, 0.3, 0.3)),), ambient=(0.1,) * 3)
    assert (lamp > dark + 5).all()
    assert lamp[0] - dark[0] > 1.5 * (lamp[2] - dark[2])
    away = look_at((1.1, 0.4, 0.5), (3.0, 1.2, 1.5))
    scene = replace(SCENE, look=LookSpec(background="plain", backdrop=(0.2, 0.4, 0.8)))
    photo.load(render_world(scene, ModelLibrary()))
    sky = photo.render({}, [(CAMERA, away)])["eye"]
    assert np.abs(sky.rgb[20:, 20:] - np.array([51, 102, 204])).max() <= 2
    assert np.isinf(sky.depth).all()
    assert not sky.segmentation.any()


@pytest.mark.slow
def test_wrong_use_is_refused_and_does_not_end_blender(photo: Renderer) -> None:
    photo.load(render_world(SCENE, ModelLibrary()))
    with pytest.raises(InvalidRequestError, match="unknown bodies"):
        photo.render({"nobody": Pose()}, [(CAMERA, EYE)])
    assert math.isfinite(photo.render(POSES, [(CAMERA, EYE)])["eye"].rgb.mean())


def test_the_worker_imports_nothing_of_roboxim() -> None:
    from roboxim_sim.rendering import photo_worker

    script = (
        "import sys, importlib.util as u; s = u.spec_from_file_location('w', sys.argv[1]); m = u.module_from_spec(s);"
        "s.loader.exec_module(m); sys.exit(any(n.startswith('roboxim') for n in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", script, photo_worker.__file__], check=False).returncode == 0
