import base64
import io
import json
import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from planted_cards import planted_card, shipped

from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import InvalidRequestError
from roboxim_eval.experiments.cost import FILMS
from roboxim_eval.grouping import grouped
from roboxim_eval.report import PolicyRun, Report, verdict_line, write_report
from roboxim_eval.report.charts.table_map import Place, Start, mark_key, table_map
from roboxim_eval.report.episodes import Episode, episodes_json
from roboxim_eval.report.evaluation import comparisons
from roboxim_eval.report.experiment import ExperimentPage, experiment_page
from roboxim_eval.report.films import chosen_films, chosen_scenes, film_strip
from roboxim_eval.report.parts import breakdowns, film_groups, scene_patterns
from roboxim_eval.report.reasons import EXPLANATIONS, explained
from roboxim_eval.statistics.rates import error_line, failure_reasons, is_measured, rate_of, success_rate


def result(index, outcome="success", reason="", instruction="Pick up the red cube"):
    return EpisodeResult(
        episode_id=f"eval-0-{index:05d}-0",
        index=index,
        outcome=outcome,
        reason=reason,
        instruction=instruction,
        steps=40,
    )


def test_wilson_interval_agrees_with_published_values():
    # Newcombe (1998), table I, method 3: 81 of 263 and 0 of 20.
    rate = success_rate(81, 263)
    assert (rate.low, rate.high) == pytest.approx((0.2553, 0.3662), abs=1e-4)


def test_the_interval_of_no_success_is_not_too_narrow():
    # Clopper and Pearson (statsmodels 0.15: proportion_confint(0, 20, method="beta")); Wilson's would be 0 to 0.161
    rates = success_rate(0, 20), success_rate(20, 20)
    assert [(rate.low, rate.high) for rate in rates] == [
        pytest.approx((0.0, 0.168433), abs=1e-6), pytest.approx((0.831567, 1.0), abs=1e-6),
    ]  # fmt: skip


def test_impossible_counts_are_refused():
    with pytest.raises(InvalidRequestError, match="3 of 2"):
        success_rate(3, 2)


def test_errors_count_as_failures():
    results = [result(0), result(1, "error", "policy_late"), result(2, "failure", "not_lifted")]
    assert rate_of(results).successes == 1
    assert failure_reasons(results) == {"policy_late": 1, "not_lifted": 1}


def test_most_episodes_in_errors_measure_no_policy(tmp_path):
    broken = PolicyRun(
        policy="mine",
        results=[result(i, "error", "policy_fault") for i in range(3)] + [result(3, "failure", "not_lifted")],
    )
    shaky = PolicyRun(policy="shaky", results=[result(0, "error", "policy_late"), result(1)])
    zero = PolicyRun(policy="zero", results=[result(i, "failure", "max_steps") for i in range(20)])
    assert error_line(broken.results) == (
        "3 of 4 episodes ended in errors (policy_fault x3); the policy is not measured"
    )
    assert error_line(shaky.results) == "1 of 2 episodes ended in errors (policy_late x1)"
    assert [is_measured(run.results) for run in (broken, shaky, zero)] == [False, True, True]
    assert error_line(zero.results) == ""
    report = Report(title="t", runs=[zero, broken, shaky], facts={}, versions={}, command="c")
    page = write_report(report, tmp_path).read_text()
    assert len(re.findall(r"not measured</span> <a [^>]*>3 of 4 episodes ended in errors", page)) == 1
    assert "mine is not compared" in page
    said = json.loads((tmp_path / "summary.json").read_text())
    numbers = said["policies"]["mine"]
    assert (numbers["measured"], numbers["rate"], numbers["high"]) == (False, None, None)
    assert numbers["errors"] == {"policy_fault": 3}
    assert "by_instruction" not in numbers
    assert "mine is not compared" in said["comparison"]
    assert "Cannot tell whether zero differs from shaky" in said["comparison"]
    assert verdict_line([broken, zero, shaky]) == ("mine is not compared: most of its episodes ended in errors."), (
        "the policy under test was not measured"
    )


