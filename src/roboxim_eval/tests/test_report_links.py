"""Numbers of a page lead to their episodes: the page's own script lists them, as in a browser."""

import html
import json
import re
import shutil
import subprocess
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from planted_cards import planted_card, shipped

import roboxim_eval
from roboxim_core.episode import EpisodeResult
from roboxim_eval.benchmark.card import BenchmarkCard, concluded_benchmark
from roboxim_eval.experiments.models import compare_models
from roboxim_eval.report import PolicyRun, Report, write_report
from roboxim_eval.report.benchmark import benchmark_page
from roboxim_eval.report.episodes import Episode, checkpoint_arm
from roboxim_eval.report.experiment import ExperimentPage, experiment_page
from roboxim_eval.report.models import models_page

SCRIPT = Path(roboxim_eval.__file__).parent / "templates/page.js"
BROWSER = """
const fs = require("fs"), [script, data, links] = JSON.parse(fs.readFileSync(0));
const made = () => ({ dataset: {}, children: [], append() {}, addEventListener() {}, scrollIntoView() {},
  after() {},
  replaceChildren(first) { this.first = first; }, querySelector: made });
const elements = { "episode-data": { textContent: data }, list: made(), filter: made(), episodes: made(),
  search: made(), count: made() };
global.document = { querySelectorAll: () => [], getElementById: (id) => elements[id], createElement: made,
  addEventListener() {} };
global.location = { hash: "" };
let changed;
global.addEventListener = (_, listener) => { changed = listener; };
new Function(script)();
console.log(JSON.stringify(links.map((link) => {
  location.hash = link; changed(); return elements.filter.first.textContent;
})));
"""
NUMBER = re.compile(r'<a [^>]*href="(#episodes[^"]*)"[^>]*>(\d+) of (\d+)</a>')
ROW = re.compile(
    r'<td><a href="(#episodes[^"]*)">[^<]*</a></td>\n<td class="plot">.*?</td>\n<td class="num soft">([^<]*)<'
)


def listed(page, links):
    """Return the numbers of successes and episodes that the page's script lists for links, in their order."""
    node = shutil.which("node")
    if node is None:
        pytest.skip("needs node, which runs the page's script")
    data = re.search(r'id="episode-data">(.*?)</script>', page, re.DOTALL)[1]
    told = json.dumps([SCRIPT.read_text(), data, [html.unescape(link) for link in links]])
    said = subprocess.run([node, "-e", BROWSER], input=told, capture_output=True, text=True, check=True, timeout=60)
    found = [re.fullmatch(r"(\d+) episodes, (\d+) succeeded", text) for text in json.loads(said.stdout)]
    return [(int(one[2]), int(one[1])) for one in found]


def leads_there(page, pattern=NUMBER):
    """Check that each link which shows ``X of N`` lists X successes among N episodes; return the number of links."""
    links = pattern.findall(page)
    assert listed(page, [link for link, *_ in links]) == [(int(a), int(b)) for _, a, b in links]
    return len(links)


def runs(policies=("bc", "zero"), episodes=60):
    """Return runs of policies on the same scenes: a light as a number and, in some scenes, a colour."""
    rng = np.random.default_rng(0)
    light = [f"{x:.4g}" for x in rng.uniform(0.5, 2.0, episodes)]
    for policy in policies:
        results = [
            EpisodeResult(
                episode_id=f"{policy}-{i}", index=i, outcome="success" if rng.random() < 0.5 else "failure",
                instruction=f"Pick up the {('cube', 'can')[i % 2]}", steps=9,
            )
            for i in range(episodes)
        ]  # fmt: skip
        drawn = {r.episode_id: {"light": light[r.index]} for r in results}
        for r in results[::3]:
            drawn[r.episode_id]["color"] = ("red", "blue")[r.index % 2]
        starts = {r.episode_id: (0.4 + 0.003 * r.index, 0.1 * (r.index % 4)) for r in results}
        yield PolicyRun(policy=policy, results=results, drawn=drawn, starts=starts)


