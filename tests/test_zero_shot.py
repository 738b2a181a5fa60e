"""The zero-shot experiments of thesis 5.1 in one command, with servers around stand-ins for the models."""

import contextlib
import importlib.util
import json
import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
STAND_INS = ROOT / "src/roboxim_policies/tests/servers"
sys.path.insert(0, str(ROOT / "scripts"))
sys.path.insert(0, str(ROOT / "src/roboxim_policies/servers"))


def module(path, name):
    spec = importlib.util.spec_from_file_location(name, path)
    found = importlib.util.module_from_spec(spec)
    sys.modules[name] = found
    spec.loader.exec_module(found)
    return found


zero_shot = module(ROOT / "scripts/zero_shot.py", "zero_shot")


def test_missing_weights_are_all_named_at_once():
    _, missing = zero_shot.planned({}, 8101)
    assert [line.split(":")[0] for line in missing] == [
        "OCTO_CHECKPOINT", "OCTO_SOURCE", "RT1_CHECKPOINT", "RT1_ENCODER", "OPENVLA_CHECKPOINT", "OPENVLA_SOURCE",
    ]  # fmt: skip
    _, missing = zero_shot.planned({"OCTO_URL": "ws://a:1", "RT1_URL": "ws://b:1", "OPENVLA_URL": "http://c:1"}, 8101)
    assert missing == []
    _, missing = zero_shot.planned({"OPENVLA_CHECKPOINT": "openvla/openvla-7b", "OPENVLA_SOURCE": "/nowhere"}, 8101)
    assert any("/nowhere/vla-scripts/deploy.py does not exist" in line for line in missing)


def test_servers_get_ports_of_their_own_and_policies_the_conventions_of_the_experiment():
    given = {"OCTO_CHECKPOINT": "hf://a/octo-small-1.5", "OCTO_SOURCE": "x y", "RT1_URL": "ws://gpu:9000"}
    servers, _ = zero_shot.planned(given, 8101)
    octo, rt1, openvla = servers
    assert octo.command[2:] == (
        "--checkpoint", "hf://a/octo-small-1.5", "--source", "x", "--source", "y", "--port", "8101",
    )  # fmt: skip
    assert (rt1.url, rt1.command, rt1.health) == ("ws://gpu:9000", (), "http://gpu:9000/healthz")
    assert openvla.url == "http://127.0.0.1:8103"
    options = zero_shot.options_of(servers, zero_shot.EXPERIMENTS["zero_shot_reenacted"], 60.0)
    assert options[:4] == ["--policy", "octo=openpi", "--option", "octo.url=ws://127.0.0.1:8101"]
    assert "rt_1_x.convention=rt1_fractal" in options
    assert "openvla.convention=fractal" in options
    assert "octo.version=octo-small-1.5" in options


class Small:
    """RT-1-X's stand-in."""

    def initial_state(self):
        return 0

    def step(self, image, embedding, state):
        action = {
            "world_vector": np.array([0.2, 0.0, -0.2]), "rotation_delta": np.zeros(3),
            "gripper_closedness_action": np.array([-1.0]), "terminate_episode": np.array([0, 1, 0]),
        }  # fmt: skip
        return action, state + 1


