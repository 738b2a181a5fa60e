import itertools
import threading
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from browser import wait_for

from roboxim_core.config import digest
from roboxim_core.errors import ConfigError
from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_core.specs import EntitySpec, PhysicalObject, SceneSpec, TaskSpec
from roboxim_runs.episodes.task_choice import task_text
from roboxim_studio.editing import document as edits
from roboxim_studio.episode.film import read_film
from roboxim_tasks.config import parse_task_config, task_config
from roboxim_tasks.sampling.episodes import EpisodeGenerator
from roboxim_tasks.skills import SKILLS

LIBRARY = ModelLibrary()


@pytest.fixture
def document(bag):
    film = read_film(bag)
    return edits.from_info(film.info)


@pytest.fixture
def editor(studio, document):
    studio.show("Scene")
    studio.editor.open(document)
    return studio.editor


def test_a_document_has_the_conditions_of_its_episode():
    can = EntitySpec(name="target", model="soda_can", pose=Pose(position=(0.5, 0.0, 0.06)))
    thing = PhysicalObject(entity="target", model="soda_can", name="soda can")
    task = TaskSpec(
        skill="rotate", objects={"target": thing}, instruction="Rotate the soda can",
        arguments={**asdict(SKILLS["rotate"].Parameters()), "target_upright": True},
    )  # fmt: skip
    document = edits.from_episode(task, SceneSpec(entities=(can,)), {})
    assert edits.checked(document, LIBRARY).task("demo", LIBRARY) == task
    with pytest.raises(ConfigError, match="several steps"):
        edits.from_episode(replace(task, skill="rotate+pick_up"), SceneSpec(entities=(can,)), {})


@pytest.mark.parametrize("purpose", ["demo", "eval"])
def test_a_drawn_scene_keeps_what_its_task_demands(purpose):
    limits = {"path_m": 0.5, "fail": True, "keep_out": [{"lower": [0, 0, 0.6], "upper": [1, 1, 1]}]}
    more = {"max_steps": 77, "limits": limits, "visible": {"pixels": 7}, "robot": "fr3"}
    config = task_config(yaml.safe_load(task_text("rotate")) | more)
    generator = EpisodeGenerator(LIBRARY)
    draw = generator.draw(SeedPath(run_seed=1, purpose=purpose, index=1), config)
    document = edits.from_draw(draw)
    assert parse_task_config(edits.as_yaml(document)) == (again := edits.checked(document, LIBRARY))
    assert again.task(purpose, LIBRARY) == replace(draw.task, drawn={})
    tolerances = [again.task(one, LIBRARY).arguments["tolerance_deg"] for one in ("demo", "eval")]
    assert tolerances == [5.0, 10.0]
    assert (again.max_steps, again.visible, again.limits) == (77, config.visible, config.limits)


@pytest.mark.thorough
def test_saved_yaml_gives_the_same_scene_hash_in_generation_and_evaluation(studio, editor, tmp_path):
    studio.editor._folder = tmp_path
    desk = editor.desk
    release = threading.Event()
    studio.bench.do(release.wait)
    editor.edit(lambda d: edits.added(d, "apple", LIBRARY, (0.42, 0.2)))
    editor.save("too_soon")
    assert "is still being checked" in editor._saved.content
    release.set()
    editor.edit(lambda d: edits.moved(d, "distractor_1", Pose(position=(0.3512345678, -0.28, 0.0357))))
    editor.edit(lambda d: edits.modified(d, "target", "color", "blue", LIBRARY))
    editor.edit(lambda d: edits.with_instruction(d, "Pick up the blue cube"))
    look = desk.scene.look
    brighter = (replace(look.lights[0], intensity=1.1), *look.lights[1:])
    editor.edit(lambda d: edits.with_look(d, replace(look, lights=brighter)))
    assert desk.refresh().result(timeout=120).valid, desk.checks.text
    file = editor.save("my_scene")
    assert file.parent == tmp_path
    wanted = edits.scene_hash(desk.document)
    assert wanted in editor._saved.content
    assert "constraint" not in editor._saved.content
    assert "checked" not in editor._saved.content
    text = file.read_text()
    assert digest(parse_task_config(text).fixed.scene) == wanted
    for purpose in ("demo", "eval"):
        seed = SeedPath(run_seed=5, purpose=purpose, index=2)
        draw = studio.bench.do(lambda seed=seed: studio.lab.draw(text, seed)).result(timeout=120)
        assert digest(draw.scene) == wanted
        assert draw.task.objects["target"].modifiers["color"] == "blue"


