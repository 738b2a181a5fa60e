"""Compare conventions with genuine clients: pictures, states, prompts, cameras and the motion of the arm.

    make verify-conventions                                   # with the clients that PyPI has
    make verify-conventions SOURCE="../openpi ../openvla-oft" # with clones: their own code runs

It runs `scripts/genuine_clients.py` in an environment of its own, writes ``pictures.png``, ``conventions.md`` and
``conventions.json`` into ``--out``, and ends with exit code 1 if a picture differs by more than one grey level, or a
state, prompt or motion by more than its tolerance.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from roboxim_core.config_folders import config_names
from roboxim_core.conventions import (
    ControllerResponse,
    Convention,
    ImageInput,
    decode_actions,
    load_convention,
    observe,
)
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.models.visuals import ScenePoses, render_world
from roboxim_core.policies import Observation, ObservationWindow
from roboxim_core.poses import Pose
from roboxim_core.proprioception import Proprioception
from roboxim_core.rotation.representations import RotationRepresentation, encode
from roboxim_core.specs import EntitySpec, SceneSpec, TableSpec
from roboxim_core.state import RobotState
from roboxim_core.vision.cameras import load_camera
from roboxim_runs.environments.session import EpisodeSession, SessionConfig
from roboxim_sim.rendering import make_renderer

ROOT = Path(__file__).resolve().parents[1]
GENUINE = ROOT / ".tools" / "verify-conventions-env" / "bin" / "python"
LEROBOT = ROOT / ".tools" / "verify-lerobot-env" / "bin" / "python"
INSTRUCTION = "Pick up the red cube"
GREY_LEVELS = 1
"""Largest allowed difference of a pixel from the genuine client's."""
STATE = 1e-3
"""Largest allowed difference of a number of the state [m, rad]."""
COLUMNS_PX = 5.0
"""Largest allowed distance of the cube's column from the client's [px]; the cubes have different sizes."""
LIBERO_BASE = np.array([-0.66, 0.0, 0.912])
STEPS = 14
COMPONENTS = ("x", "y", "z", "about x", "about y", "about z")


@dataclass
class Result:
    """What was compared for one convention."""

    client: str
    """The code that the convention was compared with."""
    grey_levels: float = 0.0
    """Largest difference of a pixel on the marked pattern."""
    mean_grey_levels: float = 0.0
    """Mean difference of a pixel on the marked pattern."""
    state: float | None = None
    """Largest difference of a number of the state; none: the convention sends none, or none was compared."""
    prompt: bool | None = None
    """Whether the prompt is equal; none: it was not compared."""
    columns: dict[str, list[float]] = field(default_factory=dict)
    """Picture to the column of the scene's cube in the genuine client's and in RoboXim's picture [px]."""
    faults: list[str] = field(default_factory=list)
    """What differs by more than its tolerance."""


def proprioception(scene: dict[str, Any]) -> Proprioception:
    """Return RoboXim's measurements in robosuite's joint positions: the pose follows from RoboXim's own kinematics."""
    pose = ArmKinematics(ModelLibrary().robot("panda")).fk(scene["joints"])
    rotation = encode(pose.rotation, RotationRepresentation.ROTATION_6D)
    return Proprioception(
        tcp_position=pose.position, tcp_rotation_6d=tuple(rotation.tolist()),
        joint_names=tuple(f"panda_joint{i}" for i in range(1, 8)), joint_positions=tuple(scene["joints"].tolist()),
        joint_velocities=(0.0,) * 7, gripper_opening=float(np.abs(scene["robot0_gripper_qpos"]).mean() / 0.04),
    )  # fmt: skip


def rendered(scene: dict[str, Any]) -> dict[str, np.ndarray]:
    """Return RoboXim's pictures of robosuite's scene, drawn by LIBERO's cameras, by the camera that policies see."""
    cube = tuple(scene["cube_in_base"].tolist())
    entity = EntitySpec(name="cube", model="cube", modifiers={"color": "red"}, pose=Pose(position=cube))
    views = {"workspace": load_camera("libero_agentview"), "wrist": load_camera("libero_wrist")}
    drawn = SceneSpec(
        entities=(entity,), cameras=tuple(views.values()), table=TableSpec(center=(0.5, 0.0, cube[2] - 0.02))
    )
    library, joints = ModelLibrary(), tuple(scene["joints"].tolist())
    pose = ArmKinematics(library.robot("panda")).fk(joints)
    fingers = tuple(np.abs(scene["robot0_gripper_qpos"]).tolist())
    opening = float(np.mean(fingers) / 0.04)
    robot = RobotState(
        joint_names=library.robot("panda").joint_names, joint_positions=joints, joint_velocities=(0.0,) * 7,
        joint_commands=joints, pose_tcp_measured=pose, pose_tcp_commanded=pose, gripper_opening=opening,
        gripper_command=opening, finger_positions=fingers,
    )  # fmt: skip
    placed, world = ScenePoses(drawn, library), render_world(drawn, library)
    poses = {f"robot/{link}": at for link, at in placed.link_poses(robot).items()} | {"cube": entity.pose}
    keys = {body.key for body in world.bodies}
    seen_from = placed.camera_poses(robot)
    renderer = make_renderer("raster")
    try:
        renderer.load(world)
        images = renderer.render(
            {key: at for key, at in poses.items() if key in keys}, [(c, seen_from[c.name]) for c in drawn.cameras]
        )
        return {name: images[camera.name].rgb for name, camera in views.items()}
    finally:
        renderer.close()


