"""Writes the Foxglove layouts of ``config/foxglove``: ``run.json`` for bags, ``live.json`` for a running graph.

Both show the same panels. They differ in who draws the robot: in bags its markers, which need no file; in a running
graph the URDF, whose meshes ``foxglove_bridge`` serves.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parents[1] / "config" / "foxglove"
CAMERAS = ("workspace", "wrist")
COLORS = ("#f5774d", "#4e98e2", "#52b788", "#f2c14e", "#9d4edd", "#e5383b", "#7f8c8d")


def layout(*, live: bool) -> dict[str, Any]:
    """Return a layout as Foxglove exports it.

    Args:
        live: Whether it is for a running graph.
    """
    panels = {
        "3D!scene": scene(live=live),
        **{f"Image!{camera}": image(camera) for camera in CAMERAS},
        "RawMessages!instruction": raw("/episode/info.task.instruction", "Instruction"),
        "Plot!motion": plot("Executed action [m, rad]", [f"/evaluator/step.action_executed[{i}]" for i in range(6)]),
        "Plot!gripper": plot(
            "Gripper", ["/evaluator/step.action_executed[6]", "/sim/state.robot.gripper_opening"], low=-0.1, high=1.1
        ),
        "Plot!verdict": plot(
            "Verdict",
            [
                "/evaluator/step.verdict.success",
                "/evaluator/step.verdict.failed",
                '/evaluator/step.verdict.predicates[:]{name=="held_s"}.value',
                "/evaluator/step.disturbance",
            ],
        ),
        "StateTransitions!phase": {
            "isSynced": True,
            "paths": [
                {"value": "/evaluator/step.phase", "label": "phase", "timestampMethod": "receiveTime"},
                {"value": "/evaluator/step.verdict.reason", "label": "reason", "timestampMethod": "receiveTime"},
            ],
        },
    }
    cameras = split("row", *(f"Image!{camera}" for camera in CAMERAS))
    left = split("column", "3D!scene", cameras, at=62)
    plots = split("column", "Plot!motion", split("column", "Plot!gripper", "Plot!verdict"), at=40)
    told = split("column", "RawMessages!instruction", "StateTransitions!phase", at=45)
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": split("row", left, split("column", told, plots, at=26), at=58),
    }


def split(direction: str, first: Any, second: Any, at: int = 50) -> dict[str, Any]:
    """Return two panels side by side (``row``) or one above the other (``column``)."""
    return {"direction": direction, "first": first, "second": second, "splitPercentage": at}


def scene(*, live: bool) -> dict[str, Any]:
    """Return the 3D panel: robot and objects, seen from the front left."""
    return {
        "foxglovePanelTitle": "Scene",
        "followTf": "world",
        "followMode": "follow-none",
        "cameraState": {
            "perspective": True, "distance": 1.7, "phi": 62, "thetaOffset": -125, "fovy": 45, "near": 0.05, "far": 100,
            "target": [0, 0, 0], "targetOffset": [0.35, 0, 0.2], "targetOrientation": [0, 0, 0, 1],
        },
        "scene": {"transforms": {"axisScale": 0, "showLabel": False, "lineWidth": 0}},
        "transforms": {},
        "topics": {
            "/sim/markers": {"visible": True, "namespaces": {"robot": {"visible": not live}}},
            "/robot_description": {"visible": live, "displayMode": "visual"},
        },
        "layers": {},
        "publish": {},
        "imageMode": {},
    }  # fmt: skip


def image(camera: str) -> dict[str, Any]:
    """Return a camera's panel."""
    return {
        "foxglovePanelTitle": camera,
        "imageMode": {
            "imageTopic": f"/camera/{camera}/image",
            "calibrationTopic": f"/camera/{camera}/camera_info",
        },
        "topics": {},
        "layers": {},
    }


def raw(path: str, title: str) -> dict[str, Any]:
    """Return a panel that shows a value as text."""
    return {
        "foxglovePanelTitle": title, "topicPath": path, "diffEnabled": False, "diffMethod": "custom",
        "diffTopicPath": "", "showFullMessageForDiff": False,
    }  # fmt: skip


def plot(title: str, paths: Sequence[str], low: float | None = None, high: float | None = None) -> dict[str, Any]:
    """Return a plot over time."""
    bounds = {key: value for key, value in (("minYValue", low), ("maxYValue", high)) if value is not None}
    return {
        "foxglovePanelTitle": title,
        "paths": [
            {"value": path, "enabled": True, "timestampMethod": "receiveTime", "color": color}
            for path, color in zip(paths, COLORS, strict=False)
        ],
        "xAxisVal": "timestamp", "isSynced": True, "showLegend": True, "legendDisplay": "floating",
        "showPlotValuesInLegend": False, "showXAxisLabels": True, "showYAxisLabels": True, "sidebarDimension": 240,
        **bounds,
    }  # fmt: skip


def files() -> dict[str, str]:
    """Return the name and the text of each layout file."""
    return {
        f"{name}.json": json.dumps(layout(live=live), indent=2) + "\n"
        for name, live in (("run", False), ("live", True))
    }


def main() -> None:
    """Write the files."""
    FOLDER.mkdir(exist_ok=True)
    for name, text in files().items():
        (FOLDER / name).write_text(text)


if __name__ == "__main__":
    main()
