"""Structure-aware fuzzing of bags: parts of real ones are changed, and mcap's own writer puts them together again.

Topics, types, schemas, messages and records are dropped, renamed, retyped, cut, repeated or exchanged, so that a reader
gets past its first checks. What comes out is read, or refused by a `RoboximError`. What a check calls whole is read.
8 mutations run always, 100 with ``-m fuzz``, as in CI, 2,000 with ``-m slow``.
"""

from __future__ import annotations

import random
import shutil
from functools import partial
from pathlib import Path

import pytest
from fuzzing import CI, FEW, MANY, accepted, mutated_bytes, run
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

from roboxim_recorder.bag import BagReader
from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.integrity.repair import repair_bag
from roboxim_recorder.summary import bag_info

ODD = ("", "nan", "-1", "0", "x" * 300, "\u00e4\u2028", "[]", "null", "../..")


@pytest.fixture(scope="module")
def small_bag(tmp_path_factory, fake):
    return fake(steps=2, settle=1).record(tmp_path_factory.mktemp("small"))


def rewritten(source: Path, target: Path, rng: random.Random) -> None:
    """Write a bag again with mcap's writer, a few of its schemas, channels, messages and records changed."""
    with source.open("rb") as stream:
        reader = make_reader(stream)
        messages = list(reader.iter_messages())[: rng.choice((40, 10_000))]
        records = list(reader.iter_metadata())
    topics = sorted({channel.topic for _, channel, _ in messages})
    rows = [[s.name, s.encoding, s.data, c.topic, m.log_time, m.publish_time, m.data] for s, c, m in messages]
    for _ in range(rng.randint(1, 3)):
        at, topic = rng.randrange(len(rows)), rng.choice(topics)
        kind = rng.choice((
            "drop_topic", "drop", "repeat", "swap", "rename_topic", "rename_type", "schema", "data", "time", "retype",
            "encoding", "reorder", "gap", "nothing",
        ))  # fmt: skip
        own = [row for row in rows if row[3] == topic]
        if kind == "drop_topic":
            rows = [row for row in rows if row[3] != topic] or rows
        elif kind == "drop":
            del rows[at]
        elif kind == "repeat":
            rows.insert(at, list(rows[at]))
        elif kind == "swap":
            other = rng.randrange(len(rows))
            rows[at][6], rows[other][6] = rows[other][6], rows[at][6]
        elif kind == "reorder":
            rng.shuffle(rows)
        elif kind == "gap":
            rows = rows[:at] + rows[at + rng.randint(1, 30) :] or rows
        elif kind == "rename_topic":
            new = rng.choice((topic + "2", "/x", "", rng.choice(topics)))
            for row in own:
                row[3] = new
        elif kind in ("rename_type", "encoding", "schema"):
            place = {"rename_type": 0, "encoding": 1, "schema": 2}[kind]
            new = {
                "rename_type": "std_msgs/msg/String", "encoding": rng.choice(("ros1msg", "protobuf", "")),
                "schema": mutated_bytes(own[0][2], rng) if own else b"",
            }[kind]  # fmt: skip
            for row in own:
                row[place] = new
        elif kind == "retype" and own:
            other = rng.choice(rows)
            for row in own:
                row[0], row[2] = other[0], other[2]
        elif kind == "data":
            rows[at][6] = mutated_bytes(rows[at][6], rng)
        elif kind == "time":
            rows[at][4] = rng.choice((0, 2**63, rows[at][4] + 1))
        if not rows:
            break
    with target.open("wb") as stream:
        writer = Writer(
            stream, compression=rng.choice((CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE)),
            chunk_size=rng.choice((1000, 1 << 20)), use_chunking=rng.random() < 0.9, enable_crcs=rng.random() < 0.8,
            use_statistics=rng.random() < 0.9,
        )  # fmt: skip
        writer.start(profile="ros2", library=rng.choice(("roboxim", "other", "")))
        schemas, channels = {}, {}
        for name, encoding, text, topic, log_time, publish_time, data in rows:
            schema = schemas.setdefault((name, encoding, text), 0) or writer.register_schema(name, encoding, text)
            schemas[name, encoding, text] = schema
            if (topic, schema) not in channels:
                channels[topic, schema] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic, schema], log_time, data, publish_time)
        for record in records if rng.random() < 0.8 else ():
            changed = dict(record.metadata)
            if rng.random() < 0.5:
                changed[rng.choice(sorted(changed))] = rng.choice(ODD)
            writer.add_metadata(record.name, changed)
        writer.finish()


def fuzz_bag(folder: Path, rng: random.Random, bag: Path) -> None:
    source, target = next(bag.glob("*.mcap")), folder / bag.name / next(bag.glob("*.mcap")).name
    target.parent.mkdir()
    shutil.copy(bag / "metadata.yaml", target.parent)
    rewritten(source, target, rng)
    if rng.random() < 0.3:
        target.write_bytes(mutated_bytes(target.read_bytes(), rng))
    if rng.random() < 0.2:
        yaml_file = target.parent / "metadata.yaml"
        yaml_file.write_bytes(mutated_bytes(yaml_file.read_bytes(), rng))
    report = check_bag(target.parent)  # never raises
    whole = accepted(lambda: [tick.state for tick in BagReader(target.parent).ticks()])
    assert whole or not report.ok, report
    accepted(lambda: bag_info(target.parent))
    accepted(lambda: (BagReader(target.parent).info, BagReader(target.parent).result))
    if not report.ok:
        repair_bag(target.parent, folder / "saved")


def test_no_mutation_of_a_bag_gives_a_traceback(tmp_path, small_bag):
    run(partial(fuzz_bag, bag=small_bag), tmp_path, "mcap", range(FEW))


@pytest.mark.fuzz
def test_no_mutation_of_a_hundred_of_a_bag_gives_a_traceback(tmp_path, small_bag):
    run(partial(fuzz_bag, bag=small_bag), tmp_path, "mcap", range(FEW, CI))


@pytest.mark.slow
def test_no_mutation_of_many_of_a_bag_gives_a_traceback(tmp_path, small_bag):
    run(partial(fuzz_bag, bag=small_bag), tmp_path, "mcap", range(CI, MANY))
