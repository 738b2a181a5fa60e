"""The audit of bags and exports, end to end: clean demonstrations pass, planted faults are found."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from roboxim_bringup.core_graph import CoreGraph
from roboxim_cli.commands.data._dataset_audit import command as audit_command
from roboxim_cli.commands.data._dataset_corrupt import command as corrupt_command
from roboxim_core.actions import ActionSemantics
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.errors import ConfigError, InvalidRequestError, RecorderError, SimError
from roboxim_recorder.export import export_bags
from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.run_bags import list_bags
from roboxim_runs.datasets.audit import AuditConfig, audit_dataset
from roboxim_runs.datasets.corruption import corrupt, fault_kinds
from roboxim_runs.datasets.export import ExportConfig, Hdf5Config, export_dataset
from roboxim_runs.datasets.rewriting import convert_dataset, merge_datasets, split_dataset
from roboxim_runs.episodes.reenactment import Recorded, Reenactor

TASKS = Path(__file__).parents[1] / "config" / "tasks"
SIDE_EFFECTS = {
    "rotation_jump": {"saturation"},
    "blank_camera": {"frozen_camera"},
    "state_lag": {"frozen_camera"},
    "camera_turned": {"frozen_camera"},
    "camera_blocked": {"frozen_camera"},
    "split_leak": {"duplicate"},
}
"""Fault to the checks that may find it, too: a camera that looks past the scene sees nothing move."""


@pytest.fixture(scope="module")
def demonstrations(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record three demonstrations of two skills."""
    out = tmp_path_factory.mktemp("demonstrations")
    try:
        graph = CoreGraph(out)
    except SimError as error:
        pytest.skip(str(error))
    with graph:
        for index, task in enumerate(("pick_cube_distractors", "push_object", "pick_up")):
            config = RunConfig(
                purpose="demo", keep="successful", max_attempts=5, output_dir=str(out),
                task_config=(TASKS / f"{task}.yaml").read_text(),
                image_width=128, image_height=128, noise_translation_m=0.003, noise_rotation_rad=0.01, run_seed=3,
            )  # fmt: skip
            assert EpisodeRunner(graph.ports, config).run_index(index).outcome == "success"
    return out


