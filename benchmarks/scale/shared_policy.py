"""Batching: answers per second of one slow policy that 4 simulators share, over those that one simulator gets.

The policy takes 50 ms for a batch of any size, as a model on a GPU does; it waits, so it takes no processor time from
the simulators. Scenes without cameras. The start of workers is not counted.
"""

import tempfile
import time
from pathlib import Path

from benchmarks._harness import Bench

from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.events import EpisodeFinished, Event
from roboxim_runs.executors import LocalExecutor

ANSWER_S = 0.05
SIMULATORS = (1, 4)
POLICY = f"""
import threading
import time

from roboxim_core.actions import hold_action
from roboxim_policies import BasePolicy


class Slow(BasePolicy):
    def another(self):
        return Slow()

    @classmethod
    def act_batch(cls, policies, windows):
        threading.Event().wait({ANSWER_S})
        with open({{log!r}}, "a") as file:
            file.write(f"{{{{time.time()}}}} {{{{len(windows)}}}}\\n")
        return [hold_action(1.0)] * len(windows)

    def act(self, window):
        return self.act_batch([self], [window])[0]
"""
TASK = """
skill: pick_up
objects: {target: {models: {values: [cube]}}}
visible: {cameras: []}
reset: {cameras: {names: []}}
"""


def main() -> None:
    """Measure and print."""
    bench = Bench("shared_policy", __doc__)
    rates = {}
    for simulators in SIMULATORS:
        episodes, steps = (3 if bench.quick else 6) * simulators, 40 if bench.quick else 150
        rates[simulators] = answers_per_second(simulators, episodes, steps)
        bench.row(simulators=simulators, episodes=episodes, answers_per_s=round(rates[simulators], 1))
    one, several = (rates[number] for number in SIMULATORS)
    bench.finish("answers of a 50 ms policy for 4 simulators, over 1", round(several / one, 2), "", at_least=2.5)


def answers_per_second(simulators: int, episodes: int, steps: int) -> float:
    """Return the rate while all simulators act: none has its first episode before it, none its last one after it."""
    ends: list[float] = []

    def note(event: Event) -> None:
        if isinstance(event, EpisodeFinished):
            ends.append(time.time())

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "slow.py").write_text(POLICY.format(log=str(folder / "answers")))
        (folder / "task.yaml").write_text(TASK)
        config = EvaluationConfig(
            policies=f"slow={folder}/slow.py:Slow", task=str(folder / "task.yaml"), out=folder / "run",
            episodes=episodes, max_steps=steps, workers=simulators,
        )  # fmt: skip
        evaluate(config, on_event=note, servers=[LocalExecutor(1, log_dir=folder / "logs")])
        lines = [line.split() for line in (folder / "answers").read_text().splitlines()]
    begin, end = ends[simulators - 1], ends[episodes - simulators]
    return sum(int(size) for at, size in lines if begin < float(at) <= end) / (end - begin)


if __name__ == "__main__":
    main()
