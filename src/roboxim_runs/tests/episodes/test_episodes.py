from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from roboxim_bringup.graph import GraphConfig, PolicyLaunch
from roboxim_core.episode import RunConfig
from roboxim_core.errors import RoboximError
from roboxim_runs.episodes.run import episode_jobs, episode_result, episodes_work, run_environment
from roboxim_runs.executors import LocalExecutor

pytestmark = [pytest.mark.ros, pytest.mark.slow]

SMALL = {"sim": {"renderer": "tiny"}, "recorder": {"output_root": "/"}}


@pytest.fixture
def environment(runtime):
    with run_environment("test") as environment:
        yield environment


def config(**changes):
    return RunConfig(**{"run_seed": 3, "purpose": "demo", "image_width": 32, "image_height": 32, **changes})


def run(executor, environment, config, indices, policies=(), **options):
    work = episodes_work(GraphConfig(parameters=SMALL, policies=tuple(policies)), config, environment)
    for outcome in executor.run(work, episode_jobs(indices), **options):
        yield episode_result(outcome, config)


def gone(pid):
    return not Path(f"/proc/{pid}").exists()


def test_results_do_not_depend_on_workers_and_a_killed_one_is_replaced(environment, tmp_path):
    executor = LocalExecutor(1, log_dir=tmp_path)
    alone = {result.index: result for result in run(executor, environment, config(), range(3))}

    killed, notes = [], []
    executor = LocalExecutor(2, log_dir=tmp_path)

    def kill_one(note):
        if note.text:
            notes.append(note.text)
        elif note.data["index"] == 1 and note.data["seq"] >= 5 and not killed:
            pids.extend(executor.pids())
            killed.append(pids[note.worker])
            os.kill(killed[0], signal.SIGKILL)

    pids = []
    recorded = config(output_dir=str(tmp_path / "run"), keep="successful")
    together = {r.index: r for r in run(executor, environment, recorded, range(3), on_note=kill_one)}
    assert len(killed) == 1
    assert "SIGKILL" in notes[0]
    assert all(gone(pid) for pid in pids)
    assert {i: r.final_state_hash for i, r in together.items()} == {i: r.final_state_hash for i, r in alone.items()}
    assert all(result.outcome == "success" for result in together.values())
    assert len(list((tmp_path / "run" / "episodes").iterdir())) == 3


def test_policy_in_the_worker_and_what_it_does_wrong(environment, tmp_path):
    (tmp_path / "mine.py").write_text(
        "from roboxim_policies import BasePolicy\n"
        "class Dies(BasePolicy):\n"
        "    def act(self, window):\n"
        "        import os\n"
        "        os._exit(3)\n"
    )
    launch = PolicyLaunch(spec=f"{tmp_path / 'mine.py'}:Dies")
    notes = []
    executor = LocalExecutor(1, log_dir=tmp_path)
    [result] = run(executor, environment, config(actor="policy"), [7], [launch], on_note=lambda n: notes.append(n.text))
    assert (result.index, result.outcome, result.reason) == (7, "error", "worker_died")
    assert "exit code 3" in result.message
    assert sum("died at index 7" in note for note in notes) == 3


@pytest.mark.parametrize(
    ("launch", "changes", "complaint"),
    [
        (PolicyLaunch(spec="nonsense"), {}, "unknown policy 'nonsense'"),
        (PolicyLaunch(spec="zero"), {"cameras": ("nonsense",)}, "no camera 'nonsense'"),
    ],
)
def test_wrong_configuration_ends_the_run_at_once(environment, tmp_path, launch, changes, complaint):
    executor = LocalExecutor(1, log_dir=tmp_path)
    with pytest.raises(RoboximError, match=complaint):
        list(run(executor, environment, config(**changes), range(5), [launch]))


def test_leaving_early_ends_the_workers(environment, tmp_path):
    executor = LocalExecutor(2, log_dir=tmp_path)
    results = run(executor, environment, config(), range(50))
    next(results)
    pids = executor.pids()
    results.close()
    assert len(pids) == 2
    assert all(gone(pid) for pid in pids)
