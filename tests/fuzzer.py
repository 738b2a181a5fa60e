"""A fuzzer over every service and action of a running graph, made from the interface definitions.

There are two kinds of requests: random ones, field by field (extremes, NaN, empty, huge, wrong names, random bytes),
and valid ones from a corpus with one or two fields changed, which reach deeper. The graph runs in a separate process,
so that the fuzzer detects its end.

From the command line, with a table of the responses::

    .venv/bin/python tests/fuzzer.py --requests 40 --seed 1
"""

from __future__ import annotations

import argparse
import json
import random
import re
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from fuzzed_graph import EPISODE_S, STOP_AFTER_S, Live, corpus, live_graph
from fuzzed_messages import Maker, interface

PARAMETERS = re.compile(r"parameter|type_description")
"""Services that rclpy offers for every node; called in every fifth round only."""


@dataclass
class Report:
    """Statistics of the requests and their responses."""

    answers: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    """Counts of responses by service: ``accepted`` or the error's name."""
    slowest: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    """Slowest response by service [s]."""
    internal: list[str] = field(default_factory=list)
    """Responses with ``INTERNAL``, which no request should get."""
    rss_mib: list[float] = field(default_factory=list)
    """Resident memory of the graph's process after each round [MiB]."""

    def table(self) -> str:
        """Return the table of the documentation."""
        lines = [
            "| service or action | requests | accepted | refused | slowest [s] | errors |",
            "| - | -: | -: | -: | -: | - |",
        ]
        for name, answers in sorted(self.answers.items()):
            total, accepted = sum(answers.values()), answers["accepted"]
            errors = ", ".join(f"{code} {n}" for code, n in answers.most_common() if code != "accepted")
            lines.append(
                f"| `{name}` | {total} | {accepted} | {total - accepted} | {self.slowest[name]:.1f} | {errors} |"
            )
        everything = sum((answers for answers in self.answers.values()), Counter())
        total = sum(everything.values())
        lines.append(f"| all | {total} | {everything['accepted']} | {total - everything['accepted']} | | |")
        return "\n".join(lines)


def verdict(answer: Any) -> tuple[str, str]:
    """Return ``accepted`` or the name of the error in a response or result, and its message."""
    from roboxim_core.errors import ErrorCode

    fields = answer.get_fields_and_field_types()
    if "error_code" in fields and "error_msg" in fields:
        return ("accepted" if not answer.error_code else ErrorCode(answer.error_code).name), answer.error_msg
    if fields.get("result") == "simulation_interfaces/Result":
        message = answer.result.error_message
        named = re.match(r"([A-Z_]+):", message)
        return ("accepted" if answer.result.result == 1 else named[1] if named else "REFUSED"), message
    if "error_code" in fields and "error_string" in fields:
        named = re.match(r"([A-Z_]+):", answer.error_string)
        return ("accepted" if not answer.error_code else named[1] if named else "REFUSED"), answer.error_string
    results = list(getattr(answer, "results", [])) if "SetParametersResult" in str(fields.get("results")) else []
    if fields.get("result") == "rcl_interfaces/SetParametersResult":
        results = [answer.result]
    if any(not result.successful for result in results):
        return "REFUSED", results[0].reason
    if fields.get("successful") == "boolean" and not answer.successful:
        return "REFUSED", ""
    return "accepted", ""


