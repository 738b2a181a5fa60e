"""A damaged bag is repaired: every whole tick before the first gap, never a wrong one, and the original untouched."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from rclpy.serialization import serialize_message
from rosbags.rosbag2 import Reader

from roboxim_core.errors import ConfigError, ErrorCode, RecorderError
from roboxim_core.verdicts import Verdict
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader, mcap_file
from roboxim_recorder.bag_writer import METADATA_FILE, McapFile
from roboxim_recorder.export import export_bags
from roboxim_recorder.export.rlds import ExportConfig
from roboxim_recorder.integrity.check import check_bag
from roboxim_recorder.integrity.repair import OUTCOME_UNKNOWN, repair_bag, survey_bag
from roboxim_recorder.integrity.salvage import Damage, SalvagedChunk, salvage
from roboxim_recorder.summary import bag_info, dataset_summary
from roboxim_ros.messages.schemas import message_schema

STEPS = 20
TICKS = STEPS + 3


@pytest.fixture(scope="module")
def whole(tmp_path_factory, fake) -> Path:
    return fake(steps=STEPS).record(tmp_path_factory.mktemp("whole"))


@pytest.fixture
def bag(whole, tmp_path) -> Path:
    """A copy to be damaged."""
    return shutil.copytree(whole, tmp_path / whole.name)


def chunks_of(file: Path):
    """Return start, end and the ticks (their stamps) of each chunk."""
    with file.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    return [
        (c.chunk_start_offset, c.chunk_start_offset + c.chunk_length, c.message_start_time // 10**8)
        for c in sorted(summary.chunk_indexes, key=lambda c: c.chunk_start_offset)
    ]


def rewrite(bag: Path, data: bytes) -> None:
    mcap_file(bag).write_bytes(data)


def flip(bag: Path, *places: int) -> None:
    data = bytearray(mcap_file(bag).read_bytes())
    for at in places:
        data[at] ^= 0x10
    rewrite(bag, bytes(data))


def messages_of(bag: Path):
    return [(topic, stamp, cdr) for (topic, cdr), (_, stamp, _) in zip(
        BagReader(bag).raw(), BagReader(bag).messages(), strict=True)]  # fmt: skip


def require_plays(bag: Path) -> None:
    """The repaired bag is whole for us, for rosbags, and has what a player seeks with."""
    assert check_bag(bag).problems == ()
    with Reader(bag) as foreign:
        assert sum(1 for _ in foreign.messages()) == foreign.message_count
    with mcap_file(bag).open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary.statistics.message_count == sum(BagReader(bag).counts.values())
        assert all(chunk.message_index_offsets for chunk in summary.chunk_indexes)
        ticks = list(make_reader(stream).iter_messages(topics=[topics.STEP], starting_at=2 * 10**8))
        assert len(ticks) == max(0, len(BagReader(bag)) - 2)


def test_a_damaged_chunk_cuts_the_episode_there_and_the_rest_is_counted(bag):
    start, end, first = chunks_of(mcap_file(bag))[3]
    flip(bag, (start + end) // 2)
    damaged = mcap_file(bag).read_bytes()
    report = repair_bag(bag)
    assert (report.state, report.kept, report.lost, report.behind) == ("lossy", first, TICKS - first, TICKS - first - 4)
    assert report.damaged_bytes < end - start + 2000
    assert "a chunk whose checksum is wrong" in report.reasons[0]
    assert report.target == bag.with_name(f"{bag.name}.repaired")
    require_plays(report.target)
    assert len(BagReader(report.target)) == first
    assert mcap_file(bag).read_bytes() == damaged, "the original is only read"


def test_a_fault_is_named_once(bag):
    start, end, _ = chunks_of(mcap_file(bag))[3]
    flip(bag, (start + end) // 2)
    report = survey_bag(bag)
    assert [reason for reason in report.reasons if reason in report.text] == [report.reasons[0]]
    assert report.further == report.reasons[1:]


def test_a_lost_result_is_never_a_success(bag, fake, tmp_path):
    rewrite(bag, mcap_file(bag).read_bytes()[: chunks_of(mcap_file(bag))[-1][0]])
    report = repair_bag(bag, tmp_path / "out" / "episodes")
    assert (report.state, report.outcome, report.reason) == ("lossy", "error", OUTCOME_UNKNOWN)
    result = BagReader(report.target).result
    assert (result.outcome, result.reason, result.last_seq) == ("error", OUTCOME_UNKNOWN, report.kept - 1)
    assert result.final_state_hash == fake(steps=STEPS).state(report.kept - 1).state_hash
    with pytest.raises(RecorderError, match=OUTCOME_UNKNOWN):
        export_bags("rlds", tmp_path / "out", tmp_path / "rlds")
    exported = export_bags("rlds", tmp_path / "out", tmp_path / "rlds", ExportConfig(only_successful=False))
    assert exported.splits == {"train": 1}
    assert exported.steps == result.steps


@pytest.mark.parametrize("verdict", [Verdict(success=True), Verdict(reason="not_lifted"), None])
def test_saved_ticks_can_be_judged_again(bag, verdict):
    rewrite(bag, mcap_file(bag).read_bytes()[: chunks_of(mcap_file(bag))[-1][0]])
    judged = []

    def rejudge(info, states):
        judged.append((info.episode_id, [state.seq for state in states]))
        return verdict

    report = repair_bag(bag, rejudge=rejudge)
    assert judged == [("demo-0-00000-0", list(range(report.kept)))]
    expected = {True: ("success", ""), False: ("failure", "not_lifted"), None: ("error", OUTCOME_UNKNOWN)}
    assert (report.outcome, report.reason) == expected[verdict and verdict.success]
    require_plays(report.target)


@pytest.mark.parametrize("fault", ["no metadata", "no end", "summary", "index", "framing of a chunk"])
def test_what_only_describes_the_messages_is_rebuilt_without_loss(bag, whole, fault):
    file = mcap_file(bag)
    data, chunks = file.read_bytes(), chunks_of(file)
    if fault == "no metadata":
        (bag / METADATA_FILE).unlink()
    elif fault == "no end":
        rewrite(bag, data[: chunks[-1][1]])
    else:
        flip(
            bag, {"summary": len(data) - 200, "index": chunks[2][1] + 14, "framing of a chunk": chunks[2][0] + 3}[fault]
        )
    report = repair_bag(bag)
    assert (report.state, report.kept, report.lost, report.outcome) == ("whole", TICKS, 0, "success")
    assert messages_of(report.target) == messages_of(whole)
    require_plays(report.target)


def test_a_whole_bag_is_left_alone(bag):
    report = repair_bag(bag)
    assert (report.state, report.kept, report.target) == ("whole", TICKS, None)
    assert list(bag.parent.iterdir()) == [bag]


def test_repairing_again_changes_nothing(bag, fake):
    flip(bag, chunks_of(mcap_file(bag))[3][0] + 100)
    first = repair_bag(bag)
    before = {file: (file.read_bytes(), file.stat().st_mtime_ns) for file in first.target.iterdir()}
    assert repair_bag(bag) == first
    assert repair_bag(first.target).state == "whole"
    assert {file: (file.read_bytes(), file.stat().st_mtime_ns) for file in first.target.iterdir()} == before
    assert sorted(path.name for path in bag.parent.iterdir()) == [bag.name, first.target.name]
    flip(first.target, 500)
    with pytest.raises(RecorderError, match="is another bag") as caught:
        repair_bag(bag)
    assert caught.value.code == ErrorCode.EPISODE_EXISTS


def test_the_new_bag_never_lies_in_the_original(bag):
    flip(bag, chunks_of(mcap_file(bag))[3][0] + 100)
    with pytest.raises(ConfigError, match="would lie in the bag"):
        repair_bag(bag, bag)


@pytest.mark.parametrize(
    ("content", "reason"),
    [
        (b"", "info is lost"), (b"garbage", "info is lost"), (None, "info is lost"),
        ("first chunk", "info is lost"), ("first tick", "no tick before the gap is complete"),
    ],
)  # fmt: skip
def test_without_a_tick_nothing_is_written(bag, content, reason):
    file = mcap_file(bag)
    if content == "first chunk":
        flip(bag, chunks_of(file)[0][0] + 80)
    elif content == "first tick":
        rewrite(bag, file.read_bytes()[: chunks_of(file)[1][0] + 30])
    elif content is None:
        rewrite(bag, file.read_bytes()[:300])
    else:
        rewrite(bag, content)
    report = repair_bag(bag)
    assert (report.state, report.target, report.kept) == ("nothing", None, 0)
    assert reason in report.text
    assert list(bag.parent.iterdir()) == [bag]


def test_a_bag_without_its_file_has_nothing_to_save(bag):
    mcap_file(bag).unlink()
    assert repair_bag(bag).state == "nothing"


def test_a_tick_that_is_wrong_under_right_checksums_is_a_gap(bag):
    reader, name = BagReader(bag), bag.name
    messages = messages_of(bag)
    shutil.rmtree(bag)
    new = McapFile(bag, name)
    for topic, kind in reader.types.items():
        new.add_topic(topic, message_schema(kind))
    for topic, stamp, cdr in messages:
        if (topic, stamp) != ("/camera/wrist/image", 5 * 10**8):
            new.write(topic, cdr, stamp)
    new.finish(reader.metadata)
    report = repair_bag(bag)
    assert (report.kept, report.lost, report.behind) == (5, TICKS - 5, TICKS - 5)
    assert "tick 5 lacks /camera/wrist/image" in report.reasons[0]
    require_plays(report.target)


def test_a_killed_recorders_bag_is_repaired(tmp_path, fake):
    episode = fake(steps=30)
    recording = episode.open(tmp_path)
    for seq in range(20):
        for topic, message in episode.tick(seq).items():
            recording.message(topic, serialize_message(message))
    report = repair_bag(recording.path)  # never closed, as after SIGKILL: what was not flushed is not in the file
    assert report.kept >= 17
    require_plays(report.target)
    recording.drop()


def test_additional_topics_are_kept_with_their_ticks(tmp_path, fake):
    from std_msgs.msg import String

    episode = fake(steps=12)
    recording = episode.open(tmp_path, extra_topics={"/notes": "std_msgs/msg/String"})
    for seq in range(episode.last_seq + 1):
        recording.message("/notes", serialize_message(String(data=f"tick {seq}")))
        for topic, message in episode.tick(seq).items():
            recording.message(topic, serialize_message(message))
    bag = tmp_path / episode.close(recording)
    start, _, first = chunks_of(mcap_file(bag))[2]
    flip(bag, start + 80)
    target = repair_bag(bag).target
    assert [message.data for _, _, message in BagReader(target).messages(["/notes"])] == [
        f"tick {seq}" for seq in range(first)
    ]


def test_info_shows_the_state_of_a_damaged_bag_in_one_line(bag, tmp_path):
    flip(bag, chunks_of(mcap_file(bag))[3][0] + 100)
    with pytest.raises(RecorderError) as caught:
        bag_info(bag)
    text = str(caught.value)
    assert "\n" not in text
    assert "damaged: 5 of 23 ticks before the first gap" in text
    assert "roboxim bag repair" in text
    run = tmp_path / "run"
    shutil.copytree(bag, run / "episodes" / bag.name)
    assert dataset_summary(run).damaged == (run / "episodes" / bag.name,)
    assert "1 damaged" in dataset_summary(run).text


def test_a_survey_writes_nothing(bag):
    flip(bag, chunks_of(mcap_file(bag))[3][0] + 100)
    assert survey_bag(bag).kept == 5
    assert list(bag.parent.iterdir()) == [bag]


# ------------------------------------------------------------------ random damage


def damage_randomly(data: bytes, rng: np.random.Generator) -> tuple[bytes, int, str]:
    """Return damaged data, the first byte that differs, and what was done."""
    at = int(rng.integers(len(data)))
    kind = ["cut", "flip", "flips", "zeroed", "inserted", "removed"][rng.integers(6)]
    if kind == "cut":
        return data[:at], at, f"cut at {at}"
    changed = bytearray(data)
    size = int(rng.integers(1, 3000))
    if kind == "inserted":
        return data[:at] + rng.bytes(size) + data[at:], at, f"{size} bytes inserted at {at}"
    if kind == "removed":
        return data[:at] + data[at + size :], at, f"{size} bytes removed at {at}"
    if kind == "zeroed":
        changed[at : at + size] = bytes(len(changed[at : at + size]))
    else:
        places = [at] if kind == "flip" else rng.integers(len(data), size=int(rng.integers(2, 20))).tolist()
        for place in places:
            changed[place] ^= int(rng.integers(1, 256))
        at = min(places)
    return bytes(changed), at, f"{kind} at {at}"


@pytest.fixture(scope="module")
def short(tmp_path_factory, fake) -> Path:
    return fake(steps=9).record(tmp_path_factory.mktemp("short"))


def require_repaired_as_promised(seed: int, whole: Path, folder: Path) -> None:
    data, original = mcap_file(whole).read_bytes(), messages_of(whole)
    damaged, at, what = damage_randomly(data, np.random.default_rng(seed))
    bag = folder / str(seed) / whole.name
    bag.mkdir(parents=True)
    shutil.copy(whole / METADATA_FILE, bag)
    (bag / mcap_file(whole).name).write_bytes(damaged)
    report = repair_bag(bag)
    assert mcap_file(bag).read_bytes() == damaged, what
    chunks = chunks_of(mcap_file(whole))
    hit = next((index for index, (_, end, _) in enumerate(chunks) if end > at), len(chunks))
    sure = chunks[hit][2] if hit < len(chunks) else len(BagReader(whole))
    assert report.kept >= sure, (what, report)
    if report.target is None:
        assert report.state in ("nothing", "whole"), what
        assert (report.state == "nothing") == (report.kept == 0), what
        return
    require_plays(report.target)
    kept = messages_of(report.target)
    assert kept[:-1] == original[: len(kept) - 1], f"{what}: a message differs"
    assert kept[-1][0] == topics.RESULT
    assert len(BagReader(report.target)) == report.kept
    assert (report.state == "whole") == (kept == original), what
    assert repair_bag(report.target).state == "whole"
    shutil.rmtree(bag.parent)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", range(24))
def test_random_damage_loses_no_whole_tick_before_the_gap_and_makes_no_wrong_one(seed, short, tmp_path):
    require_repaired_as_promised(seed, short, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(24, 224))
def test_much_random_damage(seed, whole, tmp_path):
    require_repaired_as_promised(seed, whole, tmp_path)


def test_salvage_finds_the_chunks_behind_damage(whole):
    data = mcap_file(whole).read_bytes()
    chunks = chunks_of(mcap_file(whole))
    assert [part.start for part in salvage(data)] == [start for start, _, _ in chunks]
    broken = bytearray(data)
    broken[chunks[2][0] + 1 : chunks[2][0] + 200] = b"\xff" * 199
    found = list(salvage(bytes(broken)))
    assert [part.start for part in found if isinstance(part, SalvagedChunk)] == [
        start for index, (start, _, _) in enumerate(chunks) if index != 2
    ]
    [damage] = [part for part in found if isinstance(part, Damage)]
    assert damage.start == chunks[2][0]
    assert damage.end == chunks[3][0]
