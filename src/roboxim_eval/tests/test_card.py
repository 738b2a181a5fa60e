"""The card of an experiment: its form, its hash, what follows from its counts; and models compared by their cards."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from planted_cards import planted_card, shipped

from roboxim_core.config import load_yaml, named_config
from roboxim_core.errors import ConfigError
from roboxim_eval.benchmark.card import BenchmarkCard, check_benchmark_card, concluded_benchmark, points_text, rate_text
from roboxim_eval.benchmark.config import Reference, ReferenceScore, benchmark_config
from roboxim_eval.experiments.card import sha256_of
from roboxim_eval.experiments.card_checks import check_card, concluded
from roboxim_eval.experiments.card_schema import CARDS, schema_file, schema_of, schema_text
from roboxim_eval.experiments.config import CompareConfig
from roboxim_eval.experiments.models import compare_models
from roboxim_eval.report.benchmark import benchmark_page
from roboxim_eval.report.charts.curve import CurvePoint, learning_curve
from roboxim_eval.report.experiment import ExperimentPage, experiment_page
from roboxim_eval.report.markdown import benchmark_markdown, experiment_markdown
from roboxim_eval.report.models import models_page
from roboxim_eval.report.scores import no_baseline_line, score_rows

RESULTS = Path(__file__).parents[3] / "docs/results"


def rate(condition, cell, u=0.4, s=0.8):
    return {"leave_out": u if cell.unseen else 0.85, "baseline": s, "blind": 0.05}[condition]


@pytest.fixture(scope="module")
def card():
    return planted_card(shipped(replicates=3), rate, proofs={"words received": (600, 600)})


def conforms(data, schema, root, path="card"):
    """Check data by the keywords of JSON Schema that the shipped schemas use; return the first fault, or ''."""
    if "$ref" in schema:
        return conforms(data, root["$defs"][schema["$ref"].rpartition("/")[2]], root, path)
    if "anyOf" in schema:
        faults = [conforms(data, one, root, path) for one in schema["anyOf"]]
        return "" if "" in faults else faults[-1]
    kinds = {"object": dict, "array": list, "string": str, "integer": int, "number": (int, float), "boolean": bool}
    kind = schema.get("type")
    if kind == "null":
        return "" if data is None else f"{path} is not null"
    if kind and (not isinstance(data, kinds[kind]) or (kind != "boolean" and isinstance(data, bool))):
        return f"{path} is no {kind}"
    if isinstance(data, dict):
        missing = set(schema.get("required", ())) - data.keys()
        extra = data.keys() - schema.get("properties", data).keys() if "properties" in schema else set()
        if missing or extra:
            return f"{path} lacks {missing} or has {extra}"
        inner = schema.get("properties") or dict.fromkeys(data, schema.get("additionalProperties", {}))
        faults = [conforms(data[key], inner[key], root, f"{path}.{key}") for key in data]
    elif isinstance(data, list):
        parts = schema.get("prefixItems", [])
        if parts and len(data) != len(parts):
            return f"{path} has {len(data)} items"
        faults = [
            conforms(one, parts[i] if parts else schema.get("items", {}), root, f"{path}.{i}")
            for i, one in enumerate(data)
        ]
    else:
        faults = []
    return next(filter(None, faults), "")


@pytest.mark.parametrize("name", CARDS)
def test_the_shipped_schema_is_that_of_the_code(name):
    assert schema_file(name).read_text() == schema_text(name), "run: python -m roboxim_eval.experiments.card_schema"


def test_a_card_conforms_to_the_schema(card):
    schema = schema_of("card")
    assert conforms(card.plain, schema, schema) == ""
    wrong = {**card.plain, "pairs": {"0": [[1, 2, 3]]}}
    assert "pairs.0.0 has 3 items" in conforms(wrong, schema, schema)
    assert "lacks" in conforms({k: v for k, v in card.plain.items() if k != "proofs"}, schema, schema)
    assert schema["properties"]["times"]["description"].startswith("Stage to wall time")


def test_a_card_is_checked_against_its_counts(card):
    data = card.plain
    assert check_card(json.loads(json.dumps(data))) == card
    with pytest.raises(ConfigError, match="its scores do not follow"):
        check_card({**data, "scores": {**data["scores"], "absolute": [0.9, 0.8, 1.0]}})
    with pytest.raises(ConfigError, match="its verdicts do not follow"):
        check_card({**data, "verdicts": data["verdicts"][:1]})
    with pytest.raises(ConfigError, match="its sha256 do not follow"):
        check_card({**data, "datasets": {"leave_out.0": {"sha256": "0", "by_cell": {}, "fault": "", "faulty": 0}}})
    for other in ({}, {"a": 1}, [], None, 3):
        with pytest.raises(ConfigError, match="table.json is no card of an experiment; give the card.json"):
            check_card(other, source="table.json")
    with pytest.raises(ConfigError, match="no card of schema 2, 3 or 4, found 1"):
        check_card({**data, "schema": 1})


def test_a_card_that_lacks_outcomes_is_refused_by_its_name(card):
    data = card.plain
    without = {**data, "evaluations": [one for one in data["evaluations"] if one["condition"] != "baseline"]}
    with pytest.raises(ConfigError, match="^mine.json: no outcomes of condition 'baseline'"):
        check_card(without, source="mine.json")
    short = {**data, "evaluations": [
        one for one in data["evaluations"] if (one["condition"], one["replicate"]) != ("blind", 2)]}  # fmt: skip
    with pytest.raises(ConfigError, match="^mine.json: arms are compared replicate by replicate, got 3 and 2"):
        check_card(short, source="mine.json")


def test_a_cell_without_episodes_in_one_training_is_reported(card):
    def emptied(one):
        first = next(iter(one.by_cell))
        return replace(one, by_cell={**one.by_cell, first: (0, 0, 0)}) if one.replicate == 1 else one

    found = concluded(replace(card, evaluations=tuple(map(emptied, card.evaluations)), pairs={}))
    cell = next(iter(card.evaluations[0].by_cell))
    assert any(f"leave_out, replicate 1: no episode counts in {cell}, so" in one for one in found.warnings)
    assert not any("no episode counts" in one for one in card.warnings)


def leaves(value, path=()):
    """Yield the path of every value that holds no others, one for each kind of path: of a list, its first item."""
    if isinstance(value, dict) and value:
        for key in value:
            yield from leaves(value[key], (*path, key))
    elif isinstance(value, list) and value:
        yield from leaves(value[0], (*path, 0))
    else:
        yield path


def edited(data, path):
    """Return a copy of plain data with another value at a path."""
    copy = json.loads(json.dumps(data))
    *way, last = path
    holder = copy
    for key in way:
        holder = holder[key]
    old = holder[last]
    holder[last] = {
        bool: lambda: not old,
        int: lambda: old + 1,
        float: lambda: old + 0.01,
        str: lambda: f"{old} not",
    }.get(type(old), lambda: "x")()
    return copy


@pytest.mark.thorough
def test_every_edit_of_a_card_is_noticed_and_a_new_hash_does_not_hide_an_edited_conclusion(card):
    data = card.plain
    paths = [path for path in leaves(data) if path[0] != "times"]
    assert len(paths) > 50
    for path in paths:
        changed = edited(data, path)
        with pytest.raises(ConfigError):
            check_card(changed)
        if path[0] in ("verdicts", "scores", "warnings"):
            changed["sha256"] = sha256_of({k: v for k, v in changed.items() if k not in ("sha256", "times")})
            with pytest.raises(ConfigError):
                check_card(changed)


def test_the_hash_is_that_of_the_canonical_json_without_times(card):
    data = card.plain
    content = {key: value for key, value in data.items() if key not in ("sha256", "times")}
    assert sha256_of(content) == card.sha256
    assert check_card({**data, "times": {"train/a": 3.0}}).sha256 == card.sha256


# ------------------------------------------------------------------ pages


def test_the_page_of_a_card_says_what_it_concludes(card):
    page = experiment_page(ExperimentPage(card=card, command="roboxim experiment run"))
    assert card.verdicts[0].sentence in page
    assert page.index(card.verdicts[0].sentence) < page.index(card.verdicts[1].sentence)
    assert page.count('class="heat"') == 4, "an arm each, and the difference"
    assert page.count(' unseen"') >= 4 * 6, "held-out cells are framed"
    assert "combined: unseen verb with seen object" in page
    assert "A cell is a combination of task and target. 6 of 18 are unseen" in page
    assert "words received" in page
    assert "1 check passed in all its episodes" in page, "what passed is one line"
    assert card.sha256 in page
    assert 'id="episode-data"' not in page, "a card has no episodes"


def test_a_page_without_a_primary_comparison_shows_all_of_them_together(card):
    several = planted_card(shipped("robustness", replicates=3), lambda *_: 0.8)
    assert not any(verdict.primary for verdict in several.verdicts)
    assert card.verdicts[0].primary
    assert f"- **{card.verdicts[0].sentence}**" in experiment_markdown(card)
    assert "- **" not in experiment_markdown(several)
    many = experiment_page(ExperimentPage(card=several))
    assert many.index("All comparisons, points") < many.index('data-tab="light - nominal, points"')
    assert "(primary)" not in many
    assert 'id="cells"' not in many, "one cell has no heat map"
    one = experiment_page(ExperimentPage(card=card))
    assert f"<h1>{card.experiment.name}, scale" in one
    assert "<h1>mine-laptop, scale" in experiment_page(ExperimentPage(card=card, name="mine-laptop"))
    assert "All comparisons" not in one
    assert "(primary)" in one
    assert 'id="cells"' in one


def test_a_cell_without_episodes_of_a_condition_has_no_difference(card):
    """All its episodes were excluded: the rate is not 0."""
    cell = next(one.key for one in shipped(replicates=3).cells if one.unseen)
    rows = [
        replace(row, by_cell={**row.by_cell, cell: (0, 0, 0)}) if row.condition == "leave_out" else row
        for row in card.evaluations
    ]
    page = experiment_page(ExperimentPage(card=concluded(replace(card, evaluations=tuple(rows), pairs={}))))
    assert "0 of 0" not in page
    assert f"no episode counts in {cell}" in page


def test_many_comparisons_are_grouped_by_verdict_if_all_are_of_the_same_cells(card):
    config = card.experiment.config
    compares = [
        CompareConfig(first=name, second="baseline", where="unseen", primary=False) for name in ("leave_out", "blind")
    ] * 3  # fmt: skip
    mixed = [replace(one, where="seen") if one.first == "leave_out" else one for one in compares]
    for compare, grouped in ((compares, True), (mixed, False)):
        experiment = replace(card.experiment, config=replace(config, compare=tuple(compare)))
        page = experiment_page(ExperimentPage(card=concluded(replace(card, experiment=experiment, pairs={}))))
        assert ("Lower than baseline in unseen cells: <b>" in page) == grouped
        assert ("All 6 comparisons in full" in page) == grouped


def test_names_and_numbers_of_a_curve_do_not_overlap_or_leave_it():
    """Eight curves at the bottom, with points that are close together at the left."""
    steps = (100, 200, 4000, 8000)
    names = [f"condition_{n}" for n in range(7)] + ["a_condition_with_a_very_long_name"]
    picture = learning_curve({name: [CurvePoint(steps=s, rates=(0.02, 0.0)) for s in steps] for name in names})
    labels = re.findall(r'<text x="([\d.]+)" y="([\d.]+)" class="name c\d">(\w+)<', picture)
    assert [name for *_, name in labels] == names
    heights = sorted(float(y) for _, y, _ in labels)
    assert (heights[0] > 0, heights[-1] < 300) == (True, True)
    assert min(np.diff(heights)) > 13.9
    width = float(re.search(r'viewBox="0 0 ([\d.]+) 300"', picture)[1])
    assert float(labels[-1][0]) + 7 * len(names[-1]) < width
    assert re.findall(r'y="276" text-anchor="middle" class="axis">(\w+)<', picture) == ["8k", "4k", "200"]


def test_scores_of_an_experiment_without_a_baseline_are_not_named_after_one(card):
    """Both conditions of `breadth` lack the held-out cells, so that their difference is not what holding out costs."""
    assert not no_baseline_line(card)
    breadth = check_card(json.loads((RESULTS / "breadth-laptop/card.json").read_text()))
    said = {row["name"]: (row["plain"], row["meaning"]) for row in score_rows(breadth)}
    assert said["gap, s - u"][0] == "scratch minus broad there"
    assert not any(
        "baseline" in text for name in ("gap, s - u", "relative, u / s", "competence") for text in said[name]
    )
    page = experiment_page(ExperimentPage(card=breadth))
    assert "success lost by holding out" not in page
    assert "scratch was not trained in held-out cells either" in no_baseline_line(breadth)


def test_a_training_counts_once(card):
    data = card.plain
    twice = [row for row in data["evaluations"] if row["replicate"] == 0] * 3
    with pytest.raises(ConfigError, match=r"must be of the replicates 0, 1, \.\.\.; got \[0, 0, 0\]"):
        check_card({**data, "evaluations": twice})


def test_a_benchmarks_card_is_checked_through_its_experiments(card):
    other = planted_card(shipped("camera_object", replicates=3), rate)
    whole = concluded_benchmark(
        BenchmarkCard(name="transfer", scale="full", experiments={"skill_object": card, "camera_object": other})
    )
    data = whole.plain
    schema = schema_of("benchmark_card")
    assert conforms(data, schema, schema) == ""
    assert check_benchmark_card(data).dimensions["object"].experiments == ("skill_object", "camera_object")
    with pytest.raises(ConfigError, match="found 'benchmark-3'; of a benchmark's card, use 'benchmark report --from'"):
        check_card(data)
    with pytest.raises(ConfigError, match="its dimensions do not follow"):
        check_benchmark_card({**data, "dimensions": {}})
    published = Reference(name="Octo", dimensions={"object": ReferenceScore(absolute=0.21)})
    beside = concluded_benchmark(replace(whole, reference=published)).plain
    beside["reference"]["dimensions"]["object"]["absolute"] = 0.95
    with pytest.raises(ConfigError, match="its sha256 do not follow"):
        check_benchmark_card(beside)
    changed = json.loads(json.dumps(data))
    changed["experiments"]["camera_object"]["warnings"] = []
    changed["experiments"]["camera_object"]["scores"]["gap"] = [0.0, 0.0, 0.0]
    with pytest.raises(ConfigError, match="experiment camera_object: its scores"):
        check_benchmark_card(changed)
    page = benchmark_page(whole)
    assert all(sentence in page for sentence in whole.sentences[:3])
    score = whole.dimensions["object"]
    assert score.gap[0] == pytest.approx(score.baseline[0] - score.absolute[0], abs=2e-6)
    assert f"the baseline has {rate_text(score.baseline)}, a gap of {points_text(score.gap)}; mean of" in page
    assert page.count(f'<td class="num">{points_text(score.gap)}</td>') == 1, "in the row of the dimension"


def test_a_benchmark_of_single_trainings_has_gaps_without_interval():
    single = planted_card(shipped(replicates=1), rate)
    whole = concluded_benchmark(BenchmarkCard(name="t", scale="smoke", experiments={"skill_object": single}))
    assert whole.dimensions["skill"].gap[1:] == (None, None)
    assert check_benchmark_card(whole.plain) == whole
    assert conforms(whole.plain, schema_of("benchmark_card"), schema_of("benchmark_card")) == ""
    assert "points (no interval from one training); mean of skill_object." in whole.sentences[0]
    assert "points (no interval from one training)" in benchmark_page(whole)


def tables_of(text):
    """Return the tables of a Markdown text as lists of rows, by their first heading."""
    tables, rows = {}, []
    for line in [*text.splitlines(), ""]:
        if line.startswith("|"):
            rows.append([cell.strip() for cell in line.strip("|").split("|")])
        elif rows:
            assert len({len(row) for row in rows}) == 1, "every row has a cell for each column"
            tables.setdefault(rows[0][0], rows[2:])
            rows = []
    return tables


def test_a_cards_markdown_has_its_sentences_and_counts(card):
    text = experiment_markdown(card)
    assert all(sentence in text for sentence in card.sentences)
    tables = tables_of(text)
    won, met, _ = (sum(column) for column in zip(
        *(e.by_cell["pick_up target=cube"] for e in card.evaluations if e.condition == "leave_out"), strict=True
    ))  # fmt: skip
    assert ["**pick_up target=cube**", f"{won} of {met}"] == tables["cell, **held out**"][0][:2]
    assert [row[0] for row in tables["condition"]] == ["leave_out", "baseline", "blind"]
    assert card.sha256 in text
    wide = tables_of(experiment_markdown(planted_card(shipped("robustness", replicates=3), lambda *_: 0.8)))
    assert len(wide["cell"][0]) == 2, "one cell: conditions are the rows"


def test_markdown_has_what_is_told_beside_the_card(card):
    text = experiment_markdown(card, warnings=["No held-out scene allows another instruction."])
    assert "- Warning: No held-out scene allows another instruction.\n" in text
    whole = concluded_benchmark(BenchmarkCard(name="t", scale="full", experiments={"skill_object": card}))
    said = benchmark_markdown(whole, warnings={"skill_object": ["No held-out scene allows another instruction."]})
    assert said.count("- Warning: No held-out scene allows another instruction.\n") == 1


def test_a_substitution_of_0_depends_on_what_scenes_allow():
    def shown(instead):
        (row,) = (r for r in score_rows(planted_card(shipped(), rate, instead=instead)) if r["name"] == "substitution")
        return row["value"], row["interval"]

    value, interval = shown({})
    assert value == "0.00"
    assert interval.endswith(", if scenes allow another instruction")
    value, interval = shown({"pick_up target=cube": "rotate target=cube"})
    assert float(value) > 0
    assert "scenes" not in interval


def test_a_benchmarks_markdown_shows_published_scores(card):
    config = benchmark_config(load_yaml(named_config("benchmark", "transfer")))
    whole = BenchmarkCard(name="transfer", scale="full", experiments={"skill_object": card}, reference=config.reference)
    tables = tables_of(benchmark_markdown(concluded_benchmark(whole)))
    rows = {row[0]: row[1:] for row in tables["dimension or experiment"]}
    assert rows["skill_object"][4:] == ["0.19", "72 %"], "the thesis's scores"
    assert rows["skill"][:4] == rows["skill_object"][:4], "its only experiment"
    scores = {row[0]: row[1] for row in tables["score"]}
    baseline, gap, relative = (scores[name] for name in ("baseline, s", "gap, s - u", "relative, u / s"))
    assert rows["skill"][1].startswith(f"{baseline} ("), "a ratio never stands without s and the gap"
    assert rows["skill"][2].startswith(f"{gap} (")
    assert rows["skill"][3].startswith(f"{100 * float(relative):.0f} %")


# ------------------------------------------------------------------ models


def models_of(rates, replicates=3):
    design = shipped(replicates=replicates)
    return {
        name: planted_card(design, lambda condition, cell, u=u: rate(condition, cell, u), seed=seed)
        for seed, (name, u) in enumerate(rates.items())
    }


def test_models_without_a_common_letter_differ():
    cards = models_of({"weak": 0.2, "strong": 0.8, "also_strong": 0.78})
    found = compare_models(cards)
    assert (found.condition, found.where, len(found.cells)) == ("leave_out", "unseen", 6)
    assert found.models["strong"].letters == found.models["also_strong"].letters == "a"
    assert found.models["weak"].letters == "b"
    assert any(s.startswith("strong is better than weak by") and "over 3 trainings each" in s for s in found.sentences)
    assert any(s.startswith("Cannot tell whether strong or also_strong is better") for s in found.sentences)
    page = models_page(found, cards)
    assert all(sentence in page for sentence in found.sentences)


def test_models_are_compared_on_equal_cells():
    cards = models_of({"one": 0.5, "two": 0.5})
    fewer = shipped(replicates=3)
    whole = compare_models(cards, where="all")
    assert len(whole.cells) == len(fewer.cells)
    blind = compare_models(cards, condition="blind", where="all")
    assert len(blind.cells) == 6, "only cells that were evaluated"
    with pytest.raises(ConfigError, match="no unseen cell in common"):
        compare_models({"one": cards["one"], "two": planted_card(shipped("camera_object", replicates=3), rate)})
    with pytest.raises(ConfigError, match="no condition 'leave_it'.*did you mean 'leave_out'"):
        compare_models(cards, condition="leave_it")
    with pytest.raises(ConfigError, match="at least two runs"):
        compare_models({"one": cards["one"]})


def test_single_trainings_are_compared_as_checkpoints():
    cards = models_of({"weak": 0.2, "strong": 0.9}, replicates=1)
    apart = compare_models(cards)
    assert "these checkpoints, without pairing their scenes" in apart.pairs[0].test
    scene = {("pick_up target=cube", str(i)): True for i in range(30)}
    same = compare_models(cards, scenes={"weak": [dict.fromkeys(scene, False)], "strong": [scene]})
    assert same.pairs[0].test == "these checkpoints, on 30 scenes that both met"
    assert same.pairs[0].p < 0.001
