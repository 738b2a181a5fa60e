"""Faults composed at random from edit operators, which no check knows by name.

An edit is an operator, a key and a range of ticks; a fault is one to three edits of one episode. They measure how many
unforeseen faults an audit finds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from roboxim_core.actions import ControlMode
from roboxim_core.rotation.representations import decode_rows
from roboxim_datasets.audit.faults.values import EditableEpisode
from roboxim_datasets.episode import Episode, Floats

LENGTHENING = ("repeat", "drop", "splice")
"""Operators that take whole steps, of all keys at once."""
ROWS = ("shift", "swap", "scale", "sign", "permute", "splice", "repeat")
"""Operators on the rows of one key."""
IMAGES = ("shift", "swap", "splice", "repeat")
MAX_EDITS = 3


@dataclass(frozen=True, kw_only=True)
class Composed:
    """What was done to an episode."""

    text: str
    """The edits in words."""
    keys: tuple[str, ...]
    """What they changed: ``action``, ``executed``, a vector, a camera, ``steps``, ``instruction``, ``task``."""
    action_mm: float
    """Largest change of the translation of a label or an executed action; of edits of whole steps, the motion that is
    lost, added or does not join [mm]."""
    action_deg: float
    """The same of rotations [degrees]."""
    relabelled: bool
    """Whether a text label changed."""

    @property
    def counts(self) -> bool:
        """Whether a policy would learn something else by more than 2 mm, 2 degrees or a label."""
        return self.action_mm > 2.0 or self.action_deg > 2.0 or self.relabelled


def compose(episode: EditableEpisode, others: Sequence[Episode], rng: np.random.Generator) -> Composed:
    """Edit an episode at random.

    Args:
        episode: The episode; it is changed.
        others: Further episodes, whose parts and labels may replace its own.
        rng: The random stream.
    """
    before = EditableEpisode(**vars(episode))
    texts, keys, lost = [], [], (0.0, 0.0)
    for _ in range(int(rng.integers(1, MAX_EDITS + 1))):
        other = others[int(rng.integers(len(others)))]
        key, last = str(rng.choice(_keys(episode))), EditableEpisode(**vars(episode))
        if key in ("instruction", "task"):
            text = _relabel(episode, key, other)
        elif key == "steps":
            text, joint = _steps(episode, str(rng.choice(LENGTHENING)), other, rng)
            lost = max(lost[0], joint[0]), max(lost[1], joint[1])
        elif key in episode.images:
            text = _images(episode, key, str(rng.choice(IMAGES)), other, rng)
        else:
            text = _rows(episode, key, str(rng.choice(ROWS)), other, rng)
        if text and not same(last, episode):
            texts.append(text)
            keys.append(key)
    moved = _action_change(before, episode)
    return Composed(
        text="; ".join(texts), keys=tuple(keys), action_mm=max(moved[0], lost[0]), action_deg=max(moved[1], lost[1]),
        relabelled=before.instruction != episode.instruction,
    )  # fmt: skip


def same(one: EditableEpisode, other: EditableEpisode) -> bool:
    """Return whether two versions of an episode hold the same values."""
    if (one.instruction, one.metadata, len(one)) != (other.instruction, other.metadata, len(other)):
        return False
    tables: list[tuple[Any, Any]] = [
        (one.actions, other.actions),
        *((rows, other.proprio[name]) for name, rows in one.proprio.items()),
    ]
    if one.executed is not None and other.executed is not None:
        tables.append((one.executed, other.executed))
    pairs = [pair for name in one.images for pair in zip(one.images[name], other.images[name], strict=True)]
    return all(a is b or np.array_equal(a, b) for a, b in [*tables, *pairs])


def _keys(episode: EditableEpisode) -> list[str]:
    """Return what can be edited; actions, which matter most, four times as often as a camera."""
    found = ["action"] * 4 + ["steps"] * 2 + ["instruction", "task", *episode.proprio, *episode.images]
    return found + ["executed", "both"] * (episode.executed is not None)


def _window(count: int, rng: np.random.Generator) -> tuple[int, int]:
    """Return a range of ticks: in a third of the cases all of them."""
    if rng.random() < 1 / 3:
        return 0, count
    start = int(rng.integers(0, count - 1))
    return start, int(rng.integers(start + 1, count + 1))


def _relabel(episode: EditableEpisode, key: str, other: Episode) -> str:
    if other.instruction == episode.instruction:
        return ""
    episode.instruction = other.instruction
    if key == "task":
        taken = {name: other.metadata[name] for name in ("task", "skill") if name in other.metadata}
        episode.metadata = {**episode.metadata, **taken}
    return f"{key} of another episode: '{other.instruction}'"


def _rows(episode: EditableEpisode, key: str, operator: str, other: Episode, rng: np.random.Generator) -> str:
    """Edit the rows of a key; ``both`` is labels and executed actions alike."""
    edit, text = _row_edit(episode, key, operator, other, rng)
    for name in ("action", "executed") if key == "both" else (key,):
        if name == "action":
            episode.actions = edit(episode.actions)
        elif name == "executed" and episode.executed is not None:
            episode.executed = edit(episode.executed)
        elif name in episode.proprio:
            episode.proprio = {**episode.proprio, name: edit(episode.proprio[name])}
    return text


def _row_edit(
    episode: EditableEpisode, key: str, operator: str, other: Episode, rng: np.random.Generator
) -> tuple[Callable[[Floats], Floats], str]:
    start, end = _window(len(episode), rng)
    size = episode.proprio[key].shape[1] if key in episode.proprio else episode.actions.shape[1]
    some = np.sort(rng.permutation(size)[: int(rng.integers(1, size + 1))])
    ticks = int(rng.choice([-3, -2, -1, 1, 2, 3]))
    gain = float(rng.choice([0.5, 0.7, 0.85, 1.15, 1.3, 2.0]))
    order = rng.permutation(some)
    donor = _donor(other, key)
    second = int(rng.integers(0, len(episode)))

    def edit(rows: Floats) -> Floats:
        changed = rows.copy()
        part = changed[start:end]
        if operator == "shift":
            places = np.clip(np.arange(start, end) - ticks, 0, len(rows) - 1)
            changed[start:end] = rows[places]
        elif operator == "swap":
            count = min(end - start, len(rows) - second)
            changed[start : start + count] = rows[second : second + count]
            changed[second : second + count] = rows[start : start + count]
        elif operator == "scale":
            part[:, some] *= np.float32(gain)
        elif operator == "sign":
            part[:, some] *= -1
        elif operator == "permute":
            part[:, some] = part[:, order]
        elif operator == "splice" and donor.shape[1] == rows.shape[1]:
            part[: len(donor[start:end])] = donor[start:end]
        elif operator == "repeat":
            changed[start:end] = rows[start]
        return changed

    detail = {"shift": f"by {ticks} ticks", "scale": f"by {gain:g}"}.get(operator, "")
    return edit, f"{operator} {key} {detail} in ticks {start} to {end - 1}, components {some.tolist()}"


def _donor(other: Episode, key: str) -> Floats:
    steps = list(other.steps(()))
    if key in ("action", "both"):
        return np.stack([step.action for step in steps])
    if key == "executed":
        return np.stack([step.action if step.action_executed is None else step.action_executed for step in steps])
    return np.stack([step.proprio[key] for step in steps])


def _images(episode: EditableEpisode, camera: str, operator: str, other: Episode, rng: np.random.Generator) -> str:
    start, end = _window(len(episode), rng)
    images = list(episode.images[camera])
    if operator == "shift":
        ticks = int(rng.choice([-3, -2, -1, 1, 2, 3]))
        places = np.clip(np.arange(start, end) - ticks, 0, len(images) - 1)
        images[start:end] = [episode.images[camera][place] for place in places]
    elif operator == "swap":
        second = str(rng.choice(sorted(episode.images)))
        swapped = list(episode.images[second])
        swapped[start:end], images[start:end] = images[start:end], swapped[start:end]
        episode.images = {**episode.images, second: swapped}
        if second == camera:
            return ""
    elif operator == "splice" and camera in other.cameras:
        donor = [step.images[camera] for step in other.steps((camera,))][start:end]
        images[start : start + len(donor)] = donor
    else:
        images[start:end] = [images[start]] * (end - start)
    episode.images = {**episode.images, camera: images}
    return f"{operator} {camera} in ticks {start} to {end - 1}"


def _steps(
    episode: EditableEpisode, operator: str, other: Episode, rng: np.random.Generator
) -> tuple[str, tuple[float, float]]:
    """Repeat, drop or replace whole steps; return what was done, and the motion that no longer joins [mm, degrees]."""
    count = len(episode)
    start = int(rng.integers(1, count - 2))
    end = min(count - 1, start + int(rng.integers(1, max(2, count // 4))))
    places = [*range(count)]
    donor = EditableEpisode.of(other)
    if operator == "repeat":
        joint = _commanded(episode, start, end)
        episode.take([*places[:end], *places[start:end], *places[end:]])
    elif operator == "drop":
        joint = _commanded(episode, start, end)
        episode.take([*places[:start], *places[end:]])
    else:
        end = min(end, len(donor))
        if start >= end or donor.proprio.keys() != episode.proprio.keys():
            return "", (0.0, 0.0)
        joint = _apart(episode, donor, start)
        _take_steps(episode, donor, start, end)
    return f"{operator} steps {start} to {end - 1}", joint


def _take_steps(episode: EditableEpisode, donor: EditableEpisode, start: int, end: int) -> None:
    window = slice(start, end)

    def joined(rows: Floats, others: Floats) -> Floats:
        changed = rows.copy()
        changed[window] = others[window]
        return changed

    episode.actions = joined(episode.actions, donor.actions)
    if episode.executed is not None and donor.executed is not None:
        episode.executed = joined(episode.executed, donor.executed)
    episode.proprio = {name: joined(rows, donor.proprio[name]) for name, rows in episode.proprio.items()}
    for camera in episode.images.keys() & donor.images.keys():
        episode.images = {
            **episode.images, camera: [*episode.images[camera][:start], *donor.images[camera][window],
                                       *episode.images[camera][end:]],
        }  # fmt: skip


def _commanded(episode: EditableEpisode, start: int, end: int) -> tuple[float, float]:
    """Return the total motion of the executed actions of some ticks."""
    rows = episode.actions if episode.executed is None else episode.executed
    total = rows[start:end].sum(axis=0)
    return 1000 * float(np.linalg.norm(total[:3])), float(np.degrees(np.linalg.norm(total[3:6])))


def _apart(episode: EditableEpisode, donor: EditableEpisode, tick: int) -> tuple[float, float]:
    """Return how far the hands of two episodes are apart at a tick."""
    place = episode.column("tcp.x")
    if place is None:
        return 0.0, 0.0
    vector, at = place
    return 1000 * float(np.linalg.norm((episode.proprio[vector] - donor.proprio[vector][tick])[tick, at : at + 3])), 0.0


def _action_change(before: EditableEpisode, after: EditableEpisode) -> tuple[float, float]:
    """Return the largest change of a label or an executed action at its tick; 0 where the number of ticks changed."""
    semantics = before.episode.semantics
    if len(before) != len(after) or semantics is None or semantics.control != ControlMode.END_EFFECTOR_DELTA:
        return 0.0, 0.0
    kind, moved, turned = semantics.rotation, 0.0, 0.0
    for old, new in ((before.actions, after.actions), (before.executed, after.executed)):
        if old is not None and new is not None:
            moved = max(moved, 1000 * float(np.linalg.norm(new[:, :3] - old[:, :3], axis=1).max()))
            turns = [decode_rows(rows[:, 3 : 3 + kind.size].astype(float), kind) for rows in (old, new)]
            turned = max(turned, float(np.degrees((turns[0].inv() * turns[1]).magnitude().max())))
    return moved, turned
