"""An episode as the studio shows it: every state, step and verdict, and the cameras' pictures as JPEG."""

from __future__ import annotations

import itertools
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from roboxim_core.episode import EpisodeInfo, EpisodeResult, EpisodeStep
from roboxim_core.errors import RecorderError
from roboxim_core.state import StateRecord
from roboxim_core.verdicts import Verdict
from roboxim_recorder.acted import ActedBy, acted_by, actor_of, is_shared
from roboxim_recorder.bag import BagReader
from roboxim_studio.background import program_ends, run_beside

QUALITY = 92
"""JPEG quality of pictures that are kept in memory."""
Picture = npt.NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True, eq=False)
class Film:
    """An episode; its pictures may still be on their way."""

    title: str
    """Name to show."""
    info: EpisodeInfo
    """Task, scene and everything else that defines the episode."""
    result: EpisodeResult
    """How it ended."""
    states: tuple[StateRecord, ...]
    """State of every tick."""
    steps: tuple[EpisodeStep, ...]
    """What the episode loop added to every tick."""
    pictures: Pictures
    """Pictures of every camera."""
    path: Path | None = None
    """The bag; none: it was not recorded."""
    acted: tuple[ActedBy, ...] = ()
    """Who acted at each action, if several did; empty: the episode's actor."""

    def __len__(self) -> int:
        """Count the ticks."""
        return len(self.states)

    @property
    def actors(self) -> tuple[ActedBy, ...]:
        """Who acted at each action."""
        return self.acted or (actor_of(self.info),) * self.result.steps

    @property
    def verdicts(self) -> tuple[Verdict, ...]:
        """Verdict of every tick, as recorded."""
        return tuple(step.verdict for step in self.steps)


GRACE_S = 2.0
"""Longest time for which the pictures of a bag wait for the first question for one [s]."""


@dataclass(eq=False)
class Pictures:
    """Pictures by camera and tick, compressed. Filled by one thread and read by others."""

    data: dict[str, dict[int, bytes]] = field(default_factory=dict)
    """Camera to tick to JPEG."""
    complete: threading.Event = field(default_factory=threading.Event)
    """Set when all have arrived."""
    requested: threading.Event = field(default_factory=threading.Event)
    """Set at the first request for pictures: a scene and its panel are shown first."""

    def add(self, seq: int, images: Mapping[str, Picture]) -> None:
        """Keep the pictures of a tick, uint8, shape (height, width, 3)."""
        for name, image in images.items():
            fine, coded = cv2.imencode(".jpg", image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
            assert fine
            self.data.setdefault(name, {})[seq] = coded.tobytes()

    def at(self, seq: int) -> dict[str, Picture]:
        """Return the pictures of a tick that have arrived, by camera."""
        self.requested.set()
        found = {name: ticks[seq] for name, ticks in tuple(self.data.items()) if seq in ticks}
        return {name: decoded(data) for name, data in found.items()}


def decoded(data: bytes) -> Picture:
    """Return a JPEG as RGB."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return np.ascontiguousarray(image[..., ::-1], dtype=np.uint8)


def read_film(path: Path, *, in_background: bool = True) -> Film:
    """Read a bag; its pictures follow in a thread.

    Args:
        path: The bag.
        in_background: False: return when the pictures are there too.

    Raises:
        ConfigError: When the path is no bag.
        RecorderError: When it is damaged.
    """
    reader = BagReader(path)
    ticks = list(reader.ticks(cameras=()))
    if not ticks:
        raise RecorderError(f"bag {path} has no tick; 'roboxim bag check' lists what is missing")
    pictures = Pictures()

    def fill() -> None:
        begun = time.monotonic()
        while in_background and not program_ends() and time.monotonic() - begun < GRACE_S:
            if pictures.requested.wait(0.1):
                break
        try:
            for tick in BagReader(path, info=reader.info).ticks(kinds=("image",)):
                if program_ends():
                    break
                pictures.add(tick.seq, tick.images)
        except RecorderError:
            pass  # the states are whole; a bag whose images were filtered out is shown without them
        finally:
            pictures.complete.set()

    if in_background:
        run_beside(fill, "pictures")
    else:
        fill()
    return Film(
        title=reader.info.episode_id, info=reader.info, result=reader.result, path=path,
        states=tuple(tick.state for tick in ticks), steps=tuple(tick.step for tick in ticks), pictures=pictures,
        acted=acted_by(reader) if is_shared(reader) else (),
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class Mark:
    """A tick worth a look."""

    seq: int
    """The tick."""
    name: str
    """What happens there."""


def marks(film: Film, verdicts: Sequence[Verdict] | None = None) -> tuple[Mark, ...]:
    """Return the ticks to jump to: start of acting and settling, first contacts, changes of the verdict, the end.

    Args:
        film: The episode.
        verdicts: Verdicts to go by; none: the recorded ones.
    """
    found: list[Mark] = []
    verdicts = verdicts or film.verdicts
    touched: set[str] = set()
    reason, was = "", False
    for state, step, verdict in zip(film.states, film.steps, verdicts, strict=True):
        if step.phase == "settle" and state.seq and film.steps[state.seq - 1].phase != "settle":
            found.append(Mark(seq=state.seq, name="holds still"))
        for contact in state.contacts:
            bodies = {contact.body_a, contact.body_b}
            other = next(iter(bodies - {"robot"}), "robot")
            if "robot" in bodies and contact.force_max > 0 and other not in touched:
                touched.add(other)
                found.append(Mark(seq=state.seq, name=f"robot touches {other}"))
        if verdict.success != was:
            found.append(Mark(seq=state.seq, name="solved" if verdict.success else "no longer solved"))
        if verdict.failed and (not reason or not found[-1:] or verdict.reason != reason):
            if reason != verdict.reason:
                found.append(Mark(seq=state.seq, name=f"failed: {verdict.reason}"))
            reason = verdict.reason
        was = verdict.success
    for number, (before, actor) in enumerate(itertools.pairwise(film.actors), start=1):
        if before != actor:
            found.append(Mark(seq=number, name=f"{actor} takes over"))
    found.sort(key=lambda mark: mark.seq)
    return (Mark(seq=0, name="start"), *found, Mark(seq=len(film) - 1, name=f"end: {ending(film)}"))


def ending(film: Film) -> str:
    """Return how an episode ended, in a few words."""
    return film.result.outcome + (f", {film.result.reason}" if film.result.reason else "")


def first(film: Film, holds: Callable[[int], bool]) -> int | None:
    """Return the first tick at which something holds; none: at no tick."""
    return next((seq for seq in range(len(film)) if holds(seq)), None)
