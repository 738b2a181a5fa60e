"""Files of conventions are checked when they are loaded, and what is loaded can be written and loaded again."""

import json

import numpy as np
import pytest

from roboxim_core.actions import ActionContext, Chunking
from roboxim_core.config import from_json, to_json
from roboxim_core.config_folders import config_names
from roboxim_core.conventions import Convention, decode_actions, from_actions, joined_answer, load_convention
from roboxim_core.conventions.convention import observe
from roboxim_core.errors import ConfigError, ErrorCode, InvalidRequestError
from roboxim_core.policies import Observation
from roboxim_core.poses import Pose


def written(tmp_path, text, name="own"):
    path = tmp_path / f"{name}.yaml"
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize("name", config_names("conventions"))
def test_a_convention_survives_json(name):
    convention = load_convention(name)
    assert convention.name == name
    assert convention.sources
    assert from_json(to_json(convention), Convention) == convention
    assert hash(from_json(to_json(convention), Convention)) == hash(convention)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{}", "rate_hz: required key is missing"),
        ("rate_hz: 10\nacton: {}", "did you mean 'action'"),
        ("rate_hz: 10\naction: {rotation: eulers}", "unknown value 'eulers'"),
        ("rate_hz: 10\naction: {control: joint_delta, joints: 7, order: [0, 1]}", "order must name 8"),
        ("rate_hz: 10\naction: {rotation: rotation_6d, rotation_scale_rad: 0.5}", "rotation_scale_rad must be 1"),
        ("rate_hz: 10\naction: {translation_range: [1, -1]}", "translation_range must be two numbers"),
        ("rate_hz: 10\naction: {gripper: {open: 1, closed: 1}}", "open and closed must differ"),
        ("rate_hz: 10\naction: {gripper: {threshold: 2}}", "threshold must lie between 0 and 1"),
        ("rate_hz: 10\naction: {gripper: {agree: 3}}", "need binary: true"),
        ("rate_hz: 10\nimages: [{camera: wrist, key: a}, {camera: workspace, key: a}]", "'a' of the request"),
        ("rate_hz: 10\nimages: [{camera: wrist, key: a, resize: crops}]", "did you mean 'crop'"),
        ("rate_hz: 10\nimages: [{camera: wrist, key: a, width: 0}]", "width of image 'a' must be from 1"),
        ("rate_hz: 10\nstates: [{key: s, parts: []}]", "state 's' has no parts"),
        ("rate_hz: 10\nstates: [{key: s, parts: [{field: tcp}]}]", "unknown value 'tcp'"),
        ("rate_hz: 10\nstates: [{key: s, parts: [{field: gripper, open: [1, 2]}]}]", "different lists of one length"),
        ("rate_hz: 10\nstates: [{key: s, parts: [{field: tcp_position, components: [3]}]}]", "no component 3"),
        ("rate_hz: 10\nframes: {base_axes: [x, y, y]}", "x, y and z once each"),
        ("rate_hz: 10\nframes: {base_axes: [x, y, '-z']}", "both be right-handed"),
        ("rate_hz: 10\nprompt: {template: hello}", "must contain {instruction}"),
        ("rate_hz: 10\nchunking: {horizon: 4, execute: 5}", "execute must be from 0 to 4"),
        ("rate_hz: 10\naction: {normalisation: {kind: quantiles}}", "needs a file, or first (q01) and second (q99)"),
        ("rate_hz: -1", "rate_hz must be from 0"),
    ],
)
def test_a_wrong_file_is_refused_with_the_reason(tmp_path, text, said):
    with pytest.raises(ConfigError) as error:
        load_convention(written(tmp_path, text))
    assert said in str(error.value)


def test_an_unknown_name_is_answered_with_a_suggestion():
    with pytest.raises(ConfigError, match="did you mean 'libero'"):
        load_convention("libro")


def test_own_folders_are_searched(tmp_path, monkeypatch):
    (tmp_path / "conventions").mkdir()
    (tmp_path / "conventions" / "mine.yaml").write_text("rate_hz: 7\n")
    monkeypatch.setenv("ROBOXIM_CONFIG_PATH", str(tmp_path))
    assert load_convention("mine").rate_hz == 7


STATISTICS = {"q01": [-0.1] * 6 + [0.0], "q99": [0.3] * 6 + [1.0], "min": [-1.0] * 7, "max": [3.0] * 7,
              "mean": [0.1] * 7, "std": [0.5] * 7, "mask": [True] * 6 + [False]}  # fmt: skip


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("quantiles", [0.3, -0.1, 0.1]),  # 1 is q99, -1 is q01, 0 is the middle
        ("bounds", [3.0, -1.0, 1.0]),
        ("mean_std", [0.6, -0.4, 0.1]),  # mean + std, mean - std, mean
    ],
)
@pytest.mark.parametrize("layout", ["by dataset", "single"])
def test_numbers_are_unnormalised_by_a_statistics_file(tmp_path, kind, expected, layout):
    nested = {"my_data": {"action": STATISTICS}} if layout == "by dataset" else {"action": STATISTICS}
    (tmp_path / "statistics.json").write_text(json.dumps(nested))
    dataset = "my_data" if layout == "by dataset" else ""
    text = f"rate_hz: 5\naction: {{normalisation: {{kind: {kind}, file: statistics.json, dataset: '{dataset}'}}}}"
    convention = load_convention(written(tmp_path, text))
    (tmp_path / "statistics.json").unlink()  # the numbers are part of the convention now
    rows = decode_actions(convention, [[1, -1, 0, 0, 0, 0, 0.25]])
    np.testing.assert_allclose(rows[0, :3], expected, atol=1e-12)
    assert rows[0, 6] == pytest.approx(0.25)  # the gripper is masked
    assert from_json(to_json(convention), Convention) == convention
    here = ActionContext(pose_commanded=Pose())
    np.testing.assert_allclose(from_actions(convention, rows, here), [[1, -1, 0, 0, 0, 0, 0.25]], atol=1e-9)


