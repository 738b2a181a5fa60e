"""What genuine clients send to their policy servers, and how far genuine robosuite moves its arm.

`scripts/verify_conventions.py` runs this program in the environment ``verify-conventions``; it imports nothing of
RoboXim. Clients that PyPI has (openpi-client, vla-eval) are used from there. Those that only a repository has are used
from a clone that ``--source`` names, or else from the operations that their sources state.

    .tools/verify-conventions-env/bin/python scripts/genuine_clients.py OUT [--source FOLDER ...]

OUT/requests.npz      ``SOURCE|CONVENTION|KEY``: what is sent for a scene and for a marked pattern
OUT/scene.npz         robosuite's raw pictures, poses and the cube's position
OUT/responses.json    steps of the arm for constant actions, and the identified response
OUT/clients.json      convention -> the code that made its requests
"""

from __future__ import annotations

import argparse
import ast
import importlib.metadata
import importlib.util
import json
import os
import sys
import tempfile
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

import numpy as np

from genuine_robosuite import constant_actions, identified_response, make_robosuite, observed_scene, tool

INSTRUCTION = "Pick up the red cube"


def pattern(height: int, width: int) -> np.ndarray:
    """Return a marked picture without any symmetry: four colours, a ramp, and a letter F in the upper left."""
    rows, columns = np.mgrid[0:height, 0:width]
    picture = np.zeros((height, width, 3), np.uint8)
    picture[..., 0] = columns * 255 // width
    picture[..., 1] = rows * 255 // height
    picture[..., 2] = ((rows // 16 + columns // 16) % 2) * 60
    unit = height // 16
    for top, left, tall, wide in ((1, 1, 7, 1), (1, 1, 1, 4), (4, 1, 1, 3)):
        picture[top * unit : (top + tall) * unit, left * unit : (left + wide) * unit] = 255
    picture[-2 * unit :, -3 * unit :] = (255, 0, 0)
    return picture


Requests = dict[str, Any]
"""Key to array or text."""


class Sources:
    """The clones that the user named."""

    def __init__(self, folders: list[Path]) -> None:
        self._folders = folders

    def find(self, path: str) -> Path | None:
        """Return a file that one of the clones has."""
        return next((folder / path for folder in self._folders if (folder / path).is_file()), None)

    def function(self, path: str, name: str, **known: Any) -> Callable[..., Any] | None:
        """Return a function of a clone's file, run without the file's other imports."""
        file = self.find(path)
        if file is None:
            return None
        tree = ast.parse(file.read_text())
        wanted = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == name]
        for node in wanted:
            node.returns = None
            for argument in node.args.args:
                argument.annotation = None
        space = dict(known)
        exec(compile(ast.Module(body=wanted, type_ignores=[]), str(file), "exec"), space)
        return space[name]


def upside_up(raw: np.ndarray) -> np.ndarray:
    """Turn a raw picture of robosuite by 180 degrees, as every client of LIBERO does."""
    return np.ascontiguousarray(raw[::-1, ::-1])


def state_of_libero(seen: Requests) -> np.ndarray:
    """Return the state of 8 numbers as openpi's and OpenVLA-OFT's clients make it."""
    from robosuite.utils.transform_utils import quat2axisangle

    turn = quat2axisangle(seen["robot0_eef_quat"].copy())
    return np.concatenate([seen["robot0_eef_pos"], turn, seen["robot0_gripper_qpos"]])


def openpi_libero(seen: Requests, sources: Sources) -> tuple[str, Requests]:
    """Run openpi's own evaluation of LIBERO on an environment that shows one observation; return what it sends."""
    file = sources.find("examples/libero/main.py")
    if file is None:
        from openpi_client import image_tools

        def sized(raw: np.ndarray) -> np.ndarray:
            return image_tools.convert_to_uint8(image_tools.resize_with_pad(upside_up(raw), 224, 224))

        pictures = {
            "observation/image": sized(seen["agentview_image"]),
            "observation/wrist_image": sized(seen["robot0_eye_in_hand_image"]),
        }
        request = {**pictures, "observation/state": state_of_libero(seen), "prompt": INSTRUCTION.lower()}
        return f"openpi-client {version('openpi-client')}, steps of openpi's examples/libero/main.py", request
    return "openpi's examples/libero/main.py, run", _sent_by_openpi(file, seen)


def _sent_by_openpi(file: Path, seen: Requests) -> Requests:
    sent: list[Requests] = []

    class Client:
        def __init__(self, *_: Any) -> None: ...

        def infer(self, request: Requests) -> Requests:
            sent.append(request)
            return {"actions": np.zeros((10, 7))}

    class Env:
        def __init__(self, **_: Any) -> None: ...
        def seed(self, *_: Any) -> None: ...
        def reset(self) -> Requests:
            return seen

        def set_init_state(self, *_: Any) -> Requests:
            return seen

        def step(self, action: Any) -> tuple[Requests, float, bool, dict[str, Any]]:
            return seen, 0.0, bool(sent), {}

    task = types.SimpleNamespace(language=INSTRUCTION.lower(), problem_folder="", bddl_file="")
    suite = types.SimpleNamespace(n_tasks=1, get_task=lambda _: task, get_task_init_states=lambda _: [None] * 50)
    stand_ins = {
        "libero": {}, "libero.libero": {"get_libero_path": lambda _: "", "benchmark": types.SimpleNamespace(
            get_benchmark_dict=lambda: {"libero_spatial": lambda: suite})},
        "libero.libero.envs": {"OffScreenRenderEnv": Env}, "tyro": {},
        "imageio": {"mimwrite": lambda *_, **__: None}, "tqdm": {"tqdm": lambda items: items},
    }  # fmt: skip
    for name, members in stand_ins.items():
        module = sys.modules[name] = types.ModuleType(name)
        vars(module).update(members)
    spec = importlib.util.spec_from_file_location("openpi_libero_main", file)
    assert spec is not None
    assert spec.loader is not None
    main = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(main)
    main._websocket_client_policy = types.SimpleNamespace(WebsocketClientPolicy=Client)
    with tempfile.TemporaryDirectory() as videos:
        main.eval_libero(main.Args(num_trials_per_task=1, video_out_path=videos))
    return sent[0]


def vla_eval_libero(seen: Requests, env: Any) -> tuple[str, Requests]:
    """Let vla-eval's own benchmark make its observation."""
    from vla_eval.benchmarks.libero.benchmark import LIBEROBenchmark

    benchmark = LIBEROBenchmark(send_wrist_image=True, send_state=True, quat_no_antipodal=True)
    benchmark._env = env
    made = benchmark.make_obs(seen, {"name": INSTRUCTION.lower()})
    request = {**made["images"], "states": made["states"], "task_description": made["task_description"]}
    return f"vla-eval {version('vla-eval')}, LIBEROBenchmark.make_obs, run", request


def through_tensorflow(picture: np.ndarray, size: int, *, jpeg: bool, crop_area: float = 1.0) -> np.ndarray:
    """Resize as OpenVLA's, OFT's, Octo's and SimplerEnv's clients do: JPEG, lanczos3, then a centred crop."""
    import tensorflow as tf

    image = tf.constant(picture)
    if jpeg:
        image = tf.io.decode_image(tf.image.encode_jpeg(image), expand_animations=False, dtype=tf.uint8)
    image = tf.image.resize(image, (size, size), method="lanczos3", antialias=True)
    image = tf.cast(tf.clip_by_value(tf.round(image), 0, 255), tf.uint8)
    if crop_area < 1.0:
        side = float(np.sqrt(crop_area))
        box = [[(1 - side) / 2, (1 - side) / 2, (1 + side) / 2, (1 + side) / 2]]
        scaled = tf.image.convert_image_dtype(image, tf.float32)[None]
        cropped = tf.image.crop_and_resize(scaled, box, [0], (size, size))[0]
        image = tf.image.convert_image_dtype(tf.clip_by_value(cropped, 0, 1), tf.uint8, saturate=True)
    return image.numpy()


def oft_libero(seen: Requests, sources: Sources) -> tuple[str, Requests]:
    """Prepare an observation as OpenVLA-OFT's evaluation does, with its own functions where a clone is given."""
    import tensorflow as tf

    folder = "experiments/robot/"
    turn = sources.function(f"{folder}libero/libero_utils.py", "get_libero_image")
    turn_wrist = sources.function(f"{folder}libero/libero_utils.py", "get_libero_wrist_image")
    resize = sources.function(f"{folder}openvla_utils.py", "resize_image_for_policy", tf=tf)
    genuine = turn is not None and turn_wrist is not None and resize is not None
    if genuine:
        pictures = [resize(turn(seen), 224), resize(turn_wrist(seen), 224)]
    else:
        raw = seen["agentview_image"], seen["robot0_eye_in_hand_image"]
        pictures = [through_tensorflow(upside_up(picture), 224, jpeg=True) for picture in raw]
    request = {"full_image": pictures[0], "wrist_image": pictures[1], "state": state_of_libero(seen)}
    code = "openvla-oft's own functions, run" if genuine else "TensorFlow's operations that openvla-oft states"
    return code, {**request, "instruction": INSTRUCTION.lower()}


def openvla_libero(seen: Requests) -> tuple[str, Requests]:
    """Prepare an observation as OpenVLA's evaluation of LIBERO does."""
    picture = through_tensorflow(upside_up(seen["agentview_image"]), 224, jpeg=True, crop_area=0.9)
    return "TensorFlow's operations that openvla states", {"image": picture, "instruction": INSTRUCTION.lower()}


def groot_libero(seen: Requests) -> tuple[str, Requests]:
    """Prepare an observation as Isaac-GR00T's environment of LIBERO does."""
    state = state_of_libero(seen)
    numbers = {key: state[i : i + 1] for i, key in enumerate(("x", "y", "z", "roll", "pitch", "yaw"))}
    pictures = {"image": upside_up(seen["agentview_image"]), "wrist_image": upside_up(seen["robot0_eye_in_hand_image"])}
    pictures["prompt"] = INSTRUCTION.lower()
    return "steps that Isaac-GR00T's libero_env.py states", {**pictures, **numbers, "gripper": state[6:8]}


def starvla_libero(seen: Requests) -> tuple[str, Requests]:
    """Prepare an observation as StarVLA's evaluation of LIBERO does."""
    from PIL import Image

    raw = {"primary": seen["agentview_image"], "wrist_image": seen["robot0_eye_in_hand_image"]}
    pictures = {
        key: np.asarray(Image.fromarray(upside_up(picture)).resize((224, 224), Image.Resampling.BILINEAR))
        for key, picture in raw.items()
    }
    return "Pillow's operations that starVLA's LIBERO client states", {**pictures, "lang": INSTRUCTION.lower()}


def xvla_libero(seen: Requests, env: Any) -> tuple[str, Requests]:
    """Prepare an observation as X-VLA's client of LIBERO does: the wrist picture raw, the pose of the controller."""
    position, rotation = tool(env)
    proprio = [*position, *rotation[:, 0], *rotation[:, 1], *[0.0] * 11]
    pictures = {"image0": upside_up(seen["agentview_image"]), "image1": seen["robot0_eye_in_hand_image"]}
    request = {**pictures, "proprio": np.array(proprio), "language_instruction": INSTRUCTION.lower()}
    return "steps that X-VLA's libero_client.py states, pose of robosuite's controller", request


def not_of_libero() -> dict[str, tuple[str, Requests]]:
    """Return what clients of other robots send for upright patterns of the size that their camera delivers."""
    import cv2
    from openpi_client import image_tools

    optical, wide = pattern(256, 256), pattern(180, 320)

    padded = image_tools.convert_to_uint8(image_tools.resize_with_pad(wide, 224, 224))
    droid = {"observation/exterior_image_1_left": padded, "observation/wrist_image_left": padded}
    client = f"openpi-client {version('openpi-client')}, as openpi's examples/droid/main.py uses it"
    roboarena = {"observation/exterior_image_0_left": padded, "observation/wrist_image_left": padded}
    resized = through_tensorflow(optical, 256, jpeg=False, crop_area=0.9)
    wrist = through_tensorflow(optical, 128, jpeg=False)
    operations = "TensorFlow's operations that Octo's gym_wrappers.py states"
    octo = operations, {"image_primary": resized}
    openvla = {"image": through_tensorflow(optical, 224, jpeg=True)}
    simpler = {"image": through_tensorflow(optical, 224, jpeg=False)}
    external = ("observation/exterior_image_1_left", "observation/exterior_image_2_left")
    as_rendered = "its source states that the camera's frame is sent as it is"
    return {
        "starvla_bridge": (
            f"OpenCV {cv2.__version__}, INTER_AREA as starVLA's model2simpler_interface.py uses it",
            {"image": cv2.resize(optical, (224, 224), interpolation=cv2.INTER_AREA)},
        ),
        "groot_droid": (as_rendered, {"exterior_image_1_left": wide, "wrist_image_left": wide}),
        "groot_bridge": (as_rendered, {"image_0": optical}),
        "groot_fractal": (as_rendered, {"image": pattern(256, 320)}),
        "rt1_widowx": (as_rendered, {"image": pattern(256, 320)}),
        "rt1_fractal": (as_rendered, {"image": pattern(256, 320)}),
        "cosmos3_droid": (as_rendered, dict.fromkeys((*external, "observation/wrist_image_left"), pattern(360, 640))),
        "dreamzero_droid": (
            as_rendered,
            dict.fromkeys(
                (
                    "observation/exterior_image_0_left", "observation/exterior_image_1_left",
                    "observation/wrist_image_left",
                ), wide,
            ),
        ),
        "droid_velocity": (client, droid), "droid_position": (client, droid), "octo_bridge": octo, "octo_fractal": octo,
        "octo_two_cameras": (operations, {"image_primary": resized, "image_wrist": wrist}),
        "roboarena_joint_position": (f"openpi-client {version('openpi-client')}", roboarena),
        "roboarena_joint_velocity": (f"openpi-client {version('openpi-client')}", roboarena),
        "bridge": ("TensorFlow's operations that openvla's bridge client states", openvla),
        "fractal": ("TensorFlow's operations that SimplerEnv states", simpler),
    }  # fmt: skip


def version(distribution: str) -> str:
    """Return the installed version of a distribution."""
    return importlib.metadata.version(distribution)


def main() -> None:
    """Write everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    parser.add_argument("--source", type=Path, nargs="*", default=[], help="clones of openpi, openvla-oft")
    parser.add_argument("--no-motion", action="store_true", help="leave out the motion of robosuite's arm")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    sources = Sources(options.source)
    env = make_robosuite(pictures=True)
    seen = observed_scene(env)
    # Patterns as a camera sees them; robosuite's raw pictures are flipped from top to bottom.
    optical = pattern(256, 256)
    marked = {**seen, "agentview_image": optical[::-1], "robot0_eye_in_hand_image": optical[::-1, ::-1]}
    requests: dict[str, Any] = {}
    clients: dict[str, str] = {}
    for source, shown in (("scene", seen), ("pattern", marked)):
        made = {
            "libero": openpi_libero(shown, sources), "vla_eval_libero": vla_eval_libero(shown, env),
            "oft_libero": oft_libero(shown, sources), "openvla_libero": openvla_libero(shown),
            "groot_libero": groot_libero(shown), "starvla_libero": starvla_libero(shown),
            "xvla_libero": xvla_libero(shown, env),
        }  # fmt: skip
        if source == "pattern":
            made |= not_of_libero()
        for name, (code, request) in made.items():
            clients[name] = code
            requests |= {f"{source}|{name}|{key}": np.asarray(value) for key, value in request.items()}
    np.savez_compressed(options.out / "requests.npz", **requests)
    kept = ("agentview_image", "robot0_eye_in_hand_image", "robot0_eef_pos", "robot0_eef_quat", "robot0_gripper_qpos")
    patterns = {f"pattern {h} x {w}": pattern(h, w) for h, w in ((256, 256), (180, 320), (256, 320), (360, 640))}
    np.savez_compressed(
        options.out / "scene.npz", **patterns, base=seen["base"], cube_in_base=seen["cube_in_base"],
        joints=env.sim.data.qpos[env.robots[0]._ref_joint_pos_indexes], **{key: seen[key] for key in kept},
    )  # fmt: skip
    (options.out / "clients.json").write_text(json.dumps(clients, indent=2) + "\n")
    if not options.no_motion:
        still = make_robosuite(pictures=False)
        constant = constant_actions(still)
        found = {"robosuite": version("robosuite"), "constant": constant}
        found["identified"] = identified_response(still, constant)
        (options.out / "responses.json").write_text(json.dumps(found, indent=2) + "\n")


if __name__ == "__main__":
    main()
