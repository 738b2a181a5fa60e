"""The contact sheet of objects: one picture per object, alone on the default table, in the default look."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from roboxim_core.models.articulation import object_link_poses
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import body_key, render_world
from roboxim_core.poses import Array, Pose, look_at
from roboxim_core.specs import CameraSpec, EntitySpec, SceneSpec
from roboxim_core.vision.renderer import Renderer, RenderWorld

AZIMUTH_RAD, ELEVATION_RAD = math.radians(40.0), math.radians(34.0)
"""Direction from the object to the camera; azimuth 0 is the object's x axis."""
FOV_RAD = math.radians(28.0)
MARGIN = 1.25
"""Width of the picture relative to the object's width."""
PLACE = (0.5, 0.0)
"""Position of the object on the table [m]."""
LABEL_PX = 22
GAP_PX = 4


def object_world(entity: EntitySpec, library: ModelLibrary) -> RenderWorld:
    """Return the default room with one object and without the robot.

    Raises:
        ConfigError: When the model or a modifier is unknown, or a mesh or texture cannot be read.
    """
    world = render_world(SceneSpec(entities=(entity,)), library)
    return replace(world, bodies=tuple(body for body in world.bodies if body.entity != "robot"))


def draw_object(renderer: Renderer, library: ModelLibrary, entity: EntitySpec, pixels: int) -> Image.Image:
    """Draw one object close up.

    Args:
        renderer: Renderer.
        library: Library of the model.
        entity: Model, modifiers and joint positions; the pose is replaced.
        pixels: Width and height of the picture.

    Raises:
        ConfigError: See `object_world`.
    """
    model = library.entity_model(entity)
    entity = replace(entity, pose=Pose(position=(*PLACE, model.rest_height)))
    world = object_world(entity, library)
    links = object_link_poses(model, entity.joint_positions)
    poses = {body_key(entity.name, link): entity.pose @ pose for link, pose in links.items()}
    points = np.concatenate(
        [
            poses[body.key].apply(part.mesh.vertices)
            for body in world.bodies
            if body.entity == entity.name
            for part in body.parts
        ]
    )
    camera = CameraSpec(name="sheet", width=pixels, height=pixels, fov_y_rad=FOV_RAD, near=0.05)
    renderer.load(world)
    return Image.fromarray(renderer.render(poses, [(camera, _view(points))])["sheet"].rgb)


def _view(points: Array) -> Pose:
    """Return a camera's pose in which points of shape (N, 3) in the world fill its image."""
    center = (points.min(axis=0) + points.max(axis=0)) / 2
    flat = math.cos(ELEVATION_RAD)
    direction = np.array([flat * math.cos(AZIMUTH_RAD), flat * math.sin(AZIMUTH_RAD), math.sin(ELEVATION_RAD)])
    axes = look_at(center + direction, center).rotation
    x, y, towards = axes.inv().apply(points - center).T
    middle = axes.apply([(x.min() + x.max()) / 2, (y.min() + y.max()) / 2, 0.0]) + center
    reach = np.maximum(np.abs(x - (x.min() + x.max()) / 2), np.abs(y - (y.min() + y.max()) / 2))
    away = float((MARGIN * reach / math.tan(FOV_RAD / 2) - towards).max())
    return look_at(middle + away * direction, middle)


def contact_sheet(pictures: Sequence[Image.Image], labels: Iterable[str] | None, columns: int) -> Image.Image:
    """Arrange pictures of one size in rows.

    Args:
        pictures: Pictures, at least one.
        labels: Text under each; none: no text.
        columns: Pictures in a row.
    """
    width, height = pictures[0].size
    cell = height + (LABEL_PX if labels is not None else 0) + GAP_PX
    rows = math.ceil(len(pictures) / columns)
    sheet = Image.new("RGB", (columns * (width + GAP_PX) + GAP_PX, rows * cell + GAP_PX), (245, 245, 245))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(15)
    texts = [""] * len(pictures) if labels is None else list(labels)
    for k, (picture, text) in enumerate(zip(pictures, texts, strict=True)):
        x, y = GAP_PX + (k % columns) * (width + GAP_PX), GAP_PX + (k // columns) * cell
        sheet.paste(picture, (x, y))
        draw.text((x + width / 2, y + height + LABEL_PX / 2), text, fill=(30, 30, 30), font=font, anchor="mm")
    return sheet
