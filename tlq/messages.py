"""The messages between a robot and its policy: fixed little-endian bytes, with a checksum.

    magic "TLQM" | version u8 | kind u8 | bytes of the body u16 | sequence u64 | time u64 ns | body | CRC-32 u32

The checksum (zlib's CRC-32) covers everything before it, so that no flipped bit, header included, goes unseen. A
message that is well formed may still hold nonsense: that is for `tlq.supervisor` to judge. docs/deployment.md lists
the bytes.
"""

import dataclasses
import struct
import zlib
from typing import ClassVar

import numpy as np

import tg

MAGIC = b"TLQM"
VERSION = 3
LARGEST = 4096
"""Bytes to read at most; every message is shorter, and without a patch of heights it stays one Ethernet packet."""

_HEAD = struct.Struct("<4sBBHQQ")
_CHECK = struct.Struct("<I")
_ANSWER = struct.Struct("<QQI")


class MessageError(ValueError):
    """Bytes that are no message of this version; the text says why."""


@dataclasses.dataclass(frozen=True, eq=False)
class Sensing:
    """Robot to policy, once a control period: what is measured, and what the robot is told to do."""

    KIND: ClassVar[int] = 1
    FIELDS: ClassVar[dict[str, tuple[int, ...]]] = {
        "orientation": (4,),
        "angular_velocity": (3,),
        "joint_position": (12,),
        "joint_velocity": (12,),
        "command": (2,),
        "heights": (4, tg.samples.COUNT),
    }
    """Body: these arrays, in this order, each number a float32. Heights may be (4, `MOST`)."""
    MOST: ClassVar[int] = tg.samples.COUNT + tg.footholds.COUNT

    sequence: int
    """Counts the sender's messages."""
    time: int
    """When the sensors were read, ns of the clock that sender and receiver share."""
    orientation: np.ndarray
    """(4,) unit quaternion w, x, y, z, world from trunk."""
    angular_velocity: np.ndarray
    """(3,) rad/s, trunk frame."""
    joint_position: np.ndarray
    """(12,) rad."""
    joint_velocity: np.ndarray
    """(12,) rad/s."""
    command: np.ndarray
    """(2,) unit vector in the heading frame, or 0 to stand."""
    heights: np.ndarray
    """(4, P) m, as `Controller.step` takes them, at points round the last `Targets.centres` (`tg.Core.wanted`); P is
    25, or 146 for a policy with `tg.refine`. A blind policy doesn't look at them."""

    def pack(self) -> bytes:
        """The message's bytes; raises ValueError where an array has another shape."""
        parts = []
        for name, shape in self.FIELDS.items():
            array = np.asarray(getattr(self, name), "<f4")
            patched = name == "heights" and array.shape == (4, self.MOST)
            if array.shape != shape and not patched:
                raise ValueError(f"{name} has shape {array.shape}; expected {shape}")
            parts.append(array.tobytes())
        return _frame(self.KIND, self.sequence, self.time, b"".join(parts))

    @property
    def sensors(self) -> dict[str, np.ndarray]:
        """As `Controller.step` takes them."""
        names = ("orientation", "angular_velocity", "joint_position", "joint_velocity")
        return {name: getattr(self, name) for name in names}


@dataclasses.dataclass(frozen=True, eq=False)
class Targets:
    """Policy to robot, once a control period."""

    KIND: ClassVar[int] = 2

    sequence: int
    """Counts the sender's messages."""
    time: int
    """When it was sent (ns)."""
    answers: int
    """Sequence of the newest sensor message that was accepted."""
    answers_time: int
    """Its time (ns): the difference to the robot's clock is the round trip, computation included."""
    mode: int
    """`tlq.supervisor.Mode`."""
    desired: np.ndarray
    """(12,) rad, for the joints' PD controllers."""
    damping: np.ndarray
    """(12,) N m s/rad, their derivative gains."""
    centres: np.ndarray
    """(4, 2) m, heading frame, from the trunk's centre: round these places the next message's heights are wanted. NaN:
    round the foot."""

    def pack(self) -> bytes:
        """The message's bytes; raises ValueError where an array has another shape."""
        parts = [np.asarray(x, "<f4") for x in (self.desired, self.damping, self.centres)]
        desired, damping, centres = (part.shape for part in parts)
        if (desired, damping, centres) != ((12,), (12,), (4, 2)):
            shapes = f"desired has shape {desired}, damping {damping}, centres {centres}"
            raise ValueError(f"{shapes}; expected (12,), (12,) and (4, 2)")
        answer = _ANSWER.pack(self.answers, self.answers_time, self.mode)
        body = answer + b"".join(part.tobytes() for part in parts)
        return _frame(self.KIND, self.sequence, self.time, body)


_NUMBERS = sum(int(np.prod(shape)) for shape in Sensing.FIELDS.values())
_PATCHED = _NUMBERS + 4 * tg.footholds.COUNT
_BODY = {Sensing.KIND: (4 * _NUMBERS, 4 * _PATCHED), Targets.KIND: (_ANSWER.size + 4 * (12 + 12 + 8),)}


def unpack(data: bytes) -> Sensing | Targets:
    """The message that the bytes hold; raises MessageError if they are none, or one of another version."""
    if len(data) < _HEAD.size + _CHECK.size:
        raise MessageError(f"{len(data)} bytes are too short for a message")
    magic, version, kind, size, sequence, time = _HEAD.unpack_from(data)
    if magic != MAGIC:
        raise MessageError("not a message of this program")
    if version != VERSION:
        raise MessageError(f"message version {version}; this program reads version {VERSION}")
    if size not in _BODY.get(kind, ()) or len(data) != _HEAD.size + size + _CHECK.size:
        raise MessageError(f"kind {kind} with {size} bytes, in {len(data)}, isn't a message")
    if _CHECK.unpack_from(data, len(data) - _CHECK.size)[0] != zlib.crc32(data[: -_CHECK.size]):
        raise MessageError("the checksum is wrong")
    body = data[_HEAD.size : -_CHECK.size]
    if kind == Sensing.KIND:
        return Sensing(sequence, time, **_arrays(body))
    numbers = np.frombuffer(body, "<f4", offset=_ANSWER.size).astype(np.float32)
    answers, answers_time, mode = _ANSWER.unpack_from(body)
    desired, damping, centres = np.split(numbers, [12, 24])
    return Targets(sequence, time, answers, answers_time, mode, desired, damping, centres.reshape(4, 2))


def _frame(kind: int, sequence: int, time: int, body: bytes) -> bytes:
    data = _HEAD.pack(MAGIC, VERSION, kind, len(body), sequence, time) + body
    return data + _CHECK.pack(zlib.crc32(data))


def _arrays(body: bytes) -> dict[str, np.ndarray]:
    values, start, found = np.frombuffer(body, "<f4").astype(np.float32), 0, {}
    for name, shape in Sensing.FIELDS.items():
        if name == "heights":  # the last, and all that is left
            shape = (4, (len(values) - start) // 4)
        size = int(np.prod(shape))
        found[name] = values[start : start + size].reshape(shape)
        start += size
    return found
