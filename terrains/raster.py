"""A terrain seen as a heightfield, and its true height at a point."""

import numpy as np

from terrains.geometry import UNIT, footprint_distance, to_units
from terrains.registry import Terrain


def expand(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For row n with counts[n] entries: each entry's row and its number 0..counts[n]-1 within the row."""
    row = np.repeat(np.arange(len(counts)), counts)
    return row, np.arange(len(row)) - np.repeat(np.cumsum(counts) - counts, counts)


def rasterise(terrain: Terrain, cell: float = 0.02, size: int | None = None) -> np.ndarray:
    """Heights of the terrain at cell centres.

    Args:
      cell: side of a cell (m), a multiple of 0.5 mm.
      size: cells along each axis (R = C); what covers the map if None. The map's centre is the origin.

    Returns:
      (R, C) int16, mm. Element [i, j] is at x = (i + 0.5) cell - size cell / 2, and y likewise from j.
      Edges count as inside; where primitives overlap the higher one is seen.
    """
    size = round(2 * terrain.half_extent / cell) if size is None else size
    unit = round(cell / UNIT)
    if abs(unit * UNIT - cell) > 1e-9 or unit % 2:
        raise ValueError(f"cell = {cell} m; choose a multiple of 0.0005 m")
    rows = to_units(terrain.primitives).astype(np.int64)
    rows = rows[np.argsort(rows[:, 5], kind="stable")]  # the higher ones are painted last
    rows = rows[rows[:, 5] * UNIT > terrain.floor]
    heights = np.full((size, size), round(terrain.floor * 1000), np.int16)
    first = unit // 2 - size * unit // 2  # coordinate of the centre of cell 0

    reach = rows[:, 2:4] + rows[:, 4:5]
    low = np.clip(-((first - rows[:, :2] + reach) // unit), 0, size)
    high = np.clip((rows[:, :2] + reach - first) // unit + 1, 0, size)
    tops = np.rint(rows[:, 5] * (UNIT * 1000)).astype(np.int16)
    box = rows[:, 4] == 0
    edges = np.concatenate([low, high], axis=1)[box].tolist()
    for (i0, j0, i1, j1), top in zip(edges, tops[box].tolist(), strict=True):
        heights[i0:i1, j0:j1] = top

    # Round ones: a span of cells along y for each i.
    low, high, tops, rows = low[~box], high[~box], tops[~box], rows[~box]
    which, number = expand(np.maximum(high - low, 0)[:, 0])
    i = low[which, 0] + number
    cx, cy, hx, hy, radius, _ = rows[which].T
    ox = np.maximum(abs(first + i * unit - cx) - hx, 0)
    reach = np.floor(np.sqrt(radius**2 - ox**2)).astype(np.int64) + hy
    j0 = np.clip(-((first - cy + reach) // unit), 0, size)
    j1 = np.clip((cy + reach - first) // unit + 1, 0, size)
    span, number = expand(np.maximum(j1 - j0, 0))
    cells, top = (i * size + j0)[span] + number, tops[which][span]
    flat = heights.reshape(-1)
    flat[cells] = np.maximum(flat[cells], top)  # of several values for a cell the last, the highest, stays
    return heights


def exact_height(terrain: Terrain, xy: np.ndarray) -> np.ndarray:
    """True height (m), float64 (...), of the terrain at points xy (..., 2) m, from the primitives."""
    xy = np.asarray(xy, np.float64)
    buckets = terrain.buckets
    n = len(buckets)
    index = np.clip(np.floor((xy / terrain.half_extent + 1.0) * (n / 2)).astype(int), 0, n - 1)
    candidates = buckets[index[..., 0], index[..., 1]]
    if not len(terrain.primitives):
        return np.full(xy.shape[:-1], terrain.floor)
    rows = to_units(terrain.primitives)[candidates] * UNIT
    inside = footprint_distance(rows, xy[..., 0, None], xy[..., 1, None]) <= 1e-9
    tops = np.where(inside & (candidates >= 0), rows[..., 5], terrain.floor)
    return tops.max(axis=-1, initial=terrain.floor)
