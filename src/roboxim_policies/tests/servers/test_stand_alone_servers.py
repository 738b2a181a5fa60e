"""The stand-alone servers of Octo and RT-1-X, around models of the same interface, asked by RoboXim's own wire."""

import importlib.util
import json
import os
import re
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from roboxim_core.conventions import load_convention
from roboxim_core.errors import PolicyError
from roboxim_core.policies import EpisodeStart
from roboxim_policies.remote import RemotePolicy, probe_window
from roboxim_policies.wires import openpi
from roboxim_policies.wires.openpi import OpenPiWire

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[3]
SERVERS = HERE.parents[1] / "servers"
STATISTICS = {
    "bridge_dataset": {"mean": [0.0] * 7, "std": [0.01] * 7, "mask": [True] * 6 + [False]},
    "fractal20220817_data": {"mean": [0.1] * 7, "std": [0.02] * 7, "mask": [True] * 6 + [False]},
}


def module(path, name):
    spec = importlib.util.spec_from_file_location(name, path)
    found = importlib.util.module_from_spec(spec)
    sys.modules[name] = found
    spec.loader.exec_module(found)
    return found


sys.path.insert(0, str(SERVERS))
openpi_server = module(SERVERS / "openpi_server.py", "openpi_server")
octo = module(SERVERS / "octo.py", "octo_server")
rt1 = module(SERVERS / "rt1.py", "rt1_server")
stand_in = module(HERE / "octo_stand_in/octo/model/octo_model.py", "octo_stand_in")


def octo_model(batch=1, unnorm_key=""):
    statistics = {
        name: {"action": {key: np.array(value) for key, value in part.items()}} for name, part in STATISTICS.items()
    }
    return octo.Octo(stand_in.OctoModel(statistics), batch=batch, unnorm_key=unnorm_key)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"unnorm_key": ["bridge_dataset"]}, "no statistics of the dataset .*'bridge_dataset'"),
        ({"timestep_pad_mask": np.ones((2, 1), bool)}, "has 2 values, the pictures have .2. frames"),
        ({"timestep_pad_mask": ["x", "y"]}, "has 2 values"),
    ],
)
def test_octo_refuses_a_request_by_its_part_before_its_batch(change, words):
    request = {"prompt": "open it", "image_primary": np.zeros((2, 256, 256, 3), np.uint8)}
    model = octo_model(unnorm_key="bridge_dataset")
    model.check(request)
    with pytest.raises(openpi_server.RequestError, match=words):
        model.check({**request, **change})


@contextmanager
def served(model):
    with openpi_server.Server(model, port=0, quiet=True) as server:
        yield server


def remote(server, convention, **options):
    return RemotePolicy(OpenPiWire(server.url, timeout_s=120.0, reconnect_s=0.0, **options), convention, version="1")


def episode(policy, seed, steps=3, text="open the drawer"):
    policy.reset(EpisodeStart(episode_id=f"e{seed}", instruction=text, seed=seed))
    window = replace(probe_window(policy.convention), instruction=text)
    return np.stack([policy.raw(window) for _ in range(steps)])


def test_the_stand_alone_codec_is_openpis():
    array = np.arange(12, dtype=np.float32).reshape(3, 4)
    message = {"actions": array, "text": "a", "numbers": [1, 2.5, None, True]}
    for written, read in ((openpi_server.encode, openpi.decode), (openpi.encode, openpi_server.decode)):
        found = read(written(message))
        np.testing.assert_array_equal(found.pop("actions"), array)
        assert found == {"text": "a", "numbers": [1, 2.5, None, True]}
    for recorded in sorted((ROOT / "tests/data/wires/openpi-droid").glob("*request*.bin")):
        theirs = openpi.decode(recorded.read_bytes())
        for key, value in openpi_server.decode(recorded.read_bytes()).items():
            np.testing.assert_array_equal(value, theirs[key])


@pytest.mark.parametrize(
    ("dtype", "shape", "data"),
    [
        ("|O", [1], bytes(8)),
        ("<f4", [2**40], bytes(8)),
        ("<f4", [-1], bytes(4)),
        ("<f4", [3], bytes(8)),
        ("x", [1], b"a"),
    ],
)
def test_the_stand_alone_codec_refuses_what_is_no_array(dtype, shape, data):
    import msgpack

    message = {"a": {b"__ndarray__": True, b"dtype": dtype, b"shape": shape, b"data": data}}
    with pytest.raises((ValueError, TypeError)):
        openpi_server.decode(msgpack.packb(message))


