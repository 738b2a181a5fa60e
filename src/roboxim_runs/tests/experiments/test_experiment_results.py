"""An experiment's folder after its run: report, comparison, pack. Results are planted, not simulated."""

import hashlib
import itertools
import json
import re
import shlex
import shutil
import tarfile
from collections import Counter

import numpy as np
import pytest
from click.testing import CliRunner
from planted_runs import PLANTED_EXPERIMENT, PLANTED_RATES, planted_folder

from roboxim_cli.main import group
from roboxim_core.actions import ActionSemantics
from roboxim_core.config import digest, to_json
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.results_log import ResultsLog, line_of
from roboxim_core.policies import EpisodeStart, Observation, ObservationWindow
from roboxim_core.proprioception import Proprioception
from roboxim_eval.experiments import stages_of
from roboxim_eval.experiments.card import parse_card
from roboxim_runs.evaluation.report import EvaluationRecord
from roboxim_runs.experiments import pack as experiment_pack
from roboxim_runs.experiments.card import evaluation_folder
from roboxim_runs.experiments.models import compared
from roboxim_runs.experiments.pack import pack, packed_files, unpack
from roboxim_runs.experiments.provenance import attestation_template, file_sha256, folder_sha256
from roboxim_runs.experiments.report import (
    ExperimentFolder,
    checkpoint_episodes,
    experiment_episodes,
    folder_card,
    reproduction,
    write_evaluation_pages,
    write_experiment_report,
)
from roboxim_runs.experiments.run import ExperimentRunConfig, run_experiment
from roboxim_runs.experiments.trained.policies import named_policies
from roboxim_runs.policies.specs import PolicySpec


