"""A patch of heights round the end of each foot's step, and how it shifts the place to which the foot is led.

The policy's 25 points a foot are 3 to 6 cm apart, the tops of thin poles 10 to 15 cm wide: of several places to step on
they tell which, but not to the centimetre. The patch tells that: near the place that the policy chose, the foot goes
where it meets the least gap, landing with some error. Letters: L legs, N = SIDE^2 points.
"""

from typing import Any

from tg import path

Array = Any

SIDE, CELL = 11, 0.03
"""Points along one axis, and their spacing (m): 15 cm to each side."""
COUNT = SIDE * SIDE
"""N."""
DEEP = 0.25
"""So far (m) below the patch's highest point is a gap."""
ERROR = 0.035
"""Standard deviation (m) of a landing foot from its place, by which the gaps near a place count."""
GAP, FARTHER, FAR = 3.0, 1.0, 0.17
"""What a place costs that is nothing but gap; a metre from the end of the trajectory generator's step; and at which
distance (m) from there, with the square of it, a place costs 1. As in `envs.guide`, but
not taken from there: what teaches the next policy must not move the feet of those that are shipped."""
SHARPNESS = 0.1
"""Difference of cost by which one place outweighs another e times: where the foot goes is a weighted mean of the places
in reach, so that it doesn't jump from one to another."""
CHOICES = 5
"""Places in reach along one axis."""
CORNERS = 1.3
"""Places count up to this sum of the squares of their two coordinates in units of the reach: a square's without its
corners."""
FROM, ALL = 0.3, 1.5
"""Phases (rad) of swing from which on a foot is shifted, and from which on by all of it."""


_AXIS = [(i - (SIDE - 1) / 2) * CELL for i in range(SIDE)]
"""Coordinates (m) of the points along one axis, ascending."""
_CHOICES = [2.0 * i / (CHOICES - 1) - 1.0 for i in range(CHOICES)]
"""Coordinates of the places in reach along one axis, in units of the reach."""
_WITHIN = [[1.0 * (x * x + y * y <= CORNERS) for y in _CHOICES] for x in _CHOICES]
"""Which of these places count."""


def offsets() -> list[list[float]]:
    """The N points (x, y) m of the patch from the end of the step, heading frame; y runs fastest."""
    return [[x, y] for x in _AXIS for y in _AXIS]


def shift(led: Array, patch: Array, reach: float) -> Array:
    """By how much (L, 2) m feet had better be led elsewhere, at most `reach` (m) along each axis.

    Args:
      led: (L, 2) m, where they are led, from the ends of the trajectory generator's steps, heading frame.
      patch: (L, N) m, heights at `offsets`.
      reach: m.
    """
    xp, kind = led.__array_namespace__(), led.dtype
    low = xp.reshape(xp.max(patch, axis=-1, keepdims=True) - patch > DEEP, (-1, SIDE, SIDE))
    gap = xp.astype(low, kind)
    choices = xp.asarray(_CHOICES, dtype=kind) * reach
    axis = xp.asarray(_AXIS, dtype=kind)
    places = led[:, :, None] + choices
    # A normal distribution is one along x times one along y; relative to the nearest point, which keeps it above 0.
    squares = xp.square(places[..., None] - axis)
    weights = xp.exp((xp.min(squares, axis=-1, keepdims=True) - squares) / (2.0 * ERROR**2))
    weights = weights / xp.sum(weights, axis=-1, keepdims=True)
    met = weights[:, 0] @ gap @ xp.matrix_transpose(weights[:, 1])
    x, y = places[:, 0, :, None], places[:, 1, None, :]
    square = xp.square(x) + xp.square(y)
    cost = GAP * met + FARTHER * xp.sqrt(square + 1e-6) + square / FAR**2
    cost = cost - xp.min(cost, axis=(1, 2), keepdims=True)
    weight = xp.asarray(_WITHIN, dtype=kind) * xp.exp(-cost / SHARPNESS)
    weight = weight / xp.sum(weight, axis=(1, 2), keepdims=True)
    moved = xp.stack([xp.sum(weight, axis=2) @ choices, xp.sum(weight, axis=1) @ choices], axis=-1)
    return xp.where(xp.any(low, axis=(1, 2))[:, None], moved, 0.0 * moved)


def share(phases: Array) -> Array:
    """Which part (L,) of the shift counts at phases (L,) rad."""
    xp = phases.__array_namespace__()
    return path.smoothstep(xp.clip((phases - FROM) / (ALL - FROM), 0.0, 1.0))
