"""Addresses, arrays and pictures that cannot be right are refused before they cost anything."""

import pytest
from one_request import REQUEST

from roboxim_core.errors import ConfigError, PolicyError
from roboxim_policies.wires import arrays, find_wire, groot, openpi, openvla, packing, vla_eval
from roboxim_policies.wires.errors import Deadline


@pytest.mark.parametrize(
    ("url", "words"),
    [
        ("grpc://localhost:1", "LeRobot.*pickles"),
        ("http://localhost:1", "scheme 'http' is not of this wire"),
        ("ws://", "names no host"),
        ("ws://user:secret@localhost:1", "would be recorded"),
        ("ws://localhost:notaport", "is not an address"),
    ],
)
def test_wrong_url_is_refused(url, words):
    with pytest.raises(ConfigError, match=words):
        find_wire("openpi")(url)


def test_url_gets_the_usual_scheme_and_port():
    assert find_wire("openpi")("host").url == "ws://host:8000"
    assert find_wire("groot")("host").url == "tcp://host:5555"


@pytest.mark.parametrize(
    ("dtype", "shape", "size"),
    [
        ("<f4", [2**40], 8),  # claims more than there is
        ("<f4", [2**31, 2**31, 2**31], 0),
        ("<f4", [-1], 4),
        ("<f4", [1.0], 4),
        ("<f4", [True], 4),
        ("<f4", [1] * 9, 4),
        ("|O", [1], 8),  # a pickle
        ("|V8", [1], 8),
        ("<c8", [1], 8),
        ("(1000000000,)<f4", [1], 4),
        ("<M8[ns]", [1], 8),
        ({"descr": 1}, [1], 8),
        (["<f4"], [1], 8),
    ],
)
def test_array_that_does_not_fit_its_bytes_is_refused(dtype, shape, size):
    for decode in (openpi.decode_map, vla_eval.decode_map):
        names = ("__ndarray__", "data", "dtype", "shape")
        keys = [name.encode() for name in names] if decode is openpi.decode_map else names
        with pytest.raises(PolicyError, match="cannot be read"):
            decode(dict(zip(keys, (True, bytes(size), dtype, shape), strict=True)))
    with pytest.raises(PolicyError, match="cannot be read"):
        groot.N17._decode_map({b"nd": True, b"type": dtype, b"kind": b"", b"shape": shape, b"data": bytes(size)})
    header = f"{{'descr': {dtype!r}, 'fortran_order': False, 'shape': {tuple(shape)!r}}}".encode()
    npy = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + bytes(size)
    with pytest.raises(PolicyError, match="cannot be read"):
        arrays.array_from_npy(npy)


def test_lists_that_are_larger_than_the_bound_are_refused_before_they_are_made():
    with pytest.raises(PolicyError, match="not valid MessagePack"):
        packing.unpack(b"\xdd\x7f\xff\xff\xff" + bytes(200), lambda part: part)  # claims 2^31 items
    with pytest.raises(PolicyError, match="not valid MessagePack"):
        packing.unpack(b"\x91" * 100_000, lambda part: part)  # nested
    with pytest.raises(PolicyError, match="extension"):
        packing.unpack(b"\xc7\x04\x05abcd", lambda part: part)
    with pytest.raises(PolicyError, match="not valid JSON"):
        openvla.decode("[" * 100_000)


def test_picture_that_is_larger_than_it_says_is_not_decompressed():
    import io

    from PIL import Image

    file = io.BytesIO()
    Image.new("RGB", (3000, 3000)).save(file, "PNG")
    with pytest.raises(PolicyError, match="says shape"):
        vla_eval.decode_map({"__image__": True, "format": "png", "data": file.getvalue(), "shape": [8, 8, 3]})
    assert vla_eval.decode_map(vla_eval.encode_array_or_png(REQUEST["observation/image"])).shape == (8, 8, 3)


def test_deadline_that_has_passed_says_so():
    with pytest.raises(PolicyError, match="the reply did not come within 1e-09 s"):
        Deadline(1e-9).left("the reply")
