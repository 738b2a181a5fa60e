"""Draws what the Foxglove layout ``run.json`` shows of a bag, with matplotlib, for machines without Foxglove.

The panels, topics and message paths are those of the layout. The arrangement is fixed here, and the 3D panel is drawn
by a painter's algorithm.

    .venv/bin/python scripts/draw_foxglove_layout.py BAG --tick 30 --out picture.png
"""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader
from roboxim_ros.messages.conversions import image_from_msg

LAYOUT = Path(__file__).parents[1] / "config" / "foxglove" / "run.json"
LARGEST_M = 0.04
"""Longest side of a triangle that the painter's algorithm sorts [m]."""
LIGHT = np.array([0.3, -0.4, 0.85])


class Shown:
    """A bag as a viewer plays it: the messages up to a tick."""

    def __init__(self, bag: BagReader, tick: int) -> None:
        """Read the messages that panels may ask for."""
        self.of_topic: dict[str, list[tuple[float, Any]]] = {}
        for topic, stamp_ns, message in bag.messages():
            self.of_topic.setdefault(topic, []).append((stamp_ns / 1e9, message))
        self.now_s = tick * bag.info.scene.tick_ns / 1e9

    def newest(self, topic: str) -> Any:
        """Return the newest message of a topic."""
        return [message for stamp, message in self.of_topic[topic] if stamp <= self.now_s + 1e-9][-1]

    def series(self, path: str) -> tuple[list[float], list[Any]]:
        """Return times [s] and values of a message path, e.g. ``/topic.list[:]{name=="held_s"}.value``."""
        topic, _, rest = path.partition(".")
        times, values = [], []
        for stamp, message in self.of_topic[topic]:
            found = [message]
            for part in re.findall(r"[^.\[{]+(?:\[[^\]]*\])?(?:\{[^}]*\})?", rest):
                name, index, field, wanted = re.fullmatch(
                    r'([^\[{]+)(?:\[([^\]]*)\])?(?:\{(\w+)=="([^"]*)"\})?', part
                ).groups()  # type: ignore[union-attr]
                found = [getattr(value, name) for value in found]
                if index == ":":
                    found = [item for value in found for item in value]
                elif index is not None:
                    found = [value[int(index)] for value in found if len(value) > int(index)]
                if field:
                    found = [value for value in found if getattr(value, field) == wanted]
            if found:
                times.append(stamp)
                values.append(found[0])
        return times, values

    def transforms(self) -> dict[str, tuple[np.ndarray, Rotation]]:
        """Return the pose of each frame in the world."""
        found = {"world": (np.zeros(3), Rotation.identity())}
        for topic in ("/tf_static", "/tf"):
            for item in self.newest(topic).transforms:
                t, q = item.transform.translation, item.transform.rotation
                found[item.child_frame_id] = (np.array([t.x, t.y, t.z]), Rotation.from_quat([q.x, q.y, q.z, q.w]))
        return found