@pytest.mark.slow
def test_octo_gets_its_frames_mask_and_instruction_and_answers_in_the_named_datasets_units():
    with served(octo_model()) as server:
        with remote(server, "octo_two_cameras") as policy:
            raw = episode(policy, seed=7)
            assert policy.connect()["unnorm_keys"] == sorted(STATISTICS)
            actions = policy.act(probe_window(policy.convention))
        with remote(server, "octo_fractal") as policy:
            fractal = episode(policy, seed=7, text="close the drawer")
    window = probe_window(load_convention("octo_two_cameras"))
    mean = window.newest.images["workspace"].mean() / 255
    assert raw.shape == (3, 4, 7)
    np.testing.assert_allclose(raw[0, :, 0], 0.01 * mean, rtol=0.1)
    np.testing.assert_allclose(raw[0, 0, 1:3], [0.01, 0.01], rtol=1e-5)  # with a wrist picture; one real frame of two
    np.testing.assert_allclose(raw[..., 6], 1.0)  # 1.5 of the unmasked gripper, clipped
    np.testing.assert_allclose(fractal[0, 0, 1:3], [0.1, 0.12], rtol=1e-5)  # without one, the other statistics
    np.testing.assert_allclose(fractal[..., 6], 0.0)
    assert len({row.tobytes() for row in raw[:, 0, 3:6]}) == 3, "each call draws anew"
    assert actions.shape == (4, 7)


@pytest.mark.slow
def test_octos_episodes_repeat_by_their_seed_whatever_others_ask_in_the_same_batch():
    """Four workers share a server: batches are formed, and each gets what it would get alone."""
    with served(octo_model(batch=4)) as server:
        with remote(server, "octo_bridge") as policy:
            alone = [episode(policy, seed) for seed in range(4)]
        server.worker.largest = 0
        gate = threading.Barrier(4)

        def worker(seed):
            with remote(server, "octo_bridge") as policy:
                policy.connect()
                gate.wait(60)
                return episode(policy, seed)

        _hold(server.model, until=4, waiting=server.worker)
        with ThreadPoolExecutor(4) as pool:
            together = list(pool.map(worker, range(4)))
    assert server.worker.largest > 1, "no requests were computed together"
    for mine, theirs in zip(alone, together, strict=True):
        np.testing.assert_array_equal(mine, theirs)
    assert not np.array_equal(alone[0], alone[1])


def _hold(model, until, waiting):
    """Make the model's first answer wait until all workers have asked, so that the next batch has several."""
    act, first = model.act, threading.Event()

    def held(asked):
        if not first.is_set():
            first.set()
            for _ in range(6000):
                if waiting._waiting.qsize() >= until - len(asked):
                    break
                threading.Event().wait(0.01)
        return act(asked)

    model.act = held


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"unnorm_key": "bridge"}, "no statistics of the dataset 'bridge'.*bridge_dataset, fractal"),
        ({"prompt": None}, "needs a text 'prompt'"),
        ({"image_primary": np.zeros((2, 224, 224, 3), np.uint8)}, "expected at most 2 frames of"),
        ({"image_primary": np.zeros((2, 256, 256, 3), np.float32)}, "needs uint8 pictures"),
        ({"image_left": np.zeros((2, 256, 256, 3), np.uint8)}, "image_left.*takes image_primary, image_wrist"),
        ({"timestep_pad_mask": np.ones(3, bool)}, "has 3 values"),
    ],
)  # fmt: skip
def test_a_request_that_octo_cannot_answer_is_named_and_costs_no_other_episode(change, words):
    with served(octo_model()) as server, remote(server, "octo_bridge") as good, remote(server, "octo_bridge") as bad:
        expected = episode(good, seed=1)
        bad.reset(EpisodeStart(episode_id="e", instruction="open it", seed=0))
        request = {**bad.request(probe_window(bad.convention)), **change}
        with pytest.raises(PolicyError, match=words):
            bad.wire.ask(request)
        np.testing.assert_array_equal(episode(good, seed=1), expected)
        assert episode(bad, seed=0).shape == (3, 4, 7)


