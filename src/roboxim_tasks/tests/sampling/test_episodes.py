import itertools
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from roboxim_core.config import digest, to_json
from roboxim_core.errors import ConfigError, ErrorCode, PlannerError, TaskError
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import EntitySpec, PhysicalObject, RobotSpec, SceneSpec, TaskSpec
from roboxim_tasks.choices import Choice
from roboxim_tasks.components import COMPONENTS, ResetComponent, ResetContext, register
from roboxim_tasks.config import load_task_config, parse_task_config
from roboxim_tasks.demonstration.solvable import Solvability
from roboxim_tasks.roles import description
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.sampling.placement import footprint
from roboxim_tasks.skills import SKILLS


def test_an_episode_depends_on_its_seed_path_alone(draw):
    forward = [digest(draw(index)) for index in range(6)]
    fresh = EpisodeGenerator(ModelLibrary())
    config = load_task_config("pick_cube_distractors")
    backward = [
        digest(fresh.draw(SeedPath(run_seed=3, purpose="test", index=index), config)) for index in reversed(range(6))
    ]
    assert forward == backward[::-1]
    assert len(set(forward)) == 6
    assert digest(draw(0, attempt=1)) != forward[0]
    assert digest(draw(0, purpose="demo")) != forward[0]


def test_datasets_that_differ_in_one_component_stay_paired_in_the_rest(draw):
    with_distractors, alone = load_task_config("pick_cube_distractors"), load_task_config("pick_cube")
    for index in range(20):
        a, b = draw(index, with_distractors), draw(index, alone)
        assert a.task.instruction == b.task.instruction
        assert a.scene.entity("target") == b.scene.entity("target")
        assert a.scene.robot == b.scene.robot


def test_the_target_is_uniform_over_the_area_at_any_yaw_and_the_gripper_over_its_box(draw, library):
    config = load_task_config("pick_cube")
    draws = [draw(index, config) for index in range(300)]
    positions = np.array([d.scene.entity("target").pose.position for d in draws])
    yaws = [Rotation.from_quat(d.scene.entity("target").pose.quat_xyzw).as_euler("xyz")[2] for d in draws]
    arm = ArmKinematics(library.robot("panda"))
    tcps = np.array([arm.fk(d.scene.robot.joint_positions).position for d in draws])
    assert np.ptp(positions[:, 0]) > 0.195
    assert np.ptp(positions[:, 1]) > 0.29
    for values, low, width in (
        (positions[:, 0], 0.4, 0.2), (positions[:, 1], -0.15, 0.3), (yaws, -np.pi, 2 * np.pi),
        (tcps[:, 0], 0.41, 0.12), (tcps[:, 1], -0.06, 0.12), (tcps[:, 2], 0.26, 0.12),
    ):  # fmt: skip
        assert kstest(values, "uniform", (low, width)).pvalue > 1e-3
    assert {d.task.objects["target"].modifiers["color"] for d in draws} == {"red", "green", "blue", "yellow"}


def outline(entity, library):
    corners = footprint(entity, library)
    steps = np.linspace(0.0, 1.0, 46)[:, None]
    return np.concatenate([a + steps * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)])


def distance_of(a, b):
    return np.linalg.norm(a[:, None] - b[None], axis=2).min()


def test_objects_keep_a_finger_apart_and_the_instruction_names_one_of_them(draw, library):
    counts = set()
    for index in range(30):
        d = draw(index)
        counts.add(len(d.scene.entities) - 1)
        for a, b in itertools.combinations(d.scene.entities, 2):
            assert distance_of(outline(a, library), outline(b, library)) > 0.0295
        named = description(d.task.objects["target"])
        assert d.task.instruction == f"Pick up the {named}"
        assert [description(thing) for thing in d.task.objects.values()].count(named) == 1
    assert counts == {1, 2, 3}


def test_what_cannot_be_placed_is_refused_by_the_constraint_s_name(draw):
    base = "distractors: {minimum: 3, maximum: 3, modifiers: {color: {values: [green]}}}\nmax_draws: 5\n"
    crowded = base + "reset: {distractors: {area: {lower: [0.5, 0], upper: [0.52, 0.02]}}}\n"
    far = "reset: {objects: {area: {lower: [0.85, 0.5], upper: [0.9, 0.6]}}}\nmax_draws: 5\n"
    beside = "reset: {objects: {area: {lower: [1.5, 0], upper: [1.6, 0]}}}\nmax_draws: 5\n"
    near = (
        "reset: {robot: {position: {values: [[0.5, 0, 0.05]]}}, objects: {area: {lower: [0.5, 0], upper: [0.5, 0]}}}\n"
        "max_draws: 5\n"
    )
    for text, constraint in (
        (crowded, "distractor_"), (far, "target_reachable"), (beside, "target_off_table"), (near, "start_clear"),
        ("reset: {robot: {position: {values: [[0.9, 0, 0.9]]}}}\nmax_draws: 3\n", "robot_start_reachable"),
    ):  # fmt: skip
        with pytest.raises(TaskError, match=constraint) as error:
            draw(0, parse_task_config(text))
        assert error.value.code == ErrorCode.RESET_INFEASIBLE


