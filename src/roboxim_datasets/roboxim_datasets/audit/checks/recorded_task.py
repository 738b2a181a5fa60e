"""Whether an episode's recorded task can belong to it."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from roboxim_core.errors import ConfigError
from roboxim_core.plain_data.documents import parse_json
from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.checks.behaviour import movement
from roboxim_datasets.audit.values import AuditEpisode, CannotCheckError, Finding, Severity, Values
from roboxim_datasets.episode import whole_id

MAX_SHARED = 0.25
"""Largest share of episodes whose task another episode has too, where scenes are drawn: beyond, they are not."""
FEWEST = 4
"""Fewest other episodes of a run, or of a skill, by which an episode is judged."""
APART = 1.6
"""Ratio of the distances of a pair's two episodes to a skill's episodes from which the farther one is the wrong one."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Seen:
    """What the check keeps of an episode."""

    name: str
    recording: str
    run: str
    skill: str
    task: str
    moves: Values | None


def _of_recordings(group: Sequence[_Seen]) -> list[_Seen]:
    """Return the first of each recording's stretches of one actor, which share its task."""
    first: dict[str, _Seen] = {}
    for seen in group:
        first.setdefault(seen.recording, seen)
    return list(first.values())


@AUDIT_CHECKS.register("recorded_task")
class RecordedTask(AuditCheck):
    """A recorded task that is another episode's."""

    title = "The recorded task is another episode's"
    reason = "The instruction comes from the task: the policy learns to act against the instruction."
    threshold = (
        f"a skill that none of the {FEWEST} or more other episodes of its run has, while these share one; or a task "
        "that is, with all that was drawn for its scene, another episode's word for word, in a dataset where at most "
        f"{100 * MAX_SHARED:.0f} % of the episodes share theirs. Of two with one task that one is named whose run has "
        "the skill nowhere else, or, in a run of several skills, which moves less like the others of this one; "
        "else both are a warning"
    )
    needs = "the recorded task and run, as RoboXim's exports and bags have them"
    order = 6

    def __init__(self) -> None:
        """Remember the episodes: tasks are compared with those of all others."""
        self._seen: list[_Seen] = []

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Keep the task, and how the arm moves."""
        metadata = episode.episode.metadata
        text = str(metadata.get("task", ""))
        try:
            task = parse_json(text, source="task")
        except ConfigError:
            task = None
        if not isinstance(task, dict) or "skill" not in task:
            raise CannotCheckError("the dataset does not hold the recorded task")
        try:
            moves = movement(episode)
        except CannotCheckError:
            moves = None
        own, whole = episode.episode.episode_id, whole_id(episode.episode.episode_id)
        recording = episode.name if whole == own else whole
        self._seen.append(
            _Seen(
                name=episode.name, recording=recording, run=str(metadata.get("run_seed", "")),
                skill=str(task["skill"]), task=text, moves=moves,
            )
        )  # fmt: skip
        yield from ()

    def conclude(self) -> Iterator[Finding]:
        """Compare the tasks."""
        differing = {seen.name: usual for seen, usual in _different_in_run(self._seen)}
        for seen in self._seen:
            if seen.name in differing:
                text = f"its recorded skill is '{seen.skill}', all others of its run are of '{differing[seen.name]}'"
                yield Finding(text=text, episodes=(seen.name,), ticks=(0,))
        groups = defaultdict(list)
        for seen in self._seen:
            groups[seen.task].append(seen)
        shared = [group for group in map(_of_recordings, groups.values()) if len(group) > 1]
        if sum(map(len, shared)) > max(2, MAX_SHARED * len(self._seen)):
            return
        for group in shared:
            rest = [seen for seen in group if seen.name not in differing]
            if len(rest) > 1:
                yield self._of_shared(rest)

    def _of_shared(self, group: Sequence[_Seen]) -> Finding:
        names = tuple(seen.name for seen in group)
        others = [seen for seen in self._seen if seen.skill == group[0].skill and seen.name not in names]
        runs = {seen.run for seen in group}
        mixed = any(seen.skill != group[0].skill for seen in self._seen if seen.run in runs)
        wrong = self._alone_in_its_run(group) or (_least_alike(group, others) if mixed else "")
        text = "it has the recorded task of " if wrong else "they have one recorded task: "
        return Finding(
            text=text + ", ".join(name for name in names if name != wrong) + ", drawn scene included",
            episodes=(wrong,) if wrong else names,
            ticks=(0,),
            severity=Severity.FAULT if wrong else Severity.WARNING,
        )

    def _alone_in_its_run(self, group: Sequence[_Seen]) -> str:
        """Return the only one of some episodes whose run has the skill nowhere else; empty: it is not the only one."""
        shared = Counter((seen.run, seen.skill) for seen in self._seen)
        others = {one.name: shared[one.run, one.skill] - sum(two.run == one.run for two in group) for one in group}
        alone = [name for name, count in others.items() if not count]
        return alone[0] if len(alone) == 1 else ""


def _different_in_run(seen: Sequence[_Seen]) -> Iterator[tuple[_Seen, str]]:
    """Yield episodes whose skill no other one of their run has, with the skill that all others share."""
    runs = defaultdict(list)
    for one in seen:
        runs[one.run].append(one)
    for run, members in runs.items():
        counts = Counter(one.skill for one in members)
        usual, count = counts.most_common(1)[0]
        rest = len(members) - count
        if run and count >= FEWEST and 0 < rest <= MAX_SHARED * len(members) and _most_of_another(counts, usual) == 1:
            yield from ((one, usual) for one in members if one.skill != usual)


def _most_of_another(counts: Counter[str], usual: str) -> int:
    """Return the largest count of a skill other than the usual one."""
    return max(count for skill, count in counts.items() if skill != usual)


def _least_alike(group: Sequence[_Seen], others: Sequence[_Seen]) -> str:
    """Return which of some episodes moves least like others, if it is clear; empty: it is not."""
    known = [one.moves for one in others if one.moves is not None]
    moves = [one.moves for one in group if one.moves is not None]
    if len(known) < FEWEST or len(moves) < len(group):
        return ""
    rows = np.stack(known)
    spread = np.maximum(np.quantile(rows, 0.9, axis=0) - np.quantile(rows, 0.1, axis=0), 0.02)
    far = [float(np.sort(np.linalg.norm((rows - own) / spread, axis=1))[:FEWEST].mean()) for own in moves]
    order = np.argsort(far)
    return group[int(order[-1])].name if far[order[-1]] > APART * far[order[-2]] else ""
