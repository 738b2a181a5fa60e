"""Two datasets are equal, or the comparison names what differs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.errors import InvalidRequestError
from roboxim_datasets.compare import compare, comparison_text, same_bits


def changed(episode, change):
    """Return an episode whose steps went through a function."""
    return replace(episode, read=lambda wanted: (change(step) for step in episode.read(wanted)))


def test_equal_datasets_are_equal_whatever_their_encoding(tmp_path, write):
    a, b = write(tmp_path / "a", val=[7]), write(tmp_path / "b", val=[7], encoding="jpeg")
    found = compare(a, a)
    assert found.equal
    assert (found.episodes, found.steps) == (4, 12)
    assert found.compared["images"] == "pixel by pixel"
    assert found.images["workspace"].equal == 12
    found = compare(a, b)
    assert found.equal, comparison_text(found, {"a": "a", "b": "b"})
    assert 30 < found.images["workspace"].lowest_db < 60
    assert "EQUAL" in comparison_text(found, {"a": "a", "b": "b"})
    found = compare(a, b, images="exact")
    assert "camera 'workspace' from step 0: images differ" in str(found.differences[0])
    assert found.count == 4, "each episode's camera is named once"


@pytest.mark.parametrize("level", [float("nan"), -1.0])
def test_a_level_that_is_no_number_of_decibels_is_refused(tmp_path, write, level):
    a = write(tmp_path / "a", [0])
    with pytest.raises(InvalidRequestError, match="at least 0 dB"):
        compare(a, a, lowest_psnr_db=level)


def last_bit(values):
    return (values.view(np.uint32) ^ np.uint32(1)).view(np.float32)


CHANGES = {
    "action": lambda s: replace(s, action=last_bit(s.action)) if s.index == 1 else s,
    "sim.action_executed": lambda s: replace(s, action_executed=last_bit(s.action_executed)),
    "state": lambda s: replace(s, proprio={**s.proprio, "state": last_bit(s.proprio["state"])}),
    "sim.force": lambda s: replace(s, signals={"sim.force": np.float32([9])}),
    "reward": lambda s: replace(s, reward=0.5),
    "camera 'workspace'": lambda s: replace(s, images={k: v[::-1] for k, v in s.images.items()}),
}


@pytest.mark.parametrize("what", CHANGES)
def test_a_changed_number_or_image_is_named(tmp_path, write, episode_of, what):
    a = write(tmp_path / "a", [0, 1])
    b = write(tmp_path / "b", [0, changed(episode_of(1), CHANGES[what])])
    found = compare(a, b)
    assert found.count == 1
    step = 1 if what == "action" else 0
    assert str(found.differences[0]).startswith(f"train[1] demo-1: {what} from step {step}")
    if what in ("state", "sim.force"):
        assert compare(a, b, ignore=[what]).equal


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"instruction": "Pick up something"}, "instruction: 'Pick up cube 1' against 'Pick up something'"),
        ({"episode_id": "other"}, "episode id: 'demo-1' against 'other'"),
        ({"success": False}, "success: True against False"),
    ],
)
def test_a_changed_text_is_named(tmp_path, write, episode_of, changes, message):
    a, b = write(tmp_path / "a", [0, 1]), write(tmp_path / "b", [0, episode_of(1, **changes)])
    assert [message in str(difference) for difference in compare(a, b).differences] == [True]


def test_another_length_order_split_or_feature_is_named(tmp_path, write, episode_of):
    a = write(tmp_path / "a", [0, 1])
    found = compare(a, write(tmp_path / "length", [0, episode_of(1, length=4)]))
    assert "train[1] demo-1: length: 3 against 4" in map(str, found.differences)
    found = compare(a, write(tmp_path / "order", [1, 0]))
    assert "the episodes are the same, in another order or in other splits" in map(str, found.differences)
    found = compare(a, write(tmp_path / "split", [0], val=[1]))
    assert "splits: {'train': 2} against {'train': 1, 'val': 1}" in map(str, found.differences)


def test_other_names_of_components_are_named_unless_a_dataset_states_none(tmp_path, write, description):
    def named(folder, last, state):
        action = (*description.features.action[:-1], last)
        features = replace(
            description.features, action=action, vectors={**description.features.vectors, "state": state}
        )
        return write(tmp_path / folder, [0], format="hdf5", description=replace(description, features=features))

    a, b = named("a", "gripper", ("tcp.x", "tcp.y")), named("b", "jaw", ("tcp.y", "tcp.x"))
    found = [str(difference) for difference in compare(a, b).differences]
    assert any(text.startswith("action: components dx, dy") and "dyaw, jaw" in text for text in found), found
    assert "vector 'state': components tcp.x, tcp.y against tcp.y, tcp.x" in found
    assert compare(a, named("c", "gripper", ("state.0", "state.1"))).equal


def test_bits_count_not_values():
    assert same_bits([np.nan, 1.0], [np.nan, 1.0])
    assert not same_bits([0.0], [-0.0])
    assert not same_bits([1.0], [[1.0]])