def test_a_start_out_of_reach_says_how_far_and_where_the_arm_is_at_home(draw):
    """A small arm's user read "ask for fewer objects", and no number."""
    far = "reset: {robot: {position: {values: [[0.9, 0, 0.9]]}}}\nmax_draws: 3\n"
    with pytest.raises(TaskError, match=r"stays \d+\.\d cm .* reset.robot.position \(0.90, 0.00, 0.90\)") as error:
        draw(0, parse_task_config(far))
    assert "fewer objects" not in str(error.value)


def test_objects_are_not_placed_where_the_hand_starts(draw):
    """Wide things were drawn blindly, and the whole scene again until they left the hand alone."""
    text = (
        "reset: {robot: {position: {values: [[0.5, 0, 0.05]]}}, "
        "objects: {area: {lower: [0.42, -0.1], upper: [0.58, 0.1]}}}\n"
        "distractors: {minimum: 0, maximum: 0}\nmax_draws: 1\n"
    )
    drawn = [draw(index, parse_task_config(text)).scene.entity("target").pose.position[:2] for index in range(5)]
    assert min(np.hypot(x - 0.5, y) for x, y in drawn) > 0.08


@pytest.mark.parametrize(
    ("skill", "already", "partly"),
    [
        ("open_drawer", "{lower: 0.8, upper: 1.0}", "{lower: 0.0, upper: 1.0}"),
        ("close_drawer", "{values: [0.0]}", "{values: [0.0, 0.5]}"),
    ],
)
def test_a_drawer_that_is_there_already_is_refused(skill, already, partly, draw):
    def config(target):
        return parse_task_config(f"skill: {skill}\nreset: {{joints: {{target: {target}}}}}\nmax_draws: 20")

    with pytest.raises(TaskError, match="not_there_already") as error:
        draw(0, config(already))
    assert error.value.code == ErrorCode.RESET_INFEASIBLE
    for index in range(8):
        drawn = draw(index, config(partly))
        position = drawn.scene.entity("target").joint_positions[drawn.task.arguments["joint"]]
        assert position <= 0.10 if skill == "open_drawer" else position > 0.01


def test_distractors_that_would_all_fit_the_instruction_are_refused(draw):
    text = "{objects: {target: {modifiers: {color: {values: [red]}}}}, distractors: {minimum: 1, maximum: 1, "
    with pytest.raises(TaskError, match="distractor_distinct"):
        draw(0, parse_task_config(text + "modifiers: {color: {values: [red]}}}}"))


def test_a_scene_that_already_has_what_the_instruction_names_is_refused(draw, tmp_path):
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        "entities: [{name: other, model: cube, modifiers: {color: red}, pose: {position: [0.3, 0.3, 0.0225]}}]"
    )
    config = parse_task_config(f"scene: {scene}\nobjects: {{target: {{modifiers: {{color: {{values: [red]}}}}}}}}")
    with pytest.raises(ConfigError, match="one solution"):
        draw(0, config)


def test_light_camera_and_surface_vary_as_configured(draw):
    text = """
reset:
  lights:
    intensity: {lower: 1.0, upper: 3.0}
    direction: {values: [[1, 0, -1], [0, 1, -1]], order: in_order}
    ambient: {lower: [0.2, 0.2, 0.2], upper: [0.6, 0.6, 0.6]}
  cameras:
    shift_m: {workspace: {lower: [-0.1, -0.1, 0], upper: [0.1, 0.1, 0.1]}}
    turn_rad: {wrist: {lower: [0, 0, -0.2], upper: [0, 0, 0.2]}}
  surfaces:
    table: {color: {lower: [0, 0, 0], upper: [1, 1, 1]}, texture: {values: [wood, ""]}}
"""
    config = parse_task_config(text)
    scenes = [draw(index, config).scene for index in range(8)]
    assert [scene.look.lights[0].direction[0] for scene in scenes] == [1.0, 0.0] * 4
    assert len({scene.look.lights[0].intensity for scene in scenes}) == 8
    assert all(1.0 <= scene.look.lights[0].intensity <= 3.0 for scene in scenes)
    assert len({scene.look.ambient for scene in scenes}) == 8
    assert len({scene.cameras[0].pose.position for scene in scenes}) == 8
    assert len({scene.cameras[1].pose.quat_xyzw for scene in scenes}) == 8
    assert len({scene.cameras[1].pose.position for scene in scenes}) == 1
    assert {scene.look.table.texture for scene in scenes} == {"wood", ""}


def test_the_robot_may_start_at_listed_joints(draw, library):
    home = library.robot("panda").home
    config = parse_task_config(f"reset: {{robot: {{joints: {{values: [{list(home)}]}}}}}}")
    assert draw(0, config).scene.robot.joint_positions == pytest.approx(home)
    with pytest.raises(ConfigError, match="beyond the limits"):
        draw(0, parse_task_config("reset: {robot: {joints: {values: [[9, 0, 0, -2, 0, 2, 0]]}}}"))


