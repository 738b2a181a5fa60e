"""Checks an episode's messages tick by tick: the same check for whole and for damaged bags."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TypeVar

from mcap.records import Message

from roboxim_core.episode import EpisodeInfo, EpisodeResult, EpisodeStep
from roboxim_core.state import StateRecord
from roboxim_recorder import topics
from roboxim_recorder.cdr import CleanMessage, MessageLayout
from roboxim_recorder.decoding import Decoder
from roboxim_recorder.recording import result_facts
from roboxim_ros.messages.conversions import from_msg, stamp_to_ns

T = TypeVar("T")


class TickCheck:
    """Check of the ticks of one episode, which follow its info in the order of recording."""

    def __init__(self, decoder: Decoder, info: EpisodeInfo) -> None:
        """Prepare to check the tick 0.

        Args:
            decoder: Decodes the bag's messages.
            info: The episode.
        """
        self.decoder = decoder
        """Decodes the bag's messages."""
        self._layouts: dict[str, MessageLayout] = {}
        self._tick: dict[str, CleanMessage] = {}
        self._steps = 0
        self.info = info
        self.expected = topics.scene_topics(info.scene)
        """Topic to type of everything that belongs to a tick."""
        self.ticks = 0
        """Ticks that have ended, whole or not."""
        self.state: StateRecord | None = None
        """State of the newest tick."""
        self.step: EpisodeStep | None = None
        """Step of the newest tick."""

    @property
    def filtered(self) -> tuple[str, ...]:
        """Topics of the scene that the bag lacks and that no export needs."""
        needed = {topics.NOTICE, topics.STATE, topics.STEP}
        return tuple(
            name
            for name, kind in self.expected.items()
            if name not in self.decoder.types and kind != topics.IMAGE and name not in (*needed, *topics.ADDED)
        )

    def topic_problems(self) -> Iterator[str]:
        """Yield which topics the bag lacks or has with another type."""
        for name, kind in {**topics.OWN, **self.expected}.items():
            found = self.decoder.types.get(name)
            if found != kind and (found or name not in (*topics.ADDED, *self.filtered)):
                yield f"topic {name} is {f'of type {found}' if found else 'missing'}, expected {kind}"

    def message(self, topic: str, message: Message) -> Iterator[str]:
        """Take a message of a tick and yield its faults; the tick ends with its message on `topics.STEP`."""
        if topic in self._tick:
            yield f"tick {self.ticks} has two messages on {topic}"
        if topic not in self._layouts:
            self._layouts[topic] = self.decoder.layout(topic)
        clean = self._tick[topic] = self._layouts[topic].clean(message.data)
        stamp = clean.stamp_ns()
        if not message.log_time == message.publish_time == (message.log_time if stamp is None else stamp):
            yield f"tick {self.ticks}: a message on {topic} is stamped {stamp} ns, recorded at {message.log_time} ns"
        if topic == topics.STEP:  # the last message of every tick
            yield from self._tick_problems(message.log_time)
            self._tick = {}
            self.ticks += 1

    def _value(self, topic: str, cdr: bytes, cls: type[T]) -> T:
        value: T = from_msg(self.decoder.decode(topic, cdr), cls)
        return value

    def _tick_problems(self, stamp_ns: int) -> Iterator[str]:
        seq, tick = self.ticks, self._tick
        missing = [name for name in (topics.NOTICE, topics.STATE) if name not in tick]
        if missing:
            yield f"tick {seq} lacks {', '.join(missing)}"
            return
        step = self.step = self._value(topics.STEP, bytes(tick[topics.STEP].data), EpisodeStep)
        state = self.state = self._value(topics.STATE, bytes(tick[topics.STATE].data), StateRecord)
        notice = self.decoder.decode(topics.NOTICE, bytes(tick[topics.NOTICE].data))
        if not seq == step.seq == state.seq == notice.seq:
            yield (
                f"tick {seq} has the notice of tick {notice.seq}, the state of tick {state.seq} and the step of tick "
                f"{step.seq}"
            )
        others = {step.episode_id, state.episode_id, notice.episode_id} - {self.info.episode_id}
        if others:
            yield f"tick {seq} is of another episode: {', '.join(map(repr, sorted(others)))}"
        if not stamp_ns == stamp_to_ns(notice.stamp) == seq * self.info.scene.tick_ns:
            yield f"tick {seq} is stamped {stamp_ns} ns, expected {seq * self.info.scene.tick_ns}"
        wanted = dict(zip(map(topics.absolute, notice.topics), map(int, notice.image_crc32), strict=True))
        wanted = {name: crc32 for name, crc32 in wanted.items() if name in self.decoder.types}
        there = tick.keys() - {topics.NOTICE, topics.STEP}
        if missing := sorted(wanted.keys() - there):
            yield f"tick {seq} lacks {', '.join(missing)}"
        if extra := sorted(there - wanted.keys()):
            yield f"tick {seq} has messages that its notice does not name: {', '.join(extra)}"
        for topic, crc32 in wanted.items():
            if crc32 and topic in tick and zlib.crc32(tick[topic].bytes_of("data")) != crc32:
                yield f"tick {seq}: the image on {topic} is not the one that its notice names"
        self._steps += step.phase == "act"

    @property
    def result_facts(self) -> dict[str, object]:
        """Fields of the episode's result that follow from the ticks, with their values."""
        facts = result_facts(self.info, self.ticks - 1, self.state.state_hash if self.state else "")
        return facts | {"steps": self._steps}

    def result_problems(self, result: EpisodeResult) -> Iterator[str]:
        """Yield differences between the episode's result and its ticks."""
        for name, value in self.result_facts.items():
            found = getattr(result, name)
            if found != value:
                yield f"its result has {name} {found!r}, expected {value!r}"
        if result.bag and Path(result.bag).name != self.info.episode_id:
            yield f"its result is that of the bag {result.bag}"

    def end_problems(self) -> Iterator[str]:
        """Yield a fault if the bag ends within a tick."""
        if self._tick:
            yield f"it ends within tick {self.ticks}: {', '.join(sorted(self._tick))}"
