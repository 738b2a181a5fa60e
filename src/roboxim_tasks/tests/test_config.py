import pytest

from roboxim_core.config import config_dir, to_plain
from roboxim_core.errors import ConfigError
from roboxim_tasks.config import load_task_config, parse_task_config, task_config


@pytest.mark.parametrize("path", sorted((config_dir() / "tasks").glob("*.yaml")), ids=lambda path: path.stem)
def test_every_shipped_task_loads_and_its_resolved_form_loads_again(path):
    config = load_task_config(str(path))
    assert task_config(to_plain(config)) == config


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("skill: pick_upp", ["line 1", "skill", "'pick_upp'", "pick_up"]),
        ("rate_hz: 10\nmax_step: 3", ["line 2", "max_step", "did you mean 'max_steps'"]),
        ("objects:\n  targett: {}", ["line 2", "targett", "target"]),
        (
            "objects:\n  target:\n    modifiers:\n      color: {values: [red, blu]}",
            ["line 4", "color", "'blu'", "blue"],
        ),
        ("objects:\n  target:\n    modifiers: {colour: {values: [red]}}", ["line 3", "'colour'", "color"]),
        ("objects:\n  target:\n    models: {values: [cubes]}", ["line 3", "'cubes'", "cube"]),
        ("distractors:\n  minimum: 3", ["distractors", "minimum <= maximum"]),
        ("reset:\n  lightz: {}", ["line 2", "lightz", "lights"]),
        ("reset:\n  objects:\n    gapp: 1", ["line 3", "gapp", "gap_m"]),
        ("reset:\n  objects:\n    area: {lower: [0.4], upper: [0.5]}", ["reset.objects", "area", "2 numbers"]),
        ("reset: {robot: {position: {lower: [0.5, 0, 0.3], upper: [0.4, 0, 0.3]}}}", ["position", "lower", "axis 0"]),
        ("parameters: {lift_m: high}", ["parameters", "lift_m", "number"]),
        ("reset: {cameras: {names: [wrist], shift_m: {workspace: {values: [[0, 0, 0]]}}}}", ["workspace", "wrist"]),
        ("templates: {values: ['Pick up the {target}'], lower: 1}", ["either values", "range"]),
        ("rate_hz: 10\ntemplates: {values: ['Lift the {thing}']}", ["line 2", "templates", "'thing'", "target"]),
        ("templates: {values: ['Lift the {target']}", ["line 1", "templates", "Lift the"]),
        ("a: [", ["line 1", "YAML"]),
        ("- a\n- b", ["mapping"]),
    ],
)
def test_wrong_yaml_is_refused_with_what_is_wrong_and_what_is_allowed(text, said):
    with pytest.raises(ConfigError) as error:
        parse_task_config(text)
    for part in said:
        assert part in str(error.value)
