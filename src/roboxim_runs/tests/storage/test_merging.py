"""Merged shards are one run: nothing missing, nothing double, nothing of another run, everything or nothing."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from mcap.writer import MCAP0_MAGIC

from roboxim_core.config import to_plain
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, RecorderError
from roboxim_core.plain_data.results_log import RESULTS_FILE, ResultsLog, line_of
from roboxim_core.shards import Shard
from roboxim_runs.evaluation.report import RECORD_FILE, EvaluationRecord, stored_record
from roboxim_runs.storage import merging
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.storage.merging import merge_shards, whole_command

CONFIG = {"purpose": "eval", "episodes": 7, "run_seed": 0}


def result(index, attempt=0):
    name = f"eval-0-{index:05d}-{attempt}"
    return EpisodeResult(
        episode_id=name, index=index, attempt=attempt, outcome="success", bag=f"episodes/{name}", wall_s=index + 0.5
    )


def write(path, shard, config=CONFIG, **changes):
    with RunFolder(path).opened({**config, "shard": shard, "workers": 3}) as folder:
        for index in Shard.parse(shard).indices(config["episodes"]):
            one = replace(result(index, attempt=index % 2), **changes)
            for bag in (one.bag, f"set_apart/eval-0-{index:05d}-0" if index % 2 else one.bag):
                (folder.path / bag).mkdir(parents=True, exist_ok=True)
                (folder.path / bag / "x_0.mcap").write_bytes(f"{bag} {changes}".encode() + MCAP0_MAGIC)
            folder.append(one)
    return path


@pytest.fixture
def shards(tmp_path):
    return [write(tmp_path / f"shard-{i}", f"{i}/3") for i in (1, 2, 3)]


def files(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    }


def test_the_indices_of_all_shards_are_those_of_the_run():
    for count in (1, 2, 5):
        parts = [Shard.parse(f"{i + 1}/{count}").indices(11) for i in range(count)]
        assert sorted(index for part in parts for index in part) == list(range(11))
    assert Shard.parse("").indices(3) == range(3)
    for text in ("0/3", "4/3", "1", "a/b", "1/3/5", "-1/3"):
        with pytest.raises(ConfigError, match="a shard is I/N"):
            Shard.parse(text)


def test_merged_shards_are_the_folder_of_one_run(shards, tmp_path):
    whole = write(tmp_path / "whole", "1/1")
    [merged] = merge_shards(tmp_path / "out", shards)
    assert (merged.episodes, merged.shards, merged.doubles, merged.missing) == (7, 3, 0, ())
    made, wanted = files(tmp_path / "out"), files(whole)
    config, other = (json.loads(found.pop("run.json")) for found in (made, wanted))
    other.pop("shard")
    assert config == other
    assert made == wanted
    with RunFolder(tmp_path / "out").opened({**CONFIG, "workers": 1}) as folder:
        assert len(folder.results()) == 7
    assert {path.name for path in tmp_path.iterdir()} == {"out", "whole", "shard-1", "shard-2", "shard-3"}


def test_an_episode_that_two_folders_have_is_taken_once(shards, tmp_path):
    again = write(tmp_path / "again", "1/3", wall_s=99.0, inference_s=3.0)
    for bag in (again / "episodes").iterdir():
        (bag / "x_0.mcap").write_bytes(f"episodes/{bag.name} {{}}".encode() + MCAP0_MAGIC)
    [merged] = merge_shards(tmp_path / "out", [*shards, again])
    assert (merged.episodes, merged.doubles) == (7, 3)
    assert len((tmp_path / "out" / RESULTS_FILE).read_text().splitlines()) == 7


@pytest.mark.parametrize("difference", ["outcome", "bag"])
def test_two_different_recordings_of_an_episode_are_refused(shards, tmp_path, difference):
    other = write(tmp_path / "other", "2/3", **({"outcome": "failure"} if difference == "outcome" else {}))
    if difference == "bag":
        next((other / "episodes").iterdir()).joinpath("x_0.mcap").write_bytes(b"other" + MCAP0_MAGIC)
    with pytest.raises(RecorderError, match=r"shard-2 and .*other have different recordings of episode eval-0-0000"):
        merge_shards(tmp_path / "out", [*shards, other])
    assert not (tmp_path / "out").exists()


def test_shards_of_other_configurations_are_refused(shards, tmp_path):
    other = write(tmp_path / "other", "1/3", {**CONFIG, "run_seed": 1})
    with pytest.raises(ConfigError, match=r"no shard of the run in .*shard-1: run_seed: 0 in .*shard-1, 1 in .*other"):
        merge_shards(tmp_path / "out", [*shards, other])
    with pytest.raises(ConfigError, match="holds no run"):
        merge_shards(tmp_path / "out", [*shards, shards[0] / "episodes"])
    log = shards[1] / RESULTS_FILE
    log.write_text("".join(line_of("0", entry.data) for entry in ResultsLog(log).read()))
    with pytest.raises(ConfigError, match="line 1 is a result of another run"):
        merge_shards(tmp_path / "out", shards)
    assert not (tmp_path / "out").exists()


def test_missing_episodes_are_named_and_a_later_shard_completes_the_folder(shards, tmp_path):
    with pytest.raises(
        ConfigError, match=r"2 of 7 episodes of run '.' are missing: index 1, 4 \(given shards: 1/3, 3/3"
    ):
        merge_shards(tmp_path / "out", shards[::2])
    assert not (tmp_path / "out").exists()
    [merged] = merge_shards(tmp_path / "out", shards[::2], partial=True)
    assert merged.missing == (1, 4)
    [merged] = merge_shards(tmp_path / "out", [shards[1]])
    assert (merged.episodes, merged.missing) == (7, ())
    assert len(files(tmp_path / "out")) == len(files(write(tmp_path / "whole", "1/1")))


def evaluated(path, policy, shard, *, task="pick_cube", **config):
    with RunFolder(path / policy).opened({**CONFIG, "task_config": task, "shard": shard, **config}) as folder:
        for index in Shard.parse(shard).indices(CONFIG["episodes"]):
            folder.append(replace(result(index), bag=""))
    record = EvaluationRecord(
        task=task, seed=0, policies=(policy,), facts={f"policy {policy}": f"{policy}.npz"}, trained=(policy,),
        warnings=(f"{policy} was trained elsewhere.",), command=f"roboxim evaluate --policy {policy} --shard {shard}",
    )  # fmt: skip
    (path / RECORD_FILE).write_text(json.dumps(to_plain(record)))
    return path


@pytest.mark.parametrize("into_existing", [False, True])
def test_shards_of_different_policies_become_one_evaluation(tmp_path, into_existing):
    shards = [evaluated(tmp_path / f"{p}-{n}", p, f"{n}/2") for p in ("a", "b") for n in (1, 2)]
    for part in (shards[:2], shards[2:]) if into_existing else (shards,):
        merge_shards(tmp_path / "out", part)
    record = stored_record(tmp_path / "out")
    assert record.policies == record.trained == ("a", "b")
    assert record.facts == {"policy a": "a.npz", "policy b": "b.npz"}
    assert record.warnings == ("a was trained elsewhere.", "b was trained elsewhere.")
    assert record.command == "roboxim evaluate --policy a\nroboxim evaluate --policy b"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"task": "stack"}, 'task: "pick_cube" of a, "stack" of b'),
        ({"run_seed": 1}, "other scenes than .*run_seed: 0 in .*, 1 in"),
    ],
)
def test_shards_of_policies_in_different_scenes_are_refused(tmp_path, change, words):
    first = evaluated(tmp_path / "a", "a", "1/1")
    with pytest.raises(ConfigError, match=words):
        merge_shards(tmp_path / "out", [first, evaluated(tmp_path / "b", "b", "1/1", **change)])
    assert not (tmp_path / "out").exists()


def test_a_bag_without_a_result_is_replaced_by_the_shard_s(shards, tmp_path):
    merge_shards(tmp_path / "out", shards[::2], partial=True)
    left = tmp_path / "out" / "episodes" / "eval-0-00001-1"  # a run was killed between the bag and its line
    left.mkdir()
    (left / "x_0.mcap").write_bytes(b"another recording" + MCAP0_MAGIC)
    merge_shards(tmp_path / "out", [shards[1]])
    assert files(tmp_path / "out") == files(write(tmp_path / "whole", "1/1")) | {
        "run.json": (tmp_path / "out" / "run.json").read_bytes()
    }


def test_a_lost_bag_and_a_running_shard_are_refused(shards, tmp_path):
    with (
        RunFolder(shards[0]).opened({**CONFIG, "shard": "1/3", "workers": 3}),
        pytest.raises(ConfigError, match=r"a command is running in .*shard-1"),
    ):
        merge_shards(tmp_path / "out", shards)
    (shards[2] / "episodes/eval-0-00002-0/x_0.mcap").unlink()
    with pytest.raises(RecorderError, match="names the bag episodes/eval-0-00002-0, which is gone"):
        merge_shards(tmp_path / "out", shards)


def test_a_merge_that_dies_leaves_nothing_and_is_repeated(shards, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(merging, "write_whole", lambda *_: (_ for _ in ()).throw(OSError(28, "No space left")))
        with pytest.raises(RecorderError, match="No space left"):
            merge_shards(tmp_path / "out", shards)
    assert not (tmp_path / "out").exists()
    killed = tmp_path / ".out.merging"  # what a SIGKILL leaves
    (killed / "episodes/eval-0-00000-9").mkdir(parents=True)
    merge_shards(tmp_path / "out", shards)
    assert not killed.exists()
    assert not (tmp_path / "out/episodes/eval-0-00000-9").exists()


def test_a_folder_of_something_else_is_never_written_into(shards, tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    with pytest.raises(ConfigError, match="is not a run's folder"):
        merge_shards(tmp_path / "out", shards)
    with pytest.raises(ConfigError, match="both a shard and the output"):
        merge_shards(shards[0], shards)


def test_the_command_of_a_whole_run_is_the_shard_s_without_its_own_options():
    given = "roboxim evaluate --policy 'a b' --shard 2/3 --out=runs/x-2 --seed 4"
    assert whole_command(given) == "roboxim evaluate --policy 'a b' --seed 4"
    assert whole_command("roboxim.evaluate(seed=4)") == "roboxim.evaluate(seed=4)"
