"""Choice among many policies by successive halving, and the winner's rate on fresh scenes.

All policies play a few scenes; the better half plays more, and so on until one is left. The winner's rate in the scenes
of the choice is too high: of equal policies the luckiest wins. So the winner plays fresh scenes, which alone give its
rate and interval.

Source:
    Karnin, Koren and Somekh, "Almost Optimal Exploration in Multi-Armed Bandits", 2013 (sequential halving).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from roboxim_core.errors import ConfigError, counted, listed
from roboxim_eval.statistics.rates import SuccessRate, success_rate

Play = Callable[[Sequence[str], int], Mapping[str, Sequence[bool]]]
"""Returns, for the named policies, whether each succeeded in the first so many scenes; the scenes are the same."""


@dataclass(frozen=True, kw_only=True)
class HalvingConfig:
    """Size of a choice."""

    first: int = 8
    """Scenes of the first round; each further round has twice as many in all."""
    fresh: int = 40
    """Scenes that only the winner plays."""

    def __post_init__(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: When one is below 1.
        """
        if min(self.first, self.fresh) < 1:
            raise ConfigError(f"first and fresh must be >= 1, got {self.first} and {self.fresh}")

    def most(self, policies: int) -> int:
        """Return the scenes of the last round of so many policies."""
        return int(self.first * 2 ** max(0, (policies - 1).bit_length() - 1))


@dataclass(frozen=True, kw_only=True)
class Round:
    """A round of the choice."""

    scenes: int
    """Scenes that its policies have played, those of earlier rounds included."""
    successes: dict[str, int]
    """Policy to its successes, the best first; equals in the order in which they were named."""
    kept: tuple[str, ...]
    """Those that play on."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Outcome of a choice, before the winner has played fresh scenes."""

    rounds: tuple[Round, ...]
    """The rounds."""

    @property
    def winner(self) -> str:
        """The policy that is left."""
        return self.rounds[-1].kept[0]

    @property
    def choosing(self) -> SuccessRate:
        """The winner's rate in the scenes of the choice, which is too high on average."""
        last = self.rounds[-1]
        return success_rate(last.successes[self.winner], last.scenes)

    @property
    def rollouts(self) -> int:
        """Episodes that were played."""
        played = {name: scenes.scenes for scenes in self.rounds for name in scenes.successes}
        return sum(played.values())


def choose(names: Sequence[str], play: Play, config: HalvingConfig) -> Choice:
    """Choose the best of several policies.

    Args:
        names: The policies, at least two, all different.
        play: Plays scenes.
        config: Number of scenes.

    Raises:
        ConfigError: When there are fewer than two policies, or two of one name.
    """
    if len(names) < 2 or len(set(names)) < len(names):
        raise ConfigError(f"a choice needs at least two policies of different names, got {', '.join(names) or 'none'}")
    rounds: list[Round] = []
    left, scenes = tuple(names), config.first
    while len(left) > 1:
        found = play(left, scenes)
        ranked = sorted(left, key=lambda name: -sum(found[name]))
        kept = tuple(ranked[: (len(ranked) + 1) // 2])
        rounds.append(Round(scenes=scenes, successes={name: sum(found[name]) for name in ranked}, kept=kept))
        left, scenes = kept, 2 * scenes
    return Choice(rounds=tuple(rounds))


def sentences(choice: Choice, fresh: SuccessRate) -> list[str]:
    """Say in words what a choice says.

    Args:
        choice: The choice.
        fresh: The winner's rate in fresh scenes.
    """
    lines = []
    for number, one in enumerate(choice.rounds, start=1):
        ranked = ", ".join(f"{name} {successes}" for name, successes in one.successes.items())
        lines.append(f"round {number}, {counted(one.scenes, 'scene')}: {ranked}")
    last, scenes = choice.rounds[-1].successes, choice.rounds[-1].scenes
    ties = [name for name in last if name != choice.winner and last[name] == last[choice.winner]]
    tied = f", though {listed(ties)} succeeded as often" if ties else ""
    return [
        *lines,
        f"{choice.winner} is chosen{tied}; in fresh scenes it succeeds in {fresh}",
        f"in the {counted(scenes, 'scene')} that chose it: {100 * choice.choosing.rate:.0f} %, too high on average, "
        "because of the choice",
    ]
