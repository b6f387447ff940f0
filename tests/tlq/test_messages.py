"""The messages: what goes in comes out, and nothing else is taken for one."""

import struct
import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from tlq.faults import flipped
from tlq.messages import LARGEST, MessageError, Sensing, Targets, unpack

COUNT = st.integers(0, 2**64 - 1)
FLOAT = st.floats(width=32)  # not finite ones, too: judging them is the supervisor's part


def numbers(*shape):
    return arrays(np.float32, shape, elements=FLOAT)


SENSING = st.builds(
    Sensing, sequence=COUNT, time=COUNT, **{name: numbers(*shape) for name, shape in Sensing.FIELDS.items()}
)
TARGETS = st.builds(
    Targets, COUNT, COUNT, COUNT, COUNT, st.integers(0, 2**32 - 1), numbers(12), numbers(12), numbers(4, 2)
)


def sensing(**changes):
    values = {name: np.linspace(-1, 1, int(np.prod(s))).reshape(s) for name, s in Sensing.FIELDS.items()}
    return Sensing(**{"sequence": 7, "time": 123456789, **values, **changes})


def targets(**changes):
    values = {
        "sequence": 1,
        "time": 2,
        "answers": 3,
        "answers_time": 4,
        "mode": 2,
        "desired": np.arange(12.0),
        "damping": np.arange(12.0) / 8,
        "centres": np.arange(8.0).reshape(4, 2),
    }
    return Targets(**values | changes)


@given(SENSING)
def test_sensor_messages_come_out_as_they_went_in(message):
    found = unpack(message.pack())
    assert isinstance(found, Sensing)
    assert (found.sequence, found.time) == (message.sequence, message.time)
    for name, shape in Sensing.FIELDS.items():
        array = getattr(found, name)
        assert array.shape == shape and array.dtype == np.float32
        np.testing.assert_array_equal(array, getattr(message, name))


def test_a_patch_of_heights_comes_out_as_it_went_in():
    heights = np.random.default_rng(0).normal(size=(4, Sensing.MOST)).astype(np.float32)
    data = sensing(heights=heights).pack()
    assert len(data) <= LARGEST
    found = unpack(data)
    np.testing.assert_array_equal(found.heights, heights)
    np.testing.assert_array_equal(found.command, sensing().command.astype(np.float32))


@given(TARGETS)
def test_targets_come_out_as_they_went_in(message):
    found = unpack(message.pack())
    assert isinstance(found, Targets)
    for name in ("sequence", "time", "answers", "answers_time", "mode"):
        assert getattr(found, name) == getattr(message, name)
    for name in ("desired", "damping", "centres"):
        np.testing.assert_array_equal(getattr(found, name), getattr(message, name))


def test_the_bytes_are_those_of_the_document():
    """Read by hand, at the offsets that docs/deployment.md gives."""
    data = sensing(command=np.array([0.6, -0.8])).pack()
    assert len(data) == 560 < LARGEST
    assert data[:8] == b"TLQM" + bytes([3, 1]) + struct.pack("<H", 532)
    assert struct.unpack_from("<QQ", data, 8) == (7, 123456789)
    assert struct.unpack_from("<4f", data, 24) == pytest.approx(np.linspace(-1, 1, 4), abs=1e-6)
    assert struct.unpack_from("<12f", data, 52) == pytest.approx(np.linspace(-1, 1, 12), abs=1e-6)
    assert struct.unpack_from("<2f", data, 148) == pytest.approx((0.6, -0.8))
    assert struct.unpack_from("<100f", data, 156) == pytest.approx(np.linspace(-1, 1, 100), abs=1e-6)
    assert struct.unpack_from("<I", data, 556)[0] == zlib.crc32(data[:556])
    data = targets().pack()
    assert len(data) == 176 and data[:8] == b"TLQM" + bytes([3, 2]) + struct.pack("<H", 148)
    assert struct.unpack_from("<QQQQI", data, 8) == (1, 2, 3, 4, 2)
    assert struct.unpack_from("<12f", data, 44) == tuple(range(12))
    assert struct.unpack_from("<12f", data, 92) == tuple(i / 8 for i in range(12))
    assert struct.unpack_from("<8f", data, 140) == tuple(range(8))
    assert struct.unpack_from("<I", data, 172)[0] == zlib.crc32(data[:172])


@pytest.mark.parametrize("message", [sensing(), targets()], ids=["sensing", "targets"])
def test_every_single_flipped_bit_is_seen(message):
    data = message.pack()
    for bit in range(8 * len(data)):
        with pytest.raises(MessageError):
            unpack(flipped(data, bit))


@pytest.mark.parametrize("message", [sensing(), targets()], ids=["sensing", "targets"])
def test_every_other_length_is_refused(message):
    data = message.pack()
    for length in range(len(data)):
        with pytest.raises(MessageError):
            unpack(data[:length])
    for extra in (b"\0", data):
        with pytest.raises(MessageError):
            unpack(data + extra)


@given(st.binary(max_size=1024))
def test_foreign_bytes_are_refused(data):
    with pytest.raises(MessageError):
        unpack(data)


@given(st.binary(max_size=600), st.integers(0, 255), st.integers(0, 255), st.integers(0, 65535))
def test_foreign_bytes_under_our_name_and_a_right_checksum_are_refused(body, version, kind, size):
    data = b"TLQM" + struct.pack("<BBHQQ", version, kind, size, 0, 0) + body
    if (version, kind, size, len(body)) in ((2, 1, 532, 532), (2, 1, 2468, 2468), (2, 2, 100, 100)):
        return
    with pytest.raises(MessageError):
        unpack(data + struct.pack("<I", zlib.crc32(data)))


def test_other_versions_are_named():
    data = bytearray(sensing().pack())
    data[4] = 9
    with pytest.raises(MessageError, match="message version 9; this program reads version 3"):
        unpack(bytes(data))


def test_wrong_shapes_are_not_sent():
    with pytest.raises(ValueError, match=r"heights has shape \(25, 4\); expected \(4, 25\)"):
        sensing(heights=np.zeros((25, 4))).pack()
    with pytest.raises(ValueError, match=r"heights has shape \(4, 26\)"):
        sensing(heights=np.zeros((4, 26))).pack()
    with pytest.raises(ValueError, match=r"desired has shape \(11,\)"):
        targets(desired=np.zeros(11)).pack()
