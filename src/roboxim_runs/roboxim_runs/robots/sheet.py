"""Pictures of robots at the table, and of where they reach."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from roboxim_core.config import named_config
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import render_world
from roboxim_core.plain_data.pictures import load_scenery
from roboxim_core.poses import look_at
from roboxim_core.specs import CameraSpec, RobotSpec, SceneSpec
from roboxim_runs.assets.sheet import contact_sheet
from roboxim_runs.robots.check import STEP_M, reach_map
from roboxim_sim.rendering import make_renderer
from roboxim_sim.world import World

CAMERA = ("sheet", (1.55, 0.85, 0.95), (0.28, 0.0, 0.36), math.radians(42.0))
"""Name, eye [m], target [m] and vertical field of view [rad] of the camera that sees a whole arm."""


def draw_robots(robots: Sequence[str], pixels: int, renderer: str = "raster") -> Image.Image:
    """Return one picture of robots, each at its home position at the table of the scene ``empty_table``.

    Args:
        robots: Ids.
        pixels: Side of each picture [px].
        renderer: Renderer by name.
    """
    library, pictures = ModelLibrary(), []
    name, eye, target, fov = CAMERA
    camera = CameraSpec(name=name, pose=look_at(eye, target), fov_y_rad=fov, width=pixels, height=pixels)
    base = load_scenery(named_config("scenes", "empty_table"), SceneSpec)
    drawing = make_renderer(renderer)
    with World(library) as world:
        for robot in robots:
            world.load(replace(base, robot=RobotSpec(model=robot), cameras=(camera,)))
            drawing.load(render_world(world.scene, library))
            images = drawing.render(world.body_poses(), [(camera, world.camera_poses()[name])])
            pictures.append(Image.fromarray(images[name].rgb))
    drawing.close()
    titles = [f"{robot}, {len(library.robot(robot).joint_names)} joints" for robot in robots]
    columns = min((4, 3, 5), key=lambda count: -len(robots) % count)  # with the fewest empty places
    return contact_sheet(pictures, titles, columns=min(columns, len(robots)))


def draw_reach(robot: str, file: Path) -> float:
    """Draw where a robot can point its tool down, 15 cm above the table.

    Returns:
        Area that it reaches [m^2].
    """
    xs, ys, reached = reach_map(ModelLibrary().robot(robot))
    figure = Figure(figsize=(5.2, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    half = STEP_M / 2
    extent = (ys[0] - half, ys[-1] + half, xs[0] - half, xs[-1] + half)
    axes.imshow(reached, origin="lower", extent=extent, cmap="Greens", vmin=-0.3, vmax=1.4)
    axes.plot(0.0, 0.0, "ks", markersize=9)
    axes.annotate("base", (0.0, 0.0), textcoords="offset points", xytext=(8, -3))
    axes.set(
        xlabel="y [m]", ylabel="x [m]", ylim=(-0.1, xs[-1] + half), title=f"{robot}: tool down, 15 cm above the table"
    )
    axes.invert_xaxis()
    figure.savefig(file, dpi=110)
    return float(reached.sum()) * STEP_M**2
