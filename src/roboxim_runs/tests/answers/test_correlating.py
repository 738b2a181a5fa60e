"""Tables of two benchmarks are read, or refused by row."""

import json

import pytest
from click.testing import CliRunner
from planted_runs import PLANTED_RATES, planted_folder

from roboxim_cli.main import group
from roboxim_core.config import to_plain
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError
from roboxim_runs.answers.correlating import correlated, read_results
from roboxim_runs.evaluation.report import RECORD_FILE, EvaluationRecord
from roboxim_runs.experiments.report import folder_card
from roboxim_runs.storage.folder import RunFolder

REAL = """policy,cell,successes,trials
bc,can,8,10
bc,drawer,3,10
act,can,5,10
act,drawer,2,10
zero,can,0,10
zero,drawer,1,10
"""


def written(path, text):
    path.write_text(text)
    return path


def test_tables_of_both_forms_are_matched_by_policy_and_cell(tmp_path):
    real = written(tmp_path / "real.csv", REAL)
    rows = [
        {"policy": name, "cell": "can", "successes": n, "trials": 20}
        for name, n in (("zero", 1), ("act", 9), ("bc", 17))
    ]
    ours = written(tmp_path / "ours.json", json.dumps(rows))
    found = correlated(real, [ours])
    assert [(p.name, p.rates) for p in found.policies] == [
        ("bc", (0.8, 0.85)),
        ("act", (0.5, 0.45)),
        ("zero", (0.0, 0.05)),
    ]
    words = ("correlate", str(real), str(ours), "--no-plan", "--names", "robot,sim")
    said = CliRunner().invoke(group, words, standalone_mode=False, catch_exceptions=False).stdout
    assert "sim and robot, 3 policies: Pearson 0.9" in said
    assert "different numbers of rollouts" not in said
    uneven = written(tmp_path / "uneven.csv", REAL.replace("drawer,3,10", "drawer,3,90"))
    both = ("correlate", str(uneven), str(uneven), "--no-plan")
    said_uneven = CliRunner().invoke(group, both, standalone_mode=False, catch_exceptions=False).stdout
    assert "42 % of 36" in said_uneven
    assert "Cells have different numbers of rollouts" in said_uneven, "36 is none of a user's numbers"
    data = CliRunner().invoke(group, (*words, "--json"), standalone_mode=False, catch_exceptions=False).stdout
    assert json.loads(data)["mmrv"]["value"] == 0


def test_a_cell_that_one_policy_lacks_counts_for_none(tmp_path):
    real = written(tmp_path / "real.csv", REAL)
    ours = written(tmp_path / "ours.csv", REAL.replace("act,drawer,2,10\n", ""))
    assert [p.rates for p in correlated(real, [ours]).policies] == [(0.8, 0.8), (0.5, 0.5), (0.0, 0.0)]


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("policy,successes,trials\n", "has no row"),
        ("policy,wins,trials\nbc,1,2\n", "row 2: unknown column 'wins'"),
        ("policy,successes\nbc,1\n", "row 2: has no trials"),
        ("policy,successes,trials\nbc,0.5,2\n", "row 2: expected whole numbers"),
        ("policy,successes,trials\nbc,3,2\n", "row 2: expected whole numbers"),
        ("policy,successes,trials\nbc,0,0\n", "row 2: a rate needs at least one trial"),
        ("policy,successes,trials\nbc,1,2\nbc,1,2\n", "row 3: policy 'bc' has a row of this cell already"),
        ("policy,cell,successes,trials\nbc,can,1,2\nbc,,1,2\n", "rows with a cell and one without"),
        ("policy,successes,trials\nbc,1,2,3\n", "row 2: has more values than the header has columns, e.g. '3'"),
        ("policy,successes,trials,trials\nbc,1,2,3\n", "has the column 'trials' twice"),
        ("policy;successes;trials\nbc;1;2\n", "columns are separated by commas, not by ';'"),
        ("policy,successes,trials\n ,1,2\n", "row 2: the policy has no name"),
        ("policy,successes,trials\nbc,1_0,2_0\n", "row 2: expected whole numbers"),
        (
            f"policy,successes,trials\nbc,1,{'9' * 400}\n",
            "row 2: trials must be at most 1000000000, got '9+ ",
        ),
    ],
)
def test_a_wrong_table_is_refused_by_row(tmp_path, text, error):
    with pytest.raises(ConfigError, match=error):
        read_results(written(tmp_path / "real.csv", text))


