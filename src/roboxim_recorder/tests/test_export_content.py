"""What an export's steps consist of: rate, meaning of the actions, state, images, and the convention beside them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.actions import ActionSemantics
from roboxim_core.actions.transforms import ActionContext, convert_rows
from roboxim_core.config import named_config
from roboxim_core.conventions import load_convention, observe
from roboxim_core.errors import InvalidRequestError, RecorderError
from roboxim_core.policies import Observation
from roboxim_core.proprioception import Proprioception
from roboxim_datasets.formats import open_dataset
from roboxim_recorder.export import export_bags
from roboxim_recorder.export.content import content_of
from roboxim_recorder.export.episodes import exported_episode
from roboxim_recorder.export.rlds import ExportConfig
from roboxim_recorder.export.selection import Selection, choose
from roboxim_recorder.run_bags import run_bags

STEPS = 7


@pytest.fixture(scope="module")
def run(tmp_path_factory, fake):
    folder = tmp_path_factory.mktemp("run")
    fake(steps=STEPS).record(folder)
    return folder


def exported(run, **options):
    sources = choose([run_bags(run)], Selection(**options)).sources
    return exported_episode(sources[0], content_of(sources, Selection(**options)))


def track(fake, seqs):
    return [ActionContext.of(fake(steps=STEPS).state(seq)) for seq in seqs]


def labels(fake):
    rows = np.array([fake(steps=STEPS).label(seq) for seq in range(1, STEPS + 1)], float)
    rows[np.abs(rows) < 1e-5] = 0
    return rows


ABSOLUTE = ActionSemantics(control="end_effector_absolute", rotation="quaternion_xyzw")


def test_a_lower_rate_recomposes_the_deltas(run, fake):
    """Each step ends where the last of its ticks was told to go; the gripper is that tick's; the last step is short."""
    episode = exported(run, rate_hz=5)
    steps = list(episode.steps())
    assert (episode.fps, len(steps), episode.semantics.rate_hz) == (5, 4, 5)
    first, last = [0, 2, 4, 6], [1, 3, 5, 6]
    rows = np.array([step.action for step in steps], float)
    targets = convert_rows(labels(fake)[last], ActionSemantics(), ABSOLUTE, track(fake, last))
    found = convert_rows(rows, replace(ABSOLUTE, control="end_effector_delta", rotation="euler_xyz_extrinsic",
                                       delta_base="commanded"), ABSOLUTE, track(fake, first))  # fmt: skip
    np.testing.assert_allclose(found, targets, atol=1e-6)
    assert rows[:, 6].tolist() == labels(fake)[last, 6].tolist()
    np.testing.assert_array_equal(steps[2].images["wrist"], fake().image("wrist", 4))
    assert [step.reward for step in steps] == [0, 0, 0, 1]
    with pytest.raises(RecorderError, match="10 Hz, not a whole multiple of 4 Hz"):
        exported(run, rate_hz=4)


def test_an_episode_with_other_words_has_no_subtasks_of_the_recorded_task(run):
    [source] = choose([run_bags(run)], Selection()).sources
    task = replace(source.info.task, arguments={"step_1.instruction": "Reach", "step_2.instruction": "Lift"})
    source = replace(source, info=replace(source.info, task=task))
    for relabelled, subtasks in (("", ("Reach", "Lift")), ("Wave", ())):
        given = replace(source, relabelled=relabelled)
        content = content_of((given,), Selection())
        assert exported_episode(given, content).subtasks == subtasks
        assert content.describe((given,)).features.subtasks == bool(subtasks)


def test_actions_of_another_meaning(run, fake):
    words = "end_effector_absolute,rotation_6d,absolute_open_0_closed_1"
    episode = exported(run, actions=words)
    assert episode.semantics.rotation == "rotation_6d"
    steps = list(episode.steps(()))
    assert steps[0].action.shape == (10,)
    wanted = replace(ABSOLUTE, rotation="rotation_6d", gripper="absolute_open_0_closed_1")
    expected = convert_rows(labels(fake), ActionSemantics(), wanted, track(fake, range(STEPS)))
    np.testing.assert_allclose([step.action for step in steps], expected, atol=1e-6)
    assert steps[0].action[-1] == 1.0 - fake().label(1)[6]
    np.testing.assert_array_equal(episode.semantics.component_names()[3], "x_axis.x")