@pytest.fixture(scope="module")
def exported(demonstrations: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Export them, one for validation."""
    out = tmp_path_factory.mktemp("exported") / "rlds"
    export_bags("rlds", demonstrations, out, ExportConfig(val_fraction=0.4, uneven=True))
    return out


@pytest.mark.slow
def test_clean_demonstrations_have_no_finding(demonstrations: Path, exported: Path, tmp_path: Path) -> None:
    audited = audit_dataset(demonstrations, tmp_path / "bags", AuditConfig(replay=True))
    assert [(check.name, finding.text) for check, finding in audited.result.findings()] == []
    assert {check.name for check in audited.result.checks if not check.checked} == {"content", "split_leak"}
    config = AuditConfig(bags=(demonstrations,), replay=True)
    audited = audit_dataset(exported, tmp_path / "rlds", config)
    assert [(check.name, finding.text) for check, finding in audited.result.findings()] == []
    assert {check.name for check in audited.result.checks if not check.checked} == {"clock"}


@pytest.mark.slow
def test_an_hdf5_dataset_is_audited_like_the_others(demonstrations: Path, tmp_path: Path) -> None:
    made = export_dataset("hdf5", demonstrations, tmp_path / "hdf5", Hdf5Config(uneven=True, val_fraction=0.4))
    config = AuditConfig(bags=(demonstrations,), replay=True, render=False)
    audited = audit_dataset(made.path / "dataset.hdf5", tmp_path / "clean", config)
    assert [(check.name, finding.text) for check, finding in audited.result.findings()] == []
    planted = corrupt(made.path, tmp_path / "copy", "rotation_jump", 0.34, seed=1)
    result = audit_dataset(planted.path, tmp_path / "report", AuditConfig(render=False)).result
    assert set(result.check("rotation_jump").faulty_episodes) == set(planted.planted)


@pytest.mark.slow
def test_what_was_left_out_or_edited_on_purpose_is_no_finding(demonstrations: Path, tmp_path: Path) -> None:
    whole = export_bags("hdf5", demonstrations, tmp_path / "a", Hdf5Config(uneven=True, convention="bridge")).path
    where = ["trim train/0 2..12", "relabel train/1 Touch it", "trim train/1 0..9", "split!=val"]
    cut = convert_dataset(whole, tmp_path / "b", "hdf5", where=where).path
    again = convert_dataset(cut, tmp_path / "c", "rlds", where=["trim train/0 1..5", "relabel train/1 Wave"]).path
    facts = json.loads((again / "export.json").read_text())
    assert facts["where"] == ["trim train/0 1..5", "relabel train/1 Wave"]
    assert len(facts["edits"]) == 2
    made = [whole, cut, again]
    made += [one.path for one in split_dataset(whole, tmp_path / "d", {"train": 2, "val": 1}, apart=True).values()]
    made.append(export_bags("hdf5", demonstrations, tmp_path / "e", Hdf5Config(uneven=True, split={"test": 2})).path)
    sharded = [Hdf5Config(uneven=True, val_fraction=0, shard=f"{number}/2") for number in (1, 2)]
    shards = [export_bags("hdf5", demonstrations, tmp_path / one.shard[0], one).path for one in sharded]
    made[-1:-1] = [shards[0], merge_datasets(shards, tmp_path / "f").path]
    config = AuditConfig(checks=("content", "wrong_instruction"), render=False)
    for path in made:
        for bags in ((demonstrations,), ()):
            result = audit_dataset(path, config=replace(config, bags=bags)).result
            assert [(check.name, finding.text) for check, finding in result.findings()] == []
            assert bool(result.check("content").checked) == bool(bags)
    facts = json.loads((made[-1] / "export.json").read_text())
    facts["config"]["split"] = {"test": 3}
    (made[-1] / "export.json").write_text(json.dumps(facts))
    result = audit_dataset(made[-1], config=replace(config, bags=(demonstrations,))).result
    assert len(result.check("content").findings) == 1  # the third episode is missing


@pytest.mark.slow
def test_bags_of_joint_actions_are_executed_as_such(demonstrations: Path, tmp_path: Path) -> None:
    joints = replace(ActionSemantics(), control="joint_position", frame="none", rotation="none", delta_base="none")
    with Reenactor(tmp_path / "joints") as sim:
        for bag in list_bags(demonstrations):
            recorded = Recorded.of(bag)
            acts = [
                replace(act, executed=(*state.robot.joint_commands, act.executed[-1]),
                        label=(*state.robot.joint_commands, act.label[-1]))
                for act, state in zip(recorded.acts, recorded.states[1:], strict=True)
            ]  # fmt: skip
            info = replace(recorded.info, semantics=joints)
            sim.record(replace(recorded, info=info), recorded.info.scene, acts)
    audited = audit_dataset(tmp_path / "joints", tmp_path / "report", AuditConfig(replay=True, render=False))
    assert [(check.name, finding.text) for check, finding in audited.result.findings()] == []
    assert audited.result.check("replay").checked == 3


def test_faults_are_planted_in_a_folder_below_the_working_directory(expert_bag, tmp_path, monkeypatch) -> None:
    bag, _, _ = expert_bag(seed=0, size=32)
    monkeypatch.chdir(tmp_path)
    made = corrupt(bag.parent, "copies/mine", "duplicate", 1.0)
    assert made.path == Path("copies/mine"), "as it was given, for what is printed"
    assert len(list_bags(made.path)) == 2


@pytest.mark.slow
@pytest.mark.parametrize("fault", [name for name, kind in fault_kinds().items() if kind.bags])
def test_faults_planted_in_bags_are_found(fault: str, demonstrations: Path, tmp_path: Path) -> None:
    kind = fault_kinds()[fault]
    made = corrupt(demonstrations, tmp_path / "copy", fault, 1.0, seed=1)
    assert made.planted
    config = AuditConfig(replay=kind.found_by == "replay")
    result = audit_dataset(made.path, tmp_path / "report", config).result
    assert set(result.check(kind.found_by).faulty_episodes) == set(made.planted)
    assert {check.name for check in result.checks if check.faults} <= {kind.found_by, *SIDE_EFFECTS.get(fault, ())}
    for bag in list_bags(made.path):
        if fault != "clock":  # a stamp that differs from those of its messages is no whole bag
            assert check_bag(bag).ok, check_bag(bag).problems


@pytest.mark.slow
@pytest.mark.parametrize("fault", [name for name, kind in fault_kinds().items() if kind.datasets])
def test_faults_planted_in_a_dataset_are_found(
    fault: str, demonstrations: Path, exported: Path, tmp_path: Path
) -> None:
    kind = fault_kinds()[fault]
    made = corrupt(exported, tmp_path / "copy", fault, 0.34, seed=1)
    listed = json.loads(made.listing.read_text())
    assert (listed["planted"], listed["found_by"]) == (made.planted, kind.found_by)
    of_simulator = kind.found_by == "replay"
    config = AuditConfig(bags=(demonstrations,) * of_simulator, replay=of_simulator, render=False)
    result = audit_dataset(made.path, tmp_path / "report", config).result
    assert set(result.check(kind.found_by).faulty_episodes) == set(made.planted)


@pytest.mark.slow
def test_the_commands(demonstrations: Path, tmp_path: Path) -> None:
    runner = CliRunner()
    copy = tmp_path / "copy"
    arguments = [str(demonstrations), str(copy), "--fault", "wrong_instruction", "--rate", "0.3"]
    planted = runner.invoke(corrupt_command, arguments)
    assert planted.exit_code == 0, planted.output
    assert "1 planted" in planted.output
    before = sorted(tmp_path.iterdir())
    assert runner.invoke(audit_command, [str(copy), "--check", "wrong_instruction"]).exit_code == 1
    assert sorted(tmp_path.iterdir()) == before, "without --out nothing is written"
    arguments = [str(copy), "--check", "wrong_instruction", "--out", str(tmp_path / "report")]
    found = runner.invoke(audit_command, arguments)
    assert found.exit_code == 1, "faults are an exit code of 1"
    page = tmp_path / "report" / "report.html"
    assert str(page) in found.output
    assert "data:image/webp" in page.read_text(), "pictures show the finding"
    clean = runner.invoke(audit_command, [str(demonstrations), "--check", "idle", "--out", str(tmp_path / "clean")])
    assert clean.exit_code == 0, clean.output


@pytest.mark.slow
def test_a_damaged_bag_is_reported_and_the_others_are_audited(demonstrations: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(demonstrations / "episodes", copy)
    broken = sorted(copy.iterdir())[0]
    file = next(broken.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[:-5000])
    result = audit_dataset(copy, tmp_path / "report", AuditConfig(render=False)).result
    assert list(result.unreadable) == [broken.name]
    assert not result.clean
    assert result.check("idle").checked == 2


def test_wrong_requests_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    bags = tmp_path / "bags" / "e0"
    bags.mkdir(parents=True)
    (bags / "e0_0.mcap").touch()
    cases = [
        ((bags.parent, "no_such_fault", 0.1), ConfigError, "no_such_fault"),
        ((bags.parent, "split_leak", 0.1), ConfigError, "only in a dataset"),
        ((bags.parent, "rotation_jump", 0.0), InvalidRequestError, "rate"),
    ]
    for (source, fault, rate), error, match in cases:
        with pytest.raises(error, match=match):
            corrupt(source, tmp_path / "out", fault, rate)
    assert not (tmp_path / "out").exists()
    (tmp_path / "out").mkdir()
    with pytest.raises(RecorderError, match="exists"):
        corrupt(bags.parent, tmp_path / "out", "rotation_jump", 0.5)
    with pytest.raises(ConfigError, match="unknown audit check 'speed'"):
        AuditConfig(checks=("speed",))
    with pytest.raises(ConfigError, match="no such folder"):
        audit_dataset(tmp_path / "nothing")
    with pytest.raises(ConfigError, match="no dataset"):
        audit_dataset(tmp_path / "out")


def test_every_fault_names_a_check_and_a_place() -> None:
    from roboxim_datasets.audit import AUDIT_CHECKS

    kinds = fault_kinds()
    for kind in kinds.values():
        assert kind.found_by in AUDIT_CHECKS
        assert kind.bags or kind.datasets
        assert kind.title
    found = {kind.found_by for kind in kinds.values()}
    # these know no faults; composed ones are planted for them
    general = {"behaviour", "content", "labels", "motion", "recorded_task"}
    assert found | general == set(AUDIT_CHECKS), "every check has a fault that it must find"