def test_a_convention_that_does_not_fit_the_server_is_refused_before_an_episode(tmp_path):
    own = tmp_path / "own.yaml"
    own.write_text(
        "rate_hz: 5\nwindow: 3\nextras: {unnorm_key: kuka}\nimages:\n"
        "  - {camera: workspace, key: image_primary, width: 224, height: 224}\n"
        "  - {camera: wrist, key: image_left}\n"
    )
    with (
        served(octo_model()) as server,
        remote(server, str(own)) as policy,
        pytest.raises(PolicyError, match="does not fit") as caught,
    ):
        policy.connect()
    for words in (
        "'image_primary' is 256 x 256 px",
        "sends 'image_left'",
        "2 frames at most",
        "no statistics of 'kuka'",
    ):
        assert words in str(caught.value)


class CountingPolicy:
    """RT-1-X's stand-in: its state counts the steps."""

    def initial_state(self):
        return 0

    def step(self, image, embedding, state):
        assert image.shape == (256, 320, 3)
        action = {
            "world_vector": np.array([state, image.mean() / 255, embedding[0]]),
            "rotation_delta": np.zeros(3),
            "gripper_closedness_action": np.array([1.0]),
            "terminate_episode": np.array([0, 1, 0]),
        }
        return action, state + 1


def test_rt1_keeps_a_history_for_each_connection_and_begins_it_anew_with_each_episode():
    model = rt1.Rt1(CountingPolicy(), lambda text: np.full(512, len(text) / 100, np.float32))
    with served(model) as server, remote(server, "rt1_widowx") as one, remote(server, "rt1_fractal") as two:
        for policy in (one, two):
            policy.reset(EpisodeStart(episode_id="e", instruction="open it", seed=0))
        steps = [policy.raw(probe_window(policy.convention))[0, 0] for policy in (one, one, two, one, two)]
        assert steps == [0, 1, 0, 2, 1]
        raw = episode(one, seed=1, text="close it")
        assert raw[:, 0, 0].tolist() == [0, 1, 2]
        np.testing.assert_allclose(raw[0, 0, 2], len("close it") / 100, rtol=1e-6)
        assert raw.shape == (3, 1, 7)


def test_a_model_that_raises_in_a_batch_costs_only_its_own_request():
    class Fussy(openpi_server.Model):
        batch = 3

        def act(self, asked):
            if any(request["prompt"] == "bad" for request, _ in asked):
                raise RuntimeError("out of memory")
            return [({"actions": np.zeros((1, 7), np.float32)}, None) for _ in asked]

    worker = openpi_server.Worker(Fussy())
    futures = []
    for text in ("good", "bad", "good"):
        future = openpi_server.Future()
        worker._waiting.put(("act", ({"prompt": text}, None), future))
        futures.append(future)
    with worker:
        assert futures[0].result(60)[0]["actions"].shape == (1, 7)
        assert "out of memory" in str(futures[1].exception(60))
        assert futures[2].result(60)[0]["actions"].shape == (1, 7)


@pytest.mark.parametrize(
    ("answers", "words"),
    [
        (lambda asked: [], "must answer each of 1 requests, it answered 0"),
        (lambda asked: None, "NoneType"),
        (lambda asked: [np.zeros((1, 7))] * len(asked), "a pair .reply, new state., it gave a ndarray"),
        (lambda asked: sys.exit("no weights"), "SystemExit: no weights"),
        (lambda asked: [({"actions": object()}, None)], "type object cannot be sent"),
    ],
)
def test_a_malformed_answer_of_a_model_costs_its_connection_and_hangs_no_client(answers, words):
    class Malformed(openpi_server.Model):
        def act(self, asked):
            if asked[0][0]["prompt"] == "bad":
                return answers(asked)
            return [(np.full((1, 7), 0.5, np.float32), None) for _ in asked]  # an array is the actions

    with served(Malformed()) as server:
        wires = [OpenPiWire(server.url, timeout_s=30.0, reconnect_s=0.0) for _ in range(2)]
        for wire in wires:
            wire.connect()
            wire.reset(EpisodeStart(episode_id="e", instruction="x", seed=0))
        with pytest.raises(PolicyError, match=words):
            wires[0].ask({"prompt": "bad"})
        np.testing.assert_array_equal(wires[1].ask({"prompt": "good"})["actions"], np.full((1, 7), 0.5))
        for wire in wires:
            wire.close()


