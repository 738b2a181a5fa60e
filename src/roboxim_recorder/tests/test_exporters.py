"""The registry of formats: one file adds one, and every format gets the same episodes."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import contextmanager
from dataclasses import dataclass, replace

import numpy as np
import pytest

from roboxim_core.errors import ConfigError, InvalidRequestError, RecorderError
from roboxim_core.specs import LookSpec
from roboxim_datasets.dataset import EXPORT_FILE
from roboxim_datasets.rlds import RldsReader
from roboxim_datasets.rlds.episodes import from_rlds
from roboxim_recorder.export import EXPORTERS, DatasetContents, Selection, export_bags
from roboxim_recorder.export.rlds import ExportConfig


@pytest.fixture(scope="module")
def run(tmp_path_factory, fake):
    folder = tmp_path_factory.mktemp("run")
    for index in range(3):
        fake(index=index).record(folder)
    return folder


@dataclass(frozen=True, kw_only=True)
class ListConfig(Selection):
    """A format's own field."""

    title: str = "list"
    """Name of the file."""


class ListExporter:
    """Write the names of episodes."""

    config = ListConfig
    episodes: list = []  # noqa: RUF012 - looked at by the test

    def path(self, target, config):
        return target / config.title

    @contextmanager
    def open(self, target, config, selected, *, identity, overwrite):
        self.added = []
        self.place = self.path(target, config)
        yield self

    def resumed(self, split):
        return int(split == "train")

    def add(self, split, episode):
        self.added.append((split, episode.episode_id))
        ListExporter.episodes.append(episode)

    def complete(self, files):
        self.place.mkdir(parents=True)
        for name, text in files.items():
            (self.place / name).write_text(text)
        (self.place / "names").write_text("\n".join(f"{split} {name}" for split, name in self.added))

    def contents(self, path):
        return DatasetContents(splits={"train": len((path / "names").read_text().splitlines())})


def test_a_format_is_one_class(run, tmp_path, monkeypatch, fake):
    monkeypatch.setitem(EXPORTERS._items, "list", ListExporter)
    config = ListConfig(title="mine", val_fraction=0.4)
    report = export_bags("list", run, tmp_path, config)
    assert (report.path / "names").read_text() == "train demo-0-00001-0\nval demo-0-00002-0"
    assert (report.resumed, report.steps) == (1, 15)
    assert export_bags("list", run, tmp_path, config, if_exists="keep").resumed == 3
    episode = ListExporter.episodes[0]
    assert (episode.instruction, episode.robot, episode.success) == (fake().instruction, "panda", True)
    assert episode.semantics == fake().info.semantics
    steps = list(episode.steps(["wrist"]))
    np.testing.assert_array_equal(steps[3].images["wrist"], fake(index=1).image("wrist", 3))
    assert list(steps[0].images) == ["wrist"]
    assert [step.reward for step in steps] == [0, 0, 0, 0, 1]
    np.testing.assert_array_equal(steps[2].action_executed, np.float32(fake(index=1).label(3)))
    with pytest.raises(InvalidRequestError, match="no camera 'wirst'; .*did you mean 'wrist'"):
        next(episode.steps(["wirst"]))


def test_bags_that_differ_in_their_pictures_alone_are_other_bags(tmp_path, monkeypatch, fake):
    """As renderings of one run: episodes, states and cameras are the same."""

    class Evening(fake):
        """An episode in another light."""

        @property
        def scene(self):
            return replace(super().scene, look=LookSpec(ambient=(0.1, 0.1, 0.1)))

    monkeypatch.setitem(EXPORTERS._items, "list", ListExporter)
    reports = []
    for place, episode in (("day", fake), ("evening", Evening)):
        for index in range(2):
            episode(index=index).record(tmp_path / place)
        reports.append(export_bags("list", tmp_path / place, tmp_path / f"{place} list", ListConfig()))
    day, evening = (json.loads((report.path / EXPORT_FILE).read_text())["identity"] for report in reports)
    assert day != evening


def test_an_unknown_format_and_anothers_configuration_are_refused(run, tmp_path):
    with pytest.raises(ConfigError, match="unknown exporter 'rdls'.*did you mean 'rlds'"):
        export_bags("rdls", run, tmp_path)
    with pytest.raises(ConfigError, match="takes a ExportConfig, got a ListConfig"):
        export_bags("rlds", run, tmp_path, ListConfig())


def test_an_episode_that_went_through_rlds_is_the_same(run, tmp_path, monkeypatch):
    ListExporter.episodes.clear()
    monkeypatch.setitem(EXPORTERS._items, "list", ListExporter)
    export_bags("list", run, tmp_path)
    report = export_bags("rlds", run, tmp_path, ExportConfig(encoding="png", val_fraction=0.0))
    reader = RldsReader(report.path)
    read = [from_rlds(episode, reader.features) for episode in reader.episodes("train")][1:]
    assert len(read) == len(ListExporter.episodes) == 2
    for mine, other in zip(read, ListExporter.episodes, strict=True):
        for name in ("episode_id", "length", "instruction", "semantics", "cameras", "success", "robot", "joint_names"):
            assert getattr(mine, name) == getattr(other, name), name
        assert mine.metadata == other.metadata
        for a, b in zip(mine.steps(), other.steps(), strict=True):
            np.testing.assert_array_equal(a.action, b.action)
            assert a.reward == b.reward
            for field in a.proprio:
                np.testing.assert_array_equal(a.proprio[field], b.proprio[field], err_msg=field)
            assert a.images.keys() == b.images.keys()
            for camera in a.images:
                np.testing.assert_array_equal(a.images[camera], b.images[camera])
        np.testing.assert_array_equal(mine.actions(), other.actions())
        assert mine.proprio()["joint_positions"].shape == (5, 7)


def test_a_dataset_that_changes_under_an_episode_is_an_error(run, tmp_path, fake):
    from roboxim_datasets.episode import Episode, Step

    episode = Episode(
        episode_id="e", length=2, instruction="", semantics=None, cameras={}, success=True,
        read=lambda cameras: iter([Step(index=0, action=np.zeros(7, np.float32))]),
    )  # fmt: skip
    with pytest.raises(RecorderError, match="has 1 steps, expected 2"):
        list(episode.steps())


OTHER = """
import sys
from pathlib import Path
from roboxim_datasets.build import only_build
with only_build(Path(sys.argv[1])):
    print("writing", flush=True)
    sys.stdin.read()
"""


@pytest.mark.thorough
@pytest.mark.parametrize("name", ["rlds", "lerobot", "hdf5"])
def test_a_second_export_into_one_folder_is_refused(tmp_path, fake, name):
    fake().record(tmp_path)
    exporter = EXPORTERS[name]()
    path = exporter.path(tmp_path / "out", exporter.config())
    with subprocess.Popen(
        [sys.executable, "-c", OTHER, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as other:
        assert other.stdout.readline() == b"writing\n"
        with pytest.raises(ConfigError, match="another command is writing .*wait for it or stop it"):
            export_bags(name, tmp_path, tmp_path / "out")
        other.stdin.close()
    report = export_bags(name, tmp_path, tmp_path / "out")
    assert report.splits == {"train": 1}
    assert not list((tmp_path / "out").glob("**/.partial*"))