def divided(corners: np.ndarray) -> np.ndarray:
    """Return triangles, shape (N, 3, 3), divided until they are small enough to be sorted by depth."""
    while True:
        sides = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        large = sides.max(axis=1) > LARGEST_M
        if not large.any():
            return corners
        split = corners[large]
        at = np.arange(len(split))
        longest = sides[large].argmax(axis=1)
        a, b, c = (split[at, (longest + k) % 3] for k in range(3))
        middle = (a + b) / 2
        corners = np.concatenate([corners[~large], np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


def draw_scene(axes: Any, shown: Shown, camera: dict[str, Any], config: dict[str, Any]) -> None:
    """Draw the markers with the layout's camera."""
    polar, turn = np.radians(camera["phi"]), np.radians(camera["thetaOffset"])
    back = np.array([np.sin(polar) * -np.sin(turn), np.sin(polar) * -np.cos(turn), np.cos(polar)])
    eye = np.array(camera["targetOffset"], float) + camera["distance"] * back
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    up = np.cross(back, right)
    frames = shown.transforms()
    triangles, colors = [], []
    for marker in shown.newest("/sim/markers").markers:
        if not len(marker.points) or not config.get("namespaces", {}).get(marker.ns, {}).get("visible", True):
            continue
        position, rotation = frames[marker.header.frame_id]
        points = np.array([[p.x, p.y, p.z] for p in marker.points])
        corners = divided((rotation.apply(points) + position).reshape(-1, 3, 3))
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        seen = np.einsum("ij,ij->i", normals, eye - corners.mean(axis=1)) > 0
        light = 0.45 + 0.55 * np.clip(normals @ (LIGHT / np.linalg.norm(LIGHT)), 0, 1)
        color = np.array([marker.color.r, marker.color.g, marker.color.b])
        triangles.append(corners[seen])
        colors.append(light[seen, None] * color)
    corners, shade = np.concatenate(triangles), np.clip(np.concatenate(colors), 0, 1)
    local = corners - eye
    depth = -(local @ back)
    flat = np.stack([local @ right, local @ up], axis=-1) / np.maximum(depth, 1e-3)[..., None]
    order = np.argsort(-depth.mean(axis=1))
    half = np.tan(np.radians(camera["fovy"]) / 2)
    axes.add_collection(PolyCollection(flat[order], facecolors=shade[order], edgecolors=shade[order], linewidths=0.2))
    axes.set(
        xlim=(-1.5 * half, 1.5 * half), ylim=(-half, half), aspect="equal", xticks=[], yticks=[], facecolor="#1b1e24"
    )


def draw_plot(axes: Any, shown: Shown, config: dict[str, Any]) -> None:
    """Draw a plot over time, with a line at the present."""
    for path in config["paths"]:
        times, values = shown.series(path["value"])
        axes.plot(times, [float(v) for v in values], color=path["color"], lw=1, label=path["value"])
    axes.axvline(shown.now_s, color="0.3", lw=0.8)
    axes.set_title(config["foxglovePanelTitle"], fontsize=8, loc="left")
    axes.legend(fontsize=5, loc="upper left", framealpha=0.6)
    axes.tick_params(labelsize=6)
    if "minYValue" in config:
        axes.set_ylim(config["minYValue"], config["maxYValue"])


def draw(bag: BagReader, tick: int, out: Path) -> None:
    """Draw every panel of the layout at a tick."""
    panels = json.loads(LAYOUT.read_text())["configById"]
    shown = Shown(bag, tick)
    figure = Figure(figsize=(13, 7.5), layout="constrained")
    FigureCanvasAgg(figure)
    images = [name for name in panels if name.startswith("Image!")]
    plots = [name for name in panels if name.startswith("Plot!")]
    left, side = figure.subfigures(1, 2, width_ratios=(58, 42))
    top, bottom = left.subfigures(2, 1, height_ratios=(62, 38))
    scene = panels["3D!scene"]
    draw_scene(top.subplots(), shown, scene["cameraState"], scene["topics"]["/sim/markers"])
    for axes, name in zip(np.atleast_1d(bottom.subplots(1, len(images))), images, strict=True):
        axes.imshow(image_from_msg(shown.newest(panels[name]["imageMode"]["imageTopic"])))
        axes.set(title=panels[name]["imageMode"]["imageTopic"], xticks=[], yticks=[])
        axes.title.set_fontsize(8)
    rows = side.subplots(1 + len(plots), 1, height_ratios=[0.7, *[1.0] * len(plots)])
    lines = [f"instruction: {shown.series(panels['RawMessages!instruction']['topicPath'])[1][0]}"]
    for path in panels["StateTransitions!phase"]["paths"]:
        times, values = shown.series(path["value"])
        at = max(i for i, stamp in enumerate(times) if stamp <= shown.now_s + 1e-9)
        lines.append(f"{path['label']}: {values[at] or '-'}")
    rows[0].text(0.0, 0.5, "\n".join([*lines, f"t = {shown.now_s:.1f} s"]), fontsize=10, va="center")
    rows[0].set_axis_off()
    for axes, name in zip(rows[1:], plots, strict=True):
        draw_plot(axes, shown, panels[name])
    figure.savefig(out, dpi=100)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("bag", type=Path)
    parser.add_argument("--tick", type=int, default=0, help="tick to show")
    parser.add_argument("--out", type=Path, required=True, help="picture to write")
    arguments = parser.parse_args()
    bag = BagReader(arguments.bag)
    if topics.MARKERS not in bag.types:
        parser.error(f"{arguments.bag} has no {topics.MARKERS}; it is of an earlier version of RoboXim")
    draw(bag, arguments.tick, arguments.out)


if __name__ == "__main__":
    main()