def test_numbers_of_an_evaluation_lead_to_their_episodes(tmp_path):
    broken = PolicyRun(
        policy="broken", results=[EpisodeResult(episode_id=f"b{i}", index=i, outcome="error") for i in range(5)],
        drawn={f"b{i}": {"light": "1.0"} for i in range(5)},
    )  # fmt: skip
    report = Report(title="t", runs=[*runs(), broken], facts={}, versions={}, command="c")
    page = write_report(report, tmp_path).read_text()
    assert " to " in html.unescape(page).partition('data-tab="light"')[2][:900], "thirds of numbers"
    assert "not drawn" in page, "a factor that some episodes lack"
    assert leads_there(page) > 20
    squares = re.findall(r'<a href="(#episodes\?n=[^"]*)"><rect[^>]*><title>(\d+) of (\d+) succeeded', page)
    assert listed(page, [link for link, *_ in squares]) == [(int(a), int(b)) for _, a, b in squares]
    assert len(re.findall(r'class="(?:un)?solved" data-e="', page)) == 120, "each dot leads to its episode"
    patterns = re.findall(r'<a class="chip" href="(#episodes\?n=[^"]*)"><b>(\d+)</b>', page)
    met = sum(number for _, number in listed(page, [link for link, _ in patterns]))
    assert met == 2 * 60, "each episode of a measured policy is on a scene of one pattern"
    (errors,) = re.findall(r'<a href="(#episodes[^"]*)">5 of 5 episodes ended in errors', page)
    assert listed(page, [errors]) == [(0, 5)]


def test_an_evaluation_of_a_mix_has_a_map_of_its_cells(tmp_path):
    names = ("pick_up target=cube", "pick_up target=apple", "rotate target=cube")
    of_cells = [replace(run, drawn={r.episode_id: {"cell": names[r.index % 3]} for r in run.results}) for run in runs()]
    report = Report(title="t", runs=of_cells, facts={}, versions={}, command="c")
    page = write_report(report, tmp_path).read_text()
    heat = re.findall(r'href="(#episodes[^"]*)" title="[^"]*: (\d+) of (\d+) =', page)
    assert len(heat) == 3 + 3
    assert listed(page, [link for link, *_ in heat]) == [(int(a), int(b)) for _, a, b in heat]
    assert "bc - zero, points" in page
    assert "<th>cube</th><th>apple</th>" in page
    other = [replace(run, drawn={r.episode_id: {"cell": "odd name"} for r in run.results}) for run in of_cells]
    for made in (list(runs()), other):
        assert 'id="cells"' not in write_report(replace(report, runs=made), tmp_path).read_text()


# ------------------------------------------------------------------ experiments


def rate(condition, cell):
    return {"leave_out": 0.4 if cell.unseen else 0.85, "baseline": 0.8, "blind": 0.05}[condition]


@pytest.fixture(scope="module")
def card():
    unseen = [cell.key for cell in shipped().cells if cell.unseen]
    return planted_card(shipped(replicates=3), rate, instead=dict.fromkeys(unseen, "rotate target=cube"))


def episodes_of(card):
    """Return the episodes of the final evaluations that a card counts."""
    return [
        Episode(
            arm=row.condition, replicate=row.replicate, cell=cell, scene=str(i),
            outcome="success" if i < won else "failure",
        )
        for row in card.evaluations
        if not row.checkpoint
        for cell, (won, met, _) in row.by_cell.items()
        for i in range(met)
    ]  # fmt: skip


def with_curve(card):
    """Return a card with a learning curve of one checkpoint, and the curve's episodes."""
    (final, *_), cell = card.evaluations, "pick_up target=apple"
    point = replace(final, checkpoint=2000, by_cell={cell: (3, 8, 0)})
    arm = checkpoint_arm(final.condition, 2000)
    curve = [Episode(arm=arm, cell=cell, scene=str(i), outcome="failure" if i > 2 else "success") for i in range(8)]
    return replace(card, evaluations=(*card.evaluations, point)), curve


def test_numbers_of_an_experiment_lead_to_their_episodes(card):
    card, curve = with_curve(card)
    page = experiment_page(ExperimentPage(card=card, episodes=episodes_of(card), checkpoints=curve))
    alone = [
        (link, *found) for link, text in ROW.findall(page) if (found := re.findall(r"\d+", text)) and len(found) == 2
    ]
    assert listed(page, [link for link, *_ in alone]) == [(int(a), int(b)) for _, a, b in alone]
    both = [(link, *map(int, re.findall(r"\d+", text))) for link, text in ROW.findall(page) if " - " in text]
    assert listed(page, [link for link, *_ in both]) == [(a + c, b + d) for _, a, b, c, d in both]
    assert any("total" in part for part in re.findall(r'<a href="#episodes[^"]*">([^<]*)</a>', page))
    heat = re.findall(r'href="(#episodes[^"]*)" title="[^"]*: (\d+) of (\d+) =', page)
    assert len(heat) == 18 + 18 + 6
    assert listed(page, [link for link, *_ in heat]) == [(int(a), int(b)) for _, a, b in heat]
    (point,) = re.findall(r'<a href="(#episodes[^"]*)"><circle', page)
    assert listed(page, [point]) == [(3, 8)]
    (condition,) = re.findall(r'<td class="num"><a href="(#episodes\?arm=baseline)">', page)
    counted = Counter(e.outcome for e in episodes_of(card) if e.arm == "baseline")
    assert listed(page, [condition]) == [(counted["success"], counted.total())], "without the learning curve's"
    substituted = re.findall(
        r'<a href="(#episodes[^"]*)">(\d+) of (\d+)</a></td></tr>', page.partition("done instead")[2]
    )
    for (_, number), (_, _, failed) in zip(listed(page, [s[0] for s in substituted[:6]]), substituted, strict=False):
        assert number == int(failed), "failures of the condition that was judged again"


