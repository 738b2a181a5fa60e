"""The reset component ``physics``: what may be asked for."""

import pytest

from roboxim_core.errors import ConfigError
from roboxim_tasks.config import load_task_config, parse_task_config


@pytest.mark.parametrize(
    ("physics", "message"),
    [
        ("table_friction: {values: [-0.1]}", "table_friction must be from 0 to 2"),
        ("objects: {mass: {lower: 0.1, upper: 1.0}}", "mass must be a number from 0.2 to 5"),
        ("objects: {mass: {values: [1]}, mass_kg: {values: [0.1]}}", "either mass, a factor, or mass_kg"),
        ("distractors: {friction_coefficient: {values: [0]}}", "friction_coefficient must be > 0"),
        ("objects: {wait: 1}", "wait"),
    ],
)
def test_wrong_values_are_refused_before_anything_runs(physics, message):
    with pytest.raises(ConfigError, match=message):
        parse_task_config(f"skill: pick_up\nreset: {{physics: {{{physics}}}}}")


def test_a_mass_that_is_out_of_an_objects_bounds_is_refused_by_name(draw):
    config = parse_task_config("skill: pick_up\nreset: {physics: {objects: {mass_kg: {values: [3.0]}}}}")
    with pytest.raises(ConfigError, match="cube, usually 0.08: mass must be a number from 0.2 to 5"):
        draw(0, config)


def test_physics_varies_alone(draw):
    varied, plain = draw(4, "pick_up_physics"), draw(4, "pick_up")
    assert varied.task.instruction == plain.task.instruction
    assert varied.scene.robot == plain.scene.robot
    for one, other in zip(varied.scene.entities, plain.scene.entities, strict=True):
        assert (one.name, one.model) == (other.name, other.model)
    assert set(load_task_config("pick_up_physics").reset) - set(load_task_config("pick_up").reset) == {"physics"}
