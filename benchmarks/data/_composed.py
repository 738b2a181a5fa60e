"""Faults composed at random, planted in an export in memory: what an audit finds without and with the bags."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import click
import numpy as np

from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.whole_files import write_whole
from roboxim_datasets.audit import AUDIT_CHECKS, AuditEpisode, Auditor
from roboxim_datasets.audit.faults.composed import Composed, compose
from roboxim_datasets.audit.faults.values import EditableEpisode
from roboxim_datasets.dataset import Dataset
from roboxim_datasets.episode import Episode
from roboxim_datasets.formats import open_dataset
from roboxim_recorder.run_bags import list_bags
from roboxim_runs.datasets.audit_expected import Expected, expected_of_bags

SHARE = 0.25
"""Share of the episodes of an audited copy that have a fault."""


@dataclass(kw_only=True)
class Counts:
    """What was planted and found."""

    episodes: int = 0
    """Clean episodes."""
    planted: dict[str, int] = field(default_factory=lambda: {"all": 0, "counting": 0, "text labels": 0})
    """Kind of fault to its number; ``counting``: of over 2 mm or 2 degrees in an action, or a text label."""
    found: dict[str, int] = field(default_factory=lambda: {"all": 0, "counting": 0, "text labels": 0, "with bags": 0})
    """The same of those that were found."""
    clean: list[str] = field(default_factory=list)
    """Episodes in which a fault is found before any is planted."""
    elsewhere: list[str] = field(default_factory=list)
    """Episodes without a fault in which one was found, in a copy that has faults."""
    missed: list[str] = field(default_factory=list)
    """Counting faults that were not found, in words."""

    def add(self, other: Counts) -> None:
        """Add the counts of another pass."""
        for own, more in ((self.planted, other.planted), (self.found, other.found)):
            for kind, count in more.items():
                own[kind] += count
        self.clean += other.clean
        self.elsewhere += other.elsewhere
        self.missed += other.missed


def measure(dataset: Path, bags: Path, faults: int, seed: int, results: Path) -> Counts:
    """Audit a dataset, then copies of it in memory with faults, until so many are planted.

    Args:
        dataset: The dataset.
        bags: Its bags.
        faults: Number of faults.
        seed: Seed of the faults.
        results: Folder of finished passes; they are not repeated.
    """
    opened = open_dataset(dataset)
    expected = expected_of_bags(opened, {bag.name: [bag] for bag in list_bags(bags)})
    assert isinstance(expected, Expected), expected
    episodes = list(opened.episodes())
    results.mkdir(parents=True, exist_ok=True)
    counts, number = Counts(episodes=len(episodes)), 0
    while number == 0 or counts.planted["all"] < faults:
        left = faults - counts.planted["all"] if number else 0
        stored = results / f"seed-{seed}-pass-{number}-most-{left}.json"
        if not stored.is_file():
            counted = _pass(opened, episodes, expected, left, np.random.default_rng([seed, number]))
            write_whole(stored, json.dumps(asdict(counted), indent=2) + "\n")
        counts.add(Counts(**json.loads(stored.read_text())))
        click.echo(f"pass {number}: {counts.planted['all']} of {faults} faults planted", err=True)
        number += 1
    return counts


def _pass(
    opened: Dataset, episodes: Sequence[Episode], expected: Expected, most: int, rng: np.random.Generator
) -> Counts:
    """Audit one copy with up to so many faults; 0: a clean one."""
    arm, counts, planted = ArmKinematics(ModelLibrary().robot(episodes[0].robot)), Counts(), dict[str, Composed]()
    auditor = Auditor([name for name in AUDIT_CHECKS if name not in ("hidden_object", "indistinguishable", "replay")])
    for number, episode in enumerate(episodes):
        name, audited = str(number), episode
        if rng.random() < SHARE and len(planted) < most:
            copy = EditableEpisode.of(episode)
            fault = compose(copy, episodes, rng)
            if fault.text:
                planted[name], audited = fault, copy.as_episode()
        made = AuditEpisode(name=name, split=opened.place(number)[0], episode=audited, arm=arm)
        made.exact_images = opened.features.lossless
        if name in planted:
            made.expected, made.lossless = expected.find(episode, name), opened.features.lossless
        auditor.add(made)
    result = auditor.result()
    found: dict[str, set[str]] = defaultdict(set)
    for check in result.checks:
        for name in check.faulty_episodes if check.name != "content" else ():
            found[name].add(check.name)
    for name in result.unreadable:
        found[name].add("unreadable")
    _count(counts, planted, set(found), set(result.check("content").faulty_episodes))
    wrong = [f"{name}: {', '.join(sorted(checks))}" for name, checks in found.items() if name not in planted]
    (counts.elsewhere if most else counts.clean).extend(wrong)
    return counts


def _count(counts: Counts, planted: dict[str, Composed], found: set[str], with_bags: set[str]) -> None:
    for name, fault in planted.items():
        kinds = ["all"] + ["counting"] * fault.counts + ["text labels"] * fault.relabelled
        for kind in kinds:
            counts.planted[kind] += 1
            counts.found[kind] += name in found
        counts.found["with bags"] += name in with_bags
        if fault.counts and name not in found:
            counts.missed.append(
                f"{name}: {fault.text} ({fault.action_mm:.1f} mm, {fault.action_deg:.1f} deg, "
                f"{'other' if fault.relabelled else 'same'} label)"
            )