@pytest.mark.parametrize(
    ("changed", "error"),
    [
        ({"trials": 10**400}, "row 1: trials must be at most 1000000000"),
        ({"policy": {"name": "bc"}}, r"row 1: policy: expected a name, got \{'name'"),
        ({"cell": False}, "row 1: cell: expected a name, got False"),
    ],
)
def test_a_wrong_row_of_json_is_refused(tmp_path, changed, error):
    row = {"policy": "bc", "successes": 1, "trials": 2} | changed
    with pytest.raises(ConfigError, match=error):
        read_results(written(tmp_path / "real.json", json.dumps([row])))


def test_a_cell_may_be_a_number_and_lines_may_end_as_on_an_old_mac(tmp_path):
    rows = [{"policy": "bc", "cell": cell, "successes": 1, "trials": 2} for cell in (0, 1)]
    assert read_results(written(tmp_path / "a.json", json.dumps(rows)))["bc"].cells == ("0", "1")
    (tmp_path / "a.csv").write_bytes(REAL.replace("\n", "\r").encode())
    assert read_results(tmp_path / "a.csv") == read_results(written(tmp_path / "b.csv", REAL))


def test_other_faults_are_refused(tmp_path):
    real = written(tmp_path / "real.csv", REAL)
    two = written(tmp_path / "two.csv", "policy,successes,trials\nbc,1,2\nact,1,2\nother,1,2\n")
    with pytest.raises(ConfigError, match="2 policies in common \\(bc, act\\), and a correlation needs at least 3"):
        correlated(real, [two])
    with pytest.raises(ConfigError, match="policy 'act' is in another of the tables"):
        correlated(real, [two, two])
    with pytest.raises(ConfigError, match="expected a .csv or .json file"):
        read_results(written(tmp_path / "real.txt", REAL))
    with pytest.raises(ConfigError, match="has neither"):
        read_results(tmp_path)
    with pytest.raises(ConfigError, match="row 1: expected an object"):
        read_results(written(tmp_path / "bad.json", "[3]"))


def test_a_training_counts_once_and_names_with_a_dot_are_names(tmp_path):
    folder_card(planted_folder(tmp_path / "run", PLANTED_RATES))
    card = tmp_path / "run/card.json"
    conditions = [name for name in read_results(card) if "." not in name]
    trainings = [f"{name}.{number}" for name in conditions for number in range(3)]
    assert sorted(policy.name for policy in correlated(card, [card]).policies) == sorted(trainings)
    text = "policy,successes,trials\n" + "".join(f"{name},{n},20\n" for n, name in enumerate([*conditions, *trainings]))
    listed = correlated(written(tmp_path / "real.csv", text), [card])
    assert sorted(policy.name for policy in listed.policies) == sorted(trainings)
    pooled = "policy,successes,trials\n" + "".join(f"{name},{n},9\n" for n, name in enumerate(conditions))
    only = correlated(written(tmp_path / "pooled.csv", pooled), [card])
    assert [policy.name for policy in only.policies] == conditions
    names = written(tmp_path / "names.csv", "policy,successes,trials\npi,1,9\npi.0,4,9\npi.1,5,9\n")
    assert [policy.name for policy in correlated(names, [names]).policies] == ["pi", "pi.0", "pi.1"]


def test_folders_of_evaluations_and_experiments_are_tables(tmp_path):
    card = folder_card(planted_folder(tmp_path / "run", PLANTED_RATES))
    found = read_results(tmp_path / "run")
    assert found["leave_out.2"].rate == pytest.approx(0.4)
    assert found["leave_out"].pooled.episodes == 3 * found["leave_out.0"].pooled.episodes
    assert read_results(tmp_path / "run/card.json") == found
    assert card.experiment.name == "mine"
    out = tmp_path / "evaluation"
    for name, won in (("bc", 3), ("zero", 0)):
        with RunFolder(out / name).opened({"command": "evaluate"}) as run:
            for index in range(4):
                outcome = "success" if index < won else "failure"
                run.append(EpisodeResult(episode_id=f"{index}", index=index, outcome=outcome))
    record = EvaluationRecord(task="pick_cube", seed=0, policies=("bc", "zero"))
    (out / RECORD_FILE).write_text(json.dumps(to_plain(record)))
    assert {name: arm.rate for name, arm in read_results(out).items()} == {"bc": 0.75, "zero": 0.0}
    with RunFolder(out / "zero").opened({"command": "evaluate"}) as run:
        for index in range(4, 10):
            run.append(EpisodeResult(episode_id=f"{index}", index=index, outcome="error", reason="policy_timeout"))
    with pytest.raises(ConfigError, match="does not measure zero: most episodes ended in errors"):
        read_results(out)
