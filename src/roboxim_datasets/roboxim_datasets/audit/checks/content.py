"""Every value against what it should be: an export of the bags, or another dataset of the same episodes.

This check knows no faults. Any difference is a finding; the edit that explains it best is a hint for the reader.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from roboxim_datasets.audit.check import AUDIT_CHECKS, AuditCheck
from roboxim_datasets.audit.fitting import likeliest
from roboxim_datasets.audit.images import cells_of
from roboxim_datasets.audit.values import AuditEpisode, CannotCheckError, Finding, Values
from roboxim_datasets.compare import same_bits
from roboxim_datasets.episode import EXECUTED, Episode, Floats, Step

BLOCKS = 8
"""Blocks along each side of an image whose mean colours are compared: large enough to average a codec's errors."""
BLOCK = 12.0
"""Difference of a block's mean colour (0..255) that no codec makes."""
LOWEST_DB = 26.0
"""PSNR of an image below which no codec is to blame [dB]: h264 against JPEG at 64 x 64 px reaches 30 dB or more."""
REMEMBERED = 2000
"""Episodes whose expected actions are remembered, to recognise them elsewhere."""


@dataclass(frozen=True, kw_only=True, eq=False)
class _Table:
    """An episode's numbers: name to values of shape (T, n), and the names of their components."""

    values: dict[str, Floats]
    names: dict[str, tuple[str, ...]]


@AUDIT_CHECKS.register("content")
class Content(AuditCheck):
    """Values that differ from the expected ones."""

    title = "Values differ from what they should be"
    reason = "Something changed the data after they were recorded: a policy learns the change."
    threshold = (
        "any number, text or length that is not equal, float32 bit for bit; any pixel where the format is lossless, "
        f"else the mean colour of a block (1/{BLOCKS} of a side) off by more than {BLOCK:g} of 255, or a PSNR below "
        f"{LOWEST_DB:g} dB"
    )
    needs = "the bags (--bags), which are exported again in memory, or another dataset (--against)"
    takes_any_number = True
    order = 0

    def __init__(self) -> None:
        """Remember what other episodes should be."""
        self._known: dict[bytes, str] = {}

    def look(self, episode: AuditEpisode) -> Iterator[Finding]:
        """Compare everything."""
        if episode.unexpected:
            yield episode.finding(episode.unexpected, ticks=(0,))
            return
        if episode.expected is None:
            raise CannotCheckError(episode.no_expected)
        found, expected = episode.episode, episode.expected
        yield from _texts(episode.name, found, expected)
        actual, reference = _table(found), _table(expected)
        yield from self._numbers(episode.name, actual, reference)
        if len(found) == len(expected):
            yield from _images(episode)
        if len(self._known) < REMEMBERED:
            self._known.setdefault(reference.values["action"].tobytes(), episode.name)

    def _numbers(self, name: str, actual: _Table, reference: _Table) -> Iterator[Finding]:
        for key in sorted(actual.values.keys() ^ reference.values.keys()):
            where = "nothing that should be there" if key in actual.values else "missing"
            yield Finding(text=f"{key} is {where}", episodes=(name,))
        for key in sorted(actual.values.keys() & reference.values.keys()):
            values, wanted = actual.values[key], reference.values[key]
            if values.shape == wanted.shape and same_bits(values, wanted):
                continue
            if values.shape[1:] != wanted.shape[1:]:
                yield Finding(
                    text=f"{key} has {values.shape[1]} components, expected {wanted.shape[1]}", episodes=(name,)
                )
                continue
            count = min(len(values), len(wanted))
            bad = np.flatnonzero((values[:count] != wanted[:count]).any(axis=1))
            if not len(bad):
                continue  # the length differs, which is reported
            guess = self._guess(key, values, reference, bad)
            component = int((values[bad[0]] != wanted[bad[0]]).argmax())
            label = reference.names[key][component]
            yield Finding(
                text=f"{key} differs in {len(bad)} of {len(wanted)} ticks, first at tick {bad[0]}: {label} is "
                f"{values[bad[0], component]:.6g}, expected {wanted[bad[0], component]:.6g}{guess}",
                episodes=(name,),
                ticks=tuple(dict.fromkeys((int(bad[0]), int(bad[-1])))),
                series={f"{label}": tuple(values[:, component]), f"{label} expected": tuple(wanted[:, component])},
            )

    def _guess(self, key: str, values: Floats, reference: _Table, bad: Any) -> str:
        wanted = reference.values[key]
        if key == "action" and values.tobytes() in self._known:
            return f"; likeliest: those of episode {self._known[values.tobytes()]}"
        for other, rows in reference.values.items():
            if other != key and rows.shape == values.shape and same_bits(rows, values):
                return f"; likeliest: exchanged with {other}"
        if len(values) != len(wanted):
            return "; likeliest: ticks were left out, repeated or added before it"
        window = slice(max(int(bad[0]) - 1, 0), int(bad[-1]) + 2)
        edited, right = values[window].astype(float), wanted[window].astype(float)
        if not (np.isfinite(edited).all() and np.isfinite(right).all()):
            return "; likeliest: numbers that are not finite"
        if len(bad) > 1 and (values[bad] == values[bad[0]]).all():
            return "; likeliest: one tick is repeated"
        words = likeliest(edited, right, reference.names[key])
        return f"; likeliest: {words}" if words else "; likeliest: other values"


