"""Which primitives matter where: the table from coarse map cells to primitives."""

import numpy as np

from terrains.raster import expand
from terrains.registry import Terrain


def _spans(rows: np.ndarray, cell: float, n: int, margin: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of flat indices (cell, primitive), where the footprint comes within `margin` of the cell."""
    half = n * cell / 2
    reach = rows[:, 2:4] + rows[:, 4:5] + margin
    low = np.clip(np.floor((rows[:, :2] - reach + half) / cell - 1e-6).astype(int), 0, n)
    high = np.clip(np.floor((rows[:, :2] + reach + half) / cell + 1e-6).astype(int) + 1, 0, n)
    wide, deep = np.maximum(high - low, 0).T
    which, number = expand(wide * deep)
    i, j = low[which, 0] + number // deep[which], low[which, 1] + number % deep[which]
    near = rows[which]
    ox = np.maximum(abs((i + 0.5) * cell - half - near[:, 0]) - near[:, 2] - cell / 2, 0.0)
    oy = np.maximum(abs((j + 0.5) * cell - half - near[:, 1]) - near[:, 3] - cell / 2, 0.0)
    keep = ox * ox + oy * oy <= (near[:, 4] + margin + 1e-6) ** 2
    return (i * n + j)[keep], which[keep]


def _covers(rows: np.ndarray, cells: np.ndarray, cell: float, n: int, margin: float) -> np.ndarray:
    """Whether each primitive's footprint holds all of its cell widened by `margin`."""
    half, reach = n * cell / 2, cell / 2 + margin
    dx = abs((cells // n + 0.5) * cell - half - rows[:, 0]) + reach - rows[:, 2]
    dy = abs((cells % n + 0.5) * cell - half - rows[:, 1]) + reach - rows[:, 3]
    return np.hypot(np.maximum(dx, 0), np.maximum(dy, 0)) + np.minimum(np.maximum(dx, dy), 0) <= rows[:, 4]


def candidate_table(terrain: Terrain, cell: float, margin: float) -> np.ndarray:
    """Primitives that a point over each coarse cell may be nearer to than `margin`.

    A primitive that lies under one which covers the whole widened cell is left out.

    Args:
      cell: side of a coarse cell (m), about; the map is divided evenly.
      margin: horizontal distance (m) up to which a primitive counts.

    Returns:
      (n, n, M) int64 rows of `terrain.primitives`, -1 where there are fewer than M; M the most any cell has.
    """
    n = round(2 * terrain.half_extent / cell)
    cell = 2 * terrain.half_extent / n
    rows = terrain.primitives.astype(np.float64)
    cells, which = _spans(rows, cell, n, margin)
    top = rows[which, 5]
    cover = _covers(rows[which], cells, cell, n, margin)
    covered = np.full(n * n, terrain.floor)
    np.maximum.at(covered, cells[cover], top[cover])
    keep = (top > covered[cells]) | (cover & (top == covered[cells]))
    cells, which, cover = cells[keep], which[keep], cover[keep]
    # One of several that cover a cell at the same height is enough.
    order = np.lexsort((which, ~cover, cells))
    cells, which, cover = cells[order], which[order], cover[order]
    again = np.zeros(len(cells), bool)
    again[1:] = (cells[1:] == cells[:-1]) & cover[1:] & cover[:-1]
    cells, which = cells[~again], which[~again]
    count = np.bincount(cells, minlength=n * n)
    table = np.full((n * n, max(1, count.max(initial=0))), -1)
    table[cells, expand(count)[1]] = which
    return table.reshape(n, n, -1)
