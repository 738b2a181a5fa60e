"""Proofs that an experiment was delivered: tallies of checks over the bags of its demonstrations and evaluations.

An episode that fails a check does not belong to its cell, so it does not count. If more than `MAX_FAULTS` of the
episodes of a stage fail, the experiment stops. Training data are refused at the first fault: a held-out episode in it
cannot be taken out of the weights.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from roboxim_eval.experiments.proving.cells_apart import belongs_to, distinguishing_checks
from roboxim_eval.experiments.proving.changes import (
    SAME_M,
    Change,
    change_of,
    differences,
    moved,
    seen_change,
    shown_difference,
)
from roboxim_eval.experiments.proving.delivery import CHANGED, CHECKS, VISIBLE_PX, WORDS, faults_of, hidden_distractors
from roboxim_eval.experiments.proving.demand import Demand, Shown

PROOF_OF_TRAINING = "trained_on"
"""Check of a training, not of an episode: it read the export that the experiment gave it."""
PICTURES = "pictures"
"""Count of the episodes whose pictures were compared with drawings; other episodes are checked by the bag's statements
only."""
MAX_FAULTS = 0.01
"""Share of faulty episodes above which a run stops."""
NAMED = 5
"""Number of faults that a message names."""


@dataclass(frozen=True, kw_only=True)
class Fault:
    """An episode that fails a check."""

    check: str
    """Name of the check."""
    bag: str
    """Its bag."""
    text: str
    """The fault, with figures."""

    def __str__(self) -> str:
        """Format bag, check and figures."""
        return f"{self.bag}: {self.check}: {self.text}"


@dataclass(frozen=True, kw_only=True)
class Tally:
    """Results of checks."""

    checks: dict[str, tuple[int, int]] = field(default_factory=dict)
    """Check to number of episodes that passed, and number of episodes checked."""
    faults: tuple[Fault, ...] = ()
    """All faults."""
    statements: tuple[str, ...] = ()
    """Remarks that are not faults, e.g. held-out objects that were distractors of the training."""

    def __add__(self, other: Tally) -> Tally:
        """Return both together."""
        names = dict.fromkeys((*self.checks, *other.checks))
        sums = {
            name: (
                self.checks.get(name, (0, 0))[0] + other.checks.get(name, (0, 0))[0],
                self.checks.get(name, (0, 0))[1] + other.checks.get(name, (0, 0))[1],
            )
            for name in names
        }
        return Tally(
            checks=sums, faults=(*self.faults, *other.faults), statements=(*self.statements, *other.statements)
        )

    @property
    def faulty(self) -> frozenset[str]:
        """Bags that fail a check."""
        return frozenset(fault.bag for fault in self.faults)

    def refusal(self, max_faults: float = MAX_FAULTS) -> str:
        """Return why a run must stop, naming bags and figures; empty: it may continue.

        Args:
            max_faults: Tolerated share of faulty episodes. A training on another dataset is never tolerated.
        """
        if wrong := [fault for fault in self.faults if fault.check == PROOF_OF_TRAINING]:
            return "trainings read another dataset than the experiment gave them:\n" + "\n".join(
                f"  {fault}" for fault in wrong
            )
        checked = max((n for _, n in self.checks.values()), default=0)
        if len(self.faulty) <= max_faults * checked:
            return ""
        named = "\n".join(f"  {fault}" for fault in self.faults[:NAMED])
        more = len(self.faults) - NAMED
        limit = f"; {100 * max_faults:g} % are tolerated" if max_faults else ""
        return f"{len(self.faulty)} of {checked} episodes do not show what their cell demands{limit}:\n{named}" + (
            f"\n  and {more} more" if more > 0 else ""
        )


def tally(demands: Mapping[str, Demand], episodes: Iterable[Shown], *, without: Collection[str] = ()) -> Tally:
    """Check episodes against what their cells demand.

    The received instruction is checked where the bag stores it; a statement gives the number of bags that do not.
    Another statement gives the number of hidden distractors, which are no fault. The count `PICTURES` gives the
    episodes with compared pictures, and a statement the reasons for the others, which are no fault either.

    Args:
        demands: Cell to its demands.
        episodes: Content of the bags.
        without: Checks that do not apply, e.g. ``words`` to demonstrations of an expert, which reads the task.
    """
    names = [name for name in CHECKS if name not in without]
    counts: Counter[str] = Counter()
    checked: Counter[str] = Counter()
    faults: list[Fault] = []
    reasons: dict[str, None] = {}
    number = hidden = distractors = 0
    for shown in episodes:
        number += 1
        if shown.pictures:
            checked[PICTURES] += 1
            counts[PICTURES] += not shown.not_compared
        if shown.not_compared:
            reasons[shown.not_compared] = None
        hidden += hidden_distractors(shown)
        distractors += len(shown.others)
        applicable = [name for name in names if name != WORDS or shown.received]
        checked.update(applicable)
        if shown.cell not in demands:
            faults.append(Fault(check="cell", bag=shown.bag, text=f"the evaluation has no cell '{shown.cell}'"))
            continue
        found = faults_of(demands[shown.cell], shown)
        faults += [Fault(check=name, bag=shown.bag, text=text) for name, text in found.items() if name in applicable]
        counts.update(name for name in applicable if name not in found)
    silent = number - checked[WORDS] if WORDS in names else 0
    statements = []
    if silent:
        statements.append(
            f"the bags of {silent} of {number} rollouts do not say which instruction the policy received (older bags, "
            "policies in nodes of other processes, or policies that gave no answer), so their words are unproven"
        )
    if hidden:
        statements.append(
            f"{hidden} of {distractors} distractors are hidden or out of the picture: fewer than {VISIBLE_PX} visible "
            "pixels in the best fixed camera"
        )
    if reasons:
        statements.append(
            f"pictures were not compared ({', '.join(reasons)}): where '{PICTURES}' did not pass, camera, light, "
            "texture, object and distractors are proven by what the bags state alone"
        )
    return Tally(
        checks={name: (counts[name], checked[name]) for name in (*names, PICTURES) if checked[name]},
        faults=tuple(faults),
        statements=tuple(statements),
    )


# ------------------------------------------------------------------ pairing


def pairing(arms: Mapping[str, Sequence[Shown]], changed: Mapping[str, Collection[str]]) -> Tally:
    """Check that conditions met the same scenes.

    Conditions without changes must share states and pictures of tick 0; where their policies get pictures of different
    sizes, they must share the pose of the camera. The majority of the conditions decides what is right for a scene; a
    deviating episode is a fault. If there is no majority, e.g. with two conditions, each of them has a fault.

    A changed condition must share with the majority everything that its change does not affect (module `changes`).
    Light, surfaces and exposure do not affect the state; the instruction affects neither state nor pictures; mass and
    friction do not affect the objects' places; a moved camera affects neither the light nor the start. If the change is
    visible, the pictures must differ. A scene that only one condition met is not checked.

    Args:
        arms: Condition to its episodes of one replicate.
        changed: Condition to the parts of the task that it changes, e.g. ``reset.lights``; left out: none.
    """
    scenes = {name: {(s.cell, s.number): s for s in shown} for name, shown in arms.items()}
    plain = [name for name in arms if not changed.get(name)]
    changes = {name: change for name in arms if changed.get(name) and (change := change_of(changed[name])) is not None}
    if not plain:
        return Tally()
    faults: list[Fault] = []
    met: Counter[str] = Counter()
    elsewhere: Counter[str] = Counter()
    paired = expected = delivered = 0
    for scene in dict.fromkeys(scene for name in plain for scene in scenes[name]):
        alike = {name: scenes[name][scene] for name in plain if scene in scenes[name]}
        others = {name: scenes[name][scene] for name in changes if scene in scenes[name]}
        if len(alike) + len(others) < 2:
            continue
        paired += len(alike) + len(others)
        odd = _deviating(alike)
        faults += [Fault(check="pairing", bag=alike[name].bag, text=text) for name, text in odd.items()]
        right = next((name for name in alike if name not in odd), None)
        for name, shown in others.items():
            if right is None:
                expected += changes[name].seen
                faults.append(Fault(check="pairing", bag=shown.bag, text=f"no majority of {_named(alike)} agrees"))
                continue
            found = list(_changed_faults(changes[name], shown, alike[right], right))
            faults += found
            if changes[name].seen or shown_difference(changes[name], shown, alike[right]):
                expected += 1
                delivered += not any(fault.check == "changed" for fault in found)
            met[name] += 1
            elsewhere[name] += any(not far <= SAME_M for far in moved(shown, alike[right]).values())
    failed = sum(fault.check == "pairing" for fault in faults)
    checks = {"pairing": (paired - failed, paired)} if paired else {}
    return Tally(
        checks=checks | ({"changed": (delivered, expected)} if expected else {}),
        faults=tuple(faults),
        statements=tuple(
            f"{name}: in {number} of {met[name]} scenes of a replicate objects lie elsewhere than without its change"
            for name, number in elsewhere.items()
            if number and "places" in changes[name].may
        ),
    )


def _changed_faults(change: Change, shown: Shown, right: Shown, condition: str) -> Iterator[Fault]:
    """Yield the faults of a changed episode, at most one of each check."""
    if text := "; ".join(differences(change, shown, right, condition)):
        yield Fault(check="pairing", bag=shown.bag, text=text)
    if change.seen and (seen := seen_change(shown, right)) < CHANGED:
        text = f"its pictures are {seen:.2f} of 255 from those of '{condition}', at least {CHANGED:g} expected"
        yield Fault(check="changed", bag=shown.bag, text=text)
    elif shown.pictures and shown.pictures == right.pictures and (what := shown_difference(change, shown, right)):
        text = f"its pictures are those of '{condition}', bit for bit, although the change is to show: {what}"
        yield Fault(check="changed", bag=shown.bag, text=text)


def _deviating(arms: Mapping[str, Shown]) -> dict[str, str]:
    """Return the conditions whose episode of a scene deviates from the majority, with the difference.

    A condition that deviates in one part is not counted for the next parts. Without a majority, every voting condition
    deviates.
    """
    found: dict[str, str] = {}
    for what, form, values in _parts(arms):
        votes = {name: value for name, value in values.items() if name not in found}
        if len(votes) < 2:
            continue
        given = list(votes.values())
        right = max(given, key=given.count)
        if 2 * given.count(right) <= len(given):
            end = f"no majority of {_named(votes)} agrees"
            found |= {name: f"{what} is {form.format(value)}, {end}" for name, value in votes.items()}
            continue
        reference = next(name for name, value in votes.items() if value == right)
        found |= {
            name: _difference(what, form, value, reference, right) for name, value in votes.items() if value != right
        }
    return found


_STATE = "{:.8}"
"""Format of a state's hash in messages."""


