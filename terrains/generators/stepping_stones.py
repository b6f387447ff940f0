"""Stepping stones: rows of rectangular stones over a pit."""

import numpy as np

from terrains.config import TerrainConfig, at
from terrains.geometry import STEP, boxes, draw_steps, to_height, to_steps
from terrains.registry import Layout, register


def sequence(
    rng, start, stop: int, gap: tuple[int, int], size: tuple[int, int], stone_first: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Sequences gap, stone, gap, stone, ... from `start` until a stone begins beyond `stop`, in steps.

    Args:
      start: (R,) where each sequence begins.
      gap, size: smallest and largest.
      stone_first: begin with a stone, not a gap.

    Returns:
      begin, end: (R, n) of the stones, in order; the last ones lie beyond `stop`.
    """
    start = np.asarray(start, float)
    count = int((stop - start.min()) // (gap[0] + size[0])) + 2
    gaps = draw_steps(rng, gap[0], gap[1], (len(start), count))
    if stone_first:
        gaps[:, 0] = 0
    sizes = draw_steps(rng, size[0], size[1], (len(start), count))
    end = start[:, None] + np.cumsum(gaps + sizes, axis=1)
    begin = end - sizes
    # The last gap before the map's edge is a smallest one: no pit that only the edge makes impassable.
    beyond = begin > stop
    first = np.argmax(beyond, axis=1)[:, None]
    shift = beyond * (np.take_along_axis(gaps, first, axis=1) - gap[0])
    return begin - shift, end - shift


def _beside_platform(rng, length: int, gap: tuple[int, int], size: tuple[int, int]):
    """Rows (begin, end) that fill the platform's length exactly, with one gap width and one row width."""
    options = []
    for rows in range(1, length // size[0] + 1):
        low = max(gap[0], -((rows * size[1] - length) // max(rows - 1, 1)))
        high = min(gap[1], (length - rows * size[0]) // max(rows - 1, 1))
        if low <= high if rows > 1 else size[0] <= length <= size[1]:
            options.append((rows, low, high))
    if not options:
        raise ValueError(
            f"no rows of stones of {size[0] * STEP}..{size[1] * STEP} m with gaps of {gap[0] * STEP}.."
            f"{gap[1] * STEP} m fill {length * STEP} m; choose another platform_length, size or gap"
        )
    rows, low, high = options[int(rng.random() * len(options))]
    width = draw_steps(rng, low, high, ())
    edges = np.floor((length + width) * np.arange(rows + 1) / rows) - length // 2
    return edges[:-1], edges[1:] - width


def _set_back(rng, begin, end, row: np.ndarray, most: int, gap_max: int, size_min: int):
    """Each stone's own x edges within its row: rows aren't ruled lines, gaps and sizes keep their limits."""
    between = begin[1:] - end[:-1]
    slack = (gap_max - np.concatenate([[gap_max], between, [gap_max]])) // 2
    spare = np.minimum((end - begin - size_min) // 2, most)
    inner, outer = np.minimum(slack[:-1], spare)[row], np.minimum(slack[1:], spare)[row]
    return begin[row] + draw_steps(rng, 0, inner, row.shape), end[row] - draw_steps(rng, 0, outer, row.shape)


@register("stepping_stones")
def stepping_stones(difficulty: float, rng: np.random.Generator, config: TerrainConfig) -> Layout:
    """Rows along y, each with its own sequence of stones and gaps.

    Guaranteed, with gaps in gap_min..gap_max: along a row neighbours stand a gap apart; between two rows any
    two stones that face each other do; the platform and every stone that faces it do. Rows, and the stones
    of a row, end at most 0.1 + max(0, gap_max - gap_min - size_min) from the map's edge.
    """
    cfg = config.stepping_stones
    gap = (to_steps(at(cfg.gap_min, difficulty)), to_steps(at(cfg.gap_max, difficulty)))
    size = (to_steps(cfg.size_min), to_steps(cfg.size_max))
    px, py = to_steps(config.platform_length / 2), to_steps(config.platform_width / 2)
    half = to_steps(config.half_extent)
    stop = half - to_steps(0.1)

    left, right = (np.stack(sequence(rng, [px], stop, gap, size))[:, 0] for _ in range(2))
    right, left = right[:, right[0] < half], -left[::-1, left[0] < half][:, ::-1]
    side = np.stack(_beside_platform(rng, 2 * px, gap, size))
    row_begin, row_end = np.concatenate([left, side, right], axis=1)

    far = np.flatnonzero((row_begin >= px) | (row_end <= -px))
    near = np.flatnonzero((row_begin < px) & (row_end > -px))
    # Rows that pass the platform begin with a stone on the map's edge, those beside it at its two sides.
    begin = -stop - draw_steps(rng, 0, size[0] - 1, far.shape)
    y = [sequence(rng, begin, stop, gap, size, stone_first=True)]
    y += [sequence(rng, np.full(near.shape, py), stop, gap, size) for _ in range(2)]
    y[2] = (-y[2][1], -y[2][0])
    numbers = zip((far, near, near), y, strict=True)
    row = np.concatenate([np.repeat(rows, part[0].shape[1]) for rows, part in numbers])
    y0, y1 = (np.concatenate([part[i].ravel() for part in y]) for i in range(2))
    keep = (y0 < half) & (y1 > -half)
    row, y0, y1 = row[keep], y0[keep], y1[keep]
    x0, x1 = _set_back(rng, row_begin, row_end, row, to_steps(cfg.set_back), gap[1], size[0])
    vary = to_height(cfg.top_variation) // 2
    stones = boxes(x0, x1, y0, y1, 2 * draw_steps(rng, -vary, vary, x0.shape))
    platform = boxes(-px, px, -py, py, 0)
    return Layout(np.concatenate([platform, stones]), -cfg.depth, (px * STEP, py * STEP, 0.0))