def test_a_comparison_that_planned_looks_did_not_decide_is_not_decided(tmp_path):
    # 29 against 15 of 200 scenes: McNemar's p is 0.049, but four looks were planned
    one = PolicyRun(
        policy="a", trained=True, results=[result(i, "success" if i < 129 else "failure") for i in range(200)]
    )
    other = PolicyRun(
        policy="b",
        trained=True,
        results=[result(i, "success" if i < 100 or 129 <= i < 144 else "failure") for i in range(200)],
    )
    fixed = Report(title="t", runs=[one, other], facts={}, versions={}, command="c")
    assert 'class="badge higher"' in write_report(fixed, tmp_path).read_text()
    page = write_report(replace(fixed, undecided=True), tmp_path).read_text()
    assert 'class="badge cannot_tell"' in page
    assert 'class="badge higher"' not in page
    said = json.loads((tmp_path / "summary.json").read_text())["comparison"]
    assert said == verdict_line([one, other], undecided=True)
    assert said.startswith(
        "Cannot tell whether this checkpoint of a differs from this one of b: the difference is +7 points"
    )
    assert "but the planned looks did not decide, on 200 scenes" in said
    assert comparisons([one, other], undecided=True)[0].p_value == 1.0
    equal = PolicyRun(policy="c", results=one.results)
    assert comparisons([one, equal], undecided=True)[0].kind == "as_good", "equality needs no looks"


def test_report_is_self_contained_and_escapes(tmp_path):
    film = film_strip([np.full((32, 64, 3), value, np.uint8) for value in (0, 128, 255)])
    good = PolicyRun(
        policy="bc",
        trained=True,
        results=[result(i, instruction="<b>Pick & place</b>") for i in range(18)]
        + [result(18, "failure", "not_lifted")],
        films={"eval-0-00000-0": film, "eval-0-00018-0": film},
    )
    bad = PolicyRun(policy="random", results=[result(i, "failure", "max_steps") for i in range(20)])
    report = Report(
        title="Pick up the cube",
        runs=[good, bad],
        facts={"seed": "0"},
        versions={"numpy": "2"},
        command="roboxim evaluate",
    )
    page = write_report(report, tmp_path).read_text()
    assert not re.search(r'(src|href)="(?!data:|#)', page), "a report must not refer to other files"
    assert "<b>Pick &" not in page
    assert page.count("data:image/webp") == 2
    assert page.count('type="range"') == 2
    assert verdict_line(report.runs).startswith("This checkpoint of bc succeeds more often than random by 95 points")
    assert f"2 of {len(good.results) + len(bad.results)} episodes are shown" in page
    numbers = json.loads((tmp_path / "summary.json").read_text())
    assert numbers["policies"]["bc"]["successes"] == 18
    assert numbers["policies"]["random"]["failure_reasons"] == {"max_steps": 20}


def test_numbers_of_ranges_are_grouped_into_thirds():
    groups = grouped({str(i): f"{0.1 * i:.4g}" for i in range(30)})
    assert Counter(groups.values()) == {"0 to 0.967": 10, "0.967 to 1.93": 10, "1.93 to 2.9": 10}
    assert groups["0"] == "0 to 0.967"
    assert grouped({"a": "left", "b": "right"}) == {"a": "left", "b": "right"}
    assert grouped({str(i): f"{i} {i}" for i in range(100)}) == {}, "positions are no groups"


def test_a_choice_without_a_choice_is_no_dimension():
    results = [result(i) for i in range(4)]
    drawn = {r.episode_id: {"target": "cube", "cell_number": str(r.index)} for r in results}
    assert list(PolicyRun(policy="bc", results=results, drawn=drawn).rates_by_dimension) == ["instruction"]


def test_rates_by_what_reset_components_have_drawn(tmp_path):
    results = [result(index, "success" if index % 2 else "failure") for index in range(6)]
    drawn = {r.episode_id: {"interaction_area": "left" if r.index < 4 else "right"} for r in results}
    run = PolicyRun(policy="bc", results=results, drawn=drawn)
    rates = run.rates_by_dimension["interaction_area"]
    assert {name: (rate.successes, rate.episodes) for name, rate in rates.items()} == {"left": (2, 4), "right": (1, 2)}
    report = Report(title="Areas", runs=[run], facts={}, versions={}, command="roboxim evaluate")
    assert 'data-tab="interaction area"' in write_report(report, tmp_path).read_text()
    numbers = json.loads((tmp_path / "summary.json").read_text())["policies"]["bc"]
    assert numbers["by_interaction_area"]["right"]["episodes"] == 2
    assert "by_instruction" in numbers


def data_of(page):
    """Return what the page's script reads."""
    return json.loads(re.search(r'id="episode-data">(.*?)</script>', page, re.DOTALL)[1])


