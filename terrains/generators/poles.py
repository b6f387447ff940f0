"""Poles: round posts over a pit, on a lattice shaken at random within exact limits."""

import numpy as np

from terrains.config import TerrainConfig, at
from terrains.geometry import STEP, boxes, cylinders, draw_steps, to_height, to_steps
from terrains.registry import Layout, register

_NEIGHBOURS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1))


def _axis(platform: int, half: int, pitch: int, reach: int) -> tuple[np.ndarray, int, int]:
    """Lattice along one axis, in steps.

    Args:
      platform: half length asked for.
      half: the map's half extent.
      pitch: lattice constant.
      reach: a pole's radius and its gap to the platform.

    Returns:
      coordinates of the nodes, the platform's half length, and how many nodes it replaces. The half length is
      the one nearest to the wish at which the first nodes stand a middle gap from the platform.
    """
    inside = max(1, round(2 * (platform + reach) / pitch - 1))
    count = inside + 2 * int(np.ceil((half + pitch / 2) / pitch - inside / 2))
    nodes = np.floor((np.arange(count) - (count - 1) / 2) * pitch)
    return nodes, (inside + 1) * pitch // 2 - reach, inside


def _shake(rng, state: np.ndarray, alive, beside, platform, gap, radius, sweeps: int) -> None:
    """Random moves of position and radius, each taken only if it keeps every gap within its limits.

    Metropolis sampling of the uniform distribution over all lattices that obey the limits, begun at the
    perfect lattice. Nodes of one colour (i % 2, j % 2) aren't neighbours and move together.

    Args:
      state: (3, nx + 2, ny + 2) x, y and radius, whole steps, with an empty rim; changed in place. float32
        holds squares of the differences between neighbours exactly.
      alive, beside: (nx + 2, ny + 2) bool, where there is a pole, and one next to a side of the platform.
      platform: half length and half width.
      gap, radius: smallest and largest.
    """
    shape = alive.shape
    flat, alive, beside = state.reshape(3, -1), alive.ravel(), beside.ravel()
    step = (gap[1] - gap[0]) // 2 + 1
    low, high = np.array([[-step], [-step], [radius[0]]]), np.array([[step], [step], [radius[1]]])
    around = np.array([di * shape[1] + dj for di, dj in _NEIGHBOURS])[:, None]
    i, j = np.indices(shape).reshape(2, -1)
    colours = []
    for a, b in ((0, 0), (1, 1), (0, 1), (1, 0)):
        own = np.flatnonzero(alive & (i % 2 == a) & (j % 2 == b))
        near = own + around
        side = np.where(alive[near], np.float32(1.0), np.float32(np.nan))  # nan: nobody there, no test fails
        colours.append((own, near, side, ~beside[own]))
    for own, near, side, free in colours * sweeps:
        move = draw_steps(rng, low, high, (3, len(own))).astype(np.float32)
        move[:2] += flat[:2, own]
        x, y, r = move
        ox, oy, touch = flat[:, near]
        square = ((ox - x) ** 2 + (oy - y) ** 2) * side
        touch += r
        bad = square < (touch + gap[0]) ** 2
        bad[:4] |= square[:4] > (touch[:4] + gap[1]) ** 2
        square = np.maximum(abs(x) - platform[0], 0) ** 2 + np.maximum(abs(y) - platform[1], 0) ** 2
        ok = ~bad.any(axis=0) & (square >= (r + gap[0]) ** 2) & (free | (square <= (r + gap[1]) ** 2))
        flat[:, own[ok]] = move[:, ok]


@register("poles")
def poles(difficulty: float, rng: np.random.Generator, config: TerrainConfig) -> Layout:
    """Poles on a square lattice, shaken.

    Guaranteed: no two poles stand nearer than gap_min; each pole's four lattice neighbours stand within
    gap_min..gap_max of it, edge to edge; so do the platform and each pole in the rows along its sides.
    The lattice reaches beyond the map. Diagonal neighbours may stand further apart than gap_max.
    """
    cfg = config.poles
    gap = (to_steps(at(cfg.gap_min, difficulty)), to_steps(at(cfg.gap_max, difficulty)))
    radius = (to_steps(at(cfg.diameter_min, difficulty) / 2), to_steps(at(cfg.diameter_max, difficulty) / 2))
    middle = (radius[0] + radius[1]) // 2
    reach = middle + (gap[0] + gap[1]) // 2
    pitch = middle + reach
    half = to_steps(config.half_extent)
    xs, px, inside_x = _axis(to_steps(config.platform_length / 2), half, pitch, reach)
    ys, py, inside_y = _axis(to_steps(config.platform_width / 2), half, pitch, reach)

    x, y = np.meshgrid(xs, ys, indexing="ij")
    state = np.stack([x, y, np.full(x.shape, middle)]).astype(np.float32)
    state = np.pad(state, ((0, 0), (1, 1), (1, 1)))
    rank = [abs(np.arange(len(a)) * 2 - (len(a) - 1)) - n for a, n in ((xs, inside_x), (ys, inside_y))]
    removed = (rank[0][:, None] < 0) & (rank[1] < 0)
    beside = ((rank[0][:, None] < 2) & (rank[1] < 0)) | ((rank[0][:, None] < 0) & (rank[1] < 2))
    alive, beside = np.pad(~removed, 1), np.pad(beside & ~removed, 1)
    _shake(rng, state, alive, beside, (px, py), gap, radius, cfg.sweeps)

    x, y, r = state
    vary = to_height(cfg.top_variation) // 2
    top = 2 * draw_steps(rng, -vary, vary, int(alive.sum()))
    rows = np.concatenate([boxes(-px, px, -py, py, 0), cylinders(x[alive], y[alive], r[alive], top)])
    return Layout(rows, -cfg.depth, (px * STEP, py * STEP, 0.0))