def _texts(name: str, found: Episode, expected: Episode) -> Iterator[Finding]:
    pairs: dict[str, tuple[object, object]] = {
        "the instruction": (found.instruction, expected.instruction),
        "the number of ticks": (len(found), len(expected)),
        "the success": (found.success, expected.success),
        "the episode id": (found.episode_id, expected.episode_id),
    }
    if found.metadata and expected.metadata:
        shared = found.metadata.keys() & expected.metadata.keys()
        pairs |= {f"metadata '{key}'": (found.metadata[key], expected.metadata[key]) for key in sorted(shared)}
    for what, (value, wanted) in pairs.items():
        if value != wanted and not (what == "the episode id" and "" in (value, wanted)):
            text = f"{what} is {_short(value)}, expected {_short(wanted)}"
            yield Finding(text=text, episodes=(name,), ticks=(0,))


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) < 120 else f"{text[:117]}..."


def _table(episode: Episode) -> _Table:
    steps = list(episode.steps(()))
    size = len(steps[0].action)
    names = {"action": tuple(f"action[{i}]" for i in range(size)), "reward": ("reward",)}
    values = {
        "action": np.stack([step.action for step in steps]),
        "reward": np.array([[step.reward] for step in steps], np.float32),
    }
    if all(step.action_executed is not None for step in steps):
        values[EXECUTED] = np.stack([step.signal(EXECUTED) for step in steps])
        names[EXECUTED] = tuple(f"executed[{i}]" for i in range(size))
    for vector, parts in episode.vectors.items():
        values[vector] = np.stack([step.proprio[vector] for step in steps])
        names[vector] = parts
    for signal, parts in episode.signals.items():
        values[signal] = np.stack([step.signals[signal] for step in steps])
        names[signal] = parts
    return _Table(values=values, names=names)


def _images(episode: AuditEpisode) -> Iterator[Finding]:
    """Compare images tick by tick."""
    found, expected = episode.episode, episode.expected
    assert expected is not None
    for camera in sorted(found.cameras.keys() ^ expected.cameras.keys()):
        yield episode.finding(f"only one of both has camera '{camera}'")
    shared = sorted(found.cameras.keys() & expected.cameras.keys())
    bad: dict[str, list[int]] = {camera: [] for camera in shared}
    seen: dict[str, list[Values]] = {camera: [] for camera in shared}
    wanted: dict[str, list[Values]] = {camera: [] for camera in shared}
    for actual, reference in zip(found.steps(shared), expected.steps(shared), strict=True):
        for camera in shared:
            pair = actual.images[camera], reference.images[camera]
            seen[camera].append(_colours(pair[0]))
            wanted[camera].append(_colours(pair[1]))
            if _differ(actual, reference, camera, seen[camera][-1], wanted[camera][-1], lossless=episode.lossless):
                bad[camera].append(actual.index)
    for camera, ticks in bad.items():
        if ticks:
            yield episode.finding(
                f"the images of {camera} differ in {len(ticks)} of {len(found)} ticks, first at tick {ticks[0]}"
                f"{_which(camera, ticks, seen, wanted)}",
                ticks=tuple(ticks[:3]),
                cameras=(camera,),
            )


def _colours(image: np.ndarray) -> Values:
    """Return the mean of each cell for each colour, shape (3, cells, cells)."""
    return np.stack([cells_of(image[:, :, channel].astype(np.float32)) for channel in range(3)])


def _differ(actual: Step, reference: Step, camera: str, seen: Values, wanted: Values, *, lossless: bool) -> bool:
    if actual.images[camera].shape != reference.images[camera].shape:
        return True
    if lossless:
        return not np.array_equal(actual.images[camera], reference.images[camera])
    mean = np.square(actual.images[camera].astype(np.float32) - reference.images[camera]).mean()
    too_noisy = mean > 255.0**2 / 10.0 ** (LOWEST_DB / 10.0)
    return bool(too_noisy or np.abs(_blocks(seen) - _blocks(wanted)).max() > BLOCK)


def _blocks(cells: Values) -> Values:
    """Return the means of blocks of cells, shape (3, blocks, blocks)."""
    rows, columns = (np.linspace(0, size, min(BLOCKS, size), endpoint=False).astype(int) for size in cells.shape[1:])
    sums = np.add.reduceat(np.add.reduceat(cells, rows, axis=1), columns, axis=2)
    counts = np.outer(np.diff(np.r_[rows, cells.shape[1]]), np.diff(np.r_[columns, cells.shape[2]]))
    return np.asarray(sums / counts, np.float32)


def _which(camera: str, ticks: list[int], seen: Mapping[str, list[Values]], wanted: Mapping[str, list[Values]]) -> str:
    """Return the camera or tick to which the first differing images most likely belong."""
    at = ticks[len(ticks) // 2]
    image = seen[camera][at]
    best, words = float(np.square(image - wanted[camera][at]).mean()) / 4, ""
    for other, images in wanted.items():
        for tick, candidate in enumerate(images):
            if candidate.shape == image.shape and (other, tick) != (camera, at):
                left = float(np.square(image - candidate).mean())
                if left < best:
                    best = left
                    words = f"tick {at} shows what {other} should show at tick {tick}"
    if not words and float(np.square(image[::-1] - wanted[camera][at]).mean()) < best:
        words = "red and blue are exchanged"
    return f"; likeliest: {words}" if words else ""
