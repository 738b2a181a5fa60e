"""A bag opened in Foxglove looks like its episode: what the layouts name exists in bags and on a running graph."""

from __future__ import annotations

import importlib.util
import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rosbags.interfaces import Nodetype

from roboxim_bringup.core_graph import CoreGraph
from roboxim_core.config import config_dir
from roboxim_core.episode import EpisodeRunner, RunConfig
from roboxim_recorder import topics
from roboxim_recorder.bag import BagReader
from roboxim_recorder.integrity.check import check_bag
from roboxim_ros.messages.schemas import message_schema, typestore
from roboxim_runs.episodes.task_choice import task_text
from roboxim_sim.tick_messages import KINDS

SCRIPT = Path(__file__).parents[1] / "scripts" / "foxglove_layouts.py"
SHOWS = {
    "3D": {"visualization_msgs/msg/MarkerArray", "std_msgs/msg/String"},
    "Image": {"sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"},
}
"""Panel to the types that it draws."""
NUMBERS = {"bool", "float32", "float64", "int32", "uint32"}


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> BagReader:
    folder = tmp_path_factory.mktemp("run")
    config = RunConfig(
        run_seed=5, purpose="test", task_config=task_text("pick_cube"), image_width=16, image_height=16, max_steps=3,
        output_dir=str(folder),
    )  # fmt: skip
    with CoreGraph(folder) as graph:
        result = EpisodeRunner(graph.ports, config).run_index(0)
    return BagReader(folder / result.bag)


def layout(name: str) -> dict[str, Any]:
    return json.loads((config_dir() / "foxglove" / f"{name}.json").read_text())


def named(value: Any) -> Iterator[str]:
    """Yield the topics and message paths that a layout names."""
    if isinstance(value, dict):
        for key, inner in value.items():
            if key.startswith("/"):
                yield key
            yield from named(inner)
    elif isinstance(value, list):
        for inner in value:
            yield from named(inner)
    elif isinstance(value, str) and value.startswith("/"):
        yield value


def field_type(path: str, types: dict[str, str]) -> str:
    """Return the type of a message path, e.g. ``/evaluator/step.verdict.predicates[:]{name=="held_s"}.value``."""
    topic, *fields = re.sub(r"\{[^}]*\}|\[[^\]]*\]", "", path).split(".")
    kind = types[topic]
    store = typestore((message_schema(kind),))
    for field in fields:
        node, inner = dict(store.fielddefs[kind][1])[field]
        if node in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            node, inner = inner[0]
        kind = str(inner if node == Nodetype.NAME else inner[0])
    return kind


def test_the_shipped_layouts_are_those_of_the_script():
    spec = importlib.util.spec_from_file_location("foxglove_layouts", SCRIPT)
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    for name, text in script.files().items():
        assert (config_dir() / "foxglove" / name).read_text() == text, "run scripts/foxglove_layouts.py"


@pytest.mark.parametrize("name", ["run", "live"])
def test_everything_that_a_layout_names_is_in_a_bag(bag, name):
    paths = list(named(layout(name)))
    assert len(paths) > 15
    for path in paths:
        topic = path.split(".")[0]
        assert bag.counts.get(topic, 0) > 0, f"{topic} has no message"
        assert field_type(path, bag.types)
    for panel, config in layout(name)["configById"].items():
        kind = panel.split("!")[0]
        for path in named(config):
            if kind in SHOWS:
                assert bag.types[path] in SHOWS[kind], (panel, path)
            elif kind == "Plot":
                assert field_type(path, bag.types) in NUMBERS, (panel, path)
            else:
                assert field_type(path, bag.types) == "string", (panel, path)


def test_the_live_layout_names_topics_of_the_graph():
    published = {f"/{topic}" for topic in KINDS} | {topics.STEP, topics.INFO}
    published |= {topics.image_topic(c, kind) for c in ("workspace", "wrist") for kind in ("image", "camera_info")}
    assert {path.split(".")[0] for path in named(layout("live"))} <= published


def test_the_panels_of_a_layout_are_all_placed():
    def places(tree: Any) -> list[str]:
        return [tree] if isinstance(tree, str) else places(tree["first"]) + places(tree["second"])

    for name in ("run", "live"):
        assert sorted(places(layout(name)["layout"])) == sorted(layout(name)["configById"])


def test_robot_and_objects_are_drawn_where_tf_moves_them(bag):
    frames = {"world"}
    for topic in ("/tf", "/tf_static"):
        for _, _, message in bag.messages([topic]):
            frames |= {transform.child_frame_id for transform in message.transforms}
    [markers] = [message.markers for _, _, message in bag.messages(["/sim/markers"])]
    shapes = [marker for marker in markers if marker.ns]
    assert {marker.header.frame_id for marker in shapes} <= frames
    assert {"robot", "table", "target"} <= {marker.ns for marker in shapes}
    assert check_bag(bag.path).ok


def test_bags_of_earlier_versions_are_still_whole(bag, tmp_path):
    from roboxim_recorder.bag_writer import McapFile

    target = tmp_path / bag.path.name
    old = McapFile(target, target.name)
    for topic, kind in bag.types.items():
        if topic != topics.MARKERS:
            old.add_topic(topic, message_schema(kind))
    stamps = [stamp for _, stamp, _ in bag.messages()]
    for (topic, cdr), stamp in zip(bag.raw(), stamps, strict=True):
        if topic == topics.NOTICE:
            cdr = without_markers(cdr)
        if topic != topics.MARKERS:
            old.write(topic, cdr, stamp)
    old.finish(bag.metadata)
    assert check_bag(target).problems == ()


def without_markers(cdr: bytes) -> bytes:
    from rclpy.serialization import deserialize_message, serialize_message
    from roboxim_interfaces.msg import TickNotice

    notice = deserialize_message(cdr, TickNotice)
    kept = [i for i, topic in enumerate(notice.topics) if topic != "sim/markers"]
    notice.image_crc32 = [notice.image_crc32[i] for i in kept]
    notice.topics = [notice.topics[i] for i in kept]
    return serialize_message(notice)
