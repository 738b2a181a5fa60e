"""Mining of regions in the simulator: the factors of a task, and a planted region that is found."""

from __future__ import annotations

import shutil
from types import SimpleNamespace

import pytest
import yaml
from planted_causes import FailsWhere

from roboxim_bringup.core_graph import CoreActor, CoreTasks
from roboxim_core.config import parse_yaml
from roboxim_core.episode import RunConfig
from roboxim_core.errors import ConfigError, PolicyError, SimError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.plain_data.yaml_text import plain
from roboxim_core.seeds import SeedPath
from roboxim_eval.answers.regions import SearchConfig
from roboxim_runs.answers import mining
from roboxim_runs.answers.mining import MineConfig, at_point, factors_of, mine, role_at_point
from roboxim_runs.answers.trying import TryBench
from roboxim_runs.episodes.task_choice import task_text
from roboxim_runs.policies.specs import choose_policies


def test_ranges_of_a_task_are_its_factors():
    text = task_text("pick_cube")
    found = factors_of(text)
    assert {"reset.objects.area.0", "reset.objects.area.1", "reset.objects.yaw_rad"} <= found.keys()
    chosen = factors_of(text, ["reset.objects.area"])
    assert list(chosen) == ["reset.objects.area.0", "reset.objects.area.1"]
    data = at_point(parse_yaml(text), chosen, [0.5, 0.1])
    assert data["reset"]["objects"]["area"]["lower"] == pytest.approx([0.5, 0.1], abs=1e-5)
    named = {name: (factor.words, factor.axis, factor.unit) for name, (factor, _, _) in found.items()}
    assert named["reset.objects.area.1"] == ("the object", "y", "m")
    assert named["reset.objects.yaw_rad"] == ("yaw of the object", "", "rad")
    assert named["reset.robot.position.2"] == ("the gripper at the start", "z", "m")
    with pytest.raises(ConfigError, match="no factor 'reset.light'"):
        factors_of(text, ["reset.light"])
    with pytest.raises(ConfigError, match="no range"):
        factors_of(yaml.safe_dump({"skill": "pick_up"}))


@pytest.mark.parametrize("name", ["place_on", "pick_up", "tidy_up", "pick_cube_distractors"])
def test_points_of_a_task_with_several_things_have_scenes_and_place_one_of_them(name):
    text = task_text(name)
    factors, role = factors_of(text), role_at_point(text)
    names = list(factors)
    assert not any(factor.startswith("reset.distractors") for factor in names)
    tasks = CoreTasks(ModelLibrary())
    for index, share in enumerate((0.2, 0.5, 0.8)):
        values = [factor.lower + share * (factor.upper - factor.lower) for factor, _, _ in factors.values()]
        task = yaml.safe_dump(plain(at_point(parse_yaml(text), factors, values, role)))
        scene = tasks.draw(SeedPath(run_seed=3, purpose="eval", index=index), task).scene
        placed = scene.entity(role or "target").pose.position
        wanted = [values[names.index(f"reset.objects.area.{axis}")] for axis in (0, 1)]
        assert placed[:2] == pytest.approx(wanted, abs=1e-4)
    assert factors["reset.objects.area.0"][0].words == f"the {role or 'object'}"


@pytest.mark.thorough
def test_a_planted_region_is_found_and_its_scenes_are_solved_by_the_expert(tmp_path):
    config = MineConfig(
        task_config=task_text("pick_cube"), factors=("reset.objects.area",),
        search=SearchConfig(first=16, rounds=1, per_round=8, confirm=8, regions=1),
        run=RunConfig(image_width=32, image_height=32),
    )  # fmt: skip
    try:
        bench = TryBench()
    except SimError as error:
        pytest.skip(str(error))
    with bench:
        actor = CoreActor(FailsWhere(conditions=[{"x": [0.3, 0.47]}]))
        found = mine(bench, actor, config, out=tmp_path)
        shutil.rmtree(tmp_path / next(iter(found.bags.values()))[-1])  # as if it had been stopped between two bags
        assert mine(bench, actor, config, out=tmp_path) == found
    (region,) = found.regions
    assert region.confirmed
    assert region.inside[0] > 5 > region.outside[0]
    assert region.inside[0] < found.failures < found.rollouts
    assert "closer than" in region.words
    assert "near edge of its area" in region.words
    bags = found.bags[region.words]
    assert bags
    assert all((tmp_path / bag).exists() for bag in bags)


