from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

from roboxim_bringup.graph import PolicyLaunch
from roboxim_bringup.workers import WorkerPool
from roboxim_core.episode import RunConfig
from roboxim_core.errors import RoboximError
from roboxim_ros.runs import free_domain

pytestmark = [pytest.mark.ros, pytest.mark.slow]

SMALL = {"sim": {"renderer": "tiny"}, "recorder": {"output_root": "/"}}


@pytest.fixture
def domain(runtime):
    with free_domain() as domain:
        yield domain


def config(**changes):
    return RunConfig(**{"run_seed": 3, "purpose": "demo", "image_width": 32, "image_height": 32, **changes})


def gone(pid):
    return not Path(f"/proc/{pid}").exists()


def test_results_do_not_depend_on_workers_and_a_killed_one_is_replaced(domain, tmp_path):
    with WorkerPool(1, domain=domain, parameters=SMALL, log_dir=tmp_path) as pool:
        alone = {result.index: result for result in pool.run(config(), range(3))}
        pids = pool.pids()
    assert all(gone(pid) for pid in pids)

    killed, notes = [], []

    def kill_one(progress):
        if progress.note:
            notes.append(progress.note)
        elif progress.index == 1 and progress.seq >= 5 and not killed:
            killed.append(pool.pids()[progress.worker])
            os.kill(killed[0], signal.SIGKILL)

    recorded = config(output_dir=str(tmp_path / "run"), keep="successful")
    with WorkerPool(2, domain=domain, parameters=SMALL, log_dir=tmp_path) as pool:
        together = {result.index: result for result in pool.run(recorded, range(3), on_progress=kill_one)}
        pids = pool.pids()
    assert len(killed) == 1
    assert "SIGKILL" in notes[0]
    assert all(gone(pid) for pid in pids)
    assert {i: r.final_state_hash for i, r in together.items()} == {i: r.final_state_hash for i, r in alone.items()}
    assert all(result.outcome == "success" for result in together.values())
    assert len(list((tmp_path / "run" / "episodes").iterdir())) == 3


def test_policy_in_the_worker_and_what_it_does_wrong(domain, tmp_path):
    (tmp_path / "mine.py").write_text(
        "from roboxim_policies import BasePolicy\n"
        "class Dies(BasePolicy):\n"
        "    def act(self, window):\n"
        "        import os\n"
        "        os._exit(3)\n"
    )
    launch = PolicyLaunch(spec=f"{tmp_path / 'mine.py'}:Dies")
    notes = []
    with WorkerPool(1, domain=domain, parameters=SMALL, policies=[launch], log_dir=tmp_path) as pool:
        [result] = pool.run(config(actor="policy"), [7], on_progress=lambda p: notes.append(p.note))
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
def test_wrong_configuration_ends_the_run_at_once(domain, tmp_path, launch, changes, complaint):
    with (
        WorkerPool(1, domain=domain, parameters=SMALL, policies=[launch], log_dir=tmp_path) as pool,
        pytest.raises(RoboximError, match=complaint),
    ):
        list(pool.run(config(**changes), range(5)))


def test_leaving_early_ends_the_workers(domain, tmp_path):
    with WorkerPool(2, domain=domain, parameters=SMALL, log_dir=tmp_path) as pool:
        for _ in pool.run(config(), range(50)):
            pids = pool.pids()
            break
    assert all(gone(pid) for pid in pids)
