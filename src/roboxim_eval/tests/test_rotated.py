"""Rotated designs: their held-out sets, and how often the intervals over simulated experiments hold."""

import json
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from planted_cards import planted_card

from roboxim_core.config import load_yaml, named_config, to_plain
from roboxim_core.errors import ConfigError
from roboxim_eval.experiments import design_of, experiment_config
from roboxim_eval.experiments.cells import cells_of
from roboxim_eval.experiments.rotation import held_out_sets, joined, rotated
from roboxim_eval.statistics.rotated import Part, rotated_score
from roboxim_eval.statistics.tables import Arm, Count


def laptop(name="skill_object"):
    return experiment_config(load_yaml(named_config("experiments", name)), scale="laptop")


@pytest.mark.parametrize(("sets", "held_out"), [(3, 6), (6, 3), (9, 2), (3, 4), (4, 3), (18, 1)])
def test_sets_are_disjoint_balanced_and_leave_every_level_to_be_seen(sets, held_out):
    cells = cells_of(laptop())
    found = held_out_sets(cells, sets, held_out)
    assert [len(one) for one in found] == [held_out] * sets
    assert max(Counter(cell.key for one in found for cell in one).values()) == 1
    for one in found:
        out = {cell.key for cell in one}
        for factor in ("task", "target"):
            counts = Counter(cell.levels[factor] for cell in one)
            levels = {cell.levels[factor] for cell in cells}
            assert max(counts.values()) - min(counts.get(level, 0) for level in levels) <= 1
            assert {cell.levels[factor] for cell in cells if cell.key not in out} == levels
    assert held_out_sets(cells, sets, held_out) == found


@pytest.mark.parametrize(
    ("sets", "held_out", "said"),
    [(2, 3, "at least 3"), (6, 4, "at most 3 a set, or fewer"), (3, 0, "need"), (19, 1, "has 18; give fewer sets$")],
)
def test_sets_that_do_not_exist_are_refused(sets, held_out, said):
    with pytest.raises(ConfigError, match=said):
        held_out_sets(cells_of(laptop()), sets, held_out)


def parts_of(sets=6, held_out=3, replicates=1):
    return [design_of(one) for one in rotated(laptop(), sets, held_out, replicates)]


def test_parts_are_experiments_with_seeds_of_their_own_and_datasets_of_equal_size():
    designs = parts_of(replicates=2)
    seeds = [training.seed for design in designs for training in design.trainings]
    assert sorted(set(seeds)) == list(range(12))
    sizes = {sum(design.datasets[name].values()) for design in designs for name in ("leave_out", "baseline")}
    assert sizes == {324}, "21 or 22 of each of 15 cells, where 12 cells had 27, and 18 of each of 18"
    config = replace(laptop(), replicates=replace(laptop().replicates, first_seed=40))
    assert [one.replicates.first_seed for one in rotated(config, 3, 3, 2)] == [40, 42, 44]


def test_a_part_without_an_own_seed_is_written_as_before():
    assert "first_seed" not in json.dumps(to_plain(laptop()))


def test_cards_of_parts_are_joined_and_others_are_refused():
    rate = {"leave_out": 0.5, "baseline": 0.8, "blind": 0.05}
    cards = [planted_card(d, lambda c, _: rate[c], seed=n) for n, d in enumerate(parts_of())]
    found = joined(cards)
    assert (found.sets, found.cells, found.trainings) == (6, 3, 1)
    assert found.gap_of_all_cells.low < 0.3 < found.gap_of_all_cells.high
    assert found.p_value < 0.01
    with pytest.raises(ConfigError, match="held out in two parts"):
        joined([*cards[:3], cards[0]])
    other = replace(cards[1].experiment.config, about="Another?")
    with pytest.raises(ConfigError, match='more than the held-out set: about: .* in the first card, "Another'):
        joined([cards[0], replace(cards[1], experiment=replace(cards[1].experiment, config=other)), cards[2]])
    foreign = replace(cards[1], experiment=replace(cards[1].experiment, trainer="external"))
    with pytest.raises(ConfigError, match="different trainers: bc and external"):
        joined([cards[0], foreign, cards[2]])
    with pytest.raises(ConfigError, match="at least 3 parts"):
        joined(cards[:2])


@pytest.mark.parametrize(
    "changed", [lambda compare: (), lambda compare: (replace(compare[0], where="seen"),)], ids=["nothing", "seen cells"]
)
def test_cards_of_no_rotated_design_are_said_to_be_none(changed):
    card = planted_card(parts_of()[0], lambda *_: 0.5)
    config = replace(card.experiment.config, compare=changed(card.experiment.config.compare))
    other = replace(card, experiment=replace(card.experiment, config=config))
    with pytest.raises(ConfigError, match="no part of a rotated design.*'roboxim experiment rotate' wrote"):
        joined([other] * 3)


def test_an_experiment_with_combinations_is_not_rotated():
    with pytest.raises(ConfigError, match="with combinations is not rotated"):
        rotated(laptop("combinations"), 3, 3, 1)


def parts_with(rows):
    """Return parts of one training and three cells: successes of 20 of the leave-out condition and of the baseline."""
    return [Part(first=arm([low], [[20] * 3]), second=arm([high], [[20] * 3])) for low, high in rows]


@pytest.mark.parametrize("low", range(14, 20))
def test_p_is_below_5_percent_where_the_interval_excludes_0(low):
    found = rotated_score(parts_with([([low] * 3, [20] * 3)] * 3))
    assert found.gap.p_value < 0.05, "Student's t alone"
    assert (found.p_value < 0.05) == (found.gap_of_all_cells.low > 0)