def test_a_model_that_raises_when_an_episode_begins_says_why():
    class Refusing(openpi_server.Model):
        def begin(self, seed):
            raise RuntimeError("no memory")

        def act(self, asked):
            return []

    with served(Refusing()) as server:
        wire = OpenPiWire(server.url, timeout_s=30.0, reconnect_s=0.0)
        with pytest.raises(PolicyError, match="could not reset: RuntimeError: no memory"):
            wire.reset(EpisodeStart(episode_id="e", instruction="x", seed=0))
        wire.close()


def test_a_request_to_a_server_that_stops_is_refused():
    worker = openpi_server.Worker(openpi_server.Model.__new__(type("M", (openpi_server.Model,), {"act": list})))
    with worker:
        pass
    with pytest.raises(RuntimeError, match="the server stops"):
        worker.begin(0)


def run(script, *arguments, environment=None, python=sys.executable):
    clean = {key: value for key, value in os.environ.items() if not key.startswith(("OCTO_", "RT1_"))}
    return subprocess.run(
        [python, SERVERS / script, *arguments], capture_output=True, text=True, timeout=300,
        env=clean | (environment or {}),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("script", "arguments", "words"),
    [
        ("octo.py", [], "name the weights: --checkpoint FOLDER or hf://rail-berkeley.*OCTO_CHECKPOINT"),
        ("octo.py", ["--checkpoint", "/nowhere"], "/nowhere is no checkpoint of Octo: it has no config.json"),
        ("octo.py", ["--checkpoint", "hf://a/b", "--source", "/nowhere"], "--source /nowhere is not a folder"),
        ("octo.py", ["--checkpoint", "hf://a/b"], "Octo's code cannot be imported.*Clone octo-models/octo at"),
        ("rt1.py", [], "name the weights: --checkpoint FOLDER or RT1_CHECKPOINT"),
        ("rt1.py", ["--checkpoint", "/nowhere"], "name the encoder of instructions: --encoder FOLDER or RT1_ENCODER"),
        ("rt1.py", ["--checkpoint", "/nowhere", "--encoder", "/nowhere"], "/nowhere has no saved_model.pb"),
    ],
)  # fmt: skip
@pytest.mark.slow
def test_missing_weights_are_refused_with_what_to_do(script, arguments, words):
    found = run(script, *arguments)
    assert found.returncode != 0
    assert re.search(words, " ".join(found.stderr.split())), found.stderr


def environment_python(name):
    """Return the Python of an environment; it is made from its lock unless it exists."""
    made = subprocess.run(
        [sys.executable, ROOT / "scripts/make_environment.py", name], capture_output=True, text=True, check=False
    )
    assert made.returncode == 0, made.stdout + made.stderr
    return str(ROOT / ".tools" / f"{name}-env/bin/python")


IMPORTS = {
    # what Octo's own code and dlimp import, and what the server does
    "policy-octo": "distrax, einops, flax.training.orbax_utils, huggingface_hub, jax, ml_collections, msgpack, "
    "orbax.checkpoint, tensorflow, tensorflow_datasets, tqdm, websockets.sync.server, "
    "tensorflow_metadata.proto.v0.schema_pb2, tensorflow_metadata.proto.v0.statistics_pb2, "
    "transformers.models.t5.modeling_flax_t5",
    "policy-rt1": "msgpack, tensorflow, tensorflow_text, tf_agents.policies.py_tf_eager_policy, tf_agents.specs, "
    "tf_agents.trajectories.time_step, websockets.sync.server",
    "verify-rlds": "tensorflow, tensorflow_datasets, tensorflow_metadata.proto.v0.schema_pb2",
}
"""Environment to the modules that its programs import."""


