"""Known answers: a server plays the expert's actions in each convention; a remote policy must succeed with them.

For each convention the expert solves episodes. Its actions are written in the convention's numbers, served over
openpi's wire and executed in the same scenes. The headline is the lowest success rate of a convention.
"""

from benchmarks._harness import Bench

from roboxim_bringup.known_answers import play_expert
from roboxim_core.config_folders import config_names
from roboxim_core.conventions import load_convention


def main() -> None:
    """Measure and print."""
    bench = Bench(
        "known_answers",
        __doc__,
        lambda parser: (
            parser.add_argument("--episodes", type=int, default=100, help="episodes of each convention (default: 100)"),
            parser.add_argument("--conventions", default="", help="comma-separated names; default: all"),
        ),
    )
    names = [name for name in bench.options.conventions.split(",") if name] or config_names("conventions")
    count = 1 if bench.quick else bench.options.episodes
    rates = []
    for name in names[:2] if bench.quick else names:
        convention = load_convention(name)
        results = [play_expert(convention, index) for index in range(count)]
        played = [result for result in results if result is not None]
        solved = sum(result.outcome == "success" for result in played)
        clipped = sum(result.clipped for result in played)
        rates.append(solved / max(len(played), 1))
        failed = sorted({f"{result.reason}" for result in played if result.outcome != "success"})
        bench.row(
            convention=name, solved=solved, played=len(played), expert_failed=count - len(played), clipped=clipped,
            failures=", ".join(failed),
        )  # fmt: skip
    bench.finish("lowest success rate of a convention", min(rates), "", at_least=0.99)


if __name__ == "__main__":
    main()
