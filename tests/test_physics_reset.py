"""Masses and frictions that the reset component ``physics`` draws take effect on the simulator's bodies."""

from __future__ import annotations

import numpy as np
import pytest

from roboxim_core.config import from_json, to_json
from roboxim_core.models.library import ModelLibrary
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import SceneSpec
from roboxim_sim.world import World
from roboxim_tasks.config import parse_task_config
from roboxim_tasks.sampling.episodes import EpisodeGenerator

LIBRARY = ModelLibrary()
CUBE_KG = LIBRARY.object("cube").links[0].mass
CUBE_FRICTION = LIBRARY.object("cube").friction.lateral
TASK = """
skill: pick_up
distractors: {minimum: 1, maximum: 1, models: {values: [lemon]}}
reset:
  objects: {area: {values: [[0.4, 0.0]]}}
  distractors: {area: {values: [[0.4, 0.25]]}}
  physics: {%s}
  cameras: {names: []}
"""
HOLD = np.array([0, 0, 0, 0, 0, 0, 1.0], np.float32)


def drawn(physics: str, index: int = 0) -> SceneSpec:
    seed = SeedPath(run_seed=3, purpose="test", index=index)
    return EpisodeGenerator(LIBRARY).draw(seed, parse_task_config(TASK % physics)).scene


@pytest.fixture(scope="module")
def world():
    with World(LIBRARY) as made:
        yield made


def test_a_drawn_mass_presses_on_the_table(world):
    scene = drawn("objects: {mass_kg: {values: [0.05, 0.2], order: in_order}}", 1)
    assert scene.entity("target").modifiers["mass"] == pytest.approx(0.2 / CUBE_KG)
    record = world.load(from_json(to_json(scene), SceneSpec), "e")
    (contact,) = record.contacts_between("target", "table")
    assert contact.force_last == pytest.approx(0.2 * 9.81, rel=0.05)


@pytest.mark.parametrize(("table", "cube"), [(0.4, 0.6), (0.4, 1.0), (0.7, 0.6), (0.7, 1.0)])
def test_drawn_frictions_determine_the_sliding_distance(table, cube, world):
    scene = drawn(f"table_friction: {{values: [{table}]}}, objects: {{friction: {{values: [{cube}]}}}}")
    start = world.load(scene, "e").entity("target").pose
    world.set_entity_state("target", start, linear_velocity=(0.5, 0.0, 0.0))
    for seq in range(1, 16):
        record = world.tick(seq, HOLD)
    slid = record.entity("target").pose.position[0] - start.position[0]
    assert slid == pytest.approx(0.5**2 / (2 * table * cube * CUBE_FRICTION * 9.81), rel=0.2)


def test_every_body_has_its_own_random_stream():
    everything = [drawn("", index) for index in range(6)]
    for kind in ("mass", "friction"):
        factors = np.array(
            [[scene.entity(n).modifiers[kind] for n in ("target", "distractor_1")] for scene in everything]
        )
        assert len(np.unique(factors)) == 12
    assert len({scene.table.friction for scene in everything}) == 6
    only_table = [drawn("objects: {}, distractors: {}", index) for index in range(6)]
    assert [s.table.friction for s in only_table] == [s.table.friction for s in everything]
    assert all("mass" not in scene.entity("target").modifiers for scene in only_table)
