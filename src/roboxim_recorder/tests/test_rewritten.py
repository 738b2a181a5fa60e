"""Bags that other programs wrote again: converters, filters, and bags of other systems."""

from __future__ import annotations

import shutil

import pytest
from click.testing import CliRunner
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from roboxim_core.errors import ConfigError, ErrorCode, RecorderError
from roboxim_recorder.bag import BagReader, NotAnEpisodeError, mcap_file
from roboxim_recorder.export import export_bags
from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.integrity.repair import repair_bag
from roboxim_recorder.summary import bag_info, dataset_summary

WAYS = {
    "defaults": {},
    "lz4": {"compression": CompressionType.LZ4},
    "uncompressed": {"compression": CompressionType.NONE},
    "without chunks": {"use_chunking": False},
    "without checksums": {"enable_crcs": False},
    "without index": {"index_types": IndexType.NONE},
    "without counts": {"use_statistics": False},
}


def write_again(bag, without=(), metadata=True, **options):
    """Replace a bag's file by what mcap's own writer makes of its messages, in that writer's order of announcement."""
    file = mcap_file(bag)
    old = file.rename(file.with_suffix(".old"))
    with old.open("rb") as source, file.open("wb") as target:
        reader, writer = make_reader(source), Writer(target, **options)
        writer.start(profile="ros2", library="somebody's tool")
        schemas, channels = {}, {}
        for schema, channel, message in reader.iter_messages():
            if channel.topic in without:
                continue
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(channel.topic, "cdr", schemas[schema.id])
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        for record in reader.iter_metadata() if metadata else ():
            writer.add_metadata(record.name, record.metadata)
        writer.finish()
    old.unlink()


def chatter(folder):
    """Write a bag of another system."""
    folder.mkdir()
    with (folder / "chatter_0.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
        channel = writer.register_channel("/chatter", "cdr", schema)
        state = writer.register_channel("/state", "json", 0)
        writer.add_message(channel, 0, b"\0\1\0\0\3\0\0\0hi\0\0", 0)
        writer.add_message(state, 1, b"{}", 1)
        writer.finish()
    return folder


@pytest.fixture
def run(tmp_path, fake):
    fake().record(tmp_path / "run")
    return tmp_path / "run"


@pytest.mark.thorough
@pytest.mark.parametrize("way", WAYS)
def test_a_bag_written_again_is_whole_for_every_reader(run, tmp_path, way):
    [bag] = (run / "episodes").iterdir()
    write_again(bag, **WAYS[way])
    report = check_bag(bag)
    assert report.ok, report.problems
    assert "written again by somebody's tool" in report.notes
    assert "somebody's tool" in bag_info(bag)
    assert repair_bag(bag, tmp_path / "saved").state == "whole"
    assert export_bags("rlds", run, tmp_path / "rlds").splits == {"train": 1}
    assert len(list(BagReader(bag).ticks())) == report.ticks == 8


def test_a_changed_chunk_without_other_checksums_is_still_found(run):
    [bag] = (run / "episodes").iterdir()
    write_again(bag)
    file = mcap_file(bag)
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 4
    file.write_bytes(data)
    assert not check_bag(bag).ok


def test_the_repair_of_a_damaged_copy_saves_what_is_before_the_gap(run, tmp_path):
    [bag] = (run / "episodes").iterdir()
    write_again(bag, chunk_size=4000)
    file = mcap_file(bag)
    with file.open("rb") as stream:
        chunks = make_reader(stream).get_summary().chunk_indexes
    file.write_bytes(file.read_bytes()[: chunks[len(chunks) // 2].chunk_start_offset + 50])
    report = repair_bag(bag, tmp_path / "saved")
    assert report.state == "lossy"
    assert 0 < report.kept < 8
    assert check_bag(report.target).ok


def test_a_metadata_record_that_contradicts_the_messages_is_a_problem(run):
    [bag] = (run / "episodes").iterdir()
    write_again(bag, metadata=False)
    assert check_bag(bag).ok
    file = mcap_file(bag)
    with file.open("r+b") as stream:
        data = stream.read()
    assert b"roboxim_version" not in data
    renamed = bag.rename(bag.with_name("another"))
    assert any("folder is named another" in note for note in check_bag(renamed).notes)


def test_filtered_topics_are_named_and_only_those_that_readers_need_are_missed(run, tmp_path):
    [bag] = (run / "episodes").iterdir()
    copy = shutil.copytree(bag, tmp_path / "a" / bag.name)
    write_again(copy, without=("/tf", "/camera/wrist/camera_info"))
    report = check_bag(copy)
    assert report.ok, report.problems
    [filtered] = [note for note in report.notes if note.startswith("filtered out, and not needed by exports: ")]
    assert "/tf, " in filtered
    assert filtered.endswith("/camera/wrist/camera_info")

    write_again(bag, without=("/camera/wrist/image",))
    assert "topic /camera/wrist/image is missing" in check_bag(bag).problems[0]
    with pytest.raises(RecorderError, match=r"lacks the images of /camera/wrist/image.*with images: workspace"):
        export_bags("rlds", run, tmp_path / "rlds")

    write_again(bag, without=("/sim/state",))
    with pytest.raises(RecorderError, match="no topic /sim/state, which every reader needs: it was filtered out"):
        export_bags("rlds", run, tmp_path / "rlds")
    assert "/sim/state" in repair_bag(bag, tmp_path / "saved").text


def test_a_bag_of_another_system_is_no_episode(tmp_path):
    bag = chatter(tmp_path / "chatter")
    for read in (
        bag_info,
        dataset_summary,
        lambda path: BagReader(path).info,
        lambda path: list(BagReader(path).ticks()),
    ):
        with pytest.raises(NotAnEpisodeError, match=r"no episode of RoboXim.*/chatter \(1 messages\)") as caught:
            read(bag)
        assert caught.value.code != ErrorCode.BAG_DAMAGED
    report = check_bag(bag)
    assert report.foreign
    assert "damaged" not in report.problems[0]
    assert "no episode of RoboXim" in repair_bag(bag, tmp_path / "saved").text
    assert [topic for topic, _, _ in BagReader(bag).messages(["/chatter"])] == ["/chatter"]


def test_a_bag_of_sqlite_is_named(tmp_path):
    (tmp_path / "bag_0.db3").touch()
    with pytest.raises(ConfigError, match="bag of SQLite, not MCAP; convert it"):
        BagReader(tmp_path)
    assert "convert it" in check_bag(tmp_path).problems[0]


def test_damaged_bags_end_info_with_an_exit_code(run, monkeypatch):
    pytest.importorskip("roboxim_bringup")
    from roboxim_cli.commands.data.bag import command

    [bag] = (run / "episodes").iterdir()
    file = mcap_file(bag)
    file.write_bytes(file.read_bytes()[:-100])
    for path in (bag, run):
        result = CliRunner().invoke(command, ["info", str(path)])
        assert isinstance(result.exception, RecorderError), result.output
        assert result.exception.code == ErrorCode.BAG_DAMAGED
    assert "1 damaged" in result.output
