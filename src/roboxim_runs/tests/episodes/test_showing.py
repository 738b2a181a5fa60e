"""Why an episode ended so: its bag, its run's log, and the others in its scene."""

from __future__ import annotations

import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner

from roboxim_bringup.core_graph import CoreGraph
from roboxim_cli.commands.data.dataset import command as dataset
from roboxim_cli.commands.data.show import command
from roboxim_core.config import to_plain
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_core.errors import ConfigError, SimError
from roboxim_eval.film_options import FilmOptions
from roboxim_eval.report.episodes import Episode
from roboxim_policies.builtin import RandomPolicy, ZeroPolicy
from roboxim_recorder.bag import BagReader
from roboxim_runs.datasets.viewing import viewed_episode
from roboxim_runs.episodes.facts import scene_hash
from roboxim_runs.episodes.showing import expert_way, printed, shown_episode
from roboxim_runs.evaluation.comparing import compare_evaluations
from roboxim_runs.evaluation.finding import find_episode
from roboxim_runs.evaluation.report import RECORD_FILE, EvaluationRecord, report_of, stored_record
from roboxim_runs.experiments.report import with_pages
from roboxim_runs.storage.folder import EPISODE_MARK, RunFolder


@pytest.fixture(scope="module")
def evaluated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Evaluate two policies in one scene, five actions each."""
    out = tmp_path_factory.mktemp("evaluated")
    for name, policy in (("zero", ZeroPolicy()), ("random", RandomPolicy())):
        run = out / name
        run.mkdir()
        config = RunConfig(
            purpose="eval", output_dir=str(run), image_width=48, image_height=32, max_steps=5, settle_ticks=1
        )
        try:
            graph = CoreGraph(run, policy=policy)
        except SimError as error:
            pytest.skip(str(error))
        with graph:
            RunFolder(run).append(EpisodeRunner(graph.ports, config).run_index(0))
    record = EvaluationRecord(task="pick_cube", seed=0, policies=("zero", "random"), trained=())
    (out / RECORD_FILE).write_text(json.dumps(to_plain(record)))
    return out


def test_an_episode_is_found_by_its_bag_or_its_number(evaluated: Path) -> None:
    by_number = find_episode(evaluated, 0, "random")
    assert by_number.policy == "random"
    assert [other.name for other in by_number.others] == ["zero"]
    assert find_episode(by_number.bag) == find_episode(evaluated / "random", 0)
    assert find_episode(evaluated, 0).policy == "zero", "the policy under test"
    for place, number, policy, said in (
        (evaluated, 7, "", "has no episode 7; it has 0"), (evaluated, None, "", "say which one, e.g. roboxim show"),
        (evaluated, 0, "bc", "no policy 'bc'"), (evaluated / "zero", 0, "zero", "is not an evaluation's folder"),
        (by_number.bag, 3, "", "is not a run with an episode 3"),
        (evaluated.parent, None, "", "neither a bag nor .*evaluated"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=said):
            find_episode(place, number, policy)


def as_experiment(evaluated: Path, out: Path) -> Path:
    """Copy two evaluations as an experiment lays them out: two conditions, and one of another training."""
    for name, training in (("zero", 0), ("random", 0), ("random", 1)):
        folder = out / f"evaluate/{name}.{training}"
        shutil.copytree(evaluated / name, folder / name)
        record = replace(stored_record(evaluated), policies=(name,))
        (folder / RECORD_FILE).write_text(json.dumps(to_plain(record)))
    (out / "experiment.json").write_text("{}")
    return out


def test_an_episode_of_an_experiment_is_beside_the_other_conditions(evaluated: Path, tmp_path: Path) -> None:
    out = as_experiment(evaluated, tmp_path / "experiment")
    found = find_episode(out / "evaluate/zero.0", 0)
    assert [other.bag.parents[2].name for other in found.others] == ["random.0"]
    with pytest.raises(ConfigError, match=r"3 evaluations \(random.0, random.1, zero.0\); name one, e.g. roboxim show"):
        find_episode(out, 7)


def test_a_report_of_an_experiment_explains_the_episodes_it_shows(evaluated: Path, tmp_path: Path) -> None:
    out = as_experiment(evaluated, tmp_path / "experiment")
    episodes = [
        Episode(
            arm=name, replicate=training, cell="c", scene="0", outcome="failure",
            bag=str(next((out / f"evaluate/{name}.{training}").glob("*/episodes/*")).relative_to(out)),
        )
        for name, training in (("zero", 0), ("random", 0), ("random", 1))
    ]  # fmt: skip
    paged = with_pages(out, episodes, [0, 1, 2])
    bag = Path(episodes[0].bag).name
    assert [one.page for one in paged] == [f"pages/{name}/{bag}.html" for name in ("zero", "random", "random.1")]
    page = (out / paged[0].page).read_text()
    assert f'href="../random/{bag}.html"' in page
    assert "lifted 0 cm of 5" in page
    assert "../" not in (out / paged[2].page).read_text().partition("<script")[0], "another training is another scene"
    assert [one.page for one in with_pages(out, episodes, [1])] == ["", paged[1].page, ""]
    assert not (out / paged[0].page).exists()


def test_its_page_has_all_ticks_and_what_it_was_judged_by(evaluated: Path) -> None:
    found = find_episode(evaluated, 0)
    page = shown_episode(found.bag, films=FilmOptions(), others=found.others, name=found.policy)
    assert page.film is not None
    assert page.film.frames == page.ticks == len(BagReader(found.bag)) == 7
    assert page.explanation == "0 of 2 fingers pressed it, lifted 0 cm of 5."
    assert {"grasped", "lifted", "others_upright"} <= {one.name for one in page.conditions}
    assert next(one for one in page.conditions if one.name == "lifted").least > 0.05
    assert {one.name for one in page.signals} == {"Action", "Gripper", "Tool centre point", "Joints"}
    assert page.others[0].film is not None
    random = find_episode(evaluated, 0, "random").bag
    assert scene_hash(BagReader(found.bag).info) == scene_hash(BagReader(random).info)


def test_what_the_policy_printed_is_told_by_episode(tmp_path: Path) -> None:
    assert printed(tmp_path, 1) == ("", "The logs of its run are not beside its bag.")
    (tmp_path / "logs").mkdir()
    log = tmp_path / "logs/worker-0.log"
    log.write_text("loading\n")
    assert "do not separate episodes" in printed(tmp_path, 1)[1]
    first, second, other = (EPISODE_MARK.format(n) for n in (1, 1, 2))
    node = "[INFO] [1795693283.896] [w0.sim]: renderer"
    log.write_text(f"loading\n{first}\nlost\n{second}\nhello\n{node}\nworld\n{other}\nnot mine\n")
    assert printed(tmp_path, 1) == ("hello\nworld", ""), "of the last attempt, without the nodes' lines"
    log.write_text(f"{first}\nhello\nnanobind: leaked 2 instances!\n")
    assert printed(tmp_path, 1)[0] == "hello"
    log.write_text(f"{first}\n" + "\n".join(map(str, range(1000))))
    assert "600 lines left out" in printed(tmp_path, 1)[0]
    retry = tmp_path / "logs/worker-10.log"
    retry.write_text(f"{first}\nanother worker did it again\n")
    os.utime(log, ns=(1, 1))
    assert printed(tmp_path, 1)[0] == "another worker did it again"


def test_the_command_prints_a_summary_or_writes_a_page(evaluated: Path, tmp_path: Path) -> None:
    text = CliRunner().invoke(command, [str(evaluated), "0"])
    assert text.exit_code == 0, text.output
    assert "Pick up the" in text.stdout.splitlines()[0]
    assert "random: failure" in text.stdout
    out = tmp_path / "why.html"
    page = CliRunner().invoke(command, [str(evaluated), "0", "--out", str(out)])
    assert page.exit_code == 0, page.output
    assert 'data-frames="7"' in out.read_text()
    assert "expert, planned now" in out.read_text()


def test_evaluations_of_the_past_are_compared_where_scenes_are_equal(evaluated: Path, tmp_path: Path) -> None:
    other, out = tmp_path / "later", tmp_path / "both"
    shutil.copytree(evaluated, other)
    page, said = compare_evaluations((evaluated, other), out)
    first = evaluated.name
    assert said.startswith(f"Cannot tell whether {first}: zero differs from later: zero:"), "of one name come first"
    assert said.count("on the one scene that both met") == 3
    text = page.read_text()
    assert "were met by all policies" not in text
    linked = re.findall(r'href="(pages/[^"]*)"', text)
    assert len(linked) == 4
    assert all((out / link).exists() for link in linked)
    for folders, place, message in (
        ((evaluated, evaluated), out, "two different evaluations"), ((evaluated, other), other, "choose another --out"),
        ((evaluated, tmp_path), out, "evaluation.json"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=message):
            compare_evaluations(folders, place)


def test_films_of_named_scenes_are_shown(evaluated: Path) -> None:
    text = report_of(evaluated, replace(stored_record(evaluated), film=FilmOptions(only=("0",), frames=3))).report
    assert text is not None
    assert text.read_text().count('data-frames="3"') == 2
    with pytest.raises(ConfigError, match="no episode of scene 9 is recorded"):
        report_of(evaluated, replace(stored_record(evaluated), film=FilmOptions(only=("9",))))


def test_bags_are_viewed_as_episodes_of_a_dataset(evaluated: Path, tmp_path: Path) -> None:
    bag = find_episode(evaluated, 0).bag
    for place in (bag, evaluated / "zero", next(bag.glob("*.mcap"))):
        episode, names = viewed_episode(place)
        assert (episode.length, len(names)) == (5, 7)
    with pytest.raises(ConfigError, match="has 1 bag, so episodes 0 to 0; got 3"):
        viewed_episode(evaluated / "zero", 3)
    picture = tmp_path / "sheet.png"
    done = CliRunner().invoke(dataset, ["view", str(bag), "--out", str(picture)])
    assert done.exit_code == 0, done.output
    assert picture.stat().st_size > 1000


@pytest.mark.thorough
def test_the_experts_way_is_planned_in_the_same_scene(evaluated: Path, tmp_path: Path) -> None:
    info = BagReader(find_episode(evaluated, 0).bag).info
    way = BagReader(expert_way(info, tmp_path).bag)
    assert way.info.scene == info.scene
    assert way.result.outcome == "success"