@pytest.mark.slow
@pytest.mark.parametrize("name", IMPORTS)
def test_an_environment_imports_from_its_lock_what_its_programs_import(name):
    """Packages that do not fit each other, such as protobuf and generated code, are found when they are imported."""
    python = environment_python(name)
    done = subprocess.run([python, "-c", f"import {IMPORTS[name]}"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_genuine_octo_with_random_weights_answers_from_its_lock(tmp_path):
    """Octo's own code loads its own checkpoint, and answers as the convention says."""
    sources = os.environ.get("OCTO_SOURCE", "").split()
    if len(sources) != 2:
        pytest.skip("OCTO_SOURCE must name clones of octo-models/octo and kvablack/dlimp, separated by a space")
    python = environment_python("policy-octo")
    subprocess.run([python, HERE / "make_octo_checkpoint.py", tmp_path, *sources], check=True, capture_output=True)
    with (
        started(python, "octo.py", "--checkpoint", str(tmp_path)) as url,
        RemotePolicy(OpenPiWire(url, timeout_s=800.0), "octo_two_cameras", version="1") as policy,
    ):
        assert policy.connect()["inputs"] == {"image_primary": [256, 256, 3], "image_wrist": [128, 128, 3]}
        raw = episode(policy, seed=7, steps=2)
        again = episode(policy, seed=7, steps=2)
        other = episode(policy, seed=8, steps=1)
    assert raw.shape == (2, 4, 7)
    assert (np.abs(raw[..., :6]) <= 5 * 0.01 + 1e-6).all(), "Octo clips its samples to five standard deviations"
    assert np.abs(raw[..., :6]).max() > 0.01
    assert ((raw[..., 6] >= 0) & (raw[..., 6] <= 1)).all()
    np.testing.assert_array_equal(raw, again)
    assert not np.array_equal(raw[:1], other)


@contextmanager
def started(python, script, *arguments, environment=None):
    process = subprocess.Popen(
        [python, SERVERS / script, "--port", "0", *arguments], stdout=subprocess.PIPE, text=True,
        env={**os.environ, **(environment or {})},
    )  # fmt: skip
    try:
        line = next((line for line in process.stdout if line.startswith("serving at ")), "")
        assert line, "the server ended"
        yield line.removeprefix("serving at ").strip()
    finally:
        process.terminate()
        process.wait(60)
    assert process.returncode == 0


@pytest.mark.slow
def test_octos_server_runs_in_its_environment_with_a_folder_of_sources(tmp_path):
    python = environment_python("policy-octo")
    (tmp_path / "config.json").write_text("{}")
    statistics = {name: {"action": part} for name, part in STATISTICS.items()}
    (tmp_path / "dataset_statistics.json").write_text(json.dumps(statistics))
    source = str(HERE / "octo_stand_in")
    with (
        started(python, "octo.py", "--checkpoint", str(tmp_path), "--source", source, "--batch", "2") as url,
        RemotePolicy(OpenPiWire(url, timeout_s=600.0), "octo_two_cameras", version="1") as policy,
    ):
        raw = episode(policy, seed=7)
        again = episode(policy, seed=7)
    np.testing.assert_allclose(raw[0, 0, 1:3], [0.01, 0.01], rtol=1e-5)
    np.testing.assert_array_equal(raw, again)


@pytest.mark.slow
def test_rt1s_server_runs_a_saved_model_of_tf_agents_in_its_environment(tmp_path):
    python = environment_python("policy-rt1")
    subprocess.run([python, HERE / "make_rt1_stand_in.py", tmp_path], check=True, capture_output=True)
    environment = {"RT1_CHECKPOINT": str(tmp_path / "model"), "RT1_ENCODER": str(tmp_path / "encoder")}
    with (
        started(python, "rt1.py", environment=environment) as url,
        RemotePolicy(OpenPiWire(url, timeout_s=600.0), "rt1_widowx", version="1") as policy,
    ):
        raw = episode(policy, seed=0, text="close it", steps=4)
        again = episode(policy, seed=0, text="close it", steps=4)
    mean = policy.request(probe_window(policy.convention))["image"].mean() / 255
    np.testing.assert_allclose(raw[:, 0, 0], [0, 1, 2, 2])  # tf-agents clips to the specification, +-2
    np.testing.assert_allclose(raw[0, 0, 1:3], [mean, len("close it") / 100], rtol=1e-5)
    np.testing.assert_allclose(raw[:, 0, 6], [-1, -1, 1, 1])
    np.testing.assert_array_equal(raw, again)
