"""Stairs: flights up and down round the start platform."""

import numpy as np

from terrains.config import TerrainConfig, at
from terrains.geometry import STEP, boxes, to_height, to_steps
from terrains.registry import Layout, register


@register("stairs")
def stairs(difficulty: float, rng: np.random.Generator, config: TerrainConfig) -> Layout:
    """Rectangular rings of steps, `steps` up and `steps` down again and again; nothing is drawn at random.

    Heights in steps for steps = 5, outwards: 0 (platform), 1, 2, 3, 4, 5, 4, 3, 2, 1, 0, 1, ...
    The steps of a ring overlap at its corners, so that no inner face lies near the surface.
    """
    cfg = config.stairs
    rise = to_height(at(cfg.rise, difficulty) if cfg.fixed_rise is None else cfg.fixed_rise)
    tread, half = to_steps(cfg.tread), to_steps(config.half_extent)
    px, py = to_steps(config.platform_length / 2), to_steps(config.platform_width / 2)
    ring = np.arange(1, (half - min(px, py)) // tread + 2)
    level = cfg.steps - abs(ring % (2 * cfg.steps) - cfg.steps)
    ring, top = ring[level > 0], rise * level[level > 0]
    # A ring may reach beyond the map by less than a tread; there it is not seen.
    x1, y1 = px + ring * tread, py + ring * tread
    x0, y0 = x1 - tread, y1 - tread
    sides = [boxes(x0, x1, -y1, y1, top), boxes(-x1, -x0, -y1, y1, top)]
    ends = [boxes(-x1, x1, y0, y1, top), boxes(-x1, x1, -y1, -y0, top)]
    return Layout(np.concatenate(sides + ends), 0.0, (px * STEP, py * STEP, 0.0))