class _Counting(FailsWhere):
    """Counts the episodes that it plays; raises in one of them."""

    def __init__(self, *, raises_in: int = 0) -> None:
        super().__init__(conditions=[])
        self.played, self._raises_in = 0, raises_in

    def reset(self, start):
        super().reset(start)
        self.played += 1
        if self.played == self._raises_in:
            raise RuntimeError("out of memory")


@pytest.mark.thorough
def test_a_search_that_was_stopped_continues_without_playing_again(tmp_path):
    def config(seed):
        return MineConfig(
            task_config=task_text("pick_cube"), factors=("reset.objects.area",),
            search=SearchConfig(first=6, rounds=0, seed=seed),
            run=RunConfig(image_width=32, image_height=32, max_steps=2),
        )  # fmt: skip

    try:
        bench = TryBench()
    except SimError as error:
        pytest.skip(str(error))
    with bench:
        whole = mine(bench, CoreActor(_Counting()), config(3))
        with pytest.raises(PolicyError, match="out of memory"):
            mine(bench, CoreActor(_Counting(raises_in=4)), config(3), out=tmp_path)
        rest = _Counting()
        assert mine(bench, CoreActor(rest), config(3), out=tmp_path) == whole
        assert rest.played == whole.rollouts - 3
        assert whole.unsolved == whole.rollouts == 6  # two ticks suffice neither the policy nor the expert
        with pytest.raises(ConfigError, match=r"another search or policy \(config.search.seed: 3 stored, 4"):
            mine(bench, CoreActor(rest), config(4), out=tmp_path)


def test_a_policy_that_fails_everywhere_has_no_region_and_all_failures():
    graph = SimpleNamespace(tasks=SimpleNamespace(draw=lambda *_: None))
    bench = SimpleNamespace(graph=graph, expert="expert")
    bench.run = lambda _draw, actor, _seed, config: SimpleNamespace(success=actor == "expert")
    config = MineConfig(
        task_config=task_text("pick_cube"), factors=("reset.objects.area",),
        search=SearchConfig(first=8, rounds=1, per_round=6),
    )  # fmt: skip
    found = mine(bench, "policy", config)
    assert (found.regions, found.failures, found.rollouts) == ([], 14, 14)


def test_a_search_in_a_folder_is_of_one_state_of_its_policy_and_scenes(tmp_path, monkeypatch):
    file, out = tmp_path / "mine.py", tmp_path / "out"

    def search(source, *options):
        file.write_text(source)
        (policy,) = choose_policies([f"{file}:Mine"], (), options)
        config = MineConfig(task_config=task_text("pick_cube"), policy=policy.identity(out))
        mine(SimpleNamespace(), CoreActor(FailsWhere(conditions=[])), config, out=out)

    source = "class Mine:\n    def __init__(self, gain=1.0): ...\n"
    monkeypatch.setattr(mining, "search", lambda *_: [])
    search(source)
    search(source)
    with pytest.raises(ConfigError, match=r"config.policy.files.*mine.py"):
        search(f"{source}    gain = 2\n")
    with pytest.raises(ConfigError, match=r"config.policy.options.gain: nothing stored, 2"):
        search(source, "gain=2")
    monkeypatch.setattr(mining, "definitions_of", lambda *_: {"scene table": "another"})
    with pytest.raises(ConfigError, match="definitions.scene table"):
        search(source)
