from __future__ import annotations

import pytest
from roboxim_interfaces.msg import Contact, TickNotice
from roboxim_interfaces.srv import Tick
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import ByteMultiArray, Float32
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from roboxim_cli import messages
from roboxim_core.errors import ConfigError
from roboxim_core.plain_data import yaml_text


@pytest.mark.parametrize("name", ["roboxim_interfaces/srv/Tick", "roboxim_interfaces/Tick"])
def test_type_is_looked_up_as_ros2_spells_it(name):
    assert messages.look_up(name, "srv") is Tick
    assert messages.full_name(Tick) == "roboxim_interfaces/srv/Tick"


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        ("roboxim_interfaces/srv/Tock", "roboxim_interfaces/srv/Tick"),
        ("roboxim_interface/srv/Tick", "roboxim_interfaces"),
        ("Tick", "expected one of"),
        ("roboxim_interfaces/msg/Tick", "did you mean 'roboxim_interfaces/srv/Tick'"),
    ],
)
def test_unknown_type_gets_a_suggestion(name, hint):
    with pytest.raises(ConfigError, match=hint):
        messages.look_up(name, "srv")


@pytest.mark.parametrize("cls", [Tick.Request, Tick.Response, JointState, Image, TickNotice])
def test_message_survives_yaml(cls):
    filled = messages.message_from_plain(cls, messages.prototype(cls))
    text = yaml_text.dump(messages.message_to_plain(filled, full=True))
    assert messages.message_from_plain(cls, yaml_text.parse(text, source="text")) == filled


def test_values_survive_yaml():
    text = "{header: {stamp: {sec: 5}, frame_id: world}, name: [a, 'true'], position: [1, 2.5e-3], velocity: [-1e9]}"
    message = messages.message_from_plain(JointState, yaml_text.parse(text, source="text"))
    assert message.header.stamp.sec == 5
    assert (list(message.name), list(message.position)) == (["a", "true"], [1.0, 0.0025])
    again = yaml_text.dump(messages.message_to_plain(message))
    assert messages.message_from_plain(JointState, yaml_text.parse(again, source="text")) == message


def test_fixed_array_is_filled():
    message = messages.message_from_plain(Contact, {"force_on_b": [0, 0, 0.5]})
    assert message.force_on_b.dtype.name == "float64"
    assert messages.message_to_plain(message)["force_on_b"] == [0.0, 0.0, 0.5]


@pytest.mark.parametrize(
    ("cls", "text", "complaint"),
    [
        (Tick.Request, "{episode: a}", "unknown field 'episode'.*episode_id.*did you mean 'episode_id'"),
        (Contact, "{force_on_b: [1, 2]}", "'force_on_b': expected 3 elements, got 2"),
        (Tick.Request, "{action: [1, 2, 3, 4, 5, 6, x]}", r"'action\[6\]': expected a number, got 'x'"),
        (Tick.Request, "{seq: -1}", "'seq': expected a whole number from 0 to 4294967295"),
        (Tick.Request, "{seq: 1.5}", "'seq': expected a whole number"),
        (Tick.Request, "{seq: true}", "'seq': expected a whole number"),
        (Tick.Request, "{episode_id: 5}", "'episode_id': expected a string, got 5"),
        (Tick.Request, "[1]", "as a mapping"),
        (JointState, "{header: {stamp: {secs: 1}}}", "unknown field 'header.stamp.secs'.*nanosec, sec"),
        (JointState, "{position: 1.0}", "'position': expected a list"),
        (Image, "{is_bigendian: 256}", "from 0 to 255"),
        (JointState, f"{{position: [1{400 * '0'}]}}", r"'position\[0\]': expected a number from -1.79.*e\+308 to 1.79"),
        (Float32, "{data: 1.0e+300}", "'data': expected a number from -3.4028235e\\+38 to 3.4028235e\\+38"),
    ],
)
def test_bad_yaml_names_the_field(cls, text, complaint):
    with pytest.raises(ConfigError, match=complaint):
        messages.message_from_plain(cls, yaml_text.parse(text, source="request"))


def test_broken_yaml_names_the_line():
    with pytest.raises(ConfigError, match="request line 2"):
        yaml_text.parse("a: 1\nb: [", source="request")


def test_long_arrays_are_shortened_unless_asked_for():
    image = Image(data=bytes(1000))
    shown = messages.message_to_plain(image)["data"]
    assert len(shown) == messages.SHOWN_ELEMENTS + 1
    assert "1000 in all" in shown[-1]
    assert len(messages.message_to_plain(image, full=True)["data"]) == 1000
    points = [JointTrajectoryPoint(positions=[0.0] * 7) for _ in range(100)]
    shown = messages.message_to_plain(JointTrajectory(points=points))["points"]
    assert shown[-1] == "... 96 more, 100 in all (--full shows them)"
    assert len(shown) == messages.SHOWN_MESSAGES + 1
    assert len(messages.message_to_plain(JointTrajectory(points=points[:16]))["points"]) == 16


def test_a_field_is_selected_from_the_whole_message():
    image = Image(data=bytes(range(200)))
    assert messages.field_to_plain(image, "data.100") == 100
    assert messages.field_to_plain(image, "data.-1") == 199
    assert len(messages.field_to_plain(image, "data")) == messages.SHOWN_ELEMENTS + 1
    assert messages.field_to_plain(image, "") == messages.message_to_plain(image)
    points = [JointTrajectoryPoint(positions=[float(k)]) for k in range(100)]
    assert messages.field_to_plain(JointTrajectory(points=points), "points.99.positions.0") == 99.0
    assert messages.field_to_plain(Contact(force_on_b=[0.0, 0.0, 0.5]), "force_on_b.2") == 0.5


@pytest.mark.parametrize(
    ("field", "complaint"),
    [
        ("data.200", "no element '200' in 'data.200': expected a whole number from -200 to 199"),
        ("data.-201", "no element '-201'"),
        ("data.first", "no element 'first'"),
        ("data.0.x", "no field 'x' in 'data.0.x': what lies before it is one value"),
        ("header.stamp.secs", "no field 'secs'.*expected one of"),
    ],
)
def test_a_field_that_is_not_there_is_named(field, complaint):
    with pytest.raises(ConfigError, match=complaint):
        messages.field_to_plain(Image(data=bytes(200)), field)


def test_floats_are_as_short_as_they_are_exact():
    assert yaml_text.dump(messages.message_to_plain(Float32(data=0.1))) == "{data: 0.1}\n"
    for value in (3.4028235e38, float("inf"), -0.1):  # as they are printed
        assert messages.message_to_plain(messages.message_from_plain(Float32, {"data": value})) == {"data": value}


def test_bytes_survive():
    message = messages.message_from_plain(ByteMultiArray, {"data": [1, 255]})
    assert message.data == [b"\x01", b"\xff"]
    assert messages.message_to_plain(message)["data"] == [1, 255]


def test_interface_text_has_its_comments():
    assert "uint32 seq" in messages.show("roboxim_interfaces/srv/Tick")
    assert "#" in messages.show("roboxim_interfaces/srv/Tick")
    with pytest.raises(ConfigError, match="roboxim_interfaces/srv/Tick"):
        messages.show("roboxim_interfaces/srv/Tik")