def _parts(arms: Mapping[str, Shown]) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Yield the properties that conditions must share on a scene: name, format in messages, and condition to value.

    The state comes first and pictures last, because earlier differences explain later ones.
    """
    yield "the state of tick 0", _STATE, {name: shown.state_hash for name, shown in arms.items()}
    pictures: dict[str, dict[tuple[int, ...] | None, dict[str, int]]] = {}
    for name, shown in arms.items():
        for camera, checksum in shown.pictures.items():
            pictures.setdefault(camera, {}).setdefault(shown.sizes.get(camera), {})[name] = checksum
    for camera, of_sizes in pictures.items():
        if len(of_sizes) > 1:  # policies get pictures of different sizes
            views = {name: arms[name].cameras.get(camera) for same in of_sizes.values() for name in same}
            yield f"the pose of camera '{camera}'", "{}", views
    for look in dict.fromkeys(look for shown in arms.values() for look in shown.look):
        yield look, "{}", {name: shown.look[look] for name, shown in arms.items() if look in shown.look}
    for camera, of_sizes in pictures.items():
        for same in of_sizes.values():
            yield f"the CRC-32 of the picture of camera '{camera}' at tick 0", "{:08x}", same


def _difference(what: str, form: str, value: Any, condition: str, right: Any) -> str:
    return f"{what} is {form.format(value)}, that of '{condition}' is {form.format(right)}"


def _named(conditions: Iterable[str]) -> str:
    return ", ".join(f"'{name}'" for name in conditions)


# ------------------------------------------------------------------ training data


@dataclass(frozen=True, kw_only=True)
class Trained:
    """An episode of a dataset."""

    shown: Shown
    """Content of its bag."""
    instructed: tuple[Demand, ...] = ()
    """Skill and objects that the dataset's instruction names in the scene; empty: not recognised."""
    planted: str = ""
    """Fault that was planted on purpose; empty: none."""


