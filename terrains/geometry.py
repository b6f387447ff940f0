"""A terrain's primitives: vertical prisms, and the signed distance to them in closed form.

A primitive is six numbers [cx, cy, hx, hy, radius, top] in metres, world frame: the ground |x - cx| <= hx,
|y - cy| <= hy widened by a disc of `radius`, solid from below up to z = top. `radius = 0` is a box,
`hx = hy = 0` a cylinder. All numbers are multiples of 0.5 mm, so that int16 in units of 0.25 mm is exact.
"""

import numpy as np

UNIT = 0.00025
"""Metres of one unit in which a bank stores primitives."""
STEP = 0.0005
"""Lengths of primitives are multiples of this (m)."""


def to_steps(length: float) -> int:
    """A length (m) as a whole number of 0.5 mm steps."""
    return round(length / STEP)


def to_height(length: float) -> int:
    """A height (m) rounded to whole millimetres, in 0.5 mm steps: what an int16 heightfield shows exactly."""
    return 2 * round(length * 1000)


def draw_steps(rng: np.random.Generator, low, high, size) -> np.ndarray:
    """Whole numbers uniform in low..high, both included, of the given size; float64.

    Only `Generator.random` is used anywhere in this package, so that a seed means the same terrain for ever.
    """
    return low + np.floor(rng.random(size) * (np.asarray(high) - low + 1.0))


def boxes(x0, x1, y0, y1, top) -> np.ndarray:
    """(N, 6) float32 box primitives from edges and tops in steps of 0.5 mm, each () or (N,)."""
    x0, x1, y0, y1, top = np.broadcast_arrays(*np.atleast_1d(x0, x1, y0, y1, top))
    zero = np.zeros(x0.shape)
    rows = np.stack([(x0 + x1) / 2, (y0 + y1) / 2, (x1 - x0) / 2, (y1 - y0) / 2, zero, top], axis=-1)
    return (rows * STEP).astype(np.float32)


def cylinders(x, y, radius, top) -> np.ndarray:
    """(N, 6) float32 cylinder primitives from numbers in steps of 0.5 mm, each () or (N,)."""
    x, y, radius, top = np.broadcast_arrays(*np.atleast_1d(x, y, radius, top))
    zero = np.zeros(x.shape)
    return (np.stack([x, y, zero, zero, radius, top], axis=-1) * STEP).astype(np.float32)


def to_units(primitives: np.ndarray) -> np.ndarray:
    """Primitives in metres, (..., 6), as int16 in units of 0.25 mm; refuses what would not be exact."""
    scaled = np.asarray(primitives, np.float64) / UNIT
    units = np.rint(scaled)
    if np.abs(units).max(initial=0) > 32767 or np.abs(scaled - units).max(initial=0) > 0.01:
        raise ValueError("primitives must be multiples of 0.25 mm and lie within 8.19 m of the origin")
    return units.astype(np.int16)


def footprint_distance(primitives, x, y):
    """Signed horizontal distance (m) from points to footprints.

    Args:
      primitives: (..., 6) m.
      x, y: (...) m, broadcast against the primitives' leading axes.

    Returns:
      (...) m, negative inside. NumPy or JAX, whatever comes in.
    """
    qx = abs(x - primitives[..., 0]) - primitives[..., 2]
    qy = abs(y - primitives[..., 1]) - primitives[..., 3]
    ox, oy = qx * (qx > 0), qy * (qy > 0)
    nearest = qx * (qx > qy) + qy * (qx <= qy)
    return (ox * ox + oy * oy) ** 0.5 + nearest * (nearest < 0) - primitives[..., 4]


def signed_distance(primitives, points):
    """Signed distance (m) from points (..., 3) to primitives (..., 6), negative inside; NumPy or JAX."""
    d = footprint_distance(primitives, points[..., 0], points[..., 1])
    z = points[..., 2] - primitives[..., 5]
    outside = ((d * (d > 0)) ** 2 + (z * (z > 0)) ** 2) ** 0.5
    nearest = d * (d > z) + z * (d <= z)
    return outside + nearest * (nearest < 0)