def test_rates_by_skill_and_by_object_are_the_means_of_their_cells(card):
    page = html.unescape(experiment_page(ExperimentPage(card=card, episodes=episodes_of(card))))
    assert page.index("By task, success in %") < page.index("By target, success in %")
    counts = Counter()
    for row in card.evaluations:
        for cell, (won, met, _) in row.by_cell.items():
            if row.condition == "leave_out" and cell.endswith("target=cube"):
                counts += Counter(won=won, met=met)
    section = page.partition("By target, success in %")[2]
    shown = re.search(r'>cube: leave_out</a></td>\n<td class="plot">(.*?)</td>\n<td class="num soft">([^<]*)<', section)
    assert shown[2] == f"{counts['won']} of {counts['met']}"
    assert shown[1].count('class="dot"') == 3, "the single trainings"
    assert re.search(r'aria-label="cube: leave_out: \d+ \(\d+ to \d+\)"', shown[1]), "with an interval"
    one = experiment_page(ExperimentPage(card=planted_card(shipped("robustness", replicates=3), lambda *_: 0.8)))
    assert "By factor" not in one, "a factor of one level has no table"


def test_a_page_without_episodes_has_no_dead_links(card):
    card, _ = with_curve(card)
    whole = concluded_benchmark(BenchmarkCard(name="transfer", scale="full", experiments={"skill_object": card}))
    for page in (experiment_page(ExperimentPage(card=card)), benchmark_page(whole)):
        links = set(re.findall(r'href="([^"]*)"', page))
        assert {link for link in links if not link.startswith("#")} == set()
        assert {link for link in links if f'id="{link[1:]}"' not in page} == set()
        assert "click" not in page.partition("<script>")[0]
        assert "leads here" not in page


def test_a_benchmarks_numbers_lead_into_the_reports_of_its_experiments(card):
    whole = concluded_benchmark(BenchmarkCard(name="transfer", scale="full", experiments={"skill_object": card}))
    pages = {"skill_object": "skill_object/report.html"}
    page = benchmark_page(whole, pages=pages, warnings={"skill_object": ["The scene tells it."]})
    there = experiment_page(ExperimentPage(card=card, episodes=episodes_of(card)))
    heat = re.findall(r'href="skill_object/report.html(#episodes[^"]*)" title="[^"]*: (\d+) of (\d+) =', page)
    assert len(heat) == 18 + 18 + 6
    assert listed(there, [link for link, *_ in heat]) == [(int(a), int(b)) for _, a, b in heat]
    row = page.partition('<td><a href="#skill_object">skill_object</a></td><td class="num">')[2].partition("</tr>")[0]
    absolute, baseline, gap, relative = re.findall(r'href="skill_object/report.html(#episodes[^"]*)"', row)
    counts = Counter()
    for e in card.evaluations:
        for cell, (_, met, _) in e.by_cell.items():
            counts[e.condition, cell in {c.key for c in shipped().cells if c.unseen}] += met
    leave_out, other = counts["leave_out", True], counts["baseline", True]
    assert [met for _, met in listed(there, [absolute, baseline, gap, relative])] == [
        leave_out, other, leave_out + other, leave_out + other,
    ]  # fmt: skip
    assert '<a href="#dimension-object">object</a>' in page
    assert 'id="dimension-object"><b>object</b>' in page
    assert "leave_out - baseline, points" in page, "the map of differences"
    assert "By target, success in %" in html.unescape(page)
    assert '<a href="skill_object/report.html">skill_object</a>' in page
    assert '<p class="warning">The scene tells it.</p>' in page


def test_models_lead_to_the_reports_beside_the_page(card):
    cards = {"one": card, "two": planted_card(shipped(replicates=3), rate, seed=1)}
    models = compare_models(cards)
    page = models_page(models, cards, {"one": "../one/report.html"})
    (link,) = re.findall(r'<td class="num"><a href="../one/report.html(#episodes[^"]*)">\d+ of \d+</a></td>', page)
    there = experiment_page(ExperimentPage(card=card, episodes=episodes_of(card)))
    assert listed(there, [link]) == [(models.models["one"].successes, models.models["one"].episodes)]
    assert "two/report.html" not in page
    assert "This page has no episodes" in models_page(models, cards)
