"""Chunks become one action per tick: execute k of n, ensembles, late answers."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from roboxim_core.actions import ActionPlan, ActionSemantics, Chunking
from roboxim_core.actions.chunking import weighted_mean
from roboxim_core.errors import InvalidRequestError

DELTAS = ActionSemantics()


def rows(first, count=4):
    """Return a chunk whose rows have the x components first, first + 1, ..."""
    chunk = np.zeros((count, 7), np.float32)
    chunk[:, 0] = first + np.arange(count)
    return chunk


def run(chunking, ticks, *, count=4, delay=0, one_at_a_time=False):
    """Ask whenever it is due; the answer of tick t has x components 100 t, 100 t + 1, ...; return asks and actions."""
    plan = ActionPlan(chunking, DELTAS, one_at_a_time=one_at_a_time)
    asked, executed = [], []
    for seq in range(ticks):
        if plan.due(seq):
            asked.append(seq)
            plan.add(seq, delay, rows(100 * seq, count), ())
        planned = plan.action(seq)
        executed.append(None if planned is None else float(planned.action[0]))
    return asked, executed


def test_all_rows_are_executed_by_default_and_k_of_n_on_request():
    assert run(Chunking(), 6) == ([0, 4], [0, 1, 2, 3, 400, 401])
    assert run(Chunking(execute=3), 6) == ([0, 3], [0, 1, 2, 300, 301, 302])
    assert run(Chunking(execute=9), 6) == ([0, 4], [0, 1, 2, 3, 400, 401])


def test_the_mean_combines_every_answer_that_holds_the_tick():
    asked, executed = run(Chunking(ensemble="mean"), 5, count=3)
    assert asked == [0, 1, 2, 3, 4], "an ensemble asks at every tick"
    np.testing.assert_allclose(executed, [0, (1 + 100) / 2, (2 + 101 + 200) / 3, (102 + 201 + 300) / 3, 301 * 1.0])


@pytest.mark.parametrize("decay", [0.5, -0.5])
def test_exponential_weights_count_from_the_oldest_answer(decay):
    _, executed = run(Chunking(ensemble="exponential", ensemble_decay=decay), 3, count=3)
    weights = [1.0, math.exp(-decay), math.exp(-2 * decay)]
    expected = (weights[0] * 2 + weights[1] * 101 + weights[2] * 200) / sum(weights)
    np.testing.assert_allclose(executed[2], expected, rtol=1e-6)
    assert (executed[2] < 101) == (decay > 0), "k > 0 prefers the older answers"


def test_an_ensemble_with_execute_asks_less_often():
    asked, executed = run(Chunking(ensemble="mean", execute=2), 4)
    assert asked == [0, 2]
    np.testing.assert_allclose(executed, [0, 1, (2 + 200) / 2, (3 + 201) / 2])


@pytest.mark.parametrize(
    ("chunking", "executed"),
    [
        (Chunking(), [None, None, 0, 1, 2, 3, 400, 401]),
        (Chunking(late_rows="drop"), [None, None, 2, 3, None, None, 402, 403]),
        (Chunking(late_rows="drop", execute=2), [None, None, 2, 3, 202, 203, 402, 403]),
    ],
)
def test_late_answers_are_shifted_or_lose_the_rows_whose_tick_has_passed(chunking, executed):
    assert run(chunking, 8, delay=2)[1] == executed


def test_in_real_time_the_rest_of_a_chunk_bridges_the_wait():
    asked, executed = run(Chunking(execute=2), 9, delay=2, one_at_a_time=True)
    assert asked == [0, 4, 8], "the next request waits for the answer and then for two of its actions"
    assert executed == [None, None, 0, 1, 2, 3, 400, 401, 402]


def test_an_actor_is_finished_when_its_last_action_is_executed():
    plan = ActionPlan(Chunking(), DELTAS)
    plan.add(0, 1, rows(0, 2), (), done=True)
    assert [plan.finished(seq) for seq in range(4)] == [False, False, False, True]
    assert not plan.due(3)
    more = ActionPlan(Chunking(execute=1), DELTAS)
    more.add(0, 0, rows(0, 2), (), done=True)
    assert more.due(1), "done is not heeded if the last actions are not executed"


def test_rotations_are_averaged_as_rotations_where_numbers_would_not_do():
    turns = Rotation.from_euler("z", [[0.2], [0.4]])
    semantics = ActionSemantics(control="end_effector_absolute", rotation="quaternion_xyzw")
    answers = np.zeros((2, 8))
    answers[:, 3:7] = turns.as_quat() * [[1], [-1]]
    mean = weighted_mean(answers, np.ones(2), semantics)
    assert (Rotation.from_quat(mean[3:7]) * Rotation.from_euler("z", -0.3)).magnitude() < 1e-6
    euler = np.zeros((2, 7))
    euler[:, 5] = [0.2, 0.4]
    assert weighted_mean(euler, np.array([3.0, 1.0]), DELTAS)[5] == pytest.approx(0.25)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"ensemble": "exponential"}, "needs a decay other than 0"),
        ({"ensemble_decay": 0.1}, "the others use none"),
        ({"late_rows": "skip"}, "late_rows: unknown value 'skip'"),
    ],
)
def test_contradicting_values_are_refused(values, message):
    with pytest.raises(InvalidRequestError, match=message):
        Chunking(**values)


def test_a_run_overrides_what_it_sets():
    mine = Chunking(execute=4, ensemble="exponential", ensemble_decay=0.1)
    assert mine.overridden() == mine
    assert mine.overridden(ensemble="mean", execute=1) == Chunking(execute=1, ensemble="mean")
