"""Every edit of a run's results that changes a sentence is noticed: refused, or named beside the sentence."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from roboxim_core.config import to_plain
from roboxim_core.episode import EpisodeResult
from roboxim_core.errors import ConfigError, RecorderError
from roboxim_core.plain_data.results_log import RESULTS_FILE, ResultsLog, line_of
from roboxim_core.verdicts import Verdict
from roboxim_recorder.bag import BagReader
from roboxim_recorder.run_bags import read_results
from roboxim_runs.episodes.facts import FACTS_FILE, ended, episode_facts
from roboxim_runs.evaluation.comparing import compare_evaluations
from roboxim_runs.evaluation.finding import find_episode
from roboxim_runs.evaluation.report import RECORD_FILE, EvaluationRecord, report_of
from roboxim_runs.storage.folder import RunFolder
from roboxim_runs.storage.merging import merge_shards

CONFIG = {"purpose": "eval", "run_seed": 3, "episodes": 4}


def result(index: int, outcome: str = "failure") -> EpisodeResult:
    return EpisodeResult(
        episode_id=f"eval-3-{index:05d}-0", index=index, outcome=outcome, instruction="Pick it up", skill="pick_up",
        reason="" if outcome == "success" else "not_lifted", steps=120, wall_s=4.5, delay_ticks=0.25,
        verdict=Verdict(success=outcome == "success", predicates={"lift_m": 0.01}), final_state_hash="0123456789abcdef",
    )  # fmt: skip


def evaluated(out: Path) -> Path:
    """Write an evaluation of one policy that solved one scene of four; return its results."""
    with RunFolder(out / "bc").opened(CONFIG) as folder:
        for index in range(4):
            folder.append(result(index, "success" if index == 2 else "failure"))
    record = EvaluationRecord(task="pick_cube", seed=3, policies=("bc",), trained=("bc",))
    (out / RECORD_FILE).write_text(json.dumps(to_plain(record)))
    return out / "bc" / RESULTS_FILE


def mutations(value: Any) -> Iterator[Any]:
    """Yield values that differ from a field's, at every depth."""
    if isinstance(value, dict):
        for key in value:
            yield {name: entry for name, entry in value.items() if name != key}
            yield from ({**value, key: other} for other in mutations(value[key]))
        yield {**value, "added": 1.0}
    elif isinstance(value, bool):
        yield not value
    elif isinstance(value, int | float):
        yield from (value + 1, value + 1e-12)
    elif isinstance(value, str):
        yield f"{value} "
    yield None


READERS: dict[str, Callable[[Path, Path], object]] = {
    "report": lambda out, _: report_of(out),
    "report of several": lambda out, other: compare_evaluations((out, other), out.parent / "both"),
    "show": lambda out, _: find_episode(out, 0),
    "merge": lambda out, _: merge_shards(out.parent / "merged", [out]),
    "export": lambda out, _: read_results(out / "bc"),
    "resume": lambda out, _: _resumed(out / "bc"),
}


def _resumed(run: Path) -> None:
    with RunFolder(run).opened(CONFIG) as folder:
        folder.results()


def test_every_changed_field_of_a_line_is_refused_by_name(tmp_path: Path) -> None:
    file = evaluated(tmp_path / "run")
    log, lines = ResultsLog(file), file.read_text().splitlines()
    whole = json.loads(lines[1])
    changed = [{**whole, name: other} for name in whole for other in mutations(whole[name])]
    changed += [{name: value for name, value in whole.items() if name != gone} for gone in whole]
    changed = [line for line in changed if line != whole]
    assert len(changed) > 2 * len(whole)
    for line in changed:
        file.write_text("\n".join([lines[0], json.dumps(line), *lines[2:], ""]))
        with pytest.raises(ConfigError, match=r"results.jsonl line 2 .*changed"):
            log.read()