def test_a_cell_without_episodes_does_not_narrow_the_interval():
    def width(*cells):
        one = arm([[won for won, _ in cells]] * 2, [[many for _, many in cells]] * 2)
        gap = rotated_score([Part(first=one, second=one)] * 3).gap_of_these_cells
        return gap.high - gap.low

    assert width((18, 20), (18, 20), (0, 0)) == pytest.approx(width((18, 20), (18, 20)))


# ------------------------------------------------------------------ coverage

EXPERIMENTS = 2000
DESIGNS = ((6, 3, 1), (3, 6, 2))
"""Held-out sets, cells of each, trainings of each condition in each."""
RATES = ((0.5, 0.5), (0.85, 0.85), (0.96, 0.96), (0.96, 0.8), (0.05, 0.05))
"""Baseline and leave-out condition."""
SPREADS = (0.0, 0.05, 0.15)
CELL_SPREAD = 0.15
INTERVALS = ("absolute", "baseline", "gap", "these")


def beta(mean, spread, quantile):
    """Return quantiles of beta distributions with these means; a spread that a mean does not allow is reduced."""
    from scipy.stats import beta as law

    spread = np.minimum(spread, 0.6 * np.sqrt(mean * (1 - mean)))
    size = mean * (1 - mean) / np.maximum(spread, 1e-6) ** 2 - 1
    found = law.ppf(quantile, mean * size, (1 - mean) * size)
    return np.where(spread > 1e-4, found, mean)


def simulated(rng, rates, spread, shape, experiments, unequal):
    """Return rates of cells, successes and rollouts, (experiments, 2, sets, trainings, cells).

    All cells of a training are better or worse together. Unequal cells lack a twentieth of their rollouts at random.
    """
    sets, cells, trainings = shape
    means = np.array(rates)[None, :, None, None] * np.ones((experiments, 2, sets, cells))
    of_cells = beta(means, CELL_SPREAD, rng.random((experiments, 1, sets, cells)))  # a hard cell is hard for both
    training = rng.random((experiments, 2, sets, trainings, 1))
    p = beta(of_cells[:, :, :, None, :], spread, training)
    many = np.full(p.shape, 20)
    if unequal:
        many = rng.binomial(np.resize([8, 12, 20, 40], cells), 0.95, p.shape).clip(1)
    return of_cells, rng.binomial(many, p), many


def arm(successes, many):
    return Arm(replicates=tuple(
        {str(c): Count(successes=int(k), episodes=int(n)) for c, (k, n) in enumerate(zip(*row, strict=True))}
        for row in zip(successes, many, strict=True)
    ))  # fmt: skip


def coverage(rates, spread, shape, *, unequal=False, experiments=EXPERIMENTS):
    """Return the share of experiments whose intervals hold, and the share that call equal conditions different."""
    rng = np.random.default_rng([round(1000 * r) for r in (*rates, spread)] + [*shape, unequal])
    of_cells, successes, many = simulated(rng, rates, spread, shape, experiments, unequal)
    held, false = Counter(), 0
    truth = {"absolute": rates[1], "baseline": rates[0], "gap": rates[0] - rates[1]}
    for number in range(experiments):
        score = rotated_score([
            Part(first=arm(successes[number, 1, s], many[number, 1, s]),
                 second=arm(successes[number, 0, s], many[number, 0, s]))
            for s in range(shape[0])
        ])  # fmt: skip
        gap = score.gap_of_all_cells
        intervals = {"absolute": score.absolute, "baseline": score.baseline, "gap": gap}
        for name, interval in intervals.items():
            held[name] += interval.low <= truth[name] <= interval.high
        these = float((of_cells[number, 0] - of_cells[number, 1]).mean())
        fixed = score.gap_of_these_cells
        held["these"] += fixed.low <= these <= fixed.high
        false += score.p_value < 0.05
    return {name: held[name] / experiments for name in INTERVALS} | {"false": false / experiments}


def cases():
    return [(shape, unequal, rates, spread) for shape in DESIGNS for unequal in (False, True)
            for rates in RATES for spread in SPREADS]  # fmt: skip


@pytest.mark.thorough
@pytest.mark.parametrize("rates", [(0.85, 0.85), (0.96, 0.8)])
def test_intervals_hold_in_some_simulated_experiments(rates):
    found = coverage(rates, 0.1, DESIGNS[0], unequal=True, experiments=150)
    assert min(found[name] for name in INTERVALS) >= 0.9, found


def holds(shape, unequal, rates, spread):
    found = coverage(rates, spread, shape, unequal=unequal)
    return min(found[name] for name in INTERVALS) >= 0.94 and (rates[0] != rates[1] or found["false"] <= 0.05)


@pytest.mark.thorough
@pytest.mark.parametrize("shape", DESIGNS, ids=str)
def test_every_interval_holds_near_the_ceiling_where_trainings_differ_most(shape):
    assert holds(shape, True, (0.96, 0.96), 0.15)


@pytest.mark.slow
@pytest.mark.parametrize("case", cases(), ids=str)
def test_every_interval_holds_and_verdicts_are_rarely_false(case):
    """The table of docs/explanation/statistics.md: run this file as a program."""
    assert holds(*case)


def main():
    """Print the table of docs/explanation/statistics.md: lowest coverages, highest share of false verdicts."""
    for shape in DESIGNS:
        for rates in RATES:
            found = [coverage(rates, spread, shape, unequal=u) for u in (False, True) for spread in SPREADS]
            least = [
                f"{100 * min(one[name] for one in found):.1f} %" for name in ("absolute", "baseline", "gap", "these")
            ]
            false = f"{100 * max(one['false'] for one in found):.1f} %" if rates[0] == rates[1] else "-"
            print(f"| {shape[0]} x {shape[1]} x {shape[2]} | {100 * rates[0]:g} %, {100 * rates[1]:g} % | "  # noqa: T201
                  f"{' | '.join([*least, false])} |", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
