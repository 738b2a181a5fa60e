"""A convention explains itself with numbers that it decodes."""

import pytest

from roboxim_core.config_folders import config_names
from roboxim_core.conventions import load_convention
from roboxim_core.conventions.words import described, examples


@pytest.mark.parametrize("name", config_names("conventions"))
def test_a_description_names_all_keys_notes_and_sources(name):
    convention = load_convention(name)
    text = described(convention)
    named = [image.key for image in convention.images] + [state.key for state in convention.states]
    for part in (*named, convention.prompt.key, *convention.action.keys, *convention.notes, *convention.sources):
        assert part in text
    assert (f"{convention.rate_hz:g} Hz" if convention.rate_hz else "any rate") in text
    assert len(examples(convention)) == convention.action.natural_size + 1


def test_the_examples_say_what_one_action_does():
    assert examples(load_convention("libero"))[:2] == [
        "[1, 0, 0, 0, 0, 0, 0]   moves 13.1 mm along +x (forwards)",
        "[0, 1, 0, 0, 0, 0, 0]   moves 12.45 mm along +y (to the left)",
    ]
    assert "[0, 0, 0, 1, 0, 0, 0]   turns 0.1255 rad (7.19 degrees) about +x" in examples(load_convention("libero"))
    assert examples(load_convention("droid_velocity"))[0] == "[1, 0, 0, 0, 0, 0, 0, 0.5]  turns joint 1 by 0.2 rad"
    assert examples(load_convention("rt1_widowx"))[2] == "[0, 0, 1.75, 0, 0, 0, 0]  moves 50 mm along +z (up)"


def test_turned_axes_show_in_the_examples(tmp_path):
    (tmp_path / "own.yaml").write_text("rate_hz: 10\nframes: {base_axes: ['-y', z, x], tool_axes: ['-y', z, x]}\n")
    convention = load_convention(str(tmp_path / "own.yaml"))
    first, second = examples(convention)[:2]
    assert first.endswith("moves 10 mm along -y (to the right)")
    assert second.endswith("moves 10 mm along +z (up)")
    assert "x is RoboXim's -y, y is RoboXim's z, z is RoboXim's x" in described(convention)


@pytest.mark.parametrize("control", ["end_effector_absolute", "joint_position", "joint_velocity"])
@pytest.mark.parametrize("rotation", ["rotation_6d", "quaternion_xyzw", "euler_xyz_intrinsic"])
def test_every_kind_of_action_can_be_explained(tmp_path, control, rotation):
    (tmp_path / "own.yaml").write_text(f"rate_hz: 10\naction: {{control: {control}, rotation: {rotation}}}\n")
    assert len(examples(load_convention(str(tmp_path / "own.yaml")))) > 7
