"""Compares two policies in the same scenes: where they diverge, and which moment decides (by swapping them)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from roboxim_core.config import to_plain
from roboxim_core.episode import ActorPort, Draw, RunConfig, configure_scene, executed_semantics
from roboxim_core.errors import ConfigError, ErrorCode, SimError, TaskError
from roboxim_core.limits import require_range
from roboxim_core.plain_data.differences import differences
from roboxim_core.seeds import SeedPath
from roboxim_eval.answers.moments import SceneComparison, first_success, phase_at
from roboxim_runs.answers.trying import Try, TryBench, executed_actions
from roboxim_runs.episodes_config import MAX_EPISODES


@dataclass(frozen=True, kw_only=True)
class CompareRun:
    """What is compared."""

    task_config: str
    """Task configuration, YAML."""
    scenes: int = 10
    """Number of scenes."""
    seed: int = 0
    """Seed of the scenes."""
    run: RunConfig = RunConfig()
    """How the policies act."""

    def __post_init__(self) -> None:
        """Check the number of scenes.

        Raises:
            InvalidRequestError: When it is out of range.
        """
        require_range("scenes", self.scenes, 1, MAX_EPISODES)


def compare(
    bench: TryBench, first: ActorPort, second: ActorPort, config: CompareRun, *,
    on_scene: Callable[[SceneComparison], None] = lambda _: None,
    on_part: Callable[[int, str], None] = lambda _number, _part: None,
) -> list[SceneComparison]:  # fmt: skip
    """Compare two policies.

    Args:
        bench: Cores to run episodes with.
        first: A policy.
        second: Another one whose actions are executed with the same meaning, limits and rate.
        config: What is compared.
        on_scene: Called with each scene.
        on_part: Called before each run with the scene's number and what runs, in a few words.

    Raises:
        ConfigError: When the policies' actions are executed with different meanings, limits or rates.
        InvalidRequestError: When a policy does not fit the scenes' cameras or rate.
        PolicyError: When a policy raises.
        RoboximError: When a scene cannot be drawn or breaks a constraint, or on a fault of the simulator.
    """
    drawn: list[tuple[SeedPath, Draw]] = []
    for number in range(config.scenes):
        on_part(number, "the scene is drawn")
        seed = SeedPath(run_seed=config.seed, purpose="eval", index=number)
        drawn.append((seed, bench.graph.tasks.draw(seed, config.task_config)))
        _require_same_execution(drawn[-1][1], config.run, first, second)
    found = []
    for seed, draw in drawn:
        one = _Scene(bench, draw, seed, config.run, on_part).compared(first, second)
        found.append(one)
        on_scene(one)
    return found


class _Scene:
    def __init__(
        self, bench: TryBench, draw: Draw, seed: SeedPath, run: RunConfig, on_part: Callable[[int, str], None]
    ) -> None:
        self._bench, self._draw, self._seed, self._run, self._on_part = bench, draw, seed, run, on_part

    def compared(self, first: ActorPort, second: ActorPort) -> SceneComparison:
        one, two = (self._alone(name, actor) for name, actor in (("first", first), ("second", second)))
        parted = diverging(one, two)
        outcome = (one.success, two.success)
        result = SceneComparison(scene=self._seed.index, outcome=outcome, diverge_at=parted)
        if one.success == two.success or parted is None:
            return result
        winner, loser, other = (one, two, second) if one.success else (two, one, first)
        rescuer = first if one.success else second
        end = winner.result.steps
        decides, until = None, None
        if end > parted and self._success(winner, end - 1, other):
            decides = first_success(lambda tick: self._success(winner, tick, other), parted - 1, end - 1)
        last = loser.result.steps
        if last > parted and self._success(loser, parted, rescuer):
            fails = not self._success(loser, last, rescuer)
            until = (
                first_success(lambda tick: not self._success(loser, tick, rescuer), parted, last) - 1 if fails else last
            )
        phase = "" if decides is None else phase_at(winner.states, decides)
        return replace(result, decides_at=decides, rescued_until=until, phase=phase, ticks=end)

    def _alone(self, name: str, actor: ActorPort) -> Try:
        self._on_part(self._seed.index, f"the {name} policy runs")
        found = self._bench.run(self._draw, actor, self._seed, config=self._run)
        if not found.began:
            raise TaskError(f"scene {self._seed.index}: {found.result.message}", ErrorCode.RESET_INFEASIBLE)
        return found

    def _success(self, before: Try, tick: int, then: ActorPort) -> bool:
        """Return whether an actor succeeds from a tick of another one's episode.

        Raises:
            SimError: With code ``DIVERGED`` when the simulator does not repeat the episode up to the tick.
        """
        self._on_part(self._seed.index, f"swapped at tick {tick}")
        repeat = executed_actions(before.states, tick)
        after = self._bench.run(self._draw, then, self._seed, config=self._run, repeat=repeat)
        for recorded, repeated in zip(before.states[: tick + 1], after.states, strict=False):
            if recorded.state_hash != repeated.state_hash:
                raise SimError(f"the simulator does not repeat tick {recorded.seq} of the episode", ErrorCode.DIVERGED)
        return after.success


def _require_same_execution(draw: Draw, run: RunConfig, *actors: ActorPort) -> None:
    """Refuse two policies of which one cannot repeat the executed actions of the other."""
    described = [actor.describe() for actor in actors]
    first, second = (to_plain(executed_semantics(configure_scene(draw.scene, run, one), one)) for one in described)
    if first != second:
        words = ("of the first", "of the second")
        raise ConfigError(
            "the policies cannot take over from each other, since their actions are executed differently: "
            f"{differences(first, second, words=words)}"
        )


def diverging(one: Try, two: Try) -> int | None:
    """Return the first tick whose states differ; None: all that both have are the same, bit for bit."""
    pairs = zip(one.states, two.states, strict=False)
    return next((a.seq for a, b in pairs if a.state_hash != b.state_hash), None)
