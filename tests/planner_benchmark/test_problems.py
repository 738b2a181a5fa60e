"""Problems have the stated properties; infeasibility is proved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from benchmark_values import ball_at_the_start


def test_tabletop_problems_have_the_stated_properties() -> None:
    from benchmarks.planner._problems import tabletop

    problems = [tabletop(seed) for seed in range(20)]
    assert sum(p.detour for p in problems) >= 10
    assert all(p.detour for p in problems[::2])
    assert {p.held is not None for p in problems} == {True, False}
    for p in problems:
        assert 3 <= len(p.solids) - 1 <= 10
        assert not p.referee().collides(np.array(p.start))
    assert tabletop(3) == problems[3]
    assert tabletop(3, salt=1) != problems[3]


def test_every_hard_family_gives_problems() -> None:
    from benchmarks.planner._problems_hard import FAMILIES, hard

    for family in FAMILIES:
        p = hard(family, 1)
        assert p.family == family
        assert p == hard(family, 1)
        assert not p.referee().collides(np.array(p.start))


def test_the_search_distinguishes_solvable_from_enclosed_goals() -> None:
    from benchmarks.planner._exhaustive import is_solvable
    from benchmarks.planner._problems import problem, tabletop
    from benchmarks.planner._referee import Referee, Solid

    assert is_solvable(tabletop(1), 10.0)
    # walls between here and there that begin close to the base, and a roof that keeps the arm from standing upright
    turn = (0.0, 0.0, np.sin(np.pi / 8), np.cos(np.pi / 8))
    walls = [
        Solid(kind="box", size=(2.0, 0.02, 3.0), position=(side * 0.792, side * 0.792, 1.5), quat_xyzw=turn)
        for side in (-1.0, 1.0)
    ]
    roof = Solid(kind="box", size=(3.0, 3.0, 0.02), position=(0.0, 0.0, 0.85))
    referee = Referee([*walls, roof])
    here = np.array([0.0, 0.6, 0.0, -1.5, 0.0, 2.0, 0.8])
    there = here + [np.pi / 2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    assert not referee.collides(here)
    assert not referee.collides(there)
    assert not is_solvable(problem("walled-0", referee, here, there, joints=True), 1.0)


def test_infeasibility_is_proved_at_the_ends_only() -> None:
    from benchmarks.planner._exhaustive import why_infeasible
    from benchmarks.planner._problems import tabletop

    free = tabletop(1)
    assert why_infeasible(free) == ""
    assert "start collides" in why_infeasible(replace(free, solids=(ball_at_the_start(free),)))
    away = replace(free, goal=(2.0, *free.goal[1:]))
    assert "no configuration reaches" in why_infeasible(away, attempts=50)
