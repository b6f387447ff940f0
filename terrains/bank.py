"""`Bank`: many terrains as arrays on the device, the form the look-ups read."""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from terrains.config import TerrainConfig, parse_difficulty
from terrains.geometry import to_units
from terrains.raster import rasterise
from terrains.registry import kinds, make_terrain
from terrains.table import candidate_table

_FAR = np.array([32767, 32767, 0, 0, 0, -32767], np.int16)
"""Stands in for "no primitive": 8 m off and 8 m down, it is never the nearest surface."""


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Bank:
    """K terrains. World frame; the map's centre is the origin."""

    heights: jax.Array
    """(K, R, C) int16, mm, at cell centres; first index along x, second along y."""
    primitives: jax.Array
    """(K, N, 6) int16, units of 0.25 mm: [cx, cy, hx, hy, radius, top]. Row 0 is far away: "none"."""
    table: jax.Array
    """(K, n, n, M) int16 rows of `primitives` near each coarse cell; 0 = none."""
    difficulty: jax.Array
    """(K,) float32 in [0, 1]."""
    kind_id: jax.Array
    """(K,) int32 index into `kinds`."""
    floor: jax.Array
    """(K,) float32, m: height of the ground between primitives."""
    cell: float = dataclasses.field(metadata={"static": True})
    """Side of a heightfield cell (m)."""
    table_cell: float = dataclasses.field(metadata={"static": True})
    """Side of a coarse cell (m)."""
    half_extent: float = dataclasses.field(metadata={"static": True})
    """The map covers ± this in x and y (m)."""
    kinds: tuple[str, ...] = dataclasses.field(metadata={"static": True})
    """Names of the kinds."""

    @property
    def num_terrains(self) -> int:
        """K."""
        return self.heights.shape[0]

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(leaf.nbytes for leaf in jax.tree_util.tree_leaves(self))


def _aligned(shape: tuple[int, ...]) -> np.ndarray:
    """An uninitialised int16 array on a 64-byte boundary: JAX on a CPU takes it over without a copy."""
    count = 2 * int(np.prod(shape))
    raw = np.empty(count + 64, np.uint8)
    start = -raw.ctypes.data % 64
    return raw[start : start + count].view(np.int16).reshape(shape)


def make_bank(
    kind: str,
    num_terrains: int,
    seed: int,
    difficulties: Sequence[float | str] | None = None,
    config: TerrainConfig | None = None,
) -> Bank:
    """A bank of `make_terrain(kind, difficulties[k % len(difficulties)], seed, config, index=k)`, k = 0..K-1.

    Args:
      kind: one of `kinds()`.
      num_terrains: K.
      seed: at least 0; training uses seeds below 10,000.
      difficulties: the levels, numbers in [0, 1] or "paper"; `config.levels` of them evenly if None.
      config: sizes; the defaults if None.
    """
    config = TerrainConfig() if config is None else config
    levels = np.linspace(0.0, 1.0, config.levels) if difficulties is None else difficulties
    levels = [parse_difficulty(level) for level in levels]
    if num_terrains < 1 or not levels:
        raise ValueError(
            f"{num_terrains} terrains of {len(levels)} difficulties; choose at least one of each"
        )
    size = round(2 * config.half_extent / config.cell)
    names = kinds()
    heights = _aligned((num_terrains, size, size))
    rows, tables, kind_id, floor = [], [], [], []
    for k in range(num_terrains):
        terrain = make_terrain(kind, levels[k % len(levels)], seed, config, index=k)
        heights[k] = rasterise(terrain, config.cell, size)
        rows.append(np.concatenate([_FAR[None], to_units(terrain.primitives)]))
        part = candidate_table(terrain, config.table_cell, config.contact_margin)
        tables.append((part + 1).astype(np.int16))
        kind_id.append(names.index(terrain.kind))
        floor.append(terrain.floor)
    count, most, n = max(map(len, rows)), max(t.shape[-1] for t in tables), tables[0].shape[0]
    if count > 32767:
        raise ValueError(f"a terrain of {count - 1} primitives; choose sizes that need at most 32766")
    primitives = np.tile(_FAR, (num_terrains, count, 1))
    table = np.zeros((num_terrains, n, n, most), np.int16)
    for k, (row, part) in enumerate(zip(rows, tables, strict=True)):
        primitives[k, : len(row)] = row
        table[k, :, :, : part.shape[-1]] = part
    return Bank(
        heights=jax.device_put(heights),
        primitives=jax.device_put(primitives),
        table=jax.device_put(table),
        difficulty=jnp.asarray(np.resize(levels, num_terrains), jnp.float32),
        kind_id=jnp.asarray(kind_id, jnp.int32),
        floor=jnp.asarray(floor, jnp.float32),
        cell=config.cell,
        table_cell=2 * config.half_extent / n,
        half_extent=config.half_extent,
        kinds=names,
    )
