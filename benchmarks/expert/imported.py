"""Meshes that nobody here chose: how many are imported, and how many of those that fit the gripper are picked up.

The meshes are drawn by seed from `pybullet_data`'s random shapes, and taken from the folders of ``--meshes``. Each is
imported by the rules of `roboxim assets import`, without a word about it. The expert then picks each object up with
fresh scenes, without distractors; an episode that needed a second grasp is not a success.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pybullet_data
import yaml
from benchmarks._harness import Bench
from tqdm import tqdm

from roboxim_core.errors import RoboximError

SUFFIXES = {".obj", ".stl", ".glb", ".ply", ".dae"}


def main() -> None:
    """Import, pick up, print."""
    bench = Bench("imported", __doc__, add_options)
    options = bench.options
    out: Path = options.out
    os.environ["ROBOXIM_CONFIG_PATH"] = str(out)
    meshes = chosen(options.shapes if not bench.quick else 2, options.seed, options.meshes)
    resets = 2 if bench.quick else options.resets
    rows: list[dict[str, Any]] = []
    for mesh in tqdm(meshes, unit="mesh", disable=None):
        kept = out / "rows" / f"{mesh.parent.name}-{mesh.stem}-{resets}.json"
        if not kept.is_file():
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps(row(mesh, out, resets, options.gripper, options.robot)))
        rows.append(json.loads(kept.read_text()))
        bench.row(**rows[-1])
    imported = [one for one in rows if one["imported"]]
    fitting = [one for one in imported if one["grasps"]]
    held = [one["picked_up"] / one["resets"] for one in fitting]
    sys.stdout.write(
        f"imported {len(imported)} of {len(rows)}; a grasp found for {len(fitting)}; of these picked up at the first "
        f"try: {np.mean(held):.1%} of {resets} resets each, every time {sum(share == 1 for share in held)}\n"
    )
    bench.finish("first-try picks of imported objects with a grasp", float(np.mean(held)), "", at_least=0.9)


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of this benchmark."""
    parser.add_argument("--out", type=Path, default=Path("runs/imported"), metavar="DIR", help="kept here; continued")
    parser.add_argument("--shapes", type=int, default=45, metavar="N", help="random shapes (default: 45)")
    parser.add_argument("--seed", type=int, default=1, help="seed of their choice (default: 1)")
    parser.add_argument("--meshes", type=Path, nargs="*", default=[], metavar="DIR", help="folders with more meshes")
    parser.add_argument("--gripper", default="franka_hand", help="gripper that shall grasp them (default: franka_hand)")
    parser.add_argument("--robot", default="", help="arm that has it (default: the scene's, which has the Franka hand)")
    parser.add_argument("--resets", type=int, default=20, metavar="N", help="resets of each object (default: 20)")


def chosen(shapes: int, seed: int, folders: list[Path]) -> list[Path]:
    """Return the meshes: random shapes by seed, and all of some folders."""
    all_shapes = sorted((Path(pybullet_data.getDataPath()) / "random_urdfs").glob("*/*.obj"))
    drawn = np.random.default_rng(seed).permutation(len(all_shapes))[:shapes]
    others = [file for folder in folders for file in sorted(folder.rglob("*")) if file.suffix.lower() in SUFFIXES]
    return [*(all_shapes[k] for k in sorted(drawn)), *others]


def row(mesh: Path, out: Path, resets: int, gripper: str, robot: str) -> dict[str, Any]:
    """Import a mesh and pick the object up; return the figures."""
    from roboxim_runs.assets.importing import ImportOptions, import_mesh

    found: dict[str, Any] = {"mesh": f"{mesh.parent.name}/{mesh.name}", "imported": 0, "grasps": 0, "picked_up": 0}
    try:
        made = import_mesh(_renamed(mesh, out / "meshes"), out / "objects", ImportOptions(gripper=gripper))
    except RoboximError as error:
        return found | {"resets": 0, "why": str(error)[:120]}
    model = yaml.safe_load(made.file.read_text())
    grasps = len(model.get("grasps", ()))
    found |= {"imported": 1, "grasps": grasps, "resets": resets if grasps else 0, "why": ""}
    if not grasps:
        return found | {"why": next(line for line in made.report if line.startswith("grasps:"))[:120]}
    reasons = picks(made.file.stem, resets, robot)
    failures = [reason for reason in reasons if reason]
    return found | {"picked_up": resets - len(failures), "why": "; ".join(sorted(set(failures)))[:120]}


def _renamed(mesh: Path, folder: Path) -> Path:
    """Return a link to a mesh under a name that hides no object of RoboXim's, with its neighbours beside it."""
    inside = folder / mesh.parent.name
    inside.mkdir(parents=True, exist_ok=True)
    for file in mesh.parent.iterdir():
        link = inside / (f"mesh_{file.name}" if file == mesh else file.name)
        if not link.is_symlink():
            link.symlink_to(file.resolve())
    return inside / f"mesh_{mesh.name}"


def picks(object_id: str, resets: int, robot: str) -> list[str]:
    """Let the expert pick up an object; return why each try failed, empty for a success."""
    from benchmarks.expert._expert_run import CellRunner

    from roboxim_runs.episodes.task_choice import task_text
    from roboxim_tasks.config import merged

    change = {
        "objects": {"target": {"models": [object_id]}}, "distractors": {"minimum": 0, "maximum": 0},
        "reset": {"cameras": {"names": ["workspace"]}}, "robot": robot,
    }  # fmt: skip
    config = yaml.safe_dump(merged(yaml.safe_load(task_text(skill="pick_up")), change))
    runner = CellRunner()  # anew: its library has read what was there before
    outcomes = [runner.run(object_id, config, index, replay=False) for index in range(resets)]
    return ["" if one.first_try else one.reason or "second grasp" for one in outcomes]


if __name__ == "__main__":
    main()
