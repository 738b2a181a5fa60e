"""Areas of an elongated table: objects lie in the chosen one, datasets have exact counts, the camera sees them all."""

import itertools
from collections import Counter

import numpy as np
import pytest

from roboxim_core.errors import ConfigError
from roboxim_tasks.choices import Choice
from roboxim_tasks.components.interaction_area import AREAS, InteractionAreaConfig
from roboxim_tasks.config import load_task_config, parse_task_config

SEEN = {"far_left", "middle", "right", "far_right"}


def corners(area):
    return np.array(list(itertools.product(*zip(area.lower, area.upper, strict=True))))


def area_of(drawn):
    return drawn.task.drawn["interaction_area"]


def test_the_target_lies_in_the_area_whose_turn_it_is_and_the_episode_says_which(draw):
    places = []
    for index in range(10):
        drawn = draw(index, "pick_cube_areas")
        name = area_of(drawn)
        assert name == list(AREAS)[index % 5]
        position = np.array(drawn.scene.entity("target").pose.position[:2])
        assert np.all(position >= AREAS[name].lower)
        assert np.all(position <= AREAS[name].upper)
        places.append(position - AREAS[name].lower)
    assert len({tuple(place) for place in places}) == 10, "anywhere in it"


def test_areas_are_next_to_each_other_on_the_table():
    boxes = [corners(area)[:, 1] for area in AREAS.values()]
    for left, right in itertools.pairwise(boxes):
        assert 0.0 < left.min() - right.max() < 0.1


def test_datasets_are_paired_and_leave_out_an_area_between_seen_ones(draw):
    sizes = {"interaction_area_leave_out": 300, "interaction_area_baseline": 300, "interaction_area_unseen": 50}
    areas = {}
    for task, size in sizes.items():
        mix = load_task_config(task)
        assert sum(mix.counts) == size
        areas[task] = Counter(area_of(draw(index, mix)) for index in range(20))
    assert areas["interaction_area_leave_out"] == dict.fromkeys(SEEN, 5)
    assert areas["interaction_area_baseline"] == dict.fromkeys(AREAS, 4)
    assert areas["interaction_area_unseen"] == {"left": 20}
    left_out = list(AREAS).index("left")
    assert {list(AREAS)[left_out - 1], list(AREAS)[left_out + 1]} <= SEEN


def test_the_workspace_camera_sees_all_areas_whole(draw):
    (camera,) = (c for c in draw(0, "pick_cube_areas").scene.cameras if c.name == "workspace")
    fx, fy, cx, cy = camera.matrix
    for area in AREAS.values():
        for x, y in corners(area):
            for height in (0.0, 0.2):
                u, v, w = camera.pose.inverse().apply((x, y, height))
                assert 0.0 < fx * u / w + cx < camera.width, (x, y)
                assert 0.0 < fy * v / w + cy < camera.height, (x, y)


def test_other_areas_and_roles(draw):
    text = """
skill: place_on
scene: long_table
reset:
  interaction_area:
    areas: {near: {lower: [0.3, -0.1], upper: [0.35, 0.1]}, {far}: {lower: [0.5, -0.3], upper: [0.6, 0.3]}}
    area: {values: [far]}
    roles: [{role}]
"""
    scene = draw(0, parse_task_config(text.replace("{far}", "far").replace("{role}", "support"))).scene
    assert 0.5 <= scene.entity("support").pose.position[0] <= 0.6
    with pytest.raises(ConfigError, match="no role 'button'"):
        draw(0, parse_task_config(text.replace("{far}", "far").replace("{role}", "button")))
    crowded = text.replace("{far}", "far").replace("{role}", "distractor_1") + "distractors: {minimum: 1, maximum: 1}\n"
    with pytest.raises(ConfigError, match="no role 'distractor_1' that 'objects' places"):
        draw(0, parse_task_config(crowded))
    with pytest.raises(ConfigError, match="no interaction area 'far'"):
        parse_task_config(text.replace("{far}", "distant").replace("{role}", "support"))
    with pytest.raises(ConfigError, match="not a range"):
        InteractionAreaConfig(area=Choice(lower=0.0, upper=1.0))