def test_a_scene_is_one_html_file_that_may_ask_nobody(editor, tmp_path):
    editor._folder = tmp_path
    editor.edit(lambda d: edits.with_instruction(d, "Pick up <b> the cube"))
    file = editor.share("my_scene")
    assert file == tmp_path / "my_scene.html"
    page = file.read_text()
    assert "Content-Security-Policy" in page
    assert "Pick up &lt;b&gt; the cube" in page
    assert "<b> the cube" not in page
    assert str(tmp_path) not in page
    assert editor.share("../evil") is None


@pytest.mark.parametrize("name", ["../evil", "a/b", "", "x\0"])
def test_files_stay_in_the_folder(editor, name, tmp_path):
    editor._folder = tmp_path / "inside"
    editor._folder.mkdir()
    assert editor.save(name) is None
    assert not list(tmp_path.glob("**/*.yaml"))
    assert "is no file name" in editor._saved.content


def test_an_invalid_pose_names_its_constraint_where_it_is(editor):
    x, y, z = editor.desk.scene.entity("target").pose.position
    editor.edit(lambda d: edits.added(d, "apple", LIBRARY, (x, y + 0.01)))
    checks = editor.desk.refresh().result(timeout=120)
    assert [finding.constraint for finding in checks.findings] == ["distractor_1_overlaps"]
    assert "distractor_1_overlaps" in editor._findings.content
    assert [label.text for label in editor._labels] == ["distractor_1_overlaps"]
    editor.desk.undo()
    assert editor.desk.refresh().result(timeout=120).valid
    assert not editor._labels


def test_the_ghost_shows_what_the_planner_sees_in_step_with_the_edits(editor):
    ways = []
    editor.desk.on_plan.append(ways.append)
    assert editor.desk.refresh().result(timeout=120).valid
    (way,) = ways
    assert editor.ghost.path == pytest.approx(way)
    assert editor.ghost.bodies == ()
    editor._sees.value = True
    editor.edit(lambda d: edits.added(d, "mug", LIBRARY, (0.42, 0.2)))
    assert set(editor.ghost.bodies) == {"table", *(entity.name for entity in editor.desk.scene.entities)}
    editor.edit(lambda d: edits.moved(d, "distractor_1", Pose(position=(0.35, -0.28, 0.0475))))
    assert editor.ghost._bodies["distractor_1"][1].position == pytest.approx((0.35, -0.28, 0.0475))
    editor.hide()
    assert editor.ghost.bodies == ()
    assert len(editor.ghost.path) == 0


def test_a_new_object_is_put_where_there_is_room(editor):
    for _ in range(3):
        editor._object.add("mug")
    places = [entity.pose.position[:2] for entity in editor.desk.scene.entities]
    assert min(np.linalg.norm(np.subtract(a, b)) for a, b in itertools.combinations(places, 2)) > 0.05
    assert editor.desk.refresh().result(timeout=120).findings == ()


def test_undo_and_redo_walk_through_every_edit(document):
    history = edits.History(document)
    versions = [document]
    for number in range(5):
        history.change(edits.moved(history.now, "target", Pose(position=(0.4 + 0.01 * number, 0.0, 0.02))))
        versions.append(history.now)
    assert not history.change(history.now)
    for version in reversed(versions[:-1]):
        assert history.undo()
        assert history.now == version
    assert not history.undo()
    for version in versions[1:]:
        assert history.redo()
        assert history.now == version
    history.undo()
    history.change(edits.with_instruction(history.now, "Lift it"))
    assert not history.redo()


def test_the_target_cannot_be_deleted_but_its_role_can_be_given_away(document):
    with pytest.raises(ConfigError, match="is the task's target"):
        edits.removed(document, "target")
    with_apple = edits.added(document, "apple", LIBRARY)
    given = edits.with_role(with_apple, "target", "distractor_1")
    assert given.fixed.roles == {"target": "distractor_1", "distractor_1": "target"}
    assert "target" not in edits.removed(given, "target").fixed.roles.values()


def test_a_scaled_object_keeps_resting_on_the_table(document):
    big = edits.modified(document, "target", "scale", 1.2, LIBRARY)
    entity = big.fixed.scene.entity("target")
    assert entity.pose.position[2] == pytest.approx(LIBRARY.entity_model(entity).rest_height)
    with pytest.raises(ConfigError, match="color"):
        edits.modified(document, "target", "color", "greenish", LIBRARY)


@pytest.mark.slow
def test_a_task_is_drawn_edited_and_solved_by_the_expert(studio):
    draw = studio.open_task("pick_cube").result(timeout=120)
    assert studio.editor.desk.scene == draw.scene
    ways = []
    studio.editor.desk.on_plan.append(ways.append)
    assert studio.editor.desk.refresh().result(timeout=120).valid
    target = draw.scene.entity("target").pose.position
    assert min(np.linalg.norm(ways[-1] - target, axis=1)) < 0.02  # the expert's plan leads to the target
    another = studio.bench.do(lambda: None)
    another.result(timeout=120)
    second = studio.compose.draw(another=True).result(timeout=120)
    assert second.scene != draw.scene
    film = studio.compose.solve().result(timeout=300)
    assert film.result.outcome == "success"
    assert film.info.scene == second.scene
    assert studio.mode == "Episode"
    studio.edit_episode()
    assert studio.editor.desk.scene == second.scene


