"""Datasets of others: the arm in 3D where joint positions are stated, and the distribution of actions."""

import re
import threading

import h5py
import numpy as np
import pytest

from roboxim_core.errors import ConfigError
from roboxim_core.kinematics import ArmKinematics
from roboxim_core.models.library import ModelLibrary
from roboxim_datasets.episode import Episode, Step
from roboxim_studio.episode.arm_track import ArmTrack, arm_track, arms_that_fit, named_arm
from roboxim_studio.episode.statistics import distributions
from roboxim_studio.opening import recognise
from roboxim_studio.panels.dataset import DatasetPanel

LIBRARY = ModelLibrary()
PANDA = LIBRARY.robot("panda")
STEPS = 5
JOINTS = np.array(PANDA.home) + np.linspace(0, 0.3, STEPS)[:, None]


def episode(values, names=None, vector="observation.state", **said):
    """An episode with one vector of the given rows."""
    names = tuple(names or map(str, range(values.shape[1])))
    rows = [
        Step(index=n, proprio={vector: np.float32(row)}, action=np.zeros(7, np.float32)) for n, row in enumerate(values)
    ]
    made = Episode(
        episode_id="e", length=len(rows), instruction="", semantics=None, cameras={}, success=None,
        vectors={vector: names}, read=lambda wanted: iter(rows), **said,
    )  # fmt: skip
    return made, rows


@pytest.mark.parametrize(
    ("names", "vector", "robot"),
    [
        ([f"joint_{n}" for n in range(7)] + ["gripper"], "observation.state", "Franka"),
        (["gripper"] + [f"panda_joint{n}.position" for n in range(1, 8)], "state", ""),
        ([f"main/joint{n}.pos" for n in range(1, 8)] + ["gripper.pos"], "observation.state", "franka_emika_panda"),
        (None, "joint_positions", "panda"),
        (None, "obs/robot0_joint_pos", "Panda"),
        (None, "qpos", "panda_wristcam"),
    ],
)
def test_joints_of_a_named_arm_are_found(names, vector, robot):
    first = bool(names) and names[0] == "gripper"
    extra = np.full((STEPS, 1), 0.02)
    values = np.hstack([extra, JOINTS] if first else [JOINTS, extra])
    made, rows = episode(values, names, vector, robot=robot)
    assert named_arm(made, LIBRARY) == "panda"
    track = arm_track(made, rows, PANDA)
    assert isinstance(track, ArmTrack), track
    assert track.joints == pytest.approx(JOINTS, abs=1e-6)
    assert track.opening is None
    assert track.state(2).joint_positions == pytest.approx(JOINTS[2], abs=1e-6)


@pytest.mark.parametrize(
    ("values", "vector", "why"),
    [
        (np.degrees(JOINTS), "joint_positions", "not in radians.*joint 2 is -11"),
        (JOINTS[:, :6], "joint_positions", "no positions of 7 joints"),
        (JOINTS, "joint_velocities", "no positions of 7 joints"),
        (JOINTS * np.nan, "joint_positions", "joint 1 is nan"),
    ],
)
def test_what_is_no_position_of_this_arm_is_refused_with_its_reason(values, vector, why):
    made, rows = episode(values, None, vector)
    found = arm_track(made, rows, PANDA)
    assert isinstance(found, str)
    assert re.search(why, found), found


def test_an_arm_that_is_not_named_is_not_guessed():
    made, rows = episode(JOINTS, None, "joint_positions")
    assert named_arm(made, LIBRARY) == ""
    assert {"panda", "fr3"} <= set(arms_that_fit(made, rows, LIBRARY))
    assert named_arm(episode(JOINTS, robot="UR5e")[0], LIBRARY) == ""


def test_histograms_count_every_action():
    rng = np.random.default_rng(0)
    actions = np.column_stack([rng.normal(size=1000), np.full(1000, 0.5), np.r_[np.nan, np.ones(999)]])
    normal, constant, gaps = distributions(actions, ("a", "b", "c"))
    assert normal.counts.sum() == constant.counts.sum() == 1000
    assert gaps.counts.sum() == 999
    assert (normal.mean, normal.deviation) == pytest.approx((0.0, 1.0), abs=0.1)
    x, counts = normal.outline
    assert len(x) == len(counts)
    assert (np.diff(x) >= 0).all()


