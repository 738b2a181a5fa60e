"""Edited copies of bags: whole, equal but for the edit, and the source as it was."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from roboxim_core.errors import RecorderError
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader
from roboxim_recorder.edited import copy_edited
from roboxim_recorder.integrity.check import check_bag

IMAGE = topics.image_topic("workspace")


def test_edits_reach_the_copy_and_nothing_else_changes(fake: Callable[..., Any], tmp_path: Path) -> None:
    bag = fake().record(tmp_path / "source")
    before = (bag / "metadata.yaml").read_bytes(), next(bag.glob("*.mcap")).read_bytes()

    def edit(topic: str, message: Any) -> None:
        if topic == topics.INFO:
            message.task.instruction = "Pick up the apple"
        elif topic == topics.RESULT:
            message.instruction = "Pick up the apple"
        elif topic == topics.STEP and message.seq == 2:
            message.action_label = np.zeros(7)
        elif topic == IMAGE:
            message.data = np.zeros_like(message.data)

    copy = copy_edited(bag, tmp_path / "copy", (topics.INFO, topics.RESULT, topics.STEP, IMAGE), edit)
    assert check_bag(copy).ok, check_bag(copy).problems
    assert ((bag / "metadata.yaml").read_bytes(), next(bag.glob("*.mcap")).read_bytes()) == before
    reader, source = BagReader(copy), BagReader(bag)
    assert reader.info.task.instruction == reader.metadata["instruction"] == "Pick up the apple"
    assert reader.info.scene == source.info.scene
    assert replace(reader.result, instruction=source.result.instruction) == source.result
    for tick, was in zip(reader.ticks(), source.ticks(), strict=True):
        assert (tick.state, tick.stamp_ns) == (was.state, was.stamp_ns)
        assert not tick.images["workspace"].any()
        np.testing.assert_array_equal(tick.images["wrist"], was.images["wrist"])
        assert tick.step.action_label == ((0.0,) * 7 if tick.seq == 2 else was.step.action_label)


def test_without_an_edit_the_copy_has_the_same_messages(fake: Callable[..., Any], tmp_path: Path) -> None:
    bag = fake().record(tmp_path / "source")
    copy = copy_edited(bag, tmp_path / "copy", (), lambda topic, message: None)
    assert list(BagReader(copy).raw()) == list(BagReader(bag).raw())
    assert BagReader(copy).metadata == BagReader(bag).metadata


def test_a_failing_edit_leaves_no_bag(fake: Callable[..., Any], tmp_path: Path) -> None:
    bag = fake().record(tmp_path / "source")

    def edit(topic: str, message: Any) -> None:
        raise RecorderError("no")

    with pytest.raises(RecorderError, match="no"):
        copy_edited(bag, tmp_path / "copy", (topics.STEP,), edit)
    assert not list((tmp_path / "copy").rglob("*.mcap"))
