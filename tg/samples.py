"""Height samples around each foot (paper, section IV-A)."""

import math
from typing import Any

Array = Any

COUNTS = (1, 6, 8, 10)
"""Points of each circle."""
COUNT = sum(COUNTS)
"""P = 25."""
INNER, OUTER = 0.03, 0.10
"""Radii (m) of the second circle, and of the last one where nothing else is said (`TGConfig.sample_radius`)."""


def radii(outer: float = OUTER) -> tuple[float, ...]:
    """Radius (m) of each circle: 0, 3, 6 and 10 cm; with another outer one the third lies as far between."""
    return (0.0, INNER, INNER + 3.0 / 7.0 * (outer - INNER), outer)


def within(radius: float, outer: float = OUTER) -> slice:
    """The points on circles up to a radius (m): the first ones, as the circles grow."""
    rings = zip(COUNTS, radii(outer), strict=True)
    return slice(0, sum(count for count, ring in rings if ring <= radius + 1e-6))


def circles() -> list[slice]:
    """The points of each circle."""
    ends = [sum(COUNTS[:i]) for i in range(len(COUNTS) + 1)]
    return [slice(a, b) for a, b in zip(ends[:-1], ends[1:], strict=True)]


def ring_offsets(outer: float = OUTER) -> list[tuple[float, float]]:
    """The P = 25 points (x, y) m around a foot, in the heading frame.

    Each circle starts in front of the foot and goes counter-clockwise, so that the pattern is its own mirror image.
    """
    return [
        (radius * math.cos(2 * math.pi * i / count), radius * math.sin(2 * math.pi * i / count))
        for count, radius in zip(COUNTS, radii(outer), strict=True)
        for i in range(count)
    ]


def mirrored_points() -> list[int]:
    """Index of each point's mirror image in y."""
    order, start = [], 0
    for count in COUNTS:
        order += [start + (-i) % count for i in range(count)]
        start += count
    return order