def training_tally(
    demands: Mapping[str, Demand], unseen: Collection[str], counts: Mapping[str, int], episodes: Sequence[Trained]
) -> Tally:
    """Check a training dataset against the cells that it may have.

    An episode with the content of a held-out cell is a fault, regardless of the cell that it claims
    (`distinguishing_checks`).

    Args:
        demands: All cells of the experiment with their demands.
        unseen: Held-out cells.
        counts: Cells of the dataset with their numbers of episodes.
        episodes: Episodes of the dataset.
    """
    closed = [cell for cell in unseen if cell not in counts]
    others = [demand for cell, demand in demands.items() if cell not in closed]
    distinguishing = {cell: distinguishing_checks(demands[cell], others) for cell in closed}
    faults: list[Fault] = []
    leaks = 0
    for episode in episodes:
        if text := _leak(episode, demands, distinguishing):
            leaks += 1
            faults.append(Fault(check="unseen", bag=episode.shown.bag, text=text))
    found = Counter(episode.shown.cell for episode in episodes)
    wrong = [
        Fault(check="counts", bag=cell, text=f"{found[cell]} episodes, {counts.get(cell, 0)} expected")
        for cell in dict.fromkeys((*counts, *found))
        if found[cell] != counts.get(cell, 0)
    ]
    cells = len(dict.fromkeys((*counts, *found)))
    number = len(episodes)
    return Tally(
        checks={"unseen": (number - leaks, number), "counts": (cells - len(wrong), cells)},
        faults=(*faults, *wrong),
        statements=tuple(_exposures(demands, closed, episodes)),
    )