def test_a_robot_that_stands_elsewhere_gets_its_objects_in_front_of_it(draw, tmp_path):
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        "robot: {pose: {position: [1.0, 0, 0], quat_xyzw: [0, 0, 1, 0]}}\ntable: {center: [0.5, 0, 0]}\n"
        "workspace: {lower: [0.2, -0.5, 0.002], upper: [0.8, 0.5, 0.7]}\n"
    )
    config = replace(load_task_config("pick_cube"), scene=str(scene))
    x, y, _ = draw(4, config).scene.entity("target").pose.position
    same = draw(4, load_task_config("pick_cube")).scene.entity("target").pose.position
    assert (1.0 - x, -y) == pytest.approx(same[:2], abs=1e-9)


def test_the_resolved_configuration_travels_with_the_episode(draw):
    d = draw(0)
    assert d.max_steps == 100
    assert d.config_json == to_json(load_task_config("pick_cube_distractors"))


@pytest.mark.parametrize("name", sorted(COMPONENTS))
def test_every_component_has_a_complete_default_and_draws_the_same_twice(name, library):
    config = replace(load_task_config("pick_cube_distractors"), reset={name: COMPONENTS[name].Config()})
    things = {role: PhysicalObject(entity=role, model="mug", name="mug") for role in ("target", "distractor_1")}
    things["distractor_2"] = replace(things["distractor_1"], entity="distractor_2")
    task = TaskSpec(skill="pick_up", instruction="", objects=things)
    placed = [
        EntitySpec(name=role, model="mug", pose=Pose(position=(0.5, y, 0.045)))
        for role, y in zip(things, (0.4, 0.0, -0.3), strict=True)
    ]
    there = {"objects": 0, "distractors": 1}.get(name, len(placed))
    arm = ArmKinematics(library.robot("panda"))
    scene = SceneSpec(robot=RobotSpec(joint_positions=tuple(arm.model.home)), entities=tuple(placed[:there]))
    seed = SeedPath(run_seed=1, purpose="test", index=0)

    def reset():
        context = ResetContext(seed=seed, config=config, task=task, library=library, arm=arm)
        return COMPONENTS[name](config.reset[name]).reset(scene, context)

    assert reset() == reset()


@pytest.mark.parametrize("name", sorted(SKILLS))
def test_every_skill_fills_its_own_templates(name):
    skill = SKILLS[name]
    assert skill.templates
    assert set(skill.components) <= set(COMPONENTS)
    for template in skill.templates:
        assert template.format_map(dict.fromkeys((*skill.roles, *skill.words), "thing")) != template


def test_a_component_of_one_s_own_is_one_class_and_one_key(draw):
    @dataclass(frozen=True, kw_only=True)
    class FrictionConfig:
        friction: Choice = Choice(lower=0.5, upper=1.0)

    class TableFriction(ResetComponent):
        name = "table_friction"
        Config = FrictionConfig

        def reset(self, scene, context):
            friction = self.config.friction.draw_number(context.rng(self.name), context.index)
            return replace(scene, table=replace(scene.table, friction=friction))

    register(TableFriction)
    try:
        config = parse_task_config("reset: {table_friction: {friction: {lower: 0.6, upper: 0.7}}}")
        assert 0.6 <= draw(0, config).scene.table.friction <= 0.7
        with pytest.raises(ConfigError, match="frictions"):
            parse_task_config("reset: {table_friction: {frictions: 1}}")
    finally:
        COMPONENTS._items.pop("table_friction")


class Refusing:
    """A planner that finds something wrong with every path, or with those of the first so many draws."""

    def __init__(self, draws):
        self.draws, self.asked = draws, set()

    def check_path(self, path, period_s, around):
        self.asked.add(repr(around.scene.entities))
        return "blocked" if len(self.asked) <= self.draws else ""

    def plan_to_pose(self, joints, pose_tcp_in_world, around, seed):
        raise PlannerError("no way", ErrorCode.PLANNING_FAILED)


def test_a_scene_that_cannot_be_planned_is_drawn_again(library, seed_path):
    config = load_task_config("pick_cube")
    plain = EpisodeGenerator(library).draw(seed_path(1), config)
    generator = EpisodeGenerator(library, Solvability(library, Refusing(2)))
    drawn = generator.draw(seed_path(1), config)
    assert generator.last_reset.rejections["solvable"] == 2
    assert drawn.scene.entities != plain.scene.entities
    assert EpisodeGenerator(library, Solvability(library, Refusing(0))).draw(seed_path(1), config) == plain
    few = replace(config, max_draws=2)
    with pytest.raises(TaskError, match="in 2 draws: constraint solvable refused most") as error:
        EpisodeGenerator(library, Solvability(library, Refusing(2))).draw(seed_path(1), few)
    assert error.value.code == ErrorCode.RESET_INFEASIBLE
