"""Known answers: a server plays the expert's actions in each convention; a remote policy must succeed with them.

For each convention the expert solves episodes. Its actions are written in the convention's numbers, served over
openpi's wire and executed in the same scenes. The headline is the lowest success rate of a convention.
``--log FILE`` keeps each episode's result; the same command continues.
"""

from collections import Counter
from pathlib import Path

from benchmarks._harness import Bench
from played_answers import play_episode

from roboxim_core.config import digest, to_plain
from roboxim_core.config_folders import config_names
from roboxim_core.conventions import Convention, load_convention
from roboxim_core.errors import EvaluationError
from roboxim_core.plain_data.results_log import ResultsLog
from roboxim_runs.episodes.expert_episode import expert_episode


def main() -> None:
    """Measure and print."""
    bench = Bench(
        "known_answers",
        __doc__,
        lambda parser: (
            parser.add_argument("--episodes", type=int, default=100, help="episodes of each convention (default: 100)"),
            parser.add_argument("--conventions", default="", help="comma-separated names; default: all"),
            parser.add_argument("--log", type=Path, metavar="FILE", help="keep results in FILE, and continue from it"),
        ),
    )
    names = [name for name in bench.options.conventions.split(",") if name] or config_names("conventions")
    conventions = {name: load_convention(name) for name in (names[:2] if bench.quick else names)}
    log = ResultsLog(bench.options.log) if bench.options.log else None
    results = {entry.key: entry.data for entry in log.read()} if log else {}
    episodes = range(1 if bench.quick else bench.options.episodes)
    for index in episodes:
        measure(conventions, index, results, log)
    rates = [row(bench, convention, episodes, results) for convention in conventions.values()]
    bench.finish("lowest success rate of a convention", min(rates), "", at_least=0.99)


def key_of(convention: Convention, index: int) -> str:
    """Return the key of a result."""
    return digest({"convention": to_plain(convention), "index": index})


def measure(conventions: dict[str, Convention], index: int, results: dict[str, dict], log: ResultsLog | None) -> None:
    """Play one episode in each convention that has no result of it; conventions of a rate share the expert's."""
    for rate in sorted({convention.rate_hz for convention in conventions.values()}):
        missing = {
            name: convention
            for name, convention in conventions.items()
            if convention.rate_hz == rate and key_of(convention, index) not in results
        }
        if not missing:
            continue
        try:
            episode = expert_episode("", rate_hz=rate, index=index, attempts=1)
        except EvaluationError:
            episode = None
        for name, convention in missing.items():
            found = {"convention": name, "outcome": "expert failed", "reason": "", "clipped": 0}
            if episode is not None:
                result = play_episode(convention, episode, index)
                found |= {"outcome": str(result.outcome), "reason": str(result.reason), "clipped": result.clipped}
            results[key_of(convention, index)] = found
            if log is not None:
                log.append(key_of(convention, index), found)


def row(bench: Bench, convention: Convention, episodes: range, results: dict[str, dict]) -> float:
    """Add a convention's row; return its success rate. Results of an earlier form of the convention do not count."""
    mine = [results[key_of(convention, index)] for index in episodes]
    played = [result for result in mine if result["outcome"] != "expert failed"]
    solved = sum(result["outcome"] == "success" for result in played)
    failures = Counter(result["reason"] for result in played if result["outcome"] != "success")
    bench.row(
        convention=convention.name, solved=solved, played=len(played), expert_failed=len(mine) - len(played),
        clipped=sum(result["clipped"] for result in played),
        failures=", ".join(f"{count} {reason}" for reason, count in sorted(failures.items())),
    )  # fmt: skip
    return solved / max(len(played), 1)


if __name__ == "__main__":
    main()
