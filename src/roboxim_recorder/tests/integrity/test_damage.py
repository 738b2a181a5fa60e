"""Every damage to a bag is found, from a flipped bit to a whole file of another episode."""

from __future__ import annotations

import shutil

import pytest
import yaml
from mcap.reader import make_reader

from roboxim_recorder.bag import BagReader, mcap_file
from roboxim_recorder.bag_writer import METADATA, McapFile
from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.integrity.container import container_problems, metadata_problems
from roboxim_ros.messages.schemas import message_schema


@pytest.fixture(scope="module")
def whole(tmp_path_factory, fake):
    """A bag that is small enough to try every byte."""
    return fake(steps=1, settle=1).record(tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def other(tmp_path_factory, fake):
    """A bag of another episode of the same length."""
    return fake(index=1, steps=1, settle=1).record(tmp_path_factory.mktemp("other"))


@pytest.fixture
def bag(whole, tmp_path):
    """A copy to be damaged."""
    return shutil.copytree(whole, tmp_path / whole.name)


def problems_of(data):
    with memoryview(bytes(data)) as view:
        return list(container_problems(view))


def places(size, count):
    return sorted({*range(0, size, max(1, size // count)), *range(40), *range(size - 60, size)})


def test_every_flipped_byte_and_every_lost_end_is_found(whole):
    data = mcap_file(whole).read_bytes()
    assert problems_of(data) == []
    for at in places(len(data), 1500):
        flipped = bytearray(data)
        flipped[at] ^= 1 << at % 8
        assert problems_of(flipped), f"byte {at} of {len(data)}"
        assert problems_of(data[:at]), f"cut at {at} of {len(data)}"
    assert problems_of(data + b"\0")
    assert problems_of(data[:100] + b"\0" + data[100:])


def test_a_section_of_each_kind_is_checked_through_check_bag(bag):
    file = mcap_file(bag)
    data = file.read_bytes()
    with file.open("rb") as stream:
        reader = make_reader(stream)
        chunk, summary = reader.get_summary().chunk_indexes[0], reader.get_summary()
    record = data.index(METADATA.encode(), chunk.chunk_start_offset + chunk.chunk_length)
    sections = {
        "header": 20,
        "chunk": chunk.chunk_start_offset + 60,
        "message index": next(iter(chunk.message_index_offsets.values())) + 12,
        "metadata record": record,
        "summary": data.index(b"/sim/state", record),
        "statistics": len(data) - 300,
        "footer": len(data) - 20,
        "magic": len(data) - 3,
    }
    assert summary.statistics is not None
    for section, at in sections.items():
        flipped = bytearray(data)
        flipped[at] ^= 4
        file.write_bytes(flipped)
        assert not check_bag(bag).ok, section
    for size in (0, 7, 100, len(data) // 2, len(data) - 1):
        file.write_bytes(data[:size])
        assert not check_bag(bag).ok, f"cut to {size} bytes"
    file.write_bytes(data)
    assert check_bag(bag).ok


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"garbage",
        b"\xff\xfe\x00",
        b"[" * 3000,
        b"a: [1, 2",
        b"rosbag2_bagfile_information: {version: 9}",
        b"x" * (2 << 20),
    ],
)
def test_metadata_that_is_no_description_of_the_bag_is_found(bag, content):
    (bag / "metadata.yaml").write_bytes(content)
    report = check_bag(bag)
    assert any("metadata.yaml" in problem for problem in report.problems), report
    assert (report.episode_id, report.ticks) == ("demo-0-00000-0", 3), "the messages are whole"


def test_missing_metadata_is_found(bag):
    (bag / "metadata.yaml").unlink()
    assert check_bag(bag).problems == ("its metadata.yaml cannot be read: No such file or directory",)


@pytest.mark.thorough
def test_every_changed_value_of_the_metadata_is_found(bag):
    path = bag / "metadata.yaml"
    text = path.read_text()
    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    described = yaml.load(text, loader)
    lines = text.splitlines(keepends=True)
    harmful = 0
    for index in [*range(0, len(lines), 9), *range(len(lines) - 20, len(lines), 3)]:
        old, new = next(
            (old, new) for old, new in (("0", "1"), ("a", "b"), ("e", ""), (":", "")) if old in lines[index]
        )
        changed = "".join([*lines[:index], lines[index].replace(old, new, 1), *lines[index + 1 :]])
        path.write_text(changed)
        try:
            same = yaml.load(changed, loader) == described
        except yaml.YAMLError:
            same = False
        found = list(metadata_problems(bag, described))
        assert bool(found) != same, (lines[index], found)
        harmful += not same
    assert harmful > 20
    path.write_text("# a comment changes nothing\n" + text)
    assert check_bag(bag).ok


def test_a_bag_under_another_episodes_name_is_found(bag, other, tmp_path):
    name = other.name
    renamed = bag.rename(tmp_path / name)
    assert "its folder is named demo-0-00001-0, but it holds episode 'demo-0-00000-0'" in check_bag(renamed).problems
    file = mcap_file(renamed)
    file.rename(renamed / mcap_file(other).name)
    assert not check_bag(renamed).ok
    shutil.copy(other / "metadata.yaml", renamed)
    problems = check_bag(renamed).problems
    assert any("holds episode 'demo-0-00000-0'" in problem for problem in problems)
    assert any("custom_data.episode_id" in problem for problem in problems)


def test_the_file_or_the_metadata_of_another_bag_is_found(bag, other):
    original = mcap_file(bag).read_bytes()
    mcap_file(bag).write_bytes(mcap_file(other).read_bytes())
    assert any("holds episode 'demo-0-00001-0'" in problem for problem in check_bag(bag).problems)
    mcap_file(bag).write_bytes(original)
    shutil.copy(other / "metadata.yaml", bag)
    assert not check_bag(bag).ok
    assert check_bag(other).ok


def forge(bag, change, metadata=lambda record: record):
    """Write a bag again with other messages, every checksum and count right."""
    reader = BagReader(bag)
    messages, name = list(reader.raw()), bag.name
    stamps = [stamp for _, stamp, _ in reader.messages()]
    shutil.rmtree(bag)
    new = McapFile(bag, name)
    for topic, kind in reader.types.items():
        new.add_topic(topic, message_schema(kind))
    for topic, cdr, stamp in change([(t, c, s) for (t, c), s in zip(messages, stamps, strict=True)]):
        new.write(topic, cdr, stamp)
    new.finish(metadata(dict(reader.metadata)))
    return check_bag(bag).problems


def without(topic, tick_ns=0):
    return lambda messages: [m for m in messages if m[0] != topic or m[2] != tick_ns]


def from_other(other, topic):
    theirs = {(t, s): c for (t, c), (_, s, _) in zip(BagReader(other).raw(), BagReader(other).messages(), strict=True)}
    return lambda messages: [(t, theirs[t, s] if t == topic else c, s) for t, c, s in messages]


def swapped(messages):
    """Exchange the images of two ticks, their stamps included."""
    first, second = (next(m for m in messages if m[0] == "/camera/wrist/image" and m[2] == s) for s in (0, 10**8))
    exchanged = {first[1]: second[1], second[1]: first[1]}
    return [(t, exchanged.get(c, c), s) for t, c, s in messages]


FORGERIES = {
    "a tick is missing": (lambda ms: [m for m in ms if m[2] != 10**8], "the notice of tick 2"),
    "the first tick is missing": (lambda ms: ms[:1] + [m for m in ms[1:] if m[2]], "tick 0 has the notice of tick 1"),
    "an image is missing": (without("/camera/wrist/image", 10**8), "tick 1 lacks /camera/wrist/image"),
    "a transform is missing": (without("/tf"), "tick 0 lacks /tf"),
    "a notice is missing": (without("/sim/ticks"), "tick 0 lacks /sim/ticks"),
    "a message is there twice": (
        lambda ms: [x for m in ms for x in [m] * (1 + (m[0] == "/tf"))],
        "two messages on /tf",
    ),
    "two images are exchanged": (swapped, "a message on /camera/wrist/image is stamped"),
    "the info is missing": (without("/episode/info"), "its first message is on /sim/ticks"),
    "the result is missing": (without("/episode/result", 2 * 10**8), "no message on /episode/result"),
    "the result comes first": (lambda ms: [ms[0], ms[-1], *ms[1:-1]], "follows the episode's result"),
    "it ends within a tick": (lambda ms: [*ms[:-2], ms[-1]], "it ends within tick 2"),
    "there is a second info": (lambda ms: [ms[0], *ms], "more than one message on /episode/info"),
    "nothing is there": (lambda ms: [], "no message"),
}


@pytest.mark.parametrize("name", FORGERIES)
def test_a_bag_that_lacks_something_is_found_though_its_checksums_are_right(bag, name):
    change, expected = FORGERIES[name]
    problems = forge(bag, change)
    assert any(expected in problem for problem in problems), problems


@pytest.mark.parametrize(
    "topic", ["/episode/info", "/episode/result", "/sim/state", "/sim/ticks", "/evaluator/step", "/camera/wrist/image"]
)
def test_messages_of_another_episode_are_found(bag, other, topic):
    assert forge(bag, from_other(other, topic))


@pytest.mark.parametrize("key", ["episode_id", "outcome", "instruction", "ticks", "format_version"])
def test_a_metadata_record_that_says_something_else_is_found(bag, key):
    problems = forge(bag, lambda messages: messages, lambda record: {**record, key: "another"})
    assert any(f"its metadata record has {key} 'another'" in problem for problem in problems), problems


def test_a_bag_that_is_written_again_unchanged_is_whole(bag):
    assert forge(bag, lambda messages: messages) == ()