def test_a_folder_receives_a_card_and_a_page(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
    card = folder_card(folder)
    assert card.verdicts[0].sentence.startswith("leave_out in unseen cells is lower than baseline there by 50 points")
    assert card.scores["relative"][0] == pytest.approx(0.4 / 0.9, abs=1e-5)
    assert card.datasets["leave_out.0"].sha256 == "hash of export/leave_out.0"
    assert card.trainings[0].checkpoint_sha256 == "hash of train/leave_out.0"
    assert card.trainings[0].attest.recipe == {"steps": 7, "command": "train {dataset} {out} {seed}"}
    assert folder_card(folder) == card, "a stored card is checked, not written again"
    page = write_experiment_report(folder, card).read_text()
    assert card.verdicts[0].sentence in page
    assert "roboxim experiment run mine.yaml --scale full --out run" in page
    assert "No scene has distractors, so the scene alone reveals which object is meant." in page
    assert "Only scenes of place_on have the support plate, so the scene alone reveals this task." in page
    episodes = experiment_episodes(folder)
    assert len(episodes) == 3 * (80 + 80 + 40)
    assert {e.cell for e in episodes if e.arm == "blind"} == {"pick_up target=cube", "place_on target=soda_can"}


@pytest.mark.thorough
def test_card_and_page_have_the_measures_beside_success_of_tasks_with_limits(tmp_path):
    measures = {"limits.force_max_n": 30.0, "limits.keep_out_s": 0.2, "limits.crossed": 2.0}
    folder = planted_folder(tmp_path / "limited", PLANTED_RATES, predicates=measures)
    card = folder_card(folder)
    beside = card.evaluations[0].beside
    assert (beside.episodes, beside.crossed) == (80, 80)
    assert beside.measures["force_max_n"].median == 30.0
    assert parse_card(json.loads((folder.path / "card.json").read_text())) == card
    page = write_experiment_report(folder, card).read_text()
    assert "<th>crossed a limit</th><th>largest force of a contact</th><th>time in a keep-out volume</th>" in page
    assert '<td class="num">80 of 80</td><td class="num">30 N (30 N to 30 N)</td>' in page
    without = folder_card(planted_folder(tmp_path / "free", PLANTED_RATES)).plain
    assert [row for row in without["evaluations"] if "beside" in row] == [], "without limits, cards are as before"


def test_the_printed_command_names_the_file_the_renderer_and_the_policies(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
    path = folder.path / "experiment.json"
    trained = {name: {"spec": "bc", "options": {"checkpoint": f"/old/train/{name}"}}
               for name in (f"{c}.{r}" for c in ("leave_out", "baseline") for r in range(3))}  # fmt: skip

    def printed(policies):
        def blind(replicate):
            words = {"policy": policies[f"leave_out.{replicate}"]["spec"], "instruction": ""}
            return {"spec": "reworded", "options": policies[f"leave_out.{replicate}"]["options"] | words}

        ran = {**{f"blind.{r}": blind(r) for r in range(3)}, **policies}
        stages = {f"evaluate/{name}": {"policy": {"name": "", **policy}} for name, policy in ran.items()}
        state = {**json.loads(path.read_text()), "experiment": "my files/mine.yaml", "renderer": "tiny"}
        path.write_text(json.dumps({**state, "stages": stages}))
        words = shlex.split(reproduction(ExperimentFolder.of(folder.path)))
        assert words[:4] == ["roboxim", "experiment", "run", "my files/mine.yaml"]
        assert words[words.index("--renderer") + 1] == "tiny"
        given = [
            [after for word, after in itertools.pairwise(words) if word == key] for key in ("--policy", "--option")
        ]
        return named_policies(*given)

    assert printed(trained) == {}, "policies that the experiment trains, and those that follow from them, are not named"
    mine = {"spec": "client.py:Mine", "options": {"port": 6000, "label": "6000", "note": "a: [b", "at": "runs/x"}}
    zero = {f"baseline.{r}": {"spec": "zero", "options": {}} for r in range(3)}
    named = {"leave_out.1": PolicySpec(**mine), "baseline": PolicySpec(spec="zero")}
    assert printed({**trained, **zero, "leave_out.1": mine}) == named
    blind = {"spec": "client.py:Other", "options": {}}
    assert printed({**trained, "blind.2": blind}) == {"blind.2": PolicySpec(**blind)}


def test_points_of_a_learning_curve_lead_to_episodes_of_their_own(tmp_path):
    text = PLANTED_EXPERIMENT.replace("steps: 7}", 'steps: 8, until: "--until {until}"}').replace(
        "count: 3", "count: 1"
    )
    folder = planted_folder(tmp_path / "run", PLANTED_RATES, text + "curve: {every: 4, per_checkpoint: 4}\n")
    page = write_experiment_report(folder, folder_card(folder)).read_text()
    assert '<a href="#episodes?arm=leave_out%404"><circle' in page
    assert "Success in seen cells alone. The line is the mean" in page, (
        "held-out cells are kept for the final evaluation"
    )
    arms = Counter(episode.arm for episode in checkpoint_episodes(folder))
    assert arms["leave_out@4"] == arms["baseline@4"] == 4
    assert {e.arm for e in experiment_episodes(folder)} == {"leave_out", "baseline", "blind"}


def test_the_page_of_a_card_alone_warns_of_what_its_scenes_tell(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
    folder_card(folder)
    html = tmp_path / "page.html"
    words = ("experiment", "report", "--from", str(folder.path / "card.json"), "--out", str(html))
    said = CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False).stdout
    for text in (said, html.read_text()):
        assert "No scene has distractors, so the scene alone reveals which object is meant." in text


def test_results_that_changed_after_the_card_are_refused(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
    folder_card(folder)
    results = evaluation_folder(folder.path, "evaluate/baseline.1") / "results.jsonl"
    whole = results.read_text()
    results.write_text(whole.replace('"outcome":"failure"', '"outcome":"success"', 1))
    with pytest.raises(ConfigError, match=r"results.jsonl line \d+ was changed after it was written"):
        folder_card(ExperimentFolder.of(folder.path))
    results.write_text(whole)
    entries = ResultsLog(results).read()
    lines = [line_of(entry.key, {**entry.data, "outcome": "success"}) for entry in entries]  # with new checksums
    results.write_text("".join(lines))
    with pytest.raises(ConfigError, match=r"results of evaluate/baseline.1 have changed since card.json"):
        folder_card(ExperimentFolder.of(folder.path))
    with pytest.raises(ConfigError, match="not the folder of an experiment"):
        ExperimentFolder.of(tmp_path)


def test_attestations_are_stated_and_wrong_ones_refused(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
    attest = tmp_path / "run/attest.yaml"
    attest.write_text(
        "recipe: {model: octo}\npretraining: octo-small-1.5\nexposure: unknown\n"
        "trainings: {baseline: {recipe: {steps: 3}}, leave_out.1: {exposure: 'yes'}}\n"
    )
    card = folder_card(folder)
    assert card.trainings[0].attest.recipe == {"steps": 7, "model": "octo"}
    assert any(
        "Recipes of leave_out and baseline differ in more than the dataset: steps 7 and 3" in w for w in card.warnings
    )
    assert any("pre-training of leave_out contained held-out combinations" in w for w in card.warnings)
    assert "octo-small-1.5" in write_experiment_report(folder, card).read_text()
    for text, said in (
        ("exposure: perhaps", "unknown 'perhaps'"),
        ("trainings: {leave_out.0: {dataset_sha256: abc}}", "used a dataset with hash abc, not the one"),
    ):
        attest.write_text(text)
        (tmp_path / "run/card.json").unlink(missing_ok=True)
        with pytest.raises(ConfigError, match=said):
            folder_card(ExperimentFolder.of(tmp_path / "run"))


def test_what_nobody_states_about_trainings_elsewhere_is_missed_not_filled_in(tmp_path):
    command = 'command: "train {dataset} {out} {seed}", policy: bc, '
    assert command in PLANTED_EXPERIMENT
    external = PLANTED_EXPERIMENT.replace(command, "")
    folder = planted_folder(tmp_path / "run", PLANTED_RATES, external)
    attest, unstated = tmp_path / "run/attest.yaml", "The recipe of baseline and leave_out is not stated"
    for text in (None, attestation_template(("leave_out.0",))):
        if text is not None:
            attest.write_text(text)
        (tmp_path / "run/card.json").unlink(missing_ok=True)
        card = folder_card(ExperimentFolder.of(folder.path))
        first = card.trainings[0]
        assert (first.attest.recipe, first.attest.dataset_sha256, first.steps) == ({}, "", 0)
        assert any(warning.startswith(unstated) for warning in card.warnings)
    said = card.datasets["leave_out.0"].sha256
    attest.write_text(f"recipe: {{model: octo, steps: 9}}\ntrainings: {{leave_out.0: {{dataset_sha256: {said}}}}}\n")
    (tmp_path / "run/card.json").unlink()
    card = folder_card(ExperimentFolder.of(folder.path))
    assert card.trainings[0].attest.recipe == {"model": "octo", "steps": 9}
    assert [t.attest.dataset_sha256 for t in card.trainings if t.condition == "leave_out"][:2] == [said, ""]
    assert not any("is not stated" in warning for warning in card.warnings)
    attest.write_text("recipe: {augment: false, dropout: 0, batch: 0, weights: '', seed: null}\n")
    (tmp_path / "run/card.json").unlink()
    card = folder_card(ExperimentFolder.of(folder.path))
    assert card.trainings[0].attest.recipe == {"augment": False, "dropout": 0}


def test_the_printed_command_of_a_further_round_names_the_trainer(tmp_path):
    text = PLANTED_EXPERIMENT.replace(
        "  mine: ", '  first: {command: "go {dataset} {out} {seed}", policy: bc}\n  mine: '
    )
    planted_folder(tmp_path / "run", {**PLANTED_RATES, "pick_up target=soda_can": 0.9}, text)
    state = tmp_path / "run/experiment.json"
    state.write_text(json.dumps(json.loads(state.read_text()) | {"trainer": "mine"}))
    card = folder_card(ExperimentFolder.of(tmp_path / "run"))
    out = tmp_path / "a round.yaml"
    words = ["experiment", "collect", str(tmp_path / "run/card.json"), "--demonstrations", "9", "--out", str(out)]
    said = CliRunner().invoke(group, words, catch_exceptions=False).output
    command = shlex.split(said.splitlines()[-1].partition(": ")[2])
    assert command == ["roboxim", "experiment", "run", str(out), "--trainer", "mine", "--out", "OUT"]
    assert card.warnings
    assert all(f"The card warns: {warning}" in said for warning in card.warnings)
    copy = ["experiment", "plan", str(out), "--trainer", "mine", "--no-probe", "--out", str(tmp_path / "copy.yaml")]
    assert "copy.yaml --trainer mine --out OUT" in CliRunner().invoke(group, copy, catch_exceptions=False).output


def test_stored_proofs_and_substitutions_are_part_of_the_card(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES)
    (folder.path / "proofs.json").write_text(json.dumps({"camera pose": [599, 600]}))
    judged = [{"cell": "pick_up target=cube", "satisfied": ["place_on target=cube"]}] * 9
    (folder.path / "judged_again.json").write_text(json.dumps([*judged, {"cell": "place_on target=soda_can"}]))
    card = folder_card(folder)
    assert card.proofs == {"camera pose": (599, 600)}
    assert card.scores["substitution"]["rate"][0] == pytest.approx(0.9)
    page = write_experiment_report(folder, card).read_text()
    assert "Delivery is not proved for 1 of 600 episodes: camera pose." in page
    assert "<td>pick_up target=cube</td><td>place_on target=cube</td>" in page


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


def test_compare_says_what_the_cards_warn_of(tmp_path):
    one = PLANTED_EXPERIMENT.replace("count: 3", "count: 1")
    for name in ("one", "two"):
        planted_folder(tmp_path / name, PLANTED_RATES, one)
    (tmp_path / "one/proofs.json").write_text(json.dumps({"camera pose": [599, 600]}))
    words = ("experiment", "compare", str(tmp_path / "one"), str(tmp_path / "two"))
    (tmp_path / "one/report.html").write_text("")
    words += ("--out", str(tmp_path / "models.html"))
    said = CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False).stdout
    assert "The card of one warns: Delivery is not proved for 1 of 600 episodes: camera pose." in said
    page = (tmp_path / "models.html").read_text()
    assert 'href="one/report.html#episodes?' in page
    assert "two/report.html" not in page, "it is not there"


def test_models_are_compared_on_the_scenes_that_they_shared(tmp_path):
    one = PLANTED_EXPERIMENT.replace("count: 3", "count: 1")
    planted_folder(tmp_path / "weak", {**PLANTED_RATES, "leave_out": 0.2}, one)
    planted_folder(tmp_path / "strong", {**PLANTED_RATES, "leave_out": 0.9}, one)
    models, cards = compared([tmp_path / "weak", tmp_path / "strong"])
    assert set(cards) == {"weak", "strong"}
    assert models.pairs[0].test == "these checkpoints, on 40 scenes that both met"
    assert models.models["strong"].letters != models.models["weak"].letters
    text = one.replace("steps: 7}", 'steps: 8, until: "--until {until}"}') + "curve: {every: 4, per_checkpoint: 4}\n"
    planted_folder(tmp_path / "curved", {**PLANTED_RATES, "leave_out": 0.9}, text)
    models, _ = compared([tmp_path / "weak", tmp_path / "curved"])
    assert models.pairs[0].test == "these checkpoints, on 40 scenes that both met", "a curve has scenes of its own"
    card = tmp_path / "card.json"
    card.write_text((tmp_path / "weak/card.json").read_text())
    models, _ = compared([card, tmp_path / "strong"])
    assert models.pairs[0].test == "these checkpoints, without pairing their scenes", "a card alone has no scenes"
    with pytest.raises(ConfigError, match="two of the runs are named 'weak'"):
        compared([tmp_path / "weak", tmp_path / "weak"])
    models, _ = compared([tmp_path / "weak/card.json", tmp_path / "strong/card.json"])
    assert models.models.keys() == {"weak", "strong"}, "a card is named by its folder"
    (tmp_path / "alone").mkdir()
    shutil.copy(tmp_path / "weak/card.json", tmp_path / "alone/card.json")
    with pytest.raises(ConfigError, match=r"its card can be read alone.*--from .*alone/card.json"):
        ExperimentFolder.of(tmp_path / "alone")
    models, _ = compared([tmp_path / "alone", tmp_path / "strong"])
    assert models.models.keys() == {"alone", "strong"}, "a published folder has the card alone"


@pytest.mark.thorough
def test_a_run_with_other_scenes_changes_nothing_between_the_others(tmp_path):
    one = PLANTED_EXPERIMENT.replace("count: 3", "count: 1")
    names = ("weak", "strong", "elsewhere")
    for name, rate in zip(names, (0.2, 0.9, 0.5), strict=True):
        text = one.replace("count: 1", "count: 1, first_seed: 5") if name == "elsewhere" else one
        planted_folder(tmp_path / name, {**PLANTED_RATES, "leave_out": rate}, text)
    for order in itertools.permutations(names):
        models, _ = compared([tmp_path / name for name in order])
        found = {frozenset((pair.first, pair.second)): pair.test.partition(", ")[2] for pair in models.pairs}
        assert found == {
            frozenset(("weak", "strong")): "on 40 scenes that both met",
            frozenset(("weak", "elsewhere")): "on different scenes",
            frozenset(("strong", "elsewhere")): "on different scenes",
        }, order


def test_models_are_compared_by_the_condition_of_the_first_run(tmp_path):
    one = PLANTED_EXPERIMENT.replace("count: 3", "count: 1")
    other = one.replace("first: leave_out, second: baseline", "first: baseline, second: leave_out")
    planted_folder(tmp_path / "weak", {**PLANTED_RATES, "leave_out": 0.2}, one)
    planted_folder(tmp_path / "strong", {**PLANTED_RATES, "leave_out": 0.9, "baseline": 0.0}, other)
    models, _ = compared([tmp_path / "weak", tmp_path / "strong"])
    assert models.condition == "leave_out"
    assert models.pairs[0].test == "these checkpoints, on 40 scenes that both met"
    assert models.pairs[0].difference.value == pytest.approx(0.2 - 0.9), "not the baseline's scenes"


@pytest.mark.thorough
def test_runs_whose_rollouts_were_asked_different_things_are_not_compared(tmp_path):
    planted_folder(tmp_path / "plain", PLANTED_RATES)
    planted_folder(tmp_path / "crowded", PLANTED_RATES, PLANTED_EXPERIMENT.replace("maximum: 0", "maximum: 3"))
    planted_folder(tmp_path / "large", PLANTED_RATES, PLANTED_EXPERIMENT.replace("64x64", "128x128"))
    words = ("experiment", "compare", str(tmp_path / "plain"), str(tmp_path / "crowded"))
    with pytest.raises(ConfigError, match="set.distractors.maximum: 0 in plain, 3 in crowded"):
        CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False)
    words = (*words[:3], str(tmp_path / "large"))
    said = CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False).stdout
    assert "The runs differ in image size, too: 64x64 (plain); 128x128 (large)." in said


def test_pages_of_evaluations_are_written_on_demand(tmp_path):
    folder = planted_folder(tmp_path / "run", PLANTED_RATES, PLANTED_EXPERIMENT.replace("count: 3", "count: 1"))
    folder_card(folder)
    with pytest.raises(ConfigError, match=r"leave_out.0/evaluation.json"):
        write_evaluation_pages(folder)
    for stage in stages_of(folder.design):
        if stage.kind == "evaluate":
            name = stage.name.removeprefix("evaluate/").partition(".")[0]
            record = EvaluationRecord(task="mine", seed=1, policies=(name,))
            (folder.path / stage.name / "evaluation.json").write_text(to_json(record))
    tables = tmp_path / "results.md"
    words = ("experiment", "report", str(folder.path), "--evaluations", "--films", "0", "--markdown", str(tables))
    said = CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False).stdout
    pages = sorted((folder.path / "evaluate").glob("*/report.html"))
    assert [page.parent.name for page in pages] == ["baseline.0", "blind.0", "leave_out.0"]
    assert all(f"report: {page}\n" in said for page in pages)
    assert "32 of 80" in pages[-1].read_text(), "by its own results"
    assert f"report: {tables}\n" in said
    assert "| 32 of 80 |" in tables.read_text()
