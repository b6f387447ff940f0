"""A bad line between robot and policy, to see what becomes of it: messages lost, late, torn or full of nonsense."""

import dataclasses
from typing import Any

import numpy as np

from tlq.messages import Sensing

KINDS = ("drop", "delay", "nan", "flip", "outage")


class BadLine:
    """Takes sensor messages and gives back the bytes that arrive. Its clock is the sender's."""

    def __init__(self, share: float, seed: int = 0, *, delay: float = 0.1, outage: tuple[int, int] = (5, 40)):
        """A share of the messages meets a fault, each kind equally often, except that outages are ten times as rare.

        Args:
          share: in [0, 1].
          seed: of the choice.
          delay: of the messages that are delayed (s).
          outage: how many messages in a row an outage swallows, fewest and most.
        """
        self.share, self.delay, self.outage = share, delay, outage
        self.random = np.random.default_rng(seed)
        self.met = dict.fromkeys(KINDS, 0)
        """How often each fault occurred."""
        self._chances = np.array([1.0, 1.0, 1.0, 1.0, 0.1]) / 4.1
        self._held: list[tuple[float, bytes]] = []
        self._swallow = 0

    def send(self, message: Sensing, now: float) -> list[bytes]:
        """What arrives at `now` (s) when a message is sent: delayed ones that are due, and perhaps this one."""
        due = [data for time, data in self._held if time <= now]
        self._held = [held for held in self._held if held[0] > now]
        return due + self._through(message, now)

    def _through(self, message: Sensing, now: float) -> list[bytes]:
        if self._swallow:
            self._swallow -= 1
            return []
        if self.random.random() >= self.share:
            return [message.pack()]
        kind = str(self.random.choice(KINDS, p=self._chances))
        self.met[kind] += 1
        if kind == "nan":
            return [spoilt(message, self.random).pack()]
        if kind == "flip":
            return [flipped(message.pack(), int(self.random.integers(8 * len(message.pack()))))]
        if kind == "delay":
            self._held.append((now + self.delay, message.pack()))
        elif kind == "outage":
            self._swallow = int(self.random.integers(self.outage[0], self.outage[1] + 1))
        return []


def spoilt(message: Sensing, random: np.random.Generator) -> Sensing:
    """The message with one array's numbers, or some of them, not finite or out of all bounds."""
    name = str(random.choice(list(Sensing.FIELDS)))
    array = np.array(getattr(message, name))
    hit = random.random(array.shape) < random.uniform(0.1, 1.0)
    hit.flat[random.integers(array.size)] = True
    array[hit] = random.choice([np.nan, np.inf, -np.inf, 1e30, -1e6])
    changes: dict[str, Any] = {name: array}
    return dataclasses.replace(message, **changes)


def flipped(data: bytes, bit: int) -> bytes:
    """The bytes with one bit flipped."""
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)
