"""Effects of recorded factors: found within cells and shared scenes, and seldom where there are none."""

import numpy as np
import pytest

from roboxim_eval.report.episodes import Episode
from roboxim_eval.statistics import factors
from roboxim_eval.statistics.factors import Trial, factor_effects


def trials(effect, *, seed=0, cells=6, each=40):
    """Simulate episodes of cells of different difficulty, in which the light alone has an effect."""
    rng = np.random.default_rng(seed)
    found = []
    for cell in range(cells):
        for i in range(each):
            light, other = ("dim", "bright")[rng.integers(2)], str(rng.integers(3))
            chance = 0.1 + 0.12 * cell + (effect if light == "bright" else 0.0)
            drawn = {"light": light, "other": other, "cell": str(cell)}
            name, success = f"{cell}/{i}", rng.random() < chance
            found.append(Trial(episode=name, stratum=str(cell), scene=name, success=success, drawn=drawn))
    return found


def trials_of_arms(effect, *, seed=0, arms=6, scenes=60, spread=1.5, missing=0.0):
    """Simulate arms that meet the same scenes, whose difficulty varies by a standard deviation on the logit."""
    rng = np.random.default_rng(seed)
    lights = rng.choice(["dim", "bright"], scenes)
    logits = spread * rng.standard_normal(scenes) + effect * (lights == "bright")
    wins = rng.random((arms, scenes)) < 1 / (1 + np.exp(-logits))
    met = rng.random((arms, scenes)) >= missing
    return [
        Trial(
            episode=f"{arm}/{i}", stratum=str(arm), scene=str(i), success=bool(wins[arm, i]), drawn={"light": lights[i]}
        )  # fmt: skip
        for arm in range(arms)
        for i in range(scenes)
        if met[arm, i]
    ]


def false_alarms(monkeypatch, repetitions, **simulation):
    """Return the share of simulations without an effect in which the light is significant at 5 %."""
    monkeypatch.setattr(factors, "PERMUTATIONS", 199)
    found = [factor_effects(trials_of_arms(0.0, seed=seed, **simulation)) for seed in range(repetitions)]
    return float(np.mean([effect.p_value <= 0.05 for (effect,) in found]))


def test_a_factor_with_an_effect_is_found_within_cells():
    effects = {effect.factor: effect for effect in factor_effects(trials(0.3, seed=2))}
    assert set(effects) == {"light", "other"}, "the design's own factor is not tested"
    assert effects["light"].adjusted < 0.01
    assert effects["light"].spread > 0.15
    assert effects["other"].adjusted > 0.05
    assert effects["light"].adjusted == pytest.approx(2 * effects["light"].p_value), "Holm over two factors"


def test_a_harder_cell_is_no_effect_of_a_factor():
    # the rare light is drawn more often in the hard cell; within cells it makes no difference
    rng = np.random.default_rng(3)
    found = []
    for cell, chance, rare in (("easy", 0.9, 0.1), ("hard", 0.1, 0.9)):
        for i in range(100):
            drawn = {"light": "rare" if rng.random() < rare else "usual"}
            name, success = f"{cell}{i}", rng.random() < chance
            found.append(Trial(episode=name, stratum=cell, scene=name, success=success, drawn=drawn))
    (effect,) = factor_effects(found)
    assert effect.spread > 0.4
    assert effect.p_value > 0.05


def test_scenes_of_the_same_number_in_two_cells_are_two_episodes():
    episodes = [
        Episode(arm="a", cell=cell, scene=str(i), outcome="success", drawn={"light": f"{cell}{i % 2}"})
        for cell in ("x", "y")
        for i in range(4)
    ]
    (effect,) = factor_effects([e.trial for e in episodes])
    assert {level: rate.episodes for level, rate in effect.levels.items()} == {"x0": 2, "x1": 2, "y0": 2, "y1": 2}


def test_hard_scenes_that_all_arms_met_are_no_effect_of_a_factor(monkeypatch):
    assert false_alarms(monkeypatch, 200) <= 0.09, "0.2 if each arm is permuted alone"


@pytest.mark.slow
@pytest.mark.parametrize("simulation", [{"arms": 17}, {"arms": 3, "missing": 0.2}])
def test_false_alarms_do_not_depend_on_the_arms(monkeypatch, simulation):
    assert false_alarms(monkeypatch, 200, **simulation) <= 0.09


def test_an_effect_on_scenes_that_all_arms_met_is_found():
    (effect,) = factor_effects(trials_of_arms(2.0))
    assert effect.p_value < 0.01
    assert effect.levels["bright"].rate > effect.levels["dim"].rate
    (effect,) = factor_effects(trials_of_arms(2.0, arms=3, missing=0.1))
    assert effect.p_value < 0.01, "also where some arms lack scenes"


def test_a_scene_moves_together_in_all_strata_that_met_it(monkeypatch):
    monkeypatch.setattr(factors, "PERMUTATIONS", 50)
    monkeypatch.setattr(factors, "CHUNK", 100)
    # strata a and b met scenes 0 to 9, a alone met 10 to 12; a residual names its stratum and its scene
    met = [("a", scene) for scene in range(13)] + [("b", scene) for scene in range(10)]
    found = [Trial(episode=f"{s}{i}", stratum=s, scene=f"{i:02d}", success=True, drawn={}) for s, i in met]
    residuals = np.array([100.0 * (stratum == "b") + scene for stratum, scene in met])
    shuffled = np.concatenate(list(factors._shuffles(found, residuals, np.random.default_rng(0))))
    assert shuffled.shape == (50, 23)
    assert (shuffled[:, 13:] == shuffled[:, :10] + 100).all()
    assert (np.sort(shuffled[:, :10]) == np.arange(10)).all()
    assert (np.sort(shuffled[:, 10:13]) == [10, 11, 12]).all()
    assert len(np.unique(shuffled, axis=0)) > 40


def test_policies_that_met_a_scene_share_it():
    one, other = (Episode(arm=arm, cell="x", scene="3", outcome="success").trial for arm in "ab")
    assert one.scene == other.scene
    assert one.episode != other.episode
    for elsewhere in ({"replicate": 1}, {"cell": "y"}, {"scene": "4"}):
        given = {"arm": "a", "cell": "x", "scene": "3", "outcome": "success"} | elsewhere
        assert Episode(**given).trial.scene != one.scene


@pytest.mark.slow
def test_factors_without_an_effect_are_seldom_found():
    alarms = sum(any(e.adjusted <= 0.05 for e in factor_effects(trials(0.0, seed=s, cells=3))) for s in range(200))
    assert alarms / 200 <= 0.09