def test_joint_actions_of_recorded_labels_are_the_recorded_commands(tmp_path, fake):
    fake(steps=3).record(tmp_path)
    steps = list(exported(tmp_path, actions="joint_position").steps(()))
    for seq, step in enumerate(steps, start=1):
        np.testing.assert_allclose(step.action[:7], fake().state(seq).robot.joint_commands, atol=1e-6)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("rotation_7d", "unknown word 'rotation_7d'.*did you mean 'rotation_6d'"),
        ("speed=2", "unknown field 'speed'"),
        ("rotation_6d,rotation_vector", "gives rotation twice"),
        ("end_effector_absolute,tool", "absolute pose in the tool's own frame"),
        ("joint_velocity,rotation_6d", "'rotation_6d' has no meaning with control 'joint_velocity'"),
        ("end_effector_absolute,measured", "'measured' has no meaning with control 'end_effector_absolute'"),
    ],
)
def test_actions_without_meaning_are_refused(run, words, message):
    with pytest.raises(InvalidRequestError, match=message):
        exported(run, actions=words)


def test_unchanged_actions_are_the_labels_bit_for_bit(run, fake):
    rows = np.stack([step.action for step in exported(run).steps(())])
    np.testing.assert_array_equal(rows, labels(fake).astype(np.float32))


def test_the_state_has_the_fields_asked_for(run):
    episode = exported(run, state="joint_positions,gripper_opening")
    assert len(episode.vectors["state"]) == 8
    assert episode.vectors["state"][-1] == "gripper.opening"
    assert next(episode.steps(())).proprio["state"].shape == (8,)
    with pytest.raises(InvalidRequestError, match="state: unknown value.*did you mean 'tcp_position'"):
        exported(run, state="tcp_positions")


def test_depth_is_exported_on_request_at_the_images_size(run, fake):
    episode = exported(run, depth=("workspace",), image_width=16, image_height=12)
    step = next(episode.steps(["workspace"], depth=["workspace"]))
    assert step.images["workspace"].shape == (12, 16, 3)
    assert step.depth["workspace"].shape == (12, 16)
    assert (step.depth["workspace"] == np.float32(0.5)).all()
    with pytest.raises(InvalidRequestError, match="no depth images of camera 'wrist'"):
        exported(run, depth=("wrist",))


@pytest.mark.parametrize("convention", ["", "libero_here"])
def test_the_convention_beside_a_dataset_asks_a_policy_for_what_the_dataset_holds(run, tmp_path, fake, convention):
    if convention:
        text = named_config("conventions", "libero").read_text().replace("rate_hz: 20", "rate_hz: 10")
        text = text.replace("  response: {name: robosuite_osc_pose}\n", "")  # else the expert is too fast for it
        text += "prompt: {lower: true}\n" if "prompt:" not in text else ""
        convention = str(tmp_path / "here.yaml")
        (tmp_path / "here.yaml").write_text(text)
    report = export_bags(
        "rlds", run, tmp_path / "out", ExportConfig(convention=convention, encoding="png", val_fraction=0.0)
    )
    written = load_convention(str(report.path / "convention.yaml"))
    assert written.rate_hz == 10
    episode = open_dataset(report.path).episode(0)
    step = next(episode.steps())
    state = fake(steps=STEPS).state(0)
    seen = Observation(
        seq=0,
        stamp_ns=0,
        proprio=Proprioception.of(state),
        images={name: fake().image(name, 0) for name in ("workspace", "wrist")},
    )
    request = observe(written, [seen], "Pick up the red cube")
    assert episode.instruction == request[written.prompt.key]
    for image in written.images:
        np.testing.assert_array_equal(step.images[image.camera], request[image.key])
    for vector in written.states:
        np.testing.assert_allclose(step.proprio[vector.key.rpartition("/")[2]], request[vector.key], atol=1e-6)
    decoded = written.action.decode(step.action[None], written.frames)
    back = convert_rows(decoded, written.semantics, ActionSemantics(), track(fake, [0]))
    np.testing.assert_allclose(back[0], labels(fake)[0], atol=1e-6)
    assert open_dataset(report.path).features.action[:2] == ("dx", "dy")
    assert (episode.semantics is None) == bool(convention), "scaled numbers have no meaning of their own"