@pytest.mark.thorough
def test_dragging_the_gizmo_in_the_page_moves_the_simulated_object(studio, editor, chromium):
    chromium.open(studio.url)
    chromium.wait("document.documentElement.dataset.studioConnected === 'true'")
    chromium.wait("document.querySelector('#findings')")
    pose = editor.desk.scene.entity("target").pose
    editor.select("target")
    client = wait_for(lambda: next(iter(studio.site.viser.get_clients().values()), None), "the page's client")
    wait_for(lambda: client.camera.image_width < 1200, "the panel at the side of the view", 60)
    pause = "new Promise(done => setTimeout(done, {}))"
    for _ in range(8):  # until the gizmo has been drawn
        chromium.run(pause.format(1500))
        start, end = (on_screen(client, pose.apply((along, 0.0, 0.0))) for along in (0.07, 0.17))
        chromium.mouse("mouseMoved", *start)
        chromium.run(pause.format(300))
        chromium.mouse("mousePressed", *start)
        for step in range(1, 9):
            chromium.mouse("mouseMoved", *(a + (b - a) * step / 8 for a, b in zip(start, end, strict=True)))
            chromium.run(pause.format(50))
        chromium.mouse("mouseReleased", *end)
        chromium.run(pause.format(1000))
        if editor.desk.scene.entity("target").pose.position != pose.position:
            break
    after = editor.desk.scene.entity("target").pose.position
    x, y, z = pose.inverse().apply(after)
    assert x > 0.02
    assert (y, z) == pytest.approx((0.0, 0.0), abs=1e-5)
    graph = studio.bench.do(lambda: studio.lab.graph).result()
    state = studio.bench.do(lambda: graph.sim.world.load(editor.desk.scene)).result(timeout=60)
    assert state.entity("target").pose.position == pytest.approx(after, abs=1e-3)


def on_screen(client, point):
    """Return where in the page a point of the world is drawn [px]."""
    from scipy.spatial.transform import Rotation

    camera = client.camera
    w, x, y, z = camera.wxyz
    seen = Rotation.from_quat((x, y, z, w)).inv().apply(np.array(point) - camera.position)
    focal = camera.image_height / 2 / np.tan(camera.fov / 2)
    return (
        float(camera.image_width / 2 + focal * seen[0] / seen[2]),
        float(camera.image_height / 2 + focal * seen[1] / seen[2]),
    )


def test_a_page_can_name_no_value_that_an_input_does_not_offer(editor, tmp_path):
    before = editor.desk.document
    texture = next(handle for handle, _ in editor._room._set if handle.label == "table: texture")
    texture.value = str(tmp_path / "secret.png")  # as a forged message of a page would
    (called,) = texture._impl.update_cb
    called(SimpleNamespace(client=object(), target=texture))
    assert editor.desk.document is before
    texture.value = texture.options[-1]
    called(SimpleNamespace(client=object(), target=texture))
    assert editor.desk.scene.look.table.texture == texture.options[-1]


def test_an_edit_that_cannot_be_shown_is_named(studio, editor, monkeypatch):
    def unknown(*_):
        raise ConfigError("no such model")

    monkeypatch.setattr(studio.view, "load", unknown)
    editor.edit(lambda d: edits.with_instruction(d, "Lift the cube"))
    assert studio.site._latest["alert"] == "no such model"


def test_left_and_right_are_those_of_the_scene_that_is_shown(studio, document):
    scene = document.fixed.scene
    back = Pose(position=(1.0, 0.0, 0.0), quat_xyzw=(0.0, 0.0, 1.0, 0.0))
    for robot, sign in ((scene.robot, 1.0), (replace(scene.robot, pose=back), -1.0)):
        studio.view.load(replace(scene, robot=robot))
        (left,) = [label for label in studio.view._compass if label.text == "left"]
        assert sign * left.position[1] > 0.1


def test_a_page_can_name_no_other_file_as_a_task(studio, tmp_path):
    studio.open_task("pick_cube").result(timeout=120)
    before = studio.compose.drawn
    secret = tmp_path / "secret.yaml"
    secret.write_text("password: hunter2\n")
    studio.compose._task.value = str(secret)  # as a forged message of a page would
    assert studio.compose.draw().result(timeout=60) is None
    assert "hunter2" not in studio.compose._message.content
    assert "in the list" in studio.compose._message.content
    assert studio.compose.drawn is before