def test_each_number_leads_to_its_episodes_and_each_episode_to_its_bag(tmp_path):
    results = [replace(result(i, "success" if i < 3 else "failure", "" if i < 3 else "dropped"), bag=f"episodes/{i}")
               for i in range(5)]  # fmt: skip
    run = PolicyRun(policy="bc", results=results, folder="bc", drawn={r.episode_id: {"light": "dim"} for r in results})
    page = write_report(Report(title="t", runs=[run], facts={}, versions={}, command="c"), tmp_path).read_text()
    assert 'href="#episodes?arm=bc">3 of 5</a>' in page
    assert (
        'href="#episodes?arm=bc&amp;reason=dropped&amp;outcome=failure%7Cerror">2 &times; <code>dropped</code></a>'
        in page
    )
    assert "fell from too high" in page, "a reason is explained"
    data = data_of(page)
    assert [row[8] for row in data["rows"]] == [f"bc/episodes/{i}" for i in range(5)]
    assert data["texts"][data["rows"][0][11][1]] == "dim"
    assert "roboxim replay" in page
    assert "roboxim studio" in page


def test_a_text_of_an_episode_cannot_end_the_script():
    text = str(episodes_json([Episode(arm="</script><b>", scene="0", outcome="failure", message="<!--")]))
    assert "<" not in text
    assert json.loads(text)["texts"][0] == "</script><b>"


def test_policies_are_compared_scene_by_scene():
    outcomes = {"a": [1, 1, 0, 0], "b": [1, 0, 0, 1]}
    episodes = [
        Episode(arm=arm, scene=str(i), outcome="success" if won else "failure")
        for arm, row in outcomes.items()
        for i, won in enumerate(row)
    ]
    found = {text: (count, link) for text, count, link in scene_patterns(episodes, ("a", "b"))}
    assert {text: count for text, (count, _) in found.items()} == {
        "both succeeded": 1, "only a succeeded": 1, "only b succeeded": 1, "neither succeeded": 1,
    }  # fmt: skip
    assert found["only a succeeded"][1] == "#episodes?n=1%7C5"
    assert scene_patterns(episodes[:4], ("a",)) == [], "one policy is no comparison"
    frames = film_strip([np.zeros((16, 16, 3), np.uint8)])
    groups = film_groups(episodes, dict.fromkeys(range(8), frames), ("a", "b"))
    assert [[one["number"] for one in group["films"]] for group in groups] == [[1, 5], [3, 7], [2, 6], [0, 4]], (
        "films of one scene are side by side, scenes that tell the policies apart first"
    )
    once = [replace(episode, outcome="failure" if i == 3 or i > 3 else "success") for i, episode in enumerate(episodes)]
    groups = film_groups(once, dict.fromkeys(range(8), frames), ("a", "b"))
    assert [group["films"][0]["number"] for group in groups] == [0, 3, 1, 2], "the only failure of the better is second"


