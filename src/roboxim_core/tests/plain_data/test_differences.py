from __future__ import annotations

from roboxim_core.plain_data.differences import differences


def test_only_what_differs_is_said_by_its_innermost_key():
    there = {"seed": 0, "episodes": 2, "policies": [{"spec": "bc", "options": {"checkpoint": "a"}}], "depth": False}
    asked = {"seed": 0, "episodes": 9, "policies": [{"spec": "bc", "options": {"checkpoint": "b"}}], "depth": True}
    assert differences(there, asked, ignore=("episodes",)) == (
        'depth: false stored, true requested; policies[0].options.checkpoint: "a" stored, "b" requested'
    )
    assert differences(there, there) == ""


def test_a_text_of_yaml_is_looked_into():
    there = {"task_config": "# a cube\nskill: pick_up\nobjects:\n  target:\n    models: {values: [cube]}\n"}
    asked = {"task_config": "# an apple\nskill: pick_up\nobjects:\n  target:\n    models: {values: [apple]}\n"}
    assert differences(there, asked) == (
        'task_config.objects.target.models.values: ["cube"] stored, ["apple"] requested'
    )
    commented = {"task_config": there["task_config"].replace("a cube", "the cube")}
    assert "the same values" in differences(there, commented)


def test_a_screen_is_never_flooded():
    there = {name: "x" * 500 for name in "abcdefgh"}
    said = differences(there, {"seed": 1})
    assert said.endswith("; and 4 more")
    assert len(said) < 600