@pytest.mark.parametrize("reader", READERS)
def test_every_command_refuses_a_changed_outcome(tmp_path: Path, reader: str) -> None:
    file = evaluated(tmp_path / "run")
    evaluated(tmp_path / "other")
    file.write_text(file.read_text().replace('"outcome":"failure"', '"outcome":"success"', 1))
    with pytest.raises(ConfigError, match=r"results.jsonl line 1 was changed after it was written"):
        READERS[reader](tmp_path / "run", tmp_path / "other")


def test_a_repeated_run_repairs_a_changed_line(tmp_path: Path) -> None:
    file = evaluated(tmp_path / "run")
    file.write_text(file.read_text().replace('"outcome":"failure"', '"outcome":"success"', 1))
    with RunFolder(file.parent).opened(CONFIG, repair=True) as folder:
        assert [one.index for one in folder.results()] == [1, 2, 3], "episode 0 is run again"


def test_lines_that_were_removed_repeated_reordered_or_taken_from_another_run(tmp_path: Path) -> None:
    file = evaluated(tmp_path / "run")
    whole, said = file.read_text(), report_of(tmp_path / "run", page=False)
    first, second, third, fourth = whole.splitlines(keepends=True)
    assert not said.doubts
    for same in (first + first + second + third + fourth, fourth + third + second + first, whole + first[:60]):
        file.write_text(same)
        assert repr(report_of(tmp_path / "run", page=False)) == repr(said)
    for place in range(4):
        file.write_text(whole.replace((first, second, third, fourth)[place], ""))
        (doubt,) = report_of(tmp_path / "run", page=False).doubts
        assert f"1 of 4 episodes have no result in {file} (index {place}): the run is not finished, or lines" in doubt
    file.write_text(whole + line_of("another run", to_plain(result(0, "success"))))
    with pytest.raises(ConfigError, match="line 5 is a result of another run"):
        report_of(tmp_path / "run", page=False)


def test_lines_of_an_earlier_version_are_accepted_with_a_word(tmp_path: Path) -> None:
    file = evaluated(tmp_path / "run")
    lines = [json.loads(line) for line in file.read_text().splitlines()]
    old = [json.dumps({name: value for name, value in line.items() if name != "checksum"}) for line in lines]
    for count in (1, 4):
        file.write_text("\n".join([*old[:count], *map(json.dumps, lines[count:]), ""]))
        found = report_of(tmp_path / "run")
        assert found.doubts[0].startswith(f"{file} cannot be checked whole: lines without a checksum")
        assert f"wrote: {count}." in found.doubts[0]
        assert found.report is not None
        assert "cannot be checked" in found.report.read_text()
        _, words = compare_evaluations((tmp_path / "run", _other(tmp_path)), tmp_path / "both")
        assert words.startswith(f"{file} cannot be checked whole")
    file.write_text("\n".join([json.dumps(lines[0]), *old[1:], ""]))
    with pytest.raises(ConfigError, match="line 2 was changed: it has no checksum, although the line before it has"):
        report_of(tmp_path / "run")


def _other(folder: Path) -> Path:
    if not (folder / "other").exists():
        evaluated(folder / "other")
    return folder / "other"


def test_a_new_checksum_does_not_hide_a_difference_from_the_bag(tmp_path: Path, monkeypatch: Any) -> None:
    """Whoever computes the checksum again has the bag against them, and the facts stored when it was last read."""
    line, bag = replace(result(0), bag="episodes/e"), tmp_path / "episodes/e"
    monkeypatch.setattr(BagReader, "__init__", lambda self, path: None)
    monkeypatch.setattr(BagReader, "result", line)
    log = ResultsLog(tmp_path / FACTS_FILE)
    log.append(line.episode_id, {"episode_id": line.episode_id, "scene": "known", "ended": ended(line)})
    bag.mkdir(parents=True)
    assert episode_facts(tmp_path, [replace(line, wall_s=9.0, inference_s=1.0)])
    fields = {"outcome": "success", "reason": "", "steps": 3, "instruction": "x", "held": 2, "final_state_hash": ""}
    for name, value in fields.items():
        with pytest.raises(RecorderError, match=f"differs from its bag's episodes/e .{name}"):
            episode_facts(tmp_path, [replace(line, **{name: value})])
