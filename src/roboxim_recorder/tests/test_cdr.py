"""The bytes of a message are a function of its content: padding is 0 and nothing follows it."""

from __future__ import annotations

import importlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rclpy.serialization import serialize_message
from rosbags.serde import SerdeError
from rosidl_parser.definition import AbstractSequence, AbstractString, Array, BasicType, NamespacedType

from roboxim_core.errors import InvalidRequestError
from roboxim_recorder import topics
from roboxim_recorder.cdr import MessageLayout, message_layout
from roboxim_ros.messages.schemas import MessageSchema, message_schema, typestore

KINDS = sorted({*topics.ALWAYS.values(), *topics.OWN.values(), "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"})


def message_class(name):
    package, _, kind = name.partition("/msg/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def filled(kind, draw):
    """Return a message with drawn text, numbers and lengths of lists."""
    message = kind()
    for field, slot in zip(kind.get_fields_and_field_types(), kind.SLOT_TYPES, strict=True):
        setattr(message, field, value(slot, draw))
    return message


def value(slot, draw):
    if isinstance(slot, BasicType):
        return number(slot, draw)
    if isinstance(slot, AbstractString):
        return "x" * draw(st.integers(0, 9))
    if isinstance(slot, NamespacedType):
        return filled(message_class(f"{slot.namespaces[0]}/msg/{slot.name}"), draw)
    size = slot.size if isinstance(slot, Array) else draw(st.integers(0, 3))
    assert isinstance(slot, Array | AbstractSequence)
    return [value(slot.value_type, draw) for _ in range(size)]


def number(slot, draw):
    if slot.typename == "boolean":
        return draw(st.booleans())
    if slot.typename in ("float", "double"):
        return float(np.float32(draw(st.integers(-9, 9))))
    return draw(st.integers(1, 100))


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=25, deadline=None)
@given(data=st.data())
def test_clean_bytes_are_those_of_a_serialiser_that_pads_with_zeros(kind, data):
    message = filled(message_class(kind), data.draw)
    layout, store = message_layout(message_schema(kind)), typestore((message_schema(kind),))
    clean = layout.clean(serialize_message(message))
    again = layout.clean(serialize_message(message) + b"garbage")
    definition = store.get_msgdef(kind)
    decoded, _ = definition.deserialize_cdr_le(memoryview(clean.data)[4:], 0, definition.cls, store)
    assert bytes(clean.data) == bytes(again.data) == bytes(store.serialize_cdr(decoded, kind, little_endian=True))
    for field in ("seq", "stamp_ns", "episode_id"):
        if field in clean:
            read = {"seq": clean.uint32, "stamp_ns": clean.int64, "episode_id": clean.text}[field]
            assert read(field) == getattr(message, field)


def test_padding_is_cleared_whatever_is_in_it():
    layout = message_layout(message_schema("roboxim_interfaces/msg/EpisodeStep"))
    message = message_class("roboxim_interfaces/msg/EpisodeStep")(episode_id="abc", phase="act", seq=7)
    clean = bytes(layout.clean(serialize_message(message)).data)
    dirty = 0
    for at in range(4, len(clean)):
        if clean[at] == 0:
            changed = bytearray(clean)
            changed[at] = 0xAA
            try:
                dirty += bytes(layout.clean(bytes(changed)).data) == clean
            except SerdeError:  # the length of a string or list
                continue
    assert dirty >= 5, "the message has padding"


@pytest.mark.parametrize("kind", KINDS)
def test_bytes_that_are_no_such_message_are_refused(kind):
    layout = message_layout(message_schema(kind))
    whole = bytes(layout.clean(serialize_message(message_class(kind)())).data)
    for cut in range(4, len(whole)):
        with pytest.raises(SerdeError, match=kind):
            layout.clean(whole[:cut])
    with pytest.raises(SerdeError, match="little-endian"):
        layout.clean(b"\x00\x00" + whole[2:])


def test_a_huge_length_is_refused_at_once():
    layout = message_layout(message_schema("tf2_msgs/msg/TFMessage"))
    with pytest.raises(SerdeError, match="4294967295 elements"):
        layout.clean(b"\x00\x01\x00\x00" + b"\xff" * 4)


def test_a_type_that_bags_cannot_hold_is_named():
    schema = MessageSchema(name="mine/msg/Wide", text="uint8 a\nwstring title\n")
    with pytest.raises(InvalidRequestError, match=r"mine/msg/Wide.*wstring"):
        MessageLayout(typestore((schema,)), schema.name)