@pytest.fixture
def foreign(tmp_path):
    """A file as robosuite and robomimic write it, with joint positions of a Panda."""
    rng = np.random.default_rng(0)
    with h5py.File(tmp_path / "data.hdf5", "w") as file:
        data = file.create_group("data")
        for number in range(2):
            demo = data.create_group(f"demo_{number}")
            demo.attrs["num_samples"] = STEPS
            demo["actions"] = rng.normal(size=(STEPS, 7)).astype("f4")
            demo["obs/robot0_joint_pos"] = JOINTS + 0.01 * number
            demo["obs/agentview_image"] = rng.integers(0, 255, (STEPS, 16, 16, 3), dtype=np.uint8)
    return tmp_path / "data.hdf5"


def test_the_arm_of_a_foreign_dataset_is_shown_at_every_step(studio, foreign):
    studio.open(recognise(str(foreign)))
    panel = studio.dataset
    assert panel.track is None
    assert "no 3D: the dataset names no known arm" in panel._arm_text.content
    panel.choose_arm("no_arm")  # as a forged message of a page would
    assert panel.track is None
    panel.choose_arm("panda")
    arm = ArmKinematics(PANDA)
    base = studio.view.scene.robot.pose
    for episode, step in ((0, 0), (0, 4), (1, 2)):
        if step == 2:
            panel.show(episode)
            panel.choose_arm("panda")
        panel.step(step)
        hand = base @ arm.link_poses(JOINTS[step] + 0.01 * episode)["panda_hand"]
        assert studio.view._bodies["robot/panda_hand"][1].position == pytest.approx(hand.position, abs=1e-5)
    assert not {"table", "wall"} & studio.view._bodies.keys()
    found = panel.measure()
    assert len(found) == 7
    assert {int(one.counts.sum()) for one in found} == {2 * STEPS}


def test_pictures_are_those_of_the_step_that_the_slider_says(studio, foreign, monkeypatch):
    monkeypatch.setattr(DatasetPanel, "_fill", lambda *_: None)
    studio.open(recognise(str(foreign)))
    monkeypatch.undo()
    panel = studio.dataset
    panel.step(3)  # before any picture has come
    panel._fill(panel.episode, panel._pictures)
    assert (panel.number, panel._slider.value) == (3, 3)
    ((name, shown),) = panel._images.items()
    assert (shown.image == panel._pictures.at(3)[name]).all()
    panel._pictures.data[name].pop(1)
    panel.step(1)  # whose picture has not come
    assert not shown.visible
    panel.step(2)
    assert shown.visible
    assert (shown.image == panel._pictures.at(2)[name]).all()


def test_marks_and_trims_are_of_the_episode_that_is_shown(studio, foreign, monkeypatch):
    studio.open(recognise(str(foreign)))
    panel = studio.dataset
    read, panel._number.value = panel.dataset.episode, 1
    wanted, released = threading.Event(), threading.Event()

    def damaged(index):
        raise ConfigError("damaged")

    def slowly(index):
        if index == 1:
            wanted.set()
            assert released.wait(60)
        return read(index)

    monkeypatch.setattr(panel.dataset, "episode", damaged)
    panel.show(1)
    assert (panel._name, panel._number.value, studio.site._latest["alert"]) == ("train/0", 0, "damaged")
    monkeypatch.setattr(panel.dataset, "episode", slowly)
    older = threading.Thread(target=panel.show, args=(1,))
    older.start()
    assert wanted.wait(60)
    panel.show(0)
    first = panel.episode
    released.set()
    older.join()
    assert (panel.episode, panel._name, studio.site._latest["alert"]) == (first, "train/0", "")


@pytest.mark.thorough
def test_a_foreign_dataset_in_the_page(studio, foreign, chromium):
    studio.open(recognise(str(foreign)))
    chromium.open(studio.url)
    chromium.wait("document.querySelector('#dataset-arm')?.innerText.includes('no 3D')")
    chromium.run("[...document.querySelectorAll('input')].find((one) => one.value === 'unknown').click()")
    panda = "[...document.querySelectorAll('[role=option]')].find((one) => one.innerText.trim() === 'panda')"
    chromium.wait(f"!!({panda})")
    chromium.run(f"({panda}).click()")
    chromium.wait("document.querySelector('#dataset-arm')?.innerText.includes('as the joints of panda')")
    chromium.click("Measure all episodes")
    chromium.wait("document.querySelector('#action-facts')?.innerText.includes('10 actions of 2 episodes')")
    assert not chromium.errors
