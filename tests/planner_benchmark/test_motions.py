"""The summary of a benchmark counts infeasible problems separately."""

from __future__ import annotations

from dataclasses import replace

from benchmark_values import ball_at_the_start


def test_an_unsolved_problem_counts_unless_it_is_proved_infeasible() -> None:
    from benchmarks.planner._contenders import OURS, Outcome
    from benchmarks.planner._motions import INFEASIBLE, Store, infeasible, summary
    from benchmarks.planner._problems import tabletop

    free = tabletop(1)
    blocked = replace(free, name="tabletop-2", solids=(*free.solids, ball_at_the_start(free)))
    draws = [("tabletop-1", 1, lambda: free), ("tabletop-2", 2, lambda: blocked), ("tabletop-3", 3, lambda: free)]
    store = Store(None)
    store.put(Outcome(problem="tabletop-3", contender="search", ms=0.0, error=f"{INFEASIBLE}the goal collides"))
    outcomes = [Outcome(problem=name, contender=OURS, ms=1.0, error="no path") for name, _, _ in draws]
    proved = infeasible(outcomes, draws, store, search_s=0.0)
    assert proved == {"tabletop-2", "tabletop-3"}
    row = summary(outcomes, OURS, proved)
    assert (row["count"], row["unsolved"], row["infeasible"], row["valid_share"]) == (1, 1, 2, 0.0)
