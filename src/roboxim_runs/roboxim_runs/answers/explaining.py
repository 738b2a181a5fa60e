"""Explains a failed episode by running it again with one thing changed."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from roboxim_core.episode import ActorPort, Draw, EpisodeInfo, EpisodeResult, RunConfig
from roboxim_core.errors import ConfigError, one_of
from roboxim_core.specs import SceneSpec
from roboxim_eval.answers.causes import Explanation, Tally, explanation, may_become_cause, not_yet_causes
from roboxim_runs.answers.changes import NAMES, Change, both, changes_of
from roboxim_runs.answers.trying import TryBench, recorded_run, seed_of

JITTER_RAD = 0.004
"""Standard deviation of each arm joint at the start of a repetition [rad]: repetitions of a policy without chance would
be one and the same run."""
MAX_PAIRS = 36
"""Largest number of pairs of changes that are tried."""


@dataclass(frozen=True, kw_only=True)
class ExplainConfig:
    """How much is tried."""

    repeats: int = 5
    """Runs of each change; fewer than 5 cannot show a cause among several changes."""
    only: tuple[str, ...] = ()
    """Names of the changes to try; empty: all."""
    pairs: bool = True
    """Whether to try pairs of changes if no single change is a cause."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            ConfigError: When a number is too small or a name unknown.
        """
        if self.repeats < 3:
            raise ConfigError(f"repeats must be at least 3, got {self.repeats}")
        for name in self.only:
            if name not in NAMES:
                raise ConfigError(f"unknown change '{name}'; {one_of(NAMES, name)}")


def explain(
    bench: TryBench, info: EpisodeInfo, actor: ActorPort, config: ExplainConfig | None = None, *,
    recorded: EpisodeResult | None = None, on_tally: Callable[[Tally], None] = lambda _: None,
    on_doubt: Callable[[str], None] = lambda _: None,
) -> Explanation:  # fmt: skip
    """Explain why an episode failed.

    The first repetition is the episode as it was recorded; the others start with slightly other joints, and other
    seeds of the policy. All changes have the same repetitions. A change that can no longer be shown to be a cause is
    given up, and taken up again if causes among the others allow it to be shown with fewer successes.

    Args:
        bench: Cores to run episodes with.
        info: The episode.
        actor: Its policy.
        config: How much is tried; none: the default.
        recorded: How the recorded episode ended, to compare its repetition with; none: unknown.
        on_tally: Called with each change when its runs are done.
        on_doubt: Called with each of the explanation's doubts, as early as possible.

    Raises:
        ConfigError: When the recorded episode succeeded, nothing can be changed, the bag does not say how it was run,
            or the policy is not the recorded one and does not repeat the outcome.
        PolicyError: When the policy raises.
        RoboximError: On a fault of the simulator.
    """
    config = config or ExplainConfig()
    if recorded is not None and recorded.outcome == "success":
        raise ConfigError(f"{info.episode_id} succeeded, so that it has no failure to explain; give one that failed")
    changes = [c for c in changes_of(info, bench.graph.sim.library) if not config.only or c.name in config.only]
    if not changes:
        raise ConfigError(
            f"nothing of {info.episode_id} can be changed"
            + (f" by {', '.join(config.only)}: that" if config.only else ": no distractors, and all else")
            + " is nominal"
        )
    run = _Repeats(bench, info, actor, recorded, on_doubt)
    nothing = Change(name="", words="as it was", apply=lambda task, scene, _: (task, scene))
    as_it_was = run.all_of(nothing, config.repeats)
    on_tally(as_it_was)

    def tallies(group: Sequence[Change]) -> list[Tally]:
        repeats = _enough(config.repeats, as_it_was, len(group))
        found = {change.name: Tally(name=change.name, words=change.words, successes=0, runs=0) for change in group}
        decided = False
        while not decided:
            decided = True
            for change in group:
                begun = [tally for tally in found.values() if tally.runs or tally.name not in run.infeasible]
                before, left = found[change.name], not_yet_causes(begun, as_it_was)
                found[change.name] = run.while_undecided(change, before, repeats, as_it_was, left)
                if found[change.name] != before:
                    decided = False
                    on_tally(found[change.name])
        return [tally for tally in found.values() if tally.runs]

    singles = tallies(changes)
    found = explanation(as_it_was, singles, doubts=run.doubts)
    if found.kind != "none" or not config.pairs:
        return found
    pairs = [both(one, two) for one, two in itertools.combinations(_likely(changes, singles), 2)][:MAX_PAIRS]
    return explanation(as_it_was, singles, tallies(pairs), doubts=run.doubts)


def _enough(repeats: int, as_it_was: Tally, changes: int) -> int:
    """Return how many runs can show one of some changes to be a cause, from ``repeats`` to twice as many."""
    nothing = Tally(name="", words="", successes=0, runs=0)
    enough = (n for n in range(repeats, 2 * repeats) if may_become_cause(nothing, n, as_it_was, changes))
    return next(enough, 2 * repeats)


def _likely(changes: Iterable[Change], singles: Sequence[Tally]) -> list[Change]:
    """Return the changes whose episodes began, those with successes first."""
    successes = {tally.name: tally.successes for tally in singles}
    return sorted((c for c in changes if c.name in successes), key=lambda c: -successes[c.name])


def _another_policy(info: EpisodeInfo, actor: ActorPort) -> str:
    """Return in words which policy was recorded and which is given; empty: they have one name and version."""
    given = actor.describe()
    if (given.name, given.version) == (info.actor, info.actor_version):
        return ""
    there, here = (
        f"'{name}'" + (f" ({version})" if version else "")
        for name, version in ((info.actor, info.actor_version), (given.name, given.version))
    )
    return f"{info.episode_id} was recorded with the policy {there}, and {here} is given"


class _Repeats:
    doubts: tuple[str, ...] = ()
    """Why the repetitions may not be of the recorded failure, a sentence each."""

    def __init__(
        self, bench: TryBench, info: EpisodeInfo, actor: ActorPort, recorded: EpisodeResult | None,
        on_doubt: Callable[[str], None],
    ) -> None:  # fmt: skip
        self._bench, self._info, self._actor = bench, info, actor
        self._recorded, self._on_doubt = recorded, on_doubt
        self._config, self._draw = recorded_run(info)
        self.infeasible: set[str] = set()
        """Names of changes whose scene breaks a constraint in a repetition."""
        self._other = _another_policy(info, actor)
        if self._other:
            self._doubt(f"{self._other}: what follows explains how that policy fails in this scene")

    def _doubt(self, sentence: str) -> None:
        self.doubts = (*self.doubts, sentence)
        self._on_doubt(sentence)

    def _compare(self, now: EpisodeResult) -> None:
        """Compare the exact repetition with the recording.

        Raises:
            ConfigError: When another policy has another outcome.
        """
        before = self._recorded
        if before is None or now.final_state_hash == before.final_state_hash:
            return
        ends = " and ".join(f"{one.outcome} {one.reason}".strip() for one in (before, now))
        if (now.outcome, before.outcome) != ("failure", "failure") and self._other:
            raise ConfigError(
                f"{self._other}, which does not repeat the recorded outcome ({ends}); give the policy of the recording"
            )
        if before.final_state_hash and not self._other:
            self._doubt(
                f"the exact repetition of {self._info.episode_id} ends otherwise than the recording ({ends}): the "
                "policy's options or files, the renderer or the code have changed, or the policy acts by chance"
            )

    def all_of(self, change: Change, repeats: int) -> Tally:
        outcomes = [found for number in range(repeats) if (found := self._one(change, number)) is not None]
        return Tally(name=change.name, words=change.words, successes=sum(outcomes), runs=len(outcomes))

    def while_undecided(self, change: Change, tally: Tally, repeats: int, as_it_was: Tally, left: int) -> Tally:
        for number in range(tally.runs, repeats):
            if change.name in self.infeasible or not may_become_cause(tally, repeats, as_it_was, left):
                break
            success = self._one(change, number)
            if success is None:
                self.infeasible.add(change.name)
                break
            tally = replace(tally, successes=tally.successes + success, runs=tally.runs + 1)
        return tally

    def _one(self, change: Change, number: int) -> bool | None:
        """Return whether a repetition succeeds; None: the changed scene breaks a constraint."""
        task, scene = change.apply(self._draw.task, self._draw.scene, number)
        seed = seed_of(self._info)
        draw: Draw = replace(self._draw, task=task, scene=self._started(scene, number))
        run: RunConfig = self._config
        found = self._bench.run(draw, self._actor, replace(seed, attempt=seed.attempt + number), config=run)
        if not change.name and not number:
            self._compare(found.result)
        return found.success if found.began else None

    def _started(self, scene: SceneSpec, number: int) -> SceneSpec:
        if not number:
            return scene
        joints = scene.robot.joint_positions or self._bench.graph.sim.library.robot(scene.robot.model).home
        rng = np.random.default_rng([number, self._info.index])
        moved = tuple(float(q + d) for q, d in zip(joints, rng.normal(0, JITTER_RAD, len(joints)), strict=True))
        return replace(scene, robot=replace(scene.robot, joint_positions=moved))
