"""The model behind a server is recorded before the first episode, and recognised when a run continues."""

import json
import threading

import numpy as np
import pytest
from websockets.sync.server import serve

from roboxim_cli.named import Named
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, PolicyError
from roboxim_policies import load_policy
from roboxim_policies.serving import policy_server
from roboxim_policies.wires import openpi
from roboxim_runs.policies.server_records import server_record
from roboxim_runs.policies.specs import PolicySpec, choose_policies, find_policies
from roboxim_runs.storage.folder import RunFolder


def served(port=0, **options):
    return policy_server(lambda: load_policy("random", **options), "openpi", port=port)


def chosen(url, convention="server", **more):
    options = {"url": url, "convention": convention, "version": 1, "reconnect_s": 0.0, **more}
    return choose_policies(["there=openpi"], (), [f"{key}={value}" for key, value in options.items()])[0]


def test_folder_goes_on_with_the_same_model_only(tmp_path):
    folder = RunFolder(tmp_path / "there")
    with served() as server:
        policy = chosen(server.url)
        assert policy.is_remote
        record = server_record(policy, folder, 2, 120.0)
        assert record.facts["metadata"]["roboxim"]["policy"] == "random"
        with folder.opened({"purpose": "eval", **record.plain}) as opened:
            opened.append(EpisodeResult(episode_id="e0", index=0, outcome="failure"))
        json.loads((folder.path / "run.json").read_text())
        again = server_record(policy, folder, 2, 120.0)
        assert again.plain == json.loads(json.dumps(record.plain))
    assert server_record(policy, folder, 1, 120.0).facts == again.facts, "a complete folder needs no server"
    with pytest.raises(PolicyError, match="cannot be reached"):
        server_record(policy, folder, 2, 120.0)
    with served(server.port, scale=0.1), pytest.raises(ConfigError, match="1 episode of another model.*probe differ"):
        server_record(policy, folder, 2, 120.0)


def test_answers_longer_than_the_convention_uses_are_told_when_a_run_begins(tmp_path):
    def answer(connection):
        connection.send(openpi.encode({}))
        for _ in connection:
            connection.send(openpi.encode({"actions": np.zeros((50, 7), np.float32)}))

    with serve(answer, "127.0.0.1", 0, compression=None) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        policy = chosen(f"ws://127.0.0.1:{server.socket.getsockname()[1]}", "libero")
        record = server_record(policy, RunFolder(tmp_path / "there"), 1, 120.0)
        server.shutdown()
        thread.join()
    (notice,) = record.notices
    assert "answers 50 actions; the first 10 are used" in notice
    assert set(record.plain) == {"server", "server_probe"}, (
        "what a folder holds, and a run is continued by, is as before"
    )


def test_deadline_longer_than_the_evaluators_is_refused(tmp_path):
    with served() as server, pytest.raises(ConfigError, match="waits 90 s for its server, the evaluator only 30 s"):
        server_record(chosen(server.url), RunFolder(tmp_path / "there"), 1, 30.0)


@pytest.mark.parametrize("words", [{"instruction": ""}, {"wordings": "german"}])
def test_remote_policy_with_other_words_is_recognised_as_well(words, tmp_path):
    from roboxim_runs.evaluation.run import EvaluationConfig, evaluate

    options = {"policy": "openpi", **words, "url": "ws://localhost:1", "version": "1", "reconnect_s": 0.0}
    spec = PolicySpec(spec="reworded", name="mute", options={**options, "convention": "libero"})
    (policy,) = find_policies([spec])
    assert policy.acting.is_remote
    assert policy.cameras == ("workspace", "wrist")
    with pytest.raises(PolicyError, match="cannot be reached"):  # asked before the first worker starts
        evaluate(EvaluationConfig(policies=[spec], out=tmp_path / "out", episodes=1, workers=1))
    with pytest.raises(ConfigError, match="did you mean 'libero'"):
        find_policies([PolicySpec(spec="reworded", options={**options, "convention": "libreo"})])


@pytest.mark.parametrize(
    ("name", "words"), [("lerobot", "pickles.*LeRobot model server"), ("groot-n1", "pickles.*update Isaac-GR00T")]
)
def test_server_that_exchanges_pickles_is_refused_with_the_way_round(name, words, monkeypatch):
    monkeypatch.setattr("roboxim_cli.named.fresh_catalog", lambda part: {"policies": {"openpi": {}, "groot": {}}})
    with pytest.raises(ConfigError, match=words):
        choose_policies([Named("policy").convert(name, None, None)])
    with pytest.raises(ConfigError, match="unknown policy 'lerobto'"):
        Named("policy").convert("lerobto", None, None)


def test_mistake_in_the_options_is_found_without_a_server():
    with pytest.raises(ConfigError, match="version"):
        choose_policies(["openpi"], (), ["url=ws://localhost:1", "convention=libero"])
    with pytest.raises(ConfigError, match="did you mean 'libero'"):
        chosen("ws://localhost:1", "libreo")
    with pytest.raises(ConfigError, match="policy 'lerobot': LeRobot.*pickles"):
        choose_policies(["lerobot"], (), [])
    assert chosen("ws://localhost:1", "libero").cameras == ("workspace", "wrist")
