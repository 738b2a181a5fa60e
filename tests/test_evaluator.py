"""`roboxim.Evaluator` plays episodes with a policy of this process, and the example in the documentation runs."""

import multiprocessing
import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

import roboxim
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, ErrorCode, EvaluationError, PolicyError, UnavailableError
from roboxim_policies import BasePolicy
from roboxim_runs.evaluation.beside_training import _Worker

PAGE = Path(__file__).resolve().parents[1] / "docs" / "how-to" / "generalists.md"
EXAMPLE = re.search(r"```python not-run\n(.*?Evaluator.*?)```", PAGE.read_text(), re.DOTALL).group(1)


class Lowering(BasePolicy):
    """Moves down, and counts; or raises, or ends its worker."""

    cameras = ("wrist",)
    horizon = 4

    def __init__(self, seen, fault=None):
        self.seen, self.fault = seen, fault

    def act(self, window):
        if self.fault:
            self.fault()
        self.seen.append((window.episode_id, window.newest.images["wrist"].shape, window.instruction))
        return np.tile(np.array([0, 0, -0.01, 0, 0, 0, 1], np.float32), (4, 1))


def test_wrong_numbers_and_tasks_are_named_before_anything_starts():
    with pytest.raises(ConfigError, match="must be >= 1"):
        roboxim.Evaluator(episodes=0)
    with pytest.raises(ConfigError, match="no_such_task"):
        roboxim.Evaluator("no_such_task")
    with pytest.raises(ConfigError, match="unknown purpose 'training'; .*'train'"):
        roboxim.Evaluator(purpose="training")
    with pytest.raises(ConfigError, match="rastr.*raster"):
        roboxim.Evaluator(renderer="rastr")


@pytest.mark.parametrize("errors", [1, 2, 3])
def test_episodes_that_ended_in_errors_are_told_apart_and_most_of_them_are_no_measurement(monkeypatch, errors):
    error = {"outcome": "error", "reason": "invalid_action", "message": "row 0 is not finite"}
    found = [
        EpisodeResult(episode_id=f"train-{i}", index=i, **(error if i < errors else {"outcome": "success"}))
        for i in range(3)
    ]
    evaluator = roboxim.Evaluator(episodes=3, workers=1)
    here, there = multiprocessing.Pipe()
    evaluator._workers = [_Worker(process=None, connection=here)]
    for result in found:
        there.send(("result", result))
    if errors == 1:
        score = evaluator(lambda: Lowering([]))
        assert (score.successes, score.errors) == (2, 1)
        assert re.fullmatch(r"success 2 of 3, \d s; 1 of 3 episodes ended in errors \(invalid_action x1\)", str(score))
        return
    with pytest.raises(EvaluationError, match=f"{errors} of 3 .*not measured. The first, episode 0: row 0 is not fin"):
        evaluator(lambda: Lowering([]))


class Tensor:
    """Of a library that only the user's process has."""

    def __init__(self, numbers):
        self.numbers = numbers

    def __array__(self, dtype=None, copy=None):
        return np.array(self.numbers, dtype)

    def __reduce__(self):
        raise TypeError("it lies on a device")


@pytest.mark.parametrize(
    ("numbers", "words"), [([[0.0] * 7], ""), ([[np.nan] * 7], "policy 'Answering': .*finite"), ("x", "policy 'Answ")]
)
def test_a_worker_receives_plain_actions_or_why_there_are_none(numbers, words):
    class Answering(BasePolicy):
        def act(self, window):
            return Tensor(numbers)

    here, there = multiprocessing.Pipe()
    worker = _Worker(process=None, connection=here, policy=Answering(), description=Answering().describe())
    there.send(("act", None))
    assert roboxim.Evaluator._answer(worker) is None
    answer = there.recv()
    if words:
        assert isinstance(answer, PolicyError)
        assert re.search(words, str(answer))
        assert answer.code == ErrorCode.INVALID_ACTION
    else:
        assert answer.actions.tolist() == numbers


def test_a_worker_that_has_died_between_two_calls_is_named():
    here, there = multiprocessing.Pipe()
    there.close()
    dead = subprocess.Popen(["false"])
    dead.wait()
    with pytest.raises(UnavailableError, match="a worker of the evaluator has died .exit code 1."):
        _Worker(process=dead, connection=here).send(("episode", 0))


@pytest.mark.slow
def test_the_same_scenes_are_played_at_each_call_by_warm_workers_and_errors_are_the_user_s(tmp_path):
    def broken():
        raise RuntimeError("mine")

    def end_worker():
        evaluator._workers[0].process.kill()

    first, second = [], []
    with roboxim.Evaluator("pick_cube", episodes=3, workers=2, size=64, max_steps=12) as evaluator:
        scores = [evaluator(lambda: Lowering(first))]
        pids = [worker.process.pid for worker in evaluator._workers]
        scores.append(evaluator(lambda: Lowering(second)))
        assert [worker.process.pid for worker in evaluator._workers] == pids
        assert sorted(first) == sorted(second)
        assert len({episode for episode, *_ in first}) == 3
        assert {shape for _, shape, _ in first} == {(64, 64, 3)}
        assert all(str(score).startswith("success 0 of 3, ") and score.rate.episodes == 3 for score in scores)
        with pytest.raises(RuntimeError, match="mine"):
            evaluator(lambda: Lowering([], broken))
        with pytest.raises(UnavailableError, match="a worker of the evaluator has died"):
            evaluator(lambda: Lowering([], end_worker))


@pytest.mark.slow
def test_the_example_runs(capsys):
    assert 25 <= len(EXAMPLE.splitlines()) <= 35
    exec(compile(EXAMPLE, str(PAGE), "exec"), {"__name__": "example"})
    lines = capsys.readouterr().out.splitlines()
    assert [line.split(",")[0] for line in lines] == ["10 success 0 of 2", "20 success 0 of 2"]