def red_column(picture: np.ndarray) -> float:
    """Return the middle column of a picture's red cube [px]."""
    red, green, blue = np.moveaxis(picture.astype(int), 2, 0)
    columns = np.nonzero((red > 60) & (red > 2 * green) & (red > 2 * blue))[1]
    return float(np.median(columns)) if len(columns) else float("nan")


def compare(
    name: str, client: str, requests: dict[str, Any], scene: dict[str, Any], pictures: dict[str, np.ndarray]
) -> tuple[Result, Image.Image]:
    """Compare one convention with its client."""
    convention, result = load_convention(name), Result(client=client)
    of_libero = f"scene|{name}|{convention.prompt.key}" in requests
    rows = []
    for image in convention.images:
        theirs = requests.get(f"pattern|{name}|{image.key}")
        if theirs is None:
            result.faults.append(f"the client sends no picture '{image.key}'")
            continue
        shown = scene[f"pattern {image.render_height} x {image.render_width}"]
        shown = shown[:, ::-1] if of_libero and image.camera == "wrist" else shown
        ours = image.prepare(np.ascontiguousarray(shown))
        rows.append((f"{name} {image.key}", theirs, ours))
        compare_pixels(image, theirs, ours, result)
        if of_libero:
            scenes = requests[f"scene|{name}|{image.key}"], image.prepare(pictures[image.camera])
            rows.append((f"{name} {image.key}", *scenes))
            columns = [red_column(picture) for picture in scenes]
            result.columns[image.key] = columns
            if not abs(columns[0] - columns[1]) <= COLUMNS_PX:
                result.faults.append(f"the cube of '{image.key}' is at column {columns[1]:.0f}, not {columns[0]:.0f}")
    if of_libero:
        compare_texts(convention, requests, scene, result)
    return result, strip(rows)


def compare_pixels(image: ImageInput, theirs: np.ndarray, ours: np.ndarray, result: Result) -> None:
    """Compare a prepared picture of the marked pattern with the client's."""
    if ours.shape != theirs.shape:
        result.faults.append(f"picture '{image.key}' has shape {ours.shape}, the client's {theirs.shape}")
        return
    difference = np.abs(ours.astype(int) - theirs.astype(int))
    result.grey_levels = max(result.grey_levels, float(difference.max()))
    result.mean_grey_levels = max(result.mean_grey_levels, float(difference.mean()))
    if difference.max() > GREY_LEVELS:
        result.faults.append(f"picture '{image.key}' differs by {difference.max()} grey levels")


def compare_texts(convention: Convention, requests: dict[str, Any], scene: dict[str, Any], result: Result) -> None:
    """Compare state and prompt of the scene."""
    name = convention.name
    blank = {image.camera: np.zeros((256, 256, 3), np.uint8) for image in convention.images}
    observation = Observation(seq=0, stamp_ns=0, images=blank, proprio=proprioception(scene))
    ours = observe(convention, [observation], INSTRUCTION)
    for state in convention.states:
        theirs = np.array(requests[f"scene|{name}|{state.key}"], dtype=float)
        if theirs.size >= 3:  # robosuite's own table has its base elsewhere
            theirs[:3] += LIBERO_BASE - scene["base"]
        elif state.key in "xyz":
            theirs = theirs + (LIBERO_BASE - scene["base"])["xyz".index(state.key)]
        difference = float(np.abs(np.asarray(ours[state.key], dtype=float) - theirs).max())
        result.state = max(result.state or 0.0, difference)
    if result.state is not None and result.state > STATE:
        result.faults.append(f"the state differs by {result.state:.2g}")
    theirs = requests.get(f"scene|{name}|{convention.prompt.key}")
    if theirs is not None:
        result.prompt = str(theirs) == ours[convention.prompt.key]
        if not result.prompt:
            result.faults.append(f"the prompt is {ours[convention.prompt.key]!r}, the client's {str(theirs)!r}")


