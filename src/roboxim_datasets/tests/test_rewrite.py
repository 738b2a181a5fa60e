"""Datasets are converted, merged and split; the sources stay, and an interruption loses nothing."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from roboxim_core.errors import ErrorCode, InvalidRequestError, RecorderError
from roboxim_datasets.compare import compare
from roboxim_datasets.formats import open_dataset
from roboxim_datasets.plans import plan_of, split_plan
from roboxim_datasets.rewrite import options_like, require_all_shards, write_dataset
from roboxim_datasets.rlds import RldsOptions


def ids(dataset):
    return {split: [e.episode_id for e in dataset.episodes(split)] for split in dataset.splits}


def test_a_merged_dataset_has_the_episodes_of_all_split_by_split(tmp_path, write):
    a, b = write(tmp_path / "a", [0, 1], val=[2], encoding="jpeg"), write(tmp_path / "b", [3], val=[4], encoding="jpeg")
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    written = write_dataset(plan_of(a, b), tmp_path / "m", "rlds", options_like(a), how="merge")
    merged = open_dataset(written.path)
    assert ids(merged) == {"train": ["demo-0", "demo-1", "demo-3"], "val": ["demo-2", "demo-4"]}
    assert compare(merged, write(tmp_path / "x", [0, 1, 3], val=[2, 4], encoding="jpeg"), images="exact").equal
    assert {file: file.read_bytes() for file in before} == before
    facts = json.loads((written.path / "export.json").read_text())
    assert (facts["how"], [source["name"] for source in facts["sources"]]) == ("merge", ["roboxim", "roboxim"])
    again = write_dataset(plan_of(a, b), tmp_path / "m", "rlds", options_like(a), how="merge")
    assert again.resumed == 5
    assert written.changed == again.changed == ()  # the JPEG files are copied


def test_images_that_lose_a_little_are_named(tmp_path, write):
    a, b = write(tmp_path / "a", [0, 1], encoding="jpeg"), write(tmp_path / "b", [2], encoding="png")
    frames = b.read("train", 0).length
    merged = write_dataset(plan_of(a, b), tmp_path / "m", "rlds", options_like(a), how="merge")
    again = write_dataset(plan_of(a, b), tmp_path / "m", "rlds", options_like(a), how="merge")
    for written in (merged, again):
        assert [(part.name, part.count, part.why) for part in written.changed] == [
            ("images of camera workspace", frames, "compressed anew with a small loss")
        ]
    kept = write_dataset(plan_of(a, b), tmp_path / "p", "rlds", options_like(b), how="merge")
    assert kept.changed == ()


def test_what_does_not_fit_together_is_refused(tmp_path, write):
    a, b = write(tmp_path / "a", [0]), write(tmp_path / "b", [0])
    with pytest.raises(RecorderError, match="episode 'demo-0' occurs twice"):
        write_dataset(plan_of(a, b), tmp_path / "m", "rlds", how="merge")
    (b.path / "convention.yaml").write_text("rate_hz: 5\n")
    with pytest.raises(RecorderError, match="different conventions"):
        write_dataset(plan_of(a, b), tmp_path / "m", "rlds", how="merge")
    for target in (a.path, a.path / "inside", tmp_path / "a"):
        with pytest.raises(RecorderError, match="is, or lies in, the source") as caught:
            write_dataset(plan_of(a), target, "rlds", RldsOptions(name="roboxim"), how="convert", overwrite=True)
        assert caught.value.code == ErrorCode.EXPORT_REFUSED


def with_depth(episode):
    """Return an episode with depth images."""

    def read(wanted):
        for step in episode.read(wanted):
            yield replace(step, depth={camera: np.ones((32, 48), np.float32) for camera in wanted.depth})

    return replace(episode, depth=("workspace",), read=read)


def test_depth_images_of_some_datasets_are_not_dropped(tmp_path, write, episode_of, description):
    about = replace(description, features=replace(description.features, depth=("workspace",)))
    a = write(tmp_path / "a", [0], format="hdf5")
    b = write(tmp_path / "b", [with_depth(episode_of(1))], format="hdf5", description=about)
    for pair in ((a, b), (b, a)):
        with pytest.raises(RecorderError, match="do not fit together: depth images"):
            write_dataset(plan_of(*pair), tmp_path / "m", "hdf5", how="merge")


def test_metadata_that_not_every_episode_has_are_named(tmp_path, write, episode_of):
    more = [
        episode_of(1, metadata={"note": "blue", "tries": 2}),
        episode_of(2, metadata={"note": "red", "tries": "two"}),
    ]
    a = write(tmp_path / "a", more, format="hdf5")
    written = write_dataset(plan_of(a), tmp_path / "m", "rlds", how="convert")
    assert [(part.name, part.count) for part in written.left_out] == [("tries", 2)]
    assert "not_read" in open_dataset(written.path).facts
    assert [e.metadata for e in open_dataset(written.path).episodes()] == [{"note": "blue"}, {"note": "red"}]
    same = write_dataset(plan_of(a), tmp_path / "h", "hdf5", how="convert")
    assert not same.left_out
    assert open_dataset(same.path).episode(1).metadata == more[1].metadata


def test_some_shards_of_an_export_are_not_merged_as_all(tmp_path, write):
    parts = [write(tmp_path / str(number), [number]) for number in range(3)]
    for number, part in enumerate(parts, start=1):
        facts = {"format": "rlds", "config": {"shard": f"{number}/3", "name": "roboxim"}}
        (part.path / "export.json").write_text(json.dumps(facts))
    parts = [open_dataset(part.path) for part in parts]
    require_all_shards(parts)
    two = open_dataset(write_dataset(plan_of(*parts[:2]), tmp_path / "two", "rlds", how="merge").path)
    require_all_shards([two, parts[2]])
    for some, missing in (([parts[0], parts[2]], "2/3 is"), ([two], "3/3 is"), ([parts[1]], "1/3, 3/3 are")):
        with pytest.raises(RecorderError, match=f"of which {missing} missing"):
            require_all_shards(some)


def test_the_description_has_the_number_of_the_new_datasets_episodes(tmp_path, write, description):
    def described(name, number, text):
        return write(tmp_path / name, [number], description=replace(description, text=text))

    def text_of(*sources):
        name = "m-" + "".join(source.path.parts[-3] for source in sources)
        written = write_dataset(plan_of(*sources), tmp_path / name, "rlds", how="merge")
        return open_dataset(written.path).description.text

    a = described("a", 0, "1 simulated episodes recorded with RoboXim; skills: lift.")
    b = described("b", 1, "1 simulated episodes recorded with RoboXim; skills: lift.")
    c, d = described("c", 2, "12 episodes of pushing."), described("d", 3, "")
    assert text_of(a, b) == "2 simulated episodes recorded with RoboXim; skills: lift."
    assert text_of(a, c) == ("2 episodes. simulated episodes recorded with RoboXim; skills: lift. episodes of pushing.")
    assert text_of(d) == "1 episodes; robot: panda; 10 Hz."


def test_an_interrupted_merge_goes_on(tmp_path, write):
    a, options = write(tmp_path / "a", [0, 1, 2, 3]), RldsOptions(name="copy")

    def interrupt(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_dataset(plan_of(a), tmp_path / "out", "rlds", options, how="convert", progress=interrupt)
    assert not (tmp_path / "out" / "copy" / "1.0.0").exists()
    write_dataset(plan_of(a), tmp_path / "out", "rlds", options, how="convert")
    whole = write_dataset(plan_of(a), tmp_path / "whole", "rlds", options, how="convert")
    resumed = tmp_path / "out" / "copy" / "1.0.0"
    for file in whole.path.iterdir():
        assert (resumed / file.name).read_bytes() == file.read_bytes(), file.name


def test_a_call_that_is_killed_before_the_card_is_completed_by_the_next(tmp_path, write, monkeypatch):
    def killed(dataset):
        raise KeyboardInterrupt

    a = write(tmp_path / "a", [0])
    with monkeypatch.context() as patched:
        patched.setattr("roboxim_datasets.rewrite.write_card", killed)
        with pytest.raises(KeyboardInterrupt):
            write_dataset(plan_of(a), tmp_path / "b", "rlds", how="convert")
    written = write_dataset(plan_of(a), tmp_path / "b", "rlds", how="convert")
    assert (written.path / "README.md").is_file()


def test_a_dataset_is_divided_anew(tmp_path, write):
    a = write(tmp_path / "a", [0, 1, 2, 3], val=[4, 5])
    plan = split_plan(a, {"train": 0, "val": 2})
    written = write_dataset(plan, tmp_path / "s", "rlds", options_like(a), how="split")
    found = ids(open_dataset(written.path))
    assert (len(found["train"]), len(found["val"])) == (4, 2)
    assert sorted(found["train"] + found["val"]) == [f"demo-{i}" for i in range(6)]
    for counts in ({"train": 5}, {"train": 7, "val": 0}, {"train": 6, "val": 0}, {"a": 0, "b": 0}):
        with pytest.raises(InvalidRequestError, match="has 6 episodes; expected counts that add up"):
            split_plan(a, counts)


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("format", "options", "shown"),
    [
        ("lerobot", {"version": "2.1", "columns": "openpi"}, {"front", "state", "actions"}),
        ("lerobot", {"images": True}, {"observation.images.front", "observation.state", "action"}),
        ("hdf5", {"compression": "gzip"}, None),
        ("rlds", {"encoding": "png", "name": "theirs"}, None),
    ],
)
def test_a_divided_dataset_is_written_as_its_source_is(tmp_path, write, description, format, options, shown):
    """Also without ``export.json``, which the datasets of other tools do not have."""
    parts = {"action": {"motion": (0, 6), "grip": (6, 7)}}
    about = replace(description, features=replace(description.features, keys={"workspace": "front"}), parts=parts)
    a = write(tmp_path / "a", [0, 1, 2], format=format, description=about, **options)
    (a.folder / "export.json").unlink()
    plan = split_plan(a, {"train": 2, "val": 0})
    written = write_dataset(plan, tmp_path / "s", format, options_like(a), how="split", keep_keys=True)
    found = open_dataset(written.path)
    assert options.items() <= found.options.items()
    assert found.features.keys == a.features.keys
    if shown:
        assert shown <= json.loads((written.path / "meta/info.json").read_text())["features"].keys()
        assert found.description.parts == parts
        assert "motion" in json.loads((written.path / "meta/modality.json").read_text())["action"]


@pytest.mark.thorough
def test_a_key_survives_a_conversion(tmp_path, write, description):
    about = replace(description, features=replace(description.features, keys={"workspace": "front"}))
    for key, source in (("front", about), ("image", description)):
        kinds = ("rlds", "lerobot", "hdf5", "rlds")
        now = write(tmp_path / key / "0", [0], description=source)
        for number, kind in enumerate(kinds[1:], 1):
            now = open_dataset(write_dataset(plan_of(now), tmp_path / key / str(number), kind, how="convert").path)
        assert now.features.keys == {"workspace": key}


def test_the_card_says_what_a_dataset_consists_of(tmp_path, write):
    a = write(tmp_path / "a", [0, 1], val=[2])
    written = write_dataset(plan_of(a), tmp_path / "c", "rlds", RldsOptions(name="cubes"), how="convert")
    text = (written.path / "README.md").read_text()
    head, body = text.split("---\n", 2)[1:]
    assert "task_categories:\n- robotics" in head
    for words in (
        "| `train` | 2 | 6 |", "| Pick up cube 1 | 1 |", "`dx`", "`tcp.x`, `tcp.y`", "end_effector_delta",
        "roboxim dataset convert, from roboxim (rlds)", "tensorflow_datasets", "(preview.jpg)",
    ):  # fmt: skip
        assert words in body, words
    assert "simulation" not in head  # nothing says that RoboXim recorded it
    assert "renderings" not in body
    assert "Of the split `train`" in body
    assert (written.path / "preview.jpg").read_bytes()[:2] == b"\xff\xd8"
