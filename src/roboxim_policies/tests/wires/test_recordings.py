"""What genuine clients and servers said decodes to what their index says, and our encoders say the same.

The recordings in ``tests/data/wires`` are bytes that genuine programs exchanged, see the README there.
"""

import hashlib
import json
import pickle
from pathlib import Path

import numpy as np
import pytest

from roboxim_policies.wires import groot, openpi, openvla, vla_eval

DATA = Path(__file__).parents[4] / "tests" / "data" / "wires"
CODECS = {
    "openpi-droid": (openpi.encode, openpi.decode),
    "openpi-libero": (openpi.encode, openpi.decode),
    "roboarena": (openpi.encode, openpi.decode),
    "starvla": (openpi.encode, openpi.decode),
    "vla-eval": (vla_eval.encode, vla_eval.decode),
    "openvla": (openvla.encode, openvla.decode),
    "openvla-oft": (openvla.encode, openvla.decode),
    "groot-n15": (groot.N15.encode, groot.N15.decode),
    "groot-n16": (groot.N16.encode, groot.N16.decode),
    "groot-n17": (groot.N17.encode, groot.N17.decode),
}
MESSAGES = [
    pytest.param(index.parent.name, message, id=f"{index.parent.name}/{message['file']}")
    for index in sorted(DATA.glob("*/index.json"))
    for message in json.loads(index.read_text())["messages"]
]


@pytest.fixture(autouse=True)
def _without_pickle(monkeypatch):
    def refuse(*_, **__):
        raise AssertionError("a wire unpickles")

    for name in ("load", "loads", "Unpickler", "_Unpickler", "_loads", "_load"):
        monkeypatch.setattr(pickle, name, refuse)


def as_index(value):
    """Return a decoded value as ``index.json`` describes it."""
    if isinstance(value, np.ndarray | np.generic):
        array = np.asarray(value)
        described = {"__array__": True, "dtype": array.dtype.str, "shape": list(array.shape)}
        if array.size > 200:
            return described | {"sha256": hashlib.sha256(np.ascontiguousarray(array).tobytes()).hexdigest()}
        return described | {"values": array.tolist()}
    if isinstance(value, dict):
        return {key: as_index(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_index(item) for item in value]
    return value


def plain(expected):
    """Return a description without the classes of the genuine program, which RoboXim does not have."""
    if isinstance(expected, dict):
        if "__object__" in expected:
            return plain(expected["fields"])
        if "__enum__" in expected:
            return expected["__enum__"].rpartition(".")[2]
        return {key: plain(item) for key, item in expected.items()}
    if isinstance(expected, list):
        return [plain(item) for item in expected]
    return expected


def equal(found, expected):
    if (
        isinstance(expected, dict)
        and expected.get("__array__")
        and "sha256" not in expected
        and isinstance(found, dict)
    ):
        return found == expected
    if isinstance(expected, dict):
        return (
            isinstance(found, dict) and set(found) == set(expected) and all(equal(found[k], expected[k]) for k in found)
        )
    if isinstance(expected, list):
        return isinstance(found, list) and len(found) == len(expected) and all(map(equal, found, expected))
    return found == expected


def meaning(wire, message):
    """Return what the index says of a message."""
    expected = plain(message.get("decoded"))
    if isinstance(expected, dict) and set(expected) == {"reply"}:
        return expected["reply"]
    if isinstance(expected, dict) and set(expected) == {"string", "again decoded"}:
        return expected["again decoded"]
    return expected


@pytest.mark.parametrize(("wire", "message"), MESSAGES)
def test_recording_decodes_as_its_index_says_and_our_encoder_agrees(wire, message):
    data = (DATA / wire / message["file"]).read_bytes()
    assert hashlib.sha256(data).hexdigest() == message["sha256"]
    expected = meaning(wire, message)
    if message["text"] or expected is None and data != b"\xc0":
        return  # a text frame or a body that is no message of the protocol: see the tests of the wires
    encode, decode = CODECS[wire]
    value = decode(data)
    if isinstance(expected, dict) and isinstance(expected.get("encoded"), str):
        expected = {"encoded": as_index(openvla.decode(expected["encoded"]))}
    assert equal(as_index(value), expected)
    if "modality" not in message["file"]:  # a configuration is only ever received
        assert equal(as_index(decode(encode(value))), expected)


def test_every_wire_has_recordings():
    assert {message.values[0] for message in MESSAGES} == set(CODECS)
    assert len(MESSAGES) > 90


@pytest.mark.parametrize(
    "wire", [name for name in CODECS if name.startswith(("openpi", "groot", "roboarena", "starvla"))]
)
def test_our_encoder_writes_the_bytes_of_the_genuine_client(wire):
    encode, decode = CODECS[wire]
    for message in json.loads((DATA / wire / "index.json").read_text())["messages"]:
        data = (DATA / wire / message["file"]).read_bytes()
        if message["from"] == "client":
            assert encode(decode(data)) == data, message["file"]


@pytest.mark.parametrize(("folder", "serialiser"), [("n15", groot.N15), ("n16", groot.N16), ("n17", groot.N17)])
def test_serialiser_of_groot_is_detected(folder, serialiser):
    assert groot.serialiser_of((DATA / f"groot-{folder}" / "03_response_modality.bin").read_bytes()) is serialiser


@pytest.mark.parametrize(
    ("wire", "dialect"),
    [("openpi-droid", "openpi"), ("openpi-libero", "openpi"), ("roboarena", "roboarena"), ("starvla", "starvla")],
)
def test_dialect_of_openpi_is_told_by_the_metadata(wire, dialect):
    assert openpi.dialect_of(openpi.decode((DATA / wire / "00_metadata.bin").read_bytes())) == dialect
