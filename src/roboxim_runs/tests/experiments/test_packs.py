"""An experiment's folder as one file: what is packed, and what is refused. Results are planted, not simulated."""

import hashlib
import json
import re
import shutil
import tarfile

import numpy as np
import pytest
from planted_runs import PLANTED_EXPERIMENT, PLANTED_RATES, planted_folder

from roboxim_core.actions import ActionSemantics
from roboxim_core.config import digest
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.results_log import ResultsLog
from roboxim_core.policies import EpisodeStart, Observation, ObservationWindow
from roboxim_core.proprioception import Proprioception
from roboxim_eval.experiments import stages_of
from roboxim_runs.experiments import pack as experiment_pack
from roboxim_runs.experiments.card import evaluation_folder
from roboxim_runs.experiments.pack import pack, packed_files, unpack
from roboxim_runs.experiments.provenance import file_sha256, folder_sha256
from roboxim_runs.experiments.report import ExperimentFolder, folder_card, write_experiment_report
from roboxim_runs.experiments.run import run_experiment
from roboxim_runs.experiments.run_config import ExperimentRunConfig


def test_a_pack_survives_the_loss_of_its_machine(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
    card = folder_card(folder)
    bag = evaluation_folder(folder.path, "evaluate/baseline.1") / "episodes/eval-0/eval-0_0.mcap"
    dataset = folder.path / "export/leave_out.0/train.tfrecord"
    for heavy in (bag, dataset, folder.path / "generate/0/episodes/a/a_0.mcap"):
        heavy.parent.mkdir(parents=True)
        heavy.write_bytes(b"0" * 1000)
    names = {file.relative_to(folder.path).as_posix() for file in packed_files(folder.path)}
    assert {"card.json", "experiment.json", "stages.jsonl", "train/baseline.2/checkpoint.npz"} <= names
    assert "evaluate/blind.0/blind/results.jsonl" in names
    assert not any(name.endswith((".mcap", ".tfrecord", ".lock")) for name in names)
    packed = pack(folder.path, tmp_path / "run.tar.gz")
    assert packed.files == len(names)
    found = unpack(packed.path, tmp_path / "again")
    assert found.files == packed.files
    again = ExperimentFolder.of(tmp_path / "again")
    assert folder_card(again) == card
    assert card.verdicts[0].sentence in write_experiment_report(again, card).read_text()
    with pytest.raises(ConfigError, match="is not empty"):
        unpack(packed.path, tmp_path / "again")
    with pytest.raises(ConfigError, match="exists; remove it, or name another file with --out"):
        pack(folder.path, packed.path)


def train_tiny(folder):
    """Train a bc network of the usual size for one step on two invented demonstrations."""
    from roboxim_policies.bc.config import BCConfig
    from roboxim_policies.learning.data import Demonstration, assemble
    from roboxim_policies.learning.train import Trainer

    rng = np.random.default_rng(0)
    shown = [
        Demonstration(
            images={"workspace": rng.integers(0, 255, (6, 32, 32, 3), np.uint8)},
            proprio=np.stack([Proprioception(tcp_position=(0.5, 0.01 * i, 0.1)).vector() for i in range(6)]),
            actions=rng.normal(size=(6, 7)).astype(np.float32), instruction=f"Pick up the {color} cube",
        )
        for color in ("red", "blue")
    ]  # fmt: skip
    data = assemble(shown, camera_sizes={"workspace": (32, 32)}, semantics=ActionSemantics(), robot="panda")
    return Trainer(data, BCConfig(steps=1, batch=2, image_sizes={"workspace": 32}), folder).run()


def acted(checkpoint):
    """Return what the policy of a checkpoint answers to an invented observation."""
    from roboxim_policies.learning.policy import LearnedPolicy

    policy = LearnedPolicy(checkpoint)
    policy.reset(EpisodeStart(episode_id="e", instruction="Pick up the red cube", seed=0))
    image = np.random.default_rng(1).integers(0, 255, (32, 32, 3), np.uint8)
    seen = Observation(seq=0, stamp_ns=0, images={"workspace": image}, proprio=Proprioception())
    return policy.act(
        ObservationWindow(instruction="Pick up the red cube", observations=[seen], pad_mask=(True,), episode_id="e",
                          seq=0)
    )  # fmt: skip


def hash_with(folder, file, original):
    """Return `folder_sha256` of a folder if a file of it had another hash."""
    content = hashlib.sha256()
    for one in sorted(folder.iterdir()):
        content.update(f"{one.name}\0{original if one.name == file else file_sha256(one)}\n".encode())
    return content.hexdigest()


@pytest.mark.thorough
def test_a_pack_has_finished_bc_checkpoints_without_the_optimisers_state(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
    stages = {stage.name: stage for stage in stages_of(folder.design)}
    trained = train_tiny(tmp_path / "bc")
    trainings = tmp_path / "run/train"
    last = next(name for name in reversed(stages) if name.startswith("train/")).removeprefix("train/")
    assert last not in ("leave_out.0", "leave_out.1", "baseline.0", "baseline.1")
    for name in ("baseline.0", "baseline.0@1", "baseline.1", "leave_out.0", last):
        (trainings / name).mkdir(exist_ok=True)
        shutil.copy(trained, trainings / name / "checkpoint.npz")
        (trainings / name / "trained_on.json").write_text("{}")
    # the last training is not finished, the evaluation of leave_out.0 neither
    unfinished = {f"train/{last}", "evaluate/leave_out.0"}
    log = ResultsLog(tmp_path / "run/stages.jsonl")
    log.path.unlink()
    for stage in stages.values():
        if stage.name not in unfinished:
            key = digest({"sha": stage.sha, "name": stage.name, "policy": None})
            product = {"sha256": folder_sha256(tmp_path / "run" / stage.name)} if stage.kind == "train" else {}
            log.append(key, {"stage": stage.name, "wall_s": 1.0, **product})
    card = folder_card(folder)
    packed = pack(folder.path, tmp_path / "run.tar.gz")
    short = {f"train/{name}/checkpoint.npz" for name in ("baseline.0", "baseline.0@1", "baseline.1")}
    assert packed.originals == dict.fromkeys(short, file_sha256(trained))
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")], "no drafts are left"
    found = unpack(packed.path, tmp_path / "again")
    assert found.originals == packed.originals

    def sizes(name):
        return [(tmp_path / run / "train" / name / "checkpoint.npz").stat().st_size for run in ("run", "again")]

    assert all(3 * sizes(name)[1] < sizes(name)[0] for name in ("baseline.0", "baseline.0@1", "baseline.1"))
    for name in (last, "leave_out.0", "leave_out.1"):  # two that are to be continued, and one that is not bc's
        assert len(set(sizes(name))) == 1
    assert np.array_equal(acted(trained), acted(tmp_path / "again/train/baseline.0"))

    again = ExperimentFolder.of(tmp_path / "again")
    assert folder_card(again) == card
    assert card.verdicts[0].sentence in write_experiment_report(again, card).read_text()
    (again.path / "card.json").unlink()
    assert folder_card(again).sha256 == card.sha256, "a card that is written again is the same"
    stated = next(t.checkpoint_sha256 for t in card.trainings if (t.condition, t.replicate) == ("baseline", 0))
    original = found.originals["train/baseline.0/checkpoint.npz"]
    assert hash_with(again.path / "train/baseline.0", "checkpoint.npz", original) == stated

    repacked = pack(again.path, tmp_path / "more.tar.gz")
    assert repacked.originals == packed.originals
    unpack(repacked.path, tmp_path / "more")
    for name in sorted(short):
        assert file_sha256(tmp_path / "more" / name) == file_sha256(again.path / name)

    (tmp_path / "mine.yaml").write_text(PLANTED_EXPERIMENT)
    config = ExperimentRunConfig(experiment=str(tmp_path / "mine.yaml"), out=again.path, only=("train",))
    with pytest.raises(ConfigError, match=rf"stage 'train/{re.escape(last)}' needs export/\S+; run"):
        run_experiment(config)  # it begins with the training that is not finished, and makes its dataset again


def test_packs_that_are_too_large_or_damaged_are_refused(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
    with pytest.raises(ConfigError, match=r"more than 0 MB; its largest files: .*results.jsonl"):
        pack(folder.path, tmp_path / "small.tar.gz", most_bytes=1000)
    assert list(tmp_path.glob("*small*")) == [], "nothing is left"
    packed = pack(folder.path, tmp_path / "run.tar.gz").path
    packed.write_bytes(packed.read_bytes()[:-200])
    with pytest.raises(ConfigError, match="is not a complete pack"):
        unpack(packed, tmp_path / "torn")
    with pytest.raises(ConfigError, match="not the folder of an experiment or a benchmark"):
        pack(tmp_path, tmp_path / "none.tar.gz")
    evil = tmp_path / "evil.tar.gz"
    (tmp_path / "pack.json").write_text(json.dumps({"files": {"../outside": "0"}}))
    with tarfile.open(evil, "w:gz") as archive:
        archive.add(tmp_path / "pack.json", arcname=experiment_pack.MANIFEST)
    with pytest.raises(ConfigError, match="'../outside' leaves its folder"):
        unpack(evil, tmp_path / "evil")
    (tmp_path / "pack.json").write_text(json.dumps({"files": {}, "originals": {"a": "0"}}))
    with tarfile.open(evil, "w:gz") as archive:
        archive.add(tmp_path / "pack.json", arcname=experiment_pack.MANIFEST)
    with pytest.raises(ConfigError, match="names originals of files that it does not have"):
        unpack(evil, tmp_path / "evil")