def test_a_missing_dataset_is_named(tmp_path):
    (tmp_path / "statistics.json").write_text(json.dumps({"bridge": {"action": STATISTICS}}))
    text = "rate_hz: 5\naction: {normalisation: {kind: quantiles, file: statistics.json, dataset: bridg}}"
    with pytest.raises(ConfigError, match="no statistics 'bridg'.*did you mean 'bridge'"):
        load_convention(written(tmp_path, text))


def test_a_component_that_was_constant_in_the_dataset_stays_finite(tmp_path):
    text = (
        "rate_hz: 5\naction: {normalisation: {kind: quantiles, first: [0, 0, 0, 0, 0, 0.2, 0], "
        "second: [1, 1, 1, 1, 1, 0.2, 1]}}"
    )
    convention = load_convention(written(tmp_path, text))
    here = ActionContext(pose_commanded=Pose())
    raw = from_actions(convention, [0.5, 0.5, 0.5, 0.0, 0.0, 0.1, 1.0], here)
    assert np.isfinite(raw).all()
    assert raw[0, 5] == 0.0


@pytest.mark.parametrize(
    "raw", [[[1, 2, 3]], [[np.nan] * 7], np.zeros((0, 7)), np.zeros((2, 3, 7)), [[np.inf] + [0] * 6]]
)
def test_numbers_without_meaning_are_refused(raw):
    with pytest.raises(InvalidRequestError) as error:
        decode_actions(load_convention("bridge"), raw)
    assert error.value.code == ErrorCode.INVALID_ACTION


def test_an_answer_of_several_keys_is_joined_in_the_convention_s_order():
    convention = load_convention("groot_libero")
    answer = {
        key: np.full((16, 1), float(i)) for i, key in enumerate(["gripper", "yaw", "pitch", "roll", "z", "y", "x"])
    }
    assert joined_answer(convention, answer)[0].tolist() == [6, 5, 4, 3, 2, 1, 0]
    del answer["roll"]
    with pytest.raises(InvalidRequestError, match="the answer has no 'roll'"):
        joined_answer(convention, answer)
    answer["roll"] = np.zeros((8, 1))
    with pytest.raises(InvalidRequestError, match="different lengths"):
        joined_answer(convention, answer)


def test_a_camera_that_is_missing_is_named():
    with pytest.raises(InvalidRequestError, match="needs camera 'workspace'") as error:
        observe(load_convention("bridge"), [Observation(seq=0, stamp_ns=0)], "go")
    assert error.value.code == ErrorCode.OBSERVATION_MISSING


def test_a_window_holds_the_newest_observations(tmp_path):
    text = "rate_hz: 5\nwindow: 3\npad_mask_key: mask\nimages: [{camera: wrist, key: image, width: 4, height: 4}]\n"
    text += "states: [{key: state, parts: [{field: tcp_position}]}]"
    convention = load_convention(written(tmp_path, text))
    seen = [Observation(seq=k, stamp_ns=k, images={"wrist": np.full((4, 4, 3), k, np.uint8)}) for k in range(5)]
    request = observe(convention, seen[:2], "go")
    assert request["image"][:, 0, 0, 0].tolist() == [0, 0, 1]
    assert request["mask"].tolist() == [False, True, True]
    assert request["state"].shape == (3, 3)
    assert observe(convention, seen, "go")["image"][:, 0, 0, 0].tolist() == [2, 3, 4]
    assert convention.cameras[0].name == "wrist"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("{horizon: 10, execute: 5}", Chunking(execute=5)),
        ("{horizon: 4, ensemble: newest}", Chunking()),
        ("{horizon: 4, ensemble: mean}", Chunking(ensemble="mean")),
        (
            "{horizon: 4, ensemble: exponential, ensemble_decay: 0.01}",
            Chunking(ensemble="exponential", ensemble_decay=0.01),
        ),
    ],
)
def test_the_episode_loop_executes_chunks_as_the_convention_says(text, expected, tmp_path):
    path = written(tmp_path, f"rate_hz: 10\nchunking: {text}")
    assert load_convention(path).chunking.execution == expected


def test_a_response_has_a_name_or_numbers_not_both(tmp_path):
    numbers = "gain: [1, 1, 1, 1, 1, 1], lag: [0, 0, 0, 0, 0, 0]"
    for response in (f"{{name: robosuite_osc_pose, {numbers}}}", "{gain: [1, 1]}", "{}"):
        text = f"rate_hz: 20\naction: {{rotation: rotation_vector, response: {response}}}\n"
        (tmp_path / "own.yaml").write_text(text)
        with pytest.raises(ConfigError, match="response"):
            load_convention(str(tmp_path / "own.yaml"))
    (tmp_path / "own.yaml").write_text("rate_hz: 20\naction: {rotation: rotation_vector, response: {name: nobodys}}\n")
    with pytest.raises(ConfigError, match="robosuite_osc_pose"):
        load_convention(str(tmp_path / "own.yaml"))
