"""Gap course: rows across the walking direction."""

import numpy as np

from terrains.config import TerrainConfig, at
from terrains.generators.stepping_stones import sequence
from terrains.geometry import STEP, boxes, draw_steps, to_steps
from terrains.registry import Layout, register


@register("gaps")
def gaps(difficulty: float, rng: np.random.Generator, config: TerrainConfig) -> Layout:
    """Gaps across x over the map's whole width, the same course towards +x and -x."""
    cfg = config.gaps
    gap = (to_steps(at(cfg.gap_min, difficulty)), to_steps(at(cfg.gap_max, difficulty)))
    landing = (to_steps(cfg.landing_min), to_steps(cfg.landing_max))
    px, py = to_steps(config.platform_length / 2), to_steps(config.platform_width / 2)
    half = to_steps(config.half_extent)
    if cfg.widths:
        widths = np.array([to_steps(w) for w in cfg.widths])
        landings = draw_steps(rng, *landing, widths.shape)
        end = px + np.cumsum(widths + landings)
        begin = end - landings
        end[-1] = half
        if begin[-1] >= half:
            raise ValueError(f"gap widths {cfg.widths} don't fit the map; choose fewer or a larger map")
    else:
        begin, end = (a[0] for a in sequence(rng, [px], half - to_steps(0.1), gap, landing))
    keep = begin < half
    begin, end = begin[keep], end[keep]
    platform = boxes(-px, px, -half, half, 0)
    rows = [platform, boxes(begin, end, -half, half, 0), boxes(-end, -begin, -half, half, 0)]
    return Layout(np.concatenate(rows), -cfg.depth, (px * STEP, py * STEP, 0.0))
