import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from browser import wait_for

from roboxim_core.actions import ActionSemantics
from roboxim_core.episode import Draw
from roboxim_core.errors import ConfigError
from roboxim_core.poses import Pose
from roboxim_core.seeds import SeedPath
from roboxim_recorder.bag import BagReader
from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.replay import replay
from roboxim_studio.acting.drive import Drive, next_index
from roboxim_studio.acting.lab import Lab
from roboxim_studio.acting.steering import Speeds, Steering, action_of, moves, offset_words
from roboxim_studio.acting.take import FilmRecorder
from roboxim_studio.editing import document as edits
from roboxim_studio.episode.film import read_film

SEED = SeedPath(run_seed=1, purpose="demo", index=0)
HERE = Pose(position=(0.5, 0.0, 0.3), quat_xyzw=(1.0, 0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def lab():
    lab = Lab()
    yield lab
    lab.close()


def test_keys_and_sticks_become_deltas_of_the_robots_base():
    forward = action_of(Steering(held=frozenset({"KeyW"})), HERE, 1.0, 10.0, Speeds(translation_m_s=0.2))
    assert forward == pytest.approx([0.02, 0, 0, 0, 0, 0, 1.0])
    slow = action_of(Steering(held=frozenset({"KeyA", "ShiftLeft"})), HERE, 0.0, 10.0, Speeds(translation_m_s=0.2))
    assert slow == pytest.approx([0, 0.005, 0, 0, 0, 0, 0.0])
    both = action_of(Steering(held=frozenset({"KeyW", "KeyS"})), HERE, 1.0, 10.0)
    assert not moves(both, 1.0)
    assert moves(both, 0.0)
    stick = Steering.of_message({"held": [], "pad": {"axes": [0.05, -1.0, 0.0, 0.0], "buttons": [0, 0]}})
    assert action_of(stick, HERE, 1.0, 10.0)[:3] == pytest.approx([0.02, 0.0, 0.0])


def test_the_tool_goes_to_the_gizmo_no_faster_than_allowed():
    target = Pose(position=(0.5, 0.1, 0.3), quat_xyzw=HERE.quat_xyzw)
    action = action_of(Steering(target=target), HERE, 1.0, 10.0, Speeds(translation_m_s=0.2))
    assert action[:6] == pytest.approx([0, 0.02, 0, 0, 0, 0], abs=1e-6)
    assert not moves(action_of(Steering(target=HERE), HERE, 1.0, 10.0), 1.0)


@pytest.mark.parametrize(
    "message",
    [{"held": "KeyW"}, {"held": [1, None, {}]}, {"pad": {"axes": ["x", float("nan"), 1e9]}}, {"pad": 3}, {}],
)
def test_nonsense_of_a_page_moves_nothing_beyond_the_speeds(message):
    action = action_of(Steering.of_message(message), HERE, 1.0, 10.0)
    assert np.isfinite(action).all()
    assert np.abs(action[:3]).max() <= 0.02 + 1e-9


def test_a_driven_episode_is_a_bag_like_any_other(lab, bag, tmp_path):
    film = read_film(bag)
    draw = Draw(task=film.info.task, scene=film.info.scene, max_steps=100)
    drive = Drive(lab.graph, draw, SEED, tmp_path)
    for number, state in enumerate(film.states[1 : film.result.steps + 1], start=1):
        drive.step(np.array(state.action_executed, np.float32), last=number == film.result.steps)
    assert drive.result.outcome == "success"
    assert drive.film.path == drive.bag
    assert check_bag(drive.bag).ok
    reader = BagReader(drive.bag)
    assert (reader.info.actor, reader.info.actor_privileged) == ("human", False)
    assert reader.info.semantics == ActionSemantics(rate_hz=10.0)
    assert replay(reader, lab.graph.sim).same
    assert [tick.state.state_hash for tick in reader.ticks(cameras=())] == [s.state_hash for s in film.states]
    assert next_index(tmp_path, SEED) == 1
    drive.throw_away()
    assert not drive.bag
    assert next_index(tmp_path, SEED) == 0


def test_an_episode_that_is_cut_off_is_set_apart_and_whole(lab, bag, tmp_path):
    film = read_film(bag)
    drive = Drive(lab.graph, Draw(task=film.info.task, scene=film.info.scene, max_steps=100), SEED, tmp_path)
    for _ in range(3):
        drive.step(np.array([0.01, 0, 0, 0, 0, 0, 1.0], np.float32))
    path = drive.close()
    assert path.startswith("set_apart/")
    assert check_bag(tmp_path / path).ok
    assert BagReader(tmp_path / path).result.reason == "interrupted"
    assert next_index(tmp_path, SEED) == 1


def test_the_result_of_an_interrupted_episode_counts_no_settling(bag):
    film = read_film(bag)
    sim = SimpleNamespace(world=SimpleNamespace(record=None), images={})
    recorder = FilmRecorder(sim)
    recorder.open(film.info)
    for sim.world.record, step in zip(film.states, film.steps, strict=True):
        recorder.step(step)
    recorder.abort()
    assert (recorder.film.result.steps, recorder.film.result.last_seq) == (film.result.steps, film.result.last_seq)
    assert film.result.last_seq > film.result.steps


def test_two_studios_do_not_drive_into_one_folder_at_once(lab, bag, tmp_path):
    info, other = read_film(bag).info, Lab()
    draw = Draw(task=info.task, scene=info.scene, max_steps=100)
    drive = Drive(lab.graph, draw, SEED, tmp_path)
    try:
        with pytest.raises(ConfigError, match="another command is running in"):
            Drive(other.graph, draw, SEED, tmp_path)
        drive.step(np.array([0.01, 0, 0, 0, 0, 0, 1.0], np.float32), last=True)
        assert check_bag(drive.bag).ok
        next_seed = replace(SEED, index=next_index(tmp_path, SEED))
        assert Drive(other.graph, draw, next_seed, tmp_path).close()
    finally:
        other.close()


@pytest.mark.thorough
def test_a_tap_is_one_tick_and_a_page_that_falls_silent_moves_nothing(studio, tmp_path):
    studio.drive.bags = tmp_path
    studio.open_task("pick_cube").result(timeout=120)
    studio.show("Drive")
    panel = studio.drive
    first = panel.begin().result(timeout=120)
    down, up = {"held": ["KeyR"], "pad": None}, {"held": [], "pad": None}
    for seq in (1, 2):
        panel.receive(1, down)
        panel.receive(1, up)
        wait_for(lambda seq=seq: first.state.seq == seq, "the tick of a tap", 60)
    panel.receive(1, down)  # and then nothing: the page is busy with its picture
    wait_for(lambda: first.state.seq == 3, "the tick of a word", 60)
    time.sleep(0.5)
    assert first.state.seq == 3
    commanded = first.state.robot.pose_tcp_commanded.position[2]
    assert commanded == pytest.approx(first._recorder._states[0].robot.pose_tcp_commanded.position[2] + 0.06, abs=1e-4)
    assert "target from the tool: " in panel._lamps.content
    assert "you act; time stops until you move" in panel._lamps.content
    assert "gripper: 100 % open" in panel._lamps.content
    panel.begin().result(timeout=120)
    assert f"set apart as {tmp_path.name}/set_apart/" in panel._message.content


@pytest.mark.thorough
def test_no_other_scene_is_shown_or_simulated_while_an_episode_is_driven(studio, tmp_path):
    studio.drive.bags = tmp_path
    studio.open_task("pick_cube").result(timeout=120)
    studio.show("Drive")
    studio.compose._index.value = 4
    assert studio.compose.draw().result(timeout=120) is not None
    drive = studio.drive.begin().result(timeout=120)
    assert not studio.editor.active
    assert not studio.editor.folder.visible
    scene = drive._sim.world.scene
    for act in (studio.compose.draw, studio.compose.solve):
        assert act().result(timeout=120) is None
        assert "an episode is being driven" in studio.compose._message.content
        assert studio.view.scene == scene
    assert studio.bench.do(lambda: drive.step(np.array([0.01, 0, 0, 0, 0, 0, 1.0], np.float32))).result(timeout=60)
    drive.step = lambda *_, **__: 1 / 0
    studio.drive.receive(1, {"held": ["KeyR"], "pad": None})
    wait_for(lambda: "ZeroDivisionError" in studio.drive._message.content, "the fault named", 60)
    del drive.step
    seq = drive.state.seq
    studio.drive._running.set()
    studio.drive.receive(1, {"held": [], "pad": None})
    studio.drive.receive(1, {"held": ["KeyR"], "pad": None})
    wait_for(lambda: drive.state.seq == seq + 1, "a tick after a fault", 60)
    studio.bench.do(studio.drive.leave).result(timeout=60)
    assert studio.compose.draw().result(timeout=120) is not None


def test_words_say_where_the_object_is_in_the_directions_of_the_keys():
    turned = Pose(quat_xyzw=(0.0, 0.0, 0.7071067811865476, 0.7071067811865476))  # the base looks along y
    said = offset_words(turned, (0.0, 0.0, 0.3), (0.003, 0.021, 0.26), "target")
    assert said == "target from the tool: 21 mm away, 3 mm right, 40 mm down"


def test_edits_are_what_is_driven_next(studio):
    studio.open_task("pick_cube").result(timeout=120)
    studio.show("Drive")
    assert studio.drive._source.value == "the task's next scene"
    studio.show("Scene")
    studio.editor.edit(lambda d: edits.with_instruction(d, "Lift the cube"))
    studio.show("Drive")
    assert studio.drive._source.value == "the edited scene"


@pytest.mark.thorough
def test_driving_in_the_page_with_held_keys(studio, chromium, tmp_path):
    studio.drive.bags = tmp_path
    studio.open_task("pick_cube").result(timeout=120)
    studio.show("Drive")
    chromium.open(studio.url)
    chromium.wait("document.documentElement.dataset.studioConnected === 'true'")
    drive = studio.drive.begin().result(timeout=120)
    chromium.wait("document.documentElement.dataset.studioDriving === 'true'")
    start = drive.state
    chromium.key("KeyR", down=True)
    wait_for(lambda: drive.state.seq >= start.seq + 4, "four ticks", 60)
    chromium.key("KeyR", down=False)
    wait_for(lambda: not studio.drive.steering().held, "the released key", 60)
    up = [after.robot.pose_tcp_commanded.position[2] for after in (start, drive.state)]
    assert up[1] - up[0] == pytest.approx(0.02 * (drive.state.seq - start.seq), abs=1e-4)
    chromium.run("new Promise(done => setTimeout(done, 500))")
    stands = drive.state.seq
    chromium.run("new Promise(done => setTimeout(done, 700))")
    assert drive.state.seq == stands
    chromium.key("Space", down=True)
    chromium.key("Space", down=False)
    wait_for(lambda: drive.state.robot.gripper_command == 0.0, "the gripper", 60)
    chromium.click("Open or close the gripper")  # a phone has no keys
    wait_for(lambda: drive.state.robot.gripper_command == 1.0, "the gripper open again", 60)
    chromium.key("Enter", down=True)
    chromium.key("Enter", down=False)
    wait_for(lambda: drive.result is not None, "the end", 60)
    assert drive.result.outcome == "failure"
    assert check_bag(drive.bag).ok
    chromium.wait("document.documentElement.dataset.studioDriving === 'false'")
    wait_for(lambda: studio.drive.kept == 1, "the episode counted", 60)
    assert studio.drive.solved == 0
    chromium.key("Backspace", down=True)
    chromium.key("Backspace", down=False)
    wait_for(lambda: not list(tmp_path.glob("episodes/*")), "the episode thrown away", 60)
    wait_for(lambda: studio.drive.kept == 0, "the episode not counted any more", 60)
    chromium.key("KeyN", down=True)
    chromium.key("KeyN", down=False)
    wait_for(lambda: studio.drive.drive not in (None, drive), "the next episode", 60)


@pytest.mark.slow
def test_a_page_that_goes_away_while_driving_loses_nothing(studio, chromium, tmp_path):
    studio.drive.bags = tmp_path
    studio.open_task("pick_cube").result(timeout=120)
    studio.show("Drive")
    chromium.open(studio.url)
    chromium.wait("document.documentElement.dataset.studioConnected === 'true'")
    drive = studio.drive.begin().result(timeout=120)
    chromium.wait("document.documentElement.dataset.studioDriving === 'true'")
    chromium.key("KeyR", down=True)
    wait_for(lambda: drive.state.seq >= 2, "two ticks", 60)
    chromium.open("about:blank")
    wait_for(lambda: not studio.drive.steering().held, "the page gone", 60)
    assert studio.drive.drive is drive
    chromium.open(studio.url)
    chromium.wait("document.documentElement.dataset.studioDriving === 'true'")
    studio.close()
    (apart,) = (tmp_path / "set_apart").iterdir()
    assert check_bag(apart).ok
