"""Checks of the dataset as a whole: duplicates, leaks between splits, numbers that spoil the statistics."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.values import AuditEpisode, CannotCheckError, Finding, Numbers, Severity
from roboxim_datasets.episode import Floats

CONSTANT = 1e-8
OUTLIER = 10.0
SPIKE = 2.0
MIN_SPREAD = 0.01
DECIMALS = 5


@AUDIT_CHECKS.register("duplicate")
class Duplicate(AuditCheck):
    """Episodes with the same actions."""

    title = "Episodes are contained twice"
    reason = "They count twice in training, and a split by episodes puts one into train and the other into val."
    threshold = f"all actions of two episodes equal to {DECIMALS} decimals; with other images, a warning"
    order = 21

    def __init__(self) -> None:
        """Remember the episodes."""
        self._seen: dict[str, tuple[str, Floats]] = {}

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find an episode that was there before."""
        key = action_hash(episode.actions)
        start = _first_cells(episode)
        if key not in self._seen:
            self._seen[key] = episode.name, start
            return
        name, before = self._seen[key]
        same = before.shape == start.shape and bool(np.abs(before - start).max(initial=0.0) < 1.0)
        yield episode.finding(
            f"its {len(episode.episode)} actions are those of '{name}'" + ("" if same else ", with other images"),
            ticks=(0,),
            severity=Severity.FAULT if same else Severity.WARNING,
        )


@AUDIT_CHECKS.register("split_leak")
class SplitLeak(AuditCheck):
    """Validation episodes that training contains."""

    title = "Train and validation share episodes"
    reason = "The validation loss then measures memory, and the best checkpoint is chosen by it."
    threshold = "two splits that contain the same actions, or the same seed and index of the same task"
    needs = "more than one split"
    order = 22

    def __init__(self) -> None:
        """Remember the episodes."""
        self._seen: dict[str, tuple[str, str]] = {}

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find an episode of another split."""
        keys = {"actions": action_hash(episode.actions)}
        meta = episode.episode.metadata
        if {"run_seed", "index", "task"} <= meta.keys():
            keys["seed and index"] = f"{meta['run_seed']} {meta['index']} {meta['task']}"
        shared = [
            (what, *self._seen[key])
            for what, key in keys.items()
            if self._seen.get(key, ("", episode.split))[1] != episode.split
        ]
        for key in keys.values():
            self._seen.setdefault(key, (episode.name, episode.split))
        if shared:
            what, name, split = shared[0]
            yield episode.finding(f"it is in '{episode.split}' and has the {what} of '{name}' in '{split}'", ticks=(0,))
        if not episode.split:
            raise CannotCheckError("bags have no splits; an export has")


@AUDIT_CHECKS.register("statistics")
class Statistics(AuditCheck):
    """Numbers that are not finite, outliers, components that never change.

    Non-obvious: a state far from the mean is rare, not wrong, where one skill of many leans the hand; measured, 8
    standard deviations in clean episodes of all skills. So only an isolated tick counts in states. Where every episode
    has such a tick, the standard deviation contains them all; the distance to the neighbours still shows each.
    """

    title = "Numbers spoil the normalisation"
    reason = "Trainers scale by these statistics: an outlier flattens all else, a constant divides by zero."
    threshold = (
        f"a number that is not finite; an action more than {OUTLIER:g} standard deviations from the mean; a tick whose "
        f"number is farther from the median of the five around it than {SPIKE:g} times the component's central 95 %, "
        f"velocities aside; a warning for a standard deviation below {CONSTANT:g}"
    )
    takes_any_number = True
    order = 23

    def __init__(self) -> None:
        """Remember the numbers."""
        self._episodes: dict[str, list[tuple[str, Numbers]]] = {}

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Find numbers that are not finite."""
        for name, values in episode.numbers.items():
            bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
            if len(bad):
                yield episode.finding(
                    f"{name} is not finite at {len(bad)} ticks, the first {bad[0]}", ticks=(int(bad[0]),)
                )
            elif name == "action" or name in episode.proprio:
                self._episodes.setdefault(f"{name} ({values.shape[1]})", []).append((episode.name, values))

    def conclude(self) -> Iterator[Finding]:
        """Find outliers and constants."""
        for key, episodes in self._episodes.items():
            name = key.partition(" ")[0]
            rows = np.concatenate([values for _, values in episodes]).astype(float)
            mean, deviation = rows.mean(axis=0), rows.std(axis=0)
            constant = np.flatnonzero(deviation < CONSTANT)
            if len(constant) and len(rows) > 1:
                yield Finding(text=f"{name}: components {constant.tolist()} never change", severity=Severity.WARNING)
            low, high = np.quantile(rows, [0.025, 0.975], axis=0)
            spread = np.maximum(high - low, MIN_SPREAD)
            for episode, values in episodes:
                spikes = np.abs(values - _neighbours(values)) / spread
                far = np.abs(values - mean) / np.where(deviation < CONSTANT, np.inf, deviation)
                if name == "action" and far.max() > OUTLIER:
                    yield _outlier(episode, name, values, far, "standard deviations from the mean")
                elif not name.endswith("velocities") and spikes.max() > SPIKE:
                    yield _outlier(episode, name, values, spikes, "times the central 95 % from its neighbours")


def _neighbours(values: Numbers) -> Numbers:
    """Return the median of the five ticks around each one, component by component."""
    from scipy.ndimage import median_filter

    return np.asarray(median_filter(values, size=(5, 1), mode="nearest"))


def _outlier(episode: str, name: str, values: Numbers, measure: npt.NDArray[np.float64], what: str) -> Finding:
    tick, component = (int(i) for i in np.unravel_index(int(measure.argmax()), measure.shape))
    value, size = values[tick, component], measure[tick, component]
    return Finding(
        text=f"{name}[{component}] is {value:.4g} at tick {tick}: {size:.0f} {what}",
        episodes=(episode,),
        ticks=(tick,),
        series={f"{name}[{component}]": tuple(values[:, component])},
    )


def action_hash(actions: Floats) -> str:
    """Return a hash of an episode's actions, rounded so that formats agree."""
    rounded = np.round(actions.astype(np.float64), DECIMALS) + 0.0
    return hashlib.blake2b(rounded.tobytes() + str(actions.shape).encode(), digest_size=16).hexdigest()


def _first_cells(episode: AuditEpisode) -> Floats:
    """Return the first images' summaries, cameras in order of their names."""
    tracks = [episode.tracks[camera].cells[0].ravel() for camera in sorted(episode.tracks)]  # of several sizes
    return np.concatenate(tracks) if tracks else np.zeros(0, np.float32)