@pytest.mark.ros
@pytest.mark.slow
def test_both_experiments_run_from_servers_to_cards(tmp_path):
    """Octo and RT-1-X run already, OpenVLA's server is started; each evaluates its condition, and a card is written."""
    openpi_server = module(ROOT / "src/roboxim_policies/servers/openpi_server.py", "openpi_server")
    octo = module(ROOT / "src/roboxim_policies/servers/octo.py", "octo_server")
    rt1 = module(ROOT / "src/roboxim_policies/servers/rt1.py", "rt1_server")
    stand_in = module(STAND_INS / "octo_stand_in/octo/model/octo_model.py", "octo_stand_in")
    part = {"mean": np.zeros(7), "std": np.full(7, 0.01), "mask": np.array([True] * 6 + [False])}
    statistics = {name: {"action": part} for name in ("bridge_dataset", "fractal20220817_data")}
    models = (octo.Octo(stand_in.OctoModel(statistics)), rt1.Rt1(Small(), lambda text: np.zeros(512, np.float32)))
    with (
        openpi_server.Server(models[0], port=0) as first,
        openpi_server.Server(models[1], port=0) as second,
    ):
        environment = {
            "OCTO_URL": first.url, "RT1_URL": second.url, "OPENVLA_CHECKPOINT": "openvla/openvla-7b",
            "OPENVLA_SOURCE": str(STAND_INS / "openvla_stand_in"), "OPENVLA_PYTHON": sys.executable,
        }  # fmt: skip
        run_experiments(tmp_path, environment)
    for name in zero_shot.EXPERIMENTS:
        require_results(tmp_path / name)


@pytest.mark.ros
@pytest.mark.slow
def test_one_command_starts_and_stops_the_servers_of_all_three_models(tmp_path):
    """Octo's and RT-1-X's servers run in their environments: on a class of Octo's interface, on a SavedModel."""
    environments = [ROOT / ".tools" / f"policy-{name}-env/bin/python" for name in ("octo", "rt1")]
    if missing := [str(python) for python in environments if not python.exists()]:
        pytest.skip(f"no {', '.join(missing)}: run scripts/make_environment.py policy-octo, and policy-rt1")
    subprocess.run([environments[1], STAND_INS / "make_rt1_stand_in.py", tmp_path], check=True, capture_output=True)
    octo = tmp_path / "octo"
    octo.mkdir()
    (octo / "config.json").write_text("{}")
    part = {"mean": [0.0] * 7, "std": [0.01] * 7, "mask": [True] * 6 + [False]}
    (octo / "dataset_statistics.json").write_text(json.dumps({"bridge_dataset": {"action": part}}))
    environment = {
        "OCTO_CHECKPOINT": str(octo), "OCTO_SOURCE": str(STAND_INS / "octo_stand_in"),
        "RT1_CHECKPOINT": str(tmp_path / "model"), "RT1_ENCODER": str(tmp_path / "encoder"),
        "OPENVLA_CHECKPOINT": "openvla/openvla-7b", "OPENVLA_SOURCE": str(STAND_INS / "openvla_stand_in"),
        "OPENVLA_PYTHON": sys.executable,
    }  # fmt: skip
    port = run_experiments(tmp_path, environment, "--experiments", "zero_shot")
    require_results(tmp_path / "zero_shot")
    for number in range(port, port + 3):
        with socket.socket() as probe:
            assert probe.connect_ex(("127.0.0.1", number)) != 0, f"a server still runs at port {number}"


def run_experiments(out, environment, *options):
    """Run the command; return the port of the first server."""
    port = first_of_free_ports(3)
    command = [sys.executable, ROOT / "scripts/zero_shot.py", "--out", out, "--scale", "smoke", *options]
    command += ["--first-port", str(port)]
    done = subprocess.run(command, env={**os.environ, **environment}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return port


def require_results(folder):
    card = json.loads((folder / "card.json").read_text())
    assert card["experiment"]["name"] == folder.name
    for condition in ("octo", "rt_1_x", "openvla"):
        (results,) = (folder / "evaluate" / f"{condition}.0").rglob("results.jsonl")
        (line,) = results.read_text().splitlines()
        assert '"outcome": "error"' not in line, line


def first_of_free_ports(count):
    """Return the first of several free ports that follow each other."""
    while True:
        with contextlib.ExitStack() as stack:
            sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
            sockets[0].bind(("127.0.0.1", 0))
            first = sockets[0].getsockname()[1]
            with contextlib.suppress(OSError, OverflowError):
                for i, taken in enumerate(sockets[1:], 1):
                    taken.bind(("127.0.0.1", first + i))
                return first
