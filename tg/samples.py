"""Height samples around each foot (paper, section IV-A)."""

import math
from typing import Any

Array = Any

RINGS = ((1, 0.0), (6, 0.03), (8, 0.06), (10, 0.10))
"""Points and radius (m) of each circle."""

COUNT = sum(count for count, _ in RINGS)
"""P = 25."""


def within(radius: float) -> slice:
    """The points on circles up to a radius (m): the first ones, as the circles grow."""
    return slice(0, sum(count for count, ring in RINGS if ring <= radius + 1e-6))


def circles() -> list[slice]:
    """The points of each circle."""
    ends = [sum(count for count, _ in RINGS[:i]) for i in range(len(RINGS) + 1)]
    return [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]


def ring_offsets() -> list[tuple[float, float]]:
    """The P = 25 points (x, y) m around a foot, in the heading frame.

    Each circle starts in front of the foot and goes counter-clockwise, so that the pattern is its own mirror image.
    """
    return [
        (radius * math.cos(2 * math.pi * i / count), radius * math.sin(2 * math.pi * i / count))
        for count, radius in RINGS
        for i in range(count)
    ]


def mirrored_points() -> list[int]:
    """Index of each point's mirror image in y."""
    order, start = [], 0
    for count, _ in RINGS:
        order += [start + (-i) % count for i in range(count)]
        start += count
    return order
