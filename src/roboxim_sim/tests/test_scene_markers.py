"""The shapes of a scene as markers: each in a frame that moves it, complete, small, and always the same."""

from __future__ import annotations

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import Marker, MarkerArray

from roboxim_core.models.library import ModelLibrary
from roboxim_core.poses import Pose
from roboxim_core.specs import CameraSpec, EntitySpec, RobotSpec, SceneSpec
from roboxim_ros.messages.schemas import message_schema, typestore
from roboxim_sim.scene_markers import FACES, MARKER_ARRAY, scene_markers_cdr
from roboxim_sim.tick_messages import TickMessages
from roboxim_sim.world import World


def scene_with(*entities: EntitySpec, robot: str = "panda") -> SceneSpec:
    return SceneSpec(robot=RobotSpec(model=robot), entities=entities, cameras=())


def scene_markers(scene: SceneSpec) -> list[Marker]:
    message = deserialize_message(bytes(scene_markers_cdr(scene, ModelLibrary(), 0)), MarkerArray)
    return list(message.markers)


def corners(markers: list[Marker]) -> np.ndarray:
    return np.array([[point.x, point.y, point.z] for marker in markers for point in marker.points])


@pytest.mark.parametrize("robot", ["panda", "ur5"])
@pytest.mark.thorough
def test_every_shape_is_in_a_frame_that_tf_has(robot):
    cabinet = EntitySpec(name="cabinet", model="cabinet", pose=Pose(position=(0.6, 0.2, 0.1)), fixed=True)
    with World() as world:
        world.load(scene_with(cabinet, EntitySpec(name="target", model="mug"), robot=robot))
        messages = TickMessages(world.scene, world.robot, world.scene_poses).make(world.record, {})
    tf = [deserialize_message(bytes(messages[topic]), TFMessage) for topic in ("tf", "tf_static")]
    frames = {transform.child_frame_id for message in tf for transform in message.transforms}
    first, *shapes = deserialize_message(bytes(messages["sim/markers"]), MarkerArray).markers
    assert first.action == Marker.DELETEALL, "the markers of an earlier scene vanish"
    assert {marker.header.frame_id for marker in shapes} <= {*frames, "world"}
    assert {marker.ns for marker in shapes} == {"robot", "table", "cabinet", "target"}
    assert len({(marker.ns, marker.id) for marker in shapes}) == len(shapes)
    for marker in shapes:
        assert marker.type == Marker.TRIANGLE_LIST
        assert marker.frame_locked
        assert marker.color.a == 1.0
        assert len(marker.points) % 3 == 0
        assert len(marker.points) > 0
    drawers = {marker.header.frame_id for marker in shapes if marker.ns == "cabinet"}
    assert any(frame.startswith("cabinet/") for frame in drawers), "a drawer moves with its own frame"


def test_a_shape_has_the_size_and_colour_of_its_object():
    cube = EntitySpec(name="target", model="cube", modifiers={"color": "red", "scale": 1.3})
    markers = [marker for marker in scene_markers(scene_with(cube)) if marker.ns == "target"]
    size = np.ptp(corners(markers), axis=0)
    model = ModelLibrary().entity_model(cube)
    fine = np.concatenate([part.mesh.vertices for part in _parts(model)])
    np.testing.assert_allclose(size, np.ptp(fine, axis=0), atol=2e-4)
    assert markers[0].color.r > 2 * max(markers[0].color.g, markers[0].color.b)


def _parts(model):
    from roboxim_core.models.visuals import visual_parts

    return [part for link in model.links for visual in link.visual for part in visual_parts(visual)]


def test_markers_are_small_and_the_same_every_time():
    scene = scene_with(EntitySpec(name="target", model="milk_carton"), EntitySpec(name="b", model="banana"))
    message = scene_markers_cdr(scene, ModelLibrary(), 0)
    assert message == scene_markers_cdr(scene, ModelLibrary(), 0)
    assert len(message) < 1_000_000
    per_body: dict[str, int] = {}
    for marker in scene_markers(scene):
        per_body[marker.header.frame_id] = per_body.get(marker.header.frame_id, 0) + len(marker.points) // 3
    assert max(count for frame, count in per_body.items() if frame != "world") < 2 * FACES


@pytest.mark.parametrize("robot", ["panda", "ur5"])
def test_the_parts_of_the_message_are_what_the_whole_one_would_be(robot):
    """A scene's message is put together from kept markers; where the id is depends on the lengths of names."""
    names = ["a", "ab", "abc", "abcd", "abcde", "a longer name"]
    scene = scene_with(*(EntitySpec(name=name, model="cube") for name in names), robot=robot)
    cdr = bytes(scene_markers_cdr(scene, ModelLibrary(), 1_500_000_007))
    found = deserialize_message(cdr, MarkerArray).markers
    assert [marker.id for marker in found] == list(range(len(found)))
    assert {(marker.header.stamp.sec, marker.header.stamp.nanosec) for marker in found} == {(1, 500_000_007)}
    assert {*names} < {marker.ns for marker in found}
    store = typestore((message_schema(MARKER_ARRAY),))
    assert cdr == bytes(store.serialize_cdr(store.deserialize_cdr(cdr, MARKER_ARRAY), MARKER_ARRAY))


def test_markers_do_not_depend_on_cameras():
    scene = scene_with(EntitySpec(name="target", model="cube"))
    seen = SceneSpec(robot=scene.robot, entities=scene.entities, cameras=(CameraSpec(name="eye"),))
    library = ModelLibrary()
    assert scene_markers_cdr(scene, library, 0) == scene_markers_cdr(seen, library, 0)
