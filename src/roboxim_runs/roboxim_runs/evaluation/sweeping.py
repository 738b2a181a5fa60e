"""Chooses the best of many checkpoints by successive halving, and measures it in fresh scenes.

The scenes of the choice and the fresh scenes are two evaluations in two folders. The choice has scenes of purpose
``train``, so that no evaluation has them, with any seed. The same call continues an interrupted sweep.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roboxim_core.errors import ConfigError, counted
from roboxim_core.whole_files import write_json
from roboxim_policies.learning.checkpoint_file import checkpoint_file, family_in, read_description
from roboxim_runs.evaluation.results import EvaluationResult
from roboxim_runs.evaluation.run import EvaluationConfig, evaluate
from roboxim_runs.events import Notice, OnEvent, ignore
from roboxim_runs.executors import Cancellation, Executor
from roboxim_runs.policies.specs import CHECKPOINT, PolicySpec
from roboxim_runs.storage.occupied import require_own

if TYPE_CHECKING:
    from roboxim_eval.answers.halving import Choice, HalvingConfig
    from roboxim_eval.statistics.rates import SuccessRate

RESULT = "sweep.json"
"""File with the rounds, the winner and its rate."""
CHOOSING = "choosing"
"""Folder in a sweep's of the evaluation that chooses."""
SEED_STEP = 1_000_003
"""What is added to the seed for fresh scenes."""


@dataclass(frozen=True, kw_only=True)
class SweepResult:
    """Result of a sweep."""

    choice: Choice
    """The rounds."""
    winner: PolicySpec
    """The chosen policy."""
    fresh: SuccessRate
    """Its rate in fresh scenes."""
    evaluation: EvaluationResult
    """These scenes."""


def checkpoint_policies(checkpoints: Sequence[Path]) -> list[PolicySpec]:
    """Return the policies of checkpoints, named by their folders or files.

    Args:
        checkpoints: Files, or folders of trainings, of any family.

    Raises:
        ConfigError: When one is missing, damaged or named twice.
    """
    policies: list[PolicySpec] = []
    files: set[Path] = set()
    for path in checkpoints:
        family = family_in(read_description(path))
        file = checkpoint_file(path)
        if file.resolve() in files:
            raise ConfigError(f"{path} is named twice: it would only tie with itself")
        files.add(file.resolve())
        name = file.resolve().parent.name if file.name == "checkpoint.npz" else file.stem
        name = re.sub(r"[^\w-]", "-", name).lstrip("-") or family  # of the trainings of an experiment, e.g. baseline.0
        policies.append(PolicySpec(spec=family, name=name, options={CHECKPOINT: str(path)}))
    counts = Counter(policy.name for policy in policies)
    taken = set(counts)
    for place, policy in enumerate(policies):
        if counts[policy.name] > 1:
            numbered = (f"{policy.name}-{number}" for number in itertools.count(place + 1))
            policies[place] = replace(policy, name=next(name for name in numbered if name not in taken))
            taken.add(policies[place].name)
    return policies


def sweep(
    policies: Sequence[PolicySpec],
    config: EvaluationConfig,
    halving: HalvingConfig,
    *,
    on_event: OnEvent = ignore,
    cancellation: Cancellation | None = None,
    executor: Executor | None = None,
) -> SweepResult:
    """Choose the best of several policies, and measure it in fresh scenes.

    Args:
        policies: The policies, each with a unique name.
        config: The scenes; its policies, number of episodes and purpose are not used.
        halving: Number of scenes.
        on_event: Receives the events of all evaluations.
        cancellation: Ends the call when it is set; the same call continues.
        executor: Runs the episodes; none: processes of this machine.

    Raises:
        CancelledError: When the call was cancelled.
        ConfigError: When there are not two policies of different names, only a shard is to be run, or ``out`` is no
            sweep's folder.
        RoboximError: As of `evaluate`.
    """
    from roboxim_eval.answers.halving import choose

    if config.shard:
        raise ConfigError("a shard has a part of the scenes and cannot choose; run all of them (no --shard)")
    by_name = {policy.name or policy.spec: policy for policy in policies}
    if len(by_name) < len(policies):
        raise ConfigError("two policies of a sweep have one name; name them apart")
    out = Path(config.out)
    require_own(out, "sweep", own=(RESULT, CHOOSING))

    def played(names: Sequence[str], scenes: int, part: str, **different: Any) -> EvaluationResult:
        wanted = replace(
            config, policies=[by_name[name] for name in names], out=out / part, episodes=scenes, page=False, **different
        )
        found = evaluate(wanted, on_event=on_event, cancellation=cancellation, executor=executor)
        found.require_measured()
        return found

    def play(names: Sequence[str], scenes: int) -> Mapping[str, Sequence[bool]]:
        on_event(Notice(text=f"{counted(len(names), 'policy', 'policies')}, {counted(scenes, 'scene')}"))
        found = played(names, scenes, CHOOSING, purpose="train")
        return {name: [r.outcome == "success" for r in found[name].results] for name in names}

    for scenes in (halving.most(len(by_name)), halving.fresh):
        replace(config, episodes=scenes)  # refuses too many before the first scene
    choice = choose(list(by_name), play, halving)
    on_event(Notice(text=f"{choice.winner} is chosen; {counted(halving.fresh, 'fresh scene')}"))
    evaluation = played([choice.winner], halving.fresh, "fresh", purpose="eval", seed=config.seed + SEED_STEP)
    rate = evaluation[choice.winner].rate
    result = {"rounds": [asdict(one) for one in choice.rounds], "winner": choice.winner, "fresh": asdict(rate)}
    write_json(out / RESULT, result)
    return SweepResult(choice=choice, winner=by_name[choice.winner], fresh=rate, evaluation=evaluation)
