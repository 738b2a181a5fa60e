"""Evaluations that stop early, of planted results."""

from dataclasses import replace

import pytest

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError
from roboxim_eval.film_options import FilmOptions
from roboxim_runs.evaluation import run as evaluation
from roboxim_runs.evaluation import sequential
from roboxim_runs.evaluation.report import stored_record
from roboxim_runs.evaluation.results import EvaluationResult, PolicyResult
from roboxim_runs.evaluation.run import EvaluationConfig


@pytest.fixture
def planted_evaluations(monkeypatch, tmp_path):
    """Replace evaluations by planted ones; return the numbers of scenes of the calls, and their reports' notes."""
    calls = []

    def made(rates):
        def evaluate(config, **_):
            calls.append((config.episodes, config.stopped, config.page, config.undecided))
            films.append(config.film.only)
            policies = {}
            for name, rate in zip(config.policies, rates, strict=True):
                results = tuple(
                    EpisodeResult(episode_id=f"{i}", index=i, outcome="success" if i % 10 < 10 * rate else "failure")
                    for i in range(config.episodes)
                )
                policies[name] = PolicyResult(name=name, results=results, folder=tmp_path)
            return EvaluationResult(policies=policies, report=tmp_path / "r.html", comparison="", privileged=())

        monkeypatch.setattr(sequential, "evaluate", evaluate)
        return calls

    films = made.films = []
    return made


def test_an_evaluation_stops_when_two_policies_differ(planted_evaluations):
    calls = planted_evaluations((0.9, 0.2))
    config = EvaluationConfig(policies=["good", "bad"], episodes=200)
    found = sequential.evaluate_sequentially(config, 4)
    assert found.decided
    assert "Planned: at most 200 scenes, looks after 50, 100, 150, 200." in found.sentence
    assert "Stopped after 50: good is better than bad" in found.sentence
    assert [(episodes, page) for episodes, _, page, _ in calls] == [(50, False), (50, True)], "one page, at the end"
    assert calls[-1][1] == found.sentence, "the report states it"
    assert [undecided for *_, undecided in calls] == [True, False], "a report before the end decides nothing"


def test_a_film_of_a_scene_after_the_stop_is_left_out_and_one_that_cannot_be_is_refused(planted_evaluations):
    planted_evaluations((0.9, 0.2))
    config = EvaluationConfig(policies=["good", "bad"], episodes=200, film=FilmOptions(only=("7", "150")))
    assert sequential.evaluate_sequentially(config, 4).decided
    assert planted_evaluations.films[-1] == ("7",), "it stopped after 50"
    with pytest.raises(ConfigError, match="no scene 200, x to film: scenes are numbered from 0 to 199"):
        sequential.evaluate_sequentially(replace(config, film=FilmOptions(only=("7", "200", "x"))), 4)


def test_an_evaluation_of_equal_policies_uses_all_scenes(planted_evaluations):
    calls = planted_evaluations((0.5, 0.5))
    found = sequential.evaluate_sequentially(EvaluationConfig(policies=["a", "b"], episodes=90), 3)
    assert not found.decided
    assert "cannot tell which is better" in found.sentence
    assert [episodes for episodes, *_ in calls] == [30, 60, 90, 90]
    with pytest.raises(ConfigError, match="exactly two"):
        sequential.evaluate_sequentially(EvaluationConfig(policies=["a"], episodes=90), 3)
    with pytest.raises(ConfigError, match="looks must be from 2"):
        sequential.evaluate_sequentially(EvaluationConfig(policies=["a", "b"], episodes=90), 91)


def test_the_report_agrees_with_looks_that_did_not_decide(monkeypatch, tmp_path):
    # 29 against 15 of 200 scenes: p is 0.049, which one look would call a difference and four looks do not
    wins = {"a": lambda i: i % 50 < 32 or i == 199, "b": lambda i: i % 50 < 25 or 32 <= i % 50 < 36 and i < 185}

    def planted(job, title, *_, **__):
        won = wins[title.removeprefix("rollouts of ")]
        return [
            EpisodeResult(episode_id=f"{i}", index=i, outcome="success" if won(i) else "failure")
            for i in range(job.episodes)
        ]

    monkeypatch.setattr(evaluation, "run_episodes", planted)
    config = EvaluationConfig(task="pick_up", policies=["a=random", "b=zero"], episodes=200, out=tmp_path)
    found = sequential.evaluate_sequentially(config, 4)
    assert not found.decided
    assert "cannot tell which is better" in found.sentence
    assert found.evaluation.comparison.startswith("Cannot tell whether a differs from b")
    page = (tmp_path / "report.html").read_text()
    assert found.sentence in page
    assert 'class="badge cannot_tell"' in page
    assert 'class="badge higher"' not in page
    record = stored_record(tmp_path)
    assert record.undecided
