"""Faults composed at random, planted in an export in memory: what an audit finds without and with the bags."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_datasets.audit import AUDIT_CHECKS, AuditEpisode, Auditor
from roboxim_datasets.audit.faults.composed import Composed, compose
from roboxim_datasets.audit.faults.values import EditableEpisode
from roboxim_datasets.formats import open_dataset
from roboxim_recorder.run_bags import list_bags
from roboxim_runs.datasets.audit_expected import Expected, expected_of_bags

SHARE = 0.25
"""Share of the episodes of an audited copy that have a fault."""


@dataclass(kw_only=True)
class Counts:
    """What was planted and found."""

    planted: dict[str, int] = field(default_factory=lambda: {"all": 0, "counting": 0, "text labels": 0})
    """Kind of fault to its number; ``counting``: of over 2 mm or 2 degrees in an action, or a text label."""
    found: dict[str, int] = field(default_factory=lambda: {"all": 0, "counting": 0, "text labels": 0, "with bags": 0})
    """The same of those that were found."""
    elsewhere: set[str] = field(default_factory=set)
    """Episodes without a fault in which one was found."""


def measure(dataset: Path, bags: Path, faults: int, seed: int) -> Counts:
    """Plant faults in copies of a dataset in memory and audit each copy, until so many are planted."""
    opened = open_dataset(dataset)
    expected = expected_of_bags(opened, {bag.name: [bag] for bag in list_bags(bags)})
    assert isinstance(expected, Expected), expected
    episodes = list(opened.episodes())
    arm, rng, counts = ArmKinematics(ModelLibrary().robot(episodes[0].robot)), np.random.default_rng(seed), Counts()
    names = [name for name in AUDIT_CHECKS if name not in ("hidden_object", "indistinguishable", "replay")]
    while counts.planted["all"] < faults:
        auditor, planted = Auditor(names), dict[str, Composed]()
        for number, episode in enumerate(episodes):
            name, audited = str(number), episode
            if rng.random() < SHARE and counts.planted["all"] + len(planted) < faults:
                copy = EditableEpisode.of(episode)
                fault = compose(copy, episodes, rng)
                if fault.text:
                    planted[name], audited = fault, copy.as_episode()
            made = AuditEpisode(name=name, split=opened.place(number)[0], episode=audited, arm=arm)
            if name in planted:
                made.expected, made.lossless = expected.find(episode, name), opened.features.lossless
            auditor.add(made)
        result = auditor.result()
        found = {name for check in result.checks if check.name != "content" for name in check.faulty_episodes}
        found |= set(result.unreadable)
        _count(counts, planted, found, set(result.check("content").faulty_episodes))
    return counts


def _count(counts: Counts, planted: dict[str, Composed], found: set[str], with_bags: set[str]) -> None:
    for name, fault in planted.items():
        kinds = ["all"] + ["counting"] * fault.counts + ["text labels"] * fault.relabelled
        for kind in kinds:
            counts.planted[kind] += 1
            counts.found[kind] += name in found
        counts.found["with bags"] += name in with_bags
    counts.elsewhere |= found - planted.keys()