def test_what_a_reader_compares_is_never_pooled():
    won = {"good": True, "bad": False}
    episodes = [
        Episode(arm=arm, scene=str(i), outcome="success" if won[arm] else "failure", instruction=f"Pick {i % 2}",
                drawn={"target": str(i % 2), "light": ("dim", "bright")[i // 12]})
        for arm in won for i in range(24)
    ]  # fmt: skip
    tables = breakdowns(episodes, ("good", "bad"))
    named = sorted((table["name"], table["also"]) for table in tables)
    assert named == [("light", []), ("target", ["instruction"])], "no table repeats another"
    for table in tables:
        for row in table["levels"]:
            assert [(c["rate"].successes, c["rate"].episodes) for c in row["cells"]] == [(12, 12), (0, 12)]


def test_the_map_counts_each_episode_once():
    starts = [Start(x=0.4 + 0.02 * (i % 7), y=-0.2 + 0.03 * (i // 7), success=i % 3 == 0) for i in range(60)]
    picture = str(table_map(starts))
    numbers = [(int(a), int(b)) for a, b in re.findall(r"(\d+) of (\d+) succeeded", picture)]
    assert sum(b for _, b in numbers) == 60
    assert sum(a for a, _ in numbers) == 20
    assert (picture.count('class="solved"'), picture.count('class="unsolved"')) == (20, 40)
    assert "solved" not in str(table_map(starts * 10)), "squares alone, where marks would hide each other"


def test_the_map_says_where_things_are_and_its_legend_draws_the_same_marks():
    starts = [Start(x=0.5, y=0.1, success=i % 2 == 0) for i in range(8)]
    picture = str(table_map(starts, place=Place(table=(0.5, 0.0, 0.9, 1.4))))
    assert ">robot<" in picture
    assert ">edge of the table<" in picture
    assert {"0.1", "0.3", "0.5"} <= set(re.findall(r">(-?[0-9.]+)</text>", picture)), "axes in metres"
    for success, shape in ((True, "circle"), (False, "path")):
        name = "solved" if success else "unsolved"
        assert re.search(f'<{shape} [^>]*class="{name}"', picture), "told apart by shape, on any colour"
        assert re.search(f'<{shape} [^>]*class="{name}"', str(mark_key(success)))


def test_films_of_scenes_are_chosen_by_what_happened():
    outcomes = {str(i): ["success", "success" if i % 10 else "failure"] for i in range(40)}
    chosen = chosen_scenes(outcomes, 6)
    assert len(chosen) == 6
    assert sum(not int(scene) % 10 for scene in chosen) == 3
    assert chosen_scenes(outcomes, 0) == []
    assert len(chosen_scenes(outcomes, 100)) == 40


def test_films_pause_and_scrub_and_are_chosen_evenly():
    frames = [np.full((400, 600, 3), value, np.uint8) for value in range(0, 250, 5)]
    film = film_strip(frames)
    assert (film.frames, film.height, film.width) == (24, 192, 288)
    picture = Image.open(io.BytesIO(base64.b64decode(film.sources[0].partition(",")[2])))
    assert picture.size == (288, 24 * 192)
    first, last = (np.asarray(picture.convert("RGB"))[row].mean() for row in (5, -5))
    assert (first, last) == (pytest.approx(0, abs=4), pytest.approx(245, abs=4)), (
        "the first and the last frame are shown"
    )
    whole = film_strip(frames * 3, max_frames=None, frame_ms=100.0)
    assert (whole.frames, len(whole.sources)) == (150, 3), "all frames, in strips that WebP can hold"
    outcomes = [(str(i), i % 5 == 0) for i in range(50)]
    chosen = chosen_films(outcomes, 8)
    assert sum(int(name) % 5 == 0 for name in chosen) == 4
    assert {"1", "49", "0", "45"} <= set(chosen), "spread over the run"
    assert len(chosen_films(outcomes[1:5], 8)) == 4


def test_every_reason_that_a_skill_gives_is_explained():
    root = Path(__file__).parents[2] / "roboxim_tasks/roboxim_tasks"
    texts = [path.read_text() for path in (*root.glob("skills/*.py"), root / "measures.py", root / "standing.py")]
    given = {reason for text in texts for reason in re.findall(r'reason="([a-z_]+)"', text)}
    assert len(given) > 12
    assert not given - EXPLANATIONS.keys(), "explain them in roboxim_eval/report/reasons.py"
    assert explained("not_watered") == "The condition 'watered' was not met."
    assert explained("") == "The task gave no reason."


@pytest.mark.slow
def test_a_report_of_2000_episodes_is_light(tmp_path):
    rng = np.random.default_rng(0)
    film = film_strip([rng.integers(0, 255, (128, 256, 3), np.uint8) for _ in range(24)])  # worse than any film
    runs = []
    for policy in ("bc", "octo"):
        results = [replace(result(i, "success" if rng.random() < 0.6 else "failure", "not_lifted"), bag=f"episodes/{i}")
                   for i in range(1000)]  # fmt: skip
        names = [r.episode_id for r in results]
        runs.append(PolicyRun(
            policy=policy, results=results, folder=policy, films=dict.fromkeys(names[:12], film),
            drawn={n: {f"factor {k}": f"{rng.random():.4f}" for k in range(12)} for n in names},
            starts={n: (float(rng.uniform(0.3, 0.6)), float(rng.uniform(-0.2, 0.2))) for n in names},
        ))  # fmt: skip
    page = write_report(Report(title="t", runs=runs, facts={}, versions={}, command="c"), tmp_path)
    assert page.stat().st_size < 15_000_000
    assert len(data_of(page.read_text())["rows"]) == 2000
    card = planted_card(shipped(per_cell=10), lambda _, cell: 0.4 if cell.unseen else 0.8)
    episodes = [
        Episode(
            arm=row.condition, replicate=row.replicate, cell=cell, scene=str(i), instruction=f"Do {cell}", steps=40,
            outcome="success" if i < won else "failure", reason="" if i < won else "not_lifted",
            bag=f"evaluate/{row.condition}.{row.replicate}/episodes/{i}",
            drawn={f"factor {k}": f"{rng.random():.4f}" for k in range(12)},
            start=(float(rng.uniform(0.3, 0.6)), float(rng.uniform(-0.2, 0.2))),
        )
        for row in card.evaluations for cell, (won, met, _) in row.by_cell.items() for i in range(met)
    ]  # fmt: skip
    films = {int(number): film for number in rng.choice(len(episodes), FILMS, replace=False)}
    text = experiment_page(ExperimentPage(card=card, episodes=episodes, films=films))
    assert len(text.encode()) < 15_000_000
    assert len(data_of(text)["rows"]) == len(episodes) >= 2000