def strip(rows: list[tuple[str, np.ndarray, np.ndarray]]) -> Image.Image:
    """Draw the genuine client's pictures above RoboXim's."""
    side = 200
    sheet = Image.new("RGB", (side * max(len(rows), 1), 2 * side + 40), "white")
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
    for index, (title, *pictures) in enumerate(rows):
        for line, (label, picture) in enumerate(zip((f"{title}: client", "RoboXim"), pictures, strict=True)):
            top = line * (side + 20)
            draw.text((index * side + 2, top + 2), label, "black", font)
            sheet.paste(Image.fromarray(np.ascontiguousarray(picture)).resize((side, side)), (index * side, top + 20))
    return sheet


def executed_steps(name: str) -> dict[str, list[float]]:
    """Execute a constant number of each component in RoboXim; return each tick's motion in mm or mrad per unit."""
    convention = load_convention(name)
    action = convention.action
    session = EpisodeSession(
        SessionConfig(semantics=convention.semantics, gripper=action.gripper.rule, lag=action.lag, size=64)
    )
    found = {}
    try:
        for index, component in enumerate(COMPONENTS):
            sign = -1.0 if component == "x" else 1.0  # forwards, RoboXim's workspace ends after 30 cm
            size = sign * (1.0 if index < 3 else 0.2)
            raw = np.zeros(action.raw_size)
            raw[index], raw[-1] = size, action.gripper.open
            poses = [tool(session.start(0, index))]
            for _ in range(STEPS):
                seen = session.step(decode_actions(convention, raw)[0])
                if not isinstance(seen, ObservationWindow):
                    raise SystemExit(f"the episode ended while the arm moved: {seen.reason}")
                poses.append(tool(seen))
            moved = [np.array([*(q - p), *(s * r.inv()).as_rotvec()]) for (p, r), (q, s) in pairwise(poses)]
            found[component] = [float(step[index] * 1e3 / size) for step in moved]
    finally:
        session.close()
    return found


def tool(window: ObservationWindow) -> tuple[np.ndarray, Any]:
    """Return the measured tool's position [m] and rotation."""
    proprio = window.newest.proprio
    return np.array(proprio.tcp_position), proprio.tcp_rotation


def motion_table(genuine: dict[str, list[float]], ours: dict[str, list[float]]) -> list[str]:
    """Return a table of single ticks of robosuite and of RoboXim."""
    shown = (0, 1, 2, 4, 9, 13)
    lines = [
        "| component, unit | arm | " + " | ".join(f"tick {tick + 1}" for tick in shown) + " | path of 14 ticks |",
        "| --- | --- | " + " | ".join("---" for _ in shown) + " | --- |",
    ]
    for component in COMPONENTS:
        unit = "mrad" if component.startswith("about") else "mm"
        for arm, steps in (("robosuite", genuine[component]), ("RoboXim", ours[component])):
            numbers = " | ".join(f"{steps[tick]:.1f}" for tick in shown)
            lines.append(f"| {component}, {unit} per unit | {arm} | {numbers} | {sum(steps):.0f} |")
    return lines