class Fuzzer:
    """Fuzzes a live graph."""

    def __init__(self, live: Live, seed: int) -> None:
        """List the graph's services and actions, and build the corpus."""
        self.live, self.rng = live, random.Random(seed)
        self.maker = Maker(self.rng)
        self.report = Report()
        self.corpus = corpus(live)
        node = live.clients.node
        services = {
            name.lstrip("/"): kinds[0]
            for name, kinds in node.get_service_names_and_types()
            if not name.startswith("/fuzzer")
        }
        self.actions = {
            name.removesuffix("/_action/send_goal"): kind.removesuffix("_SendGoal")
            for name, kind in services.items()
            if name.endswith("/_action/send_goal")
        }
        self.services = {name: kind for name, kind in services.items() if "/_action/" not in name}

    def run(self, requests: int, until: float = float("inf")) -> Report:
        """Send some requests to every service and action, in rounds.

        Args:
            requests: Number of requests to each.
            until: Time on the monotonic clock after which no further round starts.
        """
        doors = [("service", name) for name in sorted(self.services)] + [
            ("action", name) for name in sorted(self.actions)
        ]
        for number in range(requests):
            self.rng.shuffle(doors)
            chosen = [door for door in doors if number % 5 == 0 or not PARAMETERS.search(door[1])]
            for place, (kind, name) in enumerate(chosen):
                if place % 12 == 0:
                    self.heal()
                (self.service if kind == "service" else self.action)(name)
                if time.monotonic() > until:
                    break
            self.report.rss_mib.append(self.live.rss_mib())
            if time.monotonic() > until:
                break
        return self.report

    def heal(self) -> None:
        """Prepare the graph so that requests reach deep: load a scene and release it."""
        from roboxim_interfaces.srv import LoadScene, ReleaseEpisode

        self.live.call(ReleaseEpisode, "sim/release_episode", ReleaseEpisode.Request())
        answer = self.live.call(LoadScene, "sim/load_scene", self.corpus["sim/load_scene"]())
        assert answer.error_code == 0, f"the graph no longer takes a valid scene: {answer.error_msg}"

    def request(self, name: str, cls: Any) -> Any:
        """Return a random request, or a valid one with changed fields."""
        if name in self.corpus and self.rng.random() < 0.75:
            request = self.corpus[name]()
            for _ in range(self.rng.choice((0, 1, 1, 1, 2))):
                self.maker.mutate(request)
            return request
        return self.maker.message(cls)

    def note(self, name: str, answer: Any, began: float) -> None:
        """Note an answer."""
        code, message = verdict(answer)
        self.report.answers[name][code] += 1
        self.report.slowest[name] = max(self.report.slowest[name], time.monotonic() - began)
        if code == "INTERNAL":
            self.report.internal.append(f"{name}: {message}")

    def service(self, name: str) -> None:
        """Call a service once and check that it responds."""
        cls = interface(self.services[name])
        request = self.request(name, cls.Request)
        began = time.monotonic()
        if name == "sim/step_simulation":
            answer = self.stopped(lambda: self.live.call(cls, name, request))
        else:
            answer = self.live.call(cls, name, request)
        self.note(name, answer, began)

    def stopped(self, call: Callable[[], Any]) -> Any:
        """Make a call that may take long and stop it after a while."""
        import threading

        from simulation_interfaces.msg import SimulationState
        from simulation_interfaces.srv import SetSimulationState

        box: list[Any] = []
        thread = threading.Thread(target=lambda: box.append(call()), daemon=True)
        thread.start()
        thread.join(STOP_AFTER_S)
        while thread.is_alive():
            pause = SetSimulationState.Request(state=SimulationState(state=SimulationState.STATE_PAUSED))
            self.live.call(SetSimulationState, "sim/set_simulation_state", pause)
            thread.join(STOP_AFTER_S)
        return box[0]

    def action(self, name: str) -> None:
        """Send a goal once, cancel it after a while and check that it ends."""
        from roboxim_core.errors import RequestTimeoutError
        from roboxim_ros.actions import ActionCall

        cls = interface(self.actions[name])
        key = name if name in self.corpus and name not in self.services else f"action {name}"
        goal = self.request(key, cls.Goal)
        began = time.monotonic()
        with ActionCall(self.live.clients, cls, name) as call:
            box: list[Any] = []
            try:
                ended = call.run(goal, timeout_s=STOP_AFTER_S)
            except RequestTimeoutError:  # cancels the goal; the graph must be free for the next one
                del box
                self.report.answers[f"{name} (action)"]["cancelled"] += 1
                return
        code, message = verdict(ended.result)
        if code == "accepted" and ended.status != "succeeded":
            code = ended.status
        self.report.answers[f"{name} (action)"][code] += 1
        key = f"{name} (action)"
        self.report.slowest[key] = max(self.report.slowest[key], time.monotonic() - began)
        if code == "INTERNAL":
            self.report.internal.append(f"{name}: {message}")


def episode_hash(live: Live) -> str:
    """Run an episode through the graph and return the hash of its last state."""
    from roboxim_interfaces.action import RunEpisodes
    from roboxim_interfaces.msg import RunConfig
    from roboxim_interfaces.srv import ReleaseEpisode

    from roboxim_ros.actions import ActionCall

    live.call(ReleaseEpisode, "sim/release_episode", ReleaseEpisode.Request())
    config = RunConfig(
        run_seed=3, purpose="test", actor="policy", image_width=32, image_height=32, max_steps=8, settle_ticks=1,
        keep="none",
    )  # fmt: skip
    with ActionCall(
        live.clients, RunEpisodes, "evaluator/run_episodes"
    ) as action:  # it has no limit, unlike the service
        answer = action.run(RunEpisodes.Goal(config=config, indices=[0]), timeout_s=EPISODE_S).result
    assert answer.error_code == 0, answer.error_msg
    return str(answer.results[0].final_state_hash)


def main() -> int:
    """Fuzz a graph and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--requests", type=int, default=20, help="requests to each service and action")
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder, live_graph(Path(folder)) as live:
        before = episode_hash(live)
        fuzzer = Fuzzer(live, options.seed)
        try:
            report = fuzzer.run(options.requests)
            same = episode_hash(live) == before
        finally:
            print(fuzzer.report.table())  # noqa: T201
            print("\n".join(Counter(fuzzer.report.internal)) or "no INTERNAL error")  # noqa: T201
            print("memory [MiB]", json.dumps([round(value) for value in fuzzer.report.rss_mib]))  # noqa: T201
            if live.process.poll() is not None:
                print((Path(folder) / "graph.log").read_text()[-5000:])  # noqa: T201
            Path("/tmp/fuzz_graph.log").write_bytes((Path(folder) / "graph.log").read_bytes()[-5_000_000:])
    print("the same episode as before:", same)  # noqa: T201
    return 0 if same and not report.internal else 1


if __name__ == "__main__":
    sys.exit(main())
