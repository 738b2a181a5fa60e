"""MuJoCo's renderer on a RoboXim scene: ``run_mujoco.py FOLDER`` with ``scene.xml`` and ``frames.json``.

The response to a request ``{"pairs": n}`` is the wall and processor times of n pairs of RGB images [ms].
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from _serve import serve


def make() -> Any:
    """Load the scene."""
    folder = Path(sys.argv[1])
    frames = json.loads((folder / "frames.json").read_text())
    model = mujoco.MjModel.from_xml_path(str(folder / "scene.xml"))
    data = mujoco.MjData(model)
    renderer = mujoco.Renderer(model, height=frames["size"], width=frames["size"])
    cameras = frames["cameras"]
    counter = 0

    def pair() -> list[np.ndarray]:
        nonlocal counter
        frame = frames["frames"][counter % len(frames["frames"])]
        counter += 1
        data.mocap_pos[:], data.mocap_quat[:] = frame["positions"], frame["quaternions"]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_camlight(model, data)
        images = []
        for camera in cameras:
            renderer.update_scene(data, camera)
            images.append(renderer.render().copy())
        return images

    def handle(request: dict[str, Any]) -> dict[str, Any]:
        wall, cpu = [], []
        for _ in range(request["pairs"]):
            start, processor = time.perf_counter(), time.process_time()
            images = pair()
            wall.append(1e3 * (time.perf_counter() - start))
            cpu.append(1e3 * (time.process_time() - processor))
        if request.get("save"):
            np.save(folder / "images.npy", np.concatenate(images, axis=1))
        return {"wall_ms": wall, "cpu_ms": cpu}

    pair()
    return handle


if __name__ == "__main__":
    serve(make)
