"""Blocks: a lattice of squares with heights of their own."""

import numpy as np

from terrains.config import TerrainConfig, at
from terrains.geometry import STEP, boxes, draw_steps, to_height, to_steps
from terrains.registry import Layout, register


def _edges(platform: float, side: float, half: float) -> tuple[np.ndarray, float]:
    """Lattice edges along one axis, cut at the map's edge, and the platform's half length, in steps.

    The platform is the whole number of squares nearest to the size asked for, centred.
    """
    inner = max(1, round(platform / side)) * side / 2
    outward = np.append(np.arange(inner, half, side), half)
    inward = np.arange(-inner + side, inner - side / 2, side)
    return np.concatenate([-outward[::-1], inward, outward]), inner


@register("blocks")
def blocks(difficulty: float, rng: np.random.Generator, config: TerrainConfig) -> Layout:
    """Square blocks that cover the map, tops uniform in 0..height; the platform lies at 0."""
    side, half = to_steps(config.blocks.side), to_steps(config.half_extent)
    x, px = _edges(to_steps(config.platform_length), side, half)
    y, py = _edges(to_steps(config.platform_width), side, half)
    x0, y0 = (a.ravel() for a in np.meshgrid(x[:-1], y[:-1], indexing="ij"))
    x1, y1 = (a.ravel() for a in np.meshgrid(x[1:], y[1:], indexing="ij"))
    top = 2 * draw_steps(rng, 0, to_height(at(config.blocks.height, difficulty)) // 2, x0.shape)
    # Blocks level with the floor add nothing to it.
    keep = ((abs(x0 + x1) > 2 * px) | (abs(y0 + y1) > 2 * py)) & (top > 0)
    rows = boxes(x0[keep], x1[keep], y0[keep], y1[keep], top[keep])
    return Layout(rows, 0.0, (px * STEP, py * STEP, 0.0))
