import pytest
import yaml

from roboxim_core.config import digest, to_plain
from roboxim_core.errors import ConfigError, ErrorCode, TaskError
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_tasks.config import load_task_config, parse_task_config
from roboxim_tasks.fixed_scene import FixedTaskConfig
from roboxim_tasks.sampling.episodes import EpisodeGenerator

SEED = SeedPath(run_seed=3, purpose="demo", index=0)


@pytest.fixture(scope="module")
def drawn(library):
    return EpisodeGenerator(library).draw(SEED, load_task_config("pick_cube_distractors"))


def text(drawn, **changes):
    scene = to_plain(drawn.scene)
    roles = {role: thing.entity for role, thing in drawn.task.objects.items()}
    fixed = {"instruction": drawn.task.instruction, "roles": roles, "scene": scene} | changes
    return yaml.safe_dump({"skill": drawn.task.skill, "fixed": fixed})


def test_every_index_has_the_given_scene(library, drawn):
    config = parse_task_config(text(drawn))
    assert isinstance(config, FixedTaskConfig)
    generator = EpisodeGenerator(library)
    for index, purpose in ((0, "demo"), (7, "eval")):
        again = generator.draw(SeedPath(run_seed=9, purpose=purpose, index=index), config)
        assert again.scene == drawn.scene
        assert digest(again.scene) == digest(drawn.scene)
        assert again.task.objects == drawn.task.objects
        assert again.task.instruction == drawn.task.instruction
        assert again.max_steps == drawn.max_steps


@pytest.mark.parametrize("name", ["place_on", "push_button", "open_drawer", "push_object", "rotate"])
def test_a_given_scene_is_judged_as_the_drawn_one(library, name):
    own = load_task_config(name)
    if name == "rotate":
        own = parse_task_config("{skill: rotate, objects: {target: {models: {values: [soda_can]}}}}")
    generator = EpisodeGenerator(library)
    drawn = generator.draw(SEED, own)
    again = generator.draw(SEED, parse_task_config(text(drawn)))
    assert again.task.arguments == drawn.task.arguments


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"roles": {}}, "needs the role 'target'"),
        ({"roles": {"target": "nothing"}}, "no entity 'nothing'"),
        ({"roles": {"target": "target", "traget": "distractor_1"}}, "unknown role.*target"),
        ({"roles": {"target": "target", "distractor_1": "target"}}, "two roles have the same entity"),
        ({"instruction": " "}, "expected a text"),
        ({"scenes": {}}, "scenes"),
    ],
)
def test_what_makes_no_task_is_refused_by_name(drawn, changes, said):
    with pytest.raises(ConfigError, match=said):
        parse_task_config(text(drawn, **changes))


def test_a_task_with_a_given_scene_draws_nothing(drawn):
    data = yaml.safe_load(text(drawn)) | {"distractors": {"minimum": 1}}
    with pytest.raises(ConfigError, match="distractors"):
        parse_task_config(yaml.safe_dump(data))


def test_a_scene_that_violates_constraints_is_refused_and_all_are_named(library, drawn):
    scene = to_plain(drawn.scene)
    by_name = {entity["name"]: entity for entity in scene["entities"]}
    by_name["distractor_1"]["pose"] = to_plain(Pose(position=drawn.scene.entity("target").pose.position))
    config = parse_task_config(text(drawn, scene=scene))
    generator = EpisodeGenerator(library)
    with pytest.raises(TaskError, match="distractor_1_overlaps") as error:
        generator.draw(SEED, config)
    assert error.value.code == ErrorCode.RESET_INFEASIBLE
    by_name["target"]["pose"]["position"] = [1.5, 0.0, 0.02]
    found = {f.constraint for f in generator.findings(parse_task_config(text(drawn, scene=scene)), SEED)}
    assert found == {"target_off_table", "target_reachable"}
