"""Flat ground."""

import numpy as np

from terrains.config import TerrainConfig
from terrains.registry import Layout, register


@register("flat")
def flat(difficulty: float, rng: np.random.Generator, config: TerrainConfig) -> Layout:
    """A plane at z = 0, at every difficulty."""
    platform = (config.platform_length / 2, config.platform_width / 2, 0.0)
    return Layout(np.zeros((0, 6), np.float32), 0.0, platform)