def _leak(episode: Trained, demands: Mapping[str, Demand], closed: Mapping[str, Sequence[str]]) -> str:
    """Return the held-out cell of an episode; empty: none. ``closed`` has the checks that identify each cell."""
    for cell, checks in closed.items():
        if belongs_to(demands[cell], episode.shown, checks):
            claims = "" if episode.shown.cell == cell else f", although it claims '{episode.shown.cell}'"
            return f"it is of the held-out cell '{cell}'{claims}"
    if episode.shown.cell in closed:
        return f"it claims the held-out cell '{episode.shown.cell}'"
    return ""


def _exposures(demands: Mapping[str, Demand], closed: Sequence[str], episodes: Sequence[Trained]) -> Iterable[str]:
    """Report held-out objects as distractors of the held-out skill, and instructions that ask for a held-out cell.

    Instructions of the episode's own cell are ignored, e.g. if cells differ only by camera.
    """
    for cell in closed:
        demand = demands[cell]
        wanted = [value for allowed in demand.models.values() for value in allowed.values]
        same = [episode.shown for episode in episodes if episode.shown.skill == demand.skill]
        revealing = sum(any(model in wanted for model in shown.others.values()) for shown in same)
        if revealing:
            yield (
                f"{revealing} of {len(same)} training episodes of {demand.skill} have the object of the held-out cell "
                f"'{cell}' as a distractor"
            )
        count = sum(
            any(
                _asks_for(demand, instructed) and not _asks_for(demands[e.shown.cell], instructed)
                for instructed in e.instructed
            )
            for e in episodes
        )
        if count:
            yield f"the instructions of {count} training episodes ask for the held-out cell '{cell}'"


def _asks_for(demand: Demand, instructed: Demand) -> bool:
    return instructed.skill == demand.skill and all(
        role in instructed.models and any(not allowed.excess(value) for value in instructed.models[role].values)
        for role, allowed in demand.models.items()
    )