def response_table(identified: list[dict[str, Any]], response: ControllerResponse) -> list[str]:
    """Return a table of the identified response beside the one of ``config/responses``."""
    lines = [
        "| component | gain | lag | in the file | RMS error of a tick | RMS motion | error if executed in full |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for index, row in enumerate(identified):
        unit = "mrad" if row["component"].startswith("about") else "mm"
        lines.append(
            f"| {row['component']} | {row['gain']:.3f} | {row['lag']:.3f} | {response.gain[index]:.3f}, "
            f"{response.lag[index]:.3f} | {row['error']:.1f} {unit} | {row['motion']:.1f} {unit} | "
            f"{row['error_in_full']:.1f} {unit} |"
        )
    return lines


def picture_table(results: dict[str, Result]) -> list[str]:
    """Return a table of what was compared for each convention."""
    lines = [
        "| convention | compared with | pixels: largest, mean | cube's column: client, RoboXim | state | prompt |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for name, result in results.items():
        columns = ", ".join(f"{key}: {a:.0f}, {b:.0f}" for key, (a, b) in result.columns.items())
        state = "" if result.state is None else f"{result.state:.1e}"
        prompt = "" if result.prompt is None else "equal" if result.prompt else "differs"
        lines.append(
            f"| `{name}` | {result.client} | {result.grey_levels:.0f}, {result.mean_grey_levels:.2f} | {columns} | "
            f"{state} | {prompt} |"
        )
    return lines


def lerobot_line(out: Path, requests: dict[str, Any]) -> str:
    """Compare what LeRobot's own step makes of the scene with what vla-eval's and openpi's clients send."""
    if not LEROBOT.is_file():
        return "LeRobot: not compared; `scripts/make_environment.py verify-lerobot` adds its environment (2 GB)."
    subprocess.run([str(LEROBOT), str(ROOT / "scripts" / "genuine_lerobot.py"), str(out)], check=True)
    made = np.load(out / "lerobot.npz")
    pixels = np.abs(made["picture"].astype(int) - requests["scene|vla_eval_libero|agentview"].astype(int)).max()
    state = np.abs(made["state"] - requests["scene|libero|observation/state"]).max()
    return (
        f"LeRobot {made['version']}, LiberoProcessorStep run: its picture differs from that of `vla_eval_libero`'s "
        f"client by {pixels} grey levels, its state from that of `libero`'s by {state:.1e}."
    )


def run_clients(options: argparse.Namespace) -> None:
    """Run the genuine clients, which write into ``--out``."""
    command = [str(GENUINE), str(ROOT / "scripts" / "genuine_clients.py"), str(options.out)]
    command += ["--source", *map(str, options.source)] if options.source else []
    print("running the genuine clients", flush=True)
    subprocess.run([*command, *(["--no-motion"] if options.no_motion else [])], check=True)


def main() -> int:
    """Run the genuine clients, compare, and write what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "conventions")
    parser.add_argument("--source", type=Path, nargs="*", default=[], help="clones of openpi, openvla-oft")
    parser.add_argument("--no-motion", action="store_true", help="leave out the motion of the arm (4 minutes)")
    parser.add_argument("--keep", action="store_true", help="compare with what the clients wrote into --out before")
    options = parser.parse_args()
    if not options.keep:
        run_clients(options)
    requests, scene = (dict(np.load(options.out / f"{name}.npz")) for name in ("requests", "scene"))
    clients, pictures = json.loads((options.out / "clients.json").read_text()), rendered(scene)
    compared = {name: compare(name, client, requests, scene, pictures) for name, client in clients.items()}
    results = {name: result for name, (result, _) in compared.items()}
    others = sorted(set(config_names("conventions")) - set(results))
    lines = ["## What is sent", "", *picture_table(results), "", f"Not compared here: {', '.join(others)}."]
    lines += ["", lerobot_line(options.out, requests)]
    found: dict[str, Any] = {"conventions": {name: asdict(result) for name, result in results.items()}}
    faults = [f"{name}: {fault}" for name, result in results.items() for fault in result.faults]
    if not options.no_motion:
        motion = json.loads((options.out / "responses.json").read_text())
        response = load_convention("libero").action.response
        assert response is not None
        ours = executed_steps("libero")
        found["motion"] = {**motion, "roboxim": ours}
        lines += ["", f"## How the arm moves (robosuite {motion['robosuite']}, 20 Hz, number 1; rotations 0.2)", ""]
        lines += [*motion_table(motion["constant"], ours), "", *response_table(motion["identified"], response)]
        faults += response_faults(motion["identified"], response)
    save_sheet([sheet for _, sheet in compared.values()], options.out / "pictures.png")
    (options.out / "conventions.md").write_text("\n".join(lines) + "\n")
    (options.out / "conventions.json").write_text(json.dumps(found, indent=2) + "\n")
    print("\n".join([*lines, "", f"pictures: {options.out / 'pictures.png'}", *(faults or ["all equal"])]))
    return int(bool(faults))


def response_faults(identified: list[dict[str, Any]], response: ControllerResponse) -> list[str]:
    """Return which components the stated response misses by more than 0.02 of gain or 0.05 of lag."""
    return [
        f"{row['component']}: gain {row['gain']:.3f} and lag {row['lag']:.3f} were identified, the file states "
        f"{response.gain[index]:.3f} and {response.lag[index]:.3f}"
        for index, row in enumerate(identified)
        if abs(row["gain"] - response.gain[index]) > 0.02 or abs(row["lag"] - response.lag[index]) > 0.05
    ]


def save_sheet(sheets: list[Image.Image], path: Path) -> None:
    """Write strips below each other."""
    whole = Image.new("RGB", (max(s.width for s in sheets), sum(s.height for s in sheets)), "white")
    top = 0
    for sheet in sheets:
        whole.paste(sheet, (0, top))
        top += sheet.height
    whole.save(path, optimize=True)


if __name__ == "__main__":
    sys.exit(main())
