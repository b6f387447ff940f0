"""Terrain kinds by name, and `make_terrain`.

A new kind is a function in any file: it draws a `Layout` from a difficulty, a generator and the config.

    @terrains.register("trench")
    def trench(difficulty, rng, config):
        return terrains.Layout(primitives, floor=-0.3, platform=(0.45, 0.35, 0.0))
"""

import dataclasses
import functools
import zlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from terrains.config import TerrainConfig, parse_difficulty


class Layout(NamedTuple):
    """What a generator returns."""

    primitives: np.ndarray
    """(N, 6) float32, m; see `terrains.geometry`."""
    floor: float
    """Height of the ground between primitives (m)."""
    platform: tuple[float, float, float]
    """Start platform round the origin: half length along x, half width along y, top (m)."""


@dataclasses.dataclass(frozen=True, eq=False)
class Terrain:
    """One terrain's true geometry (world frame, metres); heightfield and MuJoCo geoms are views of it."""

    kind: str
    """Registered kind; for `mixed`, the one that was drawn."""
    difficulty: float
    """In [0, 1]."""
    seed: int
    """Seed of the bank it belongs to."""
    index: int
    """Its place in that bank."""
    primitives: np.ndarray
    """(N, 6) float32, m; see `terrains.geometry`."""
    floor: float
    """Height of the ground between primitives (m)."""
    half_extent: float
    """The map covers ± this in x and y (m)."""
    platform: tuple[float, float, float]
    """Start platform round the origin: half length along x, half width along y, top (m)."""

    @functools.cached_property
    def buckets(self) -> np.ndarray:
        """(n, n, M) int: rows of `primitives` over each 0.1 m cell, -1 where none; for `exact_height`."""
        from terrains.table import candidate_table

        return candidate_table(self, cell=0.1, margin=0.0)

    def turned(self, quarters: int = 1) -> "Terrain":
        """The same terrain turned about z by so many quarter turns, counter-clockwise."""
        rows, (px, py, top) = self.primitives, self.platform
        for _ in range(quarters % 4):
            rows = rows[:, [1, 0, 3, 2, 4, 5]] * np.array([-1, 1, 1, 1, 1, 1], np.float32)
            px, py = py, px
        return dataclasses.replace(self, primitives=rows, platform=(px, py, top))


Generator = Callable[[float, np.random.Generator, TerrainConfig], Layout]
_GENERATORS: dict[str, Generator] = {}


def register(name: str) -> Callable[[Generator], Generator]:
    """Decorator that makes a generator known under a name."""

    def add(generator: Generator) -> Generator:
        if name in _GENERATORS or name == "mixed":
            raise ValueError(
                f"terrain {name!r} exists already; choose another name than {', '.join(kinds())}"
            )
        _GENERATORS[name] = generator
        return generator

    return add


def kinds() -> tuple[str, ...]:
    """Names `make_terrain` knows, in order of registration; `mixed` last."""
    return (*_GENERATORS, "mixed")


def _rng(kind: str, seed: int, index: int) -> np.random.Generator:
    sequence = np.random.SeedSequence([zlib.crc32(kind.encode()), seed, index])
    return np.random.Generator(np.random.PCG64(sequence))


def make_terrain(
    kind: str, difficulty: float | str, seed: int, config: TerrainConfig | None = None, *, index: int = 0
) -> Terrain:
    """The terrain of a kind, a difficulty and a seed: the same one on every machine, for ever.

    Args:
      kind: one of `kinds()`.
      difficulty: in [0, 1], or "paper". The random numbers don't depend on it: a seed keeps its character.
      seed: at least 0. Training uses seeds below 10,000.
      config: sizes; the defaults if None. Its `kind`, `num_terrains`, `seed` and `levels` are not used.
      index: place in the bank of that seed; instance k of a bank is `index=k`.
    """
    config = TerrainConfig() if config is None else config
    level = parse_difficulty(difficulty)
    if kind == "mixed":
        names = tuple(config.mixed.kinds)
        if not names or "mixed" in names:
            raise ValueError(f"mixed.kinds is {names}; choose one or more of {', '.join(_GENERATORS)}")
        kind = names[int(_rng("mixed", seed, index).random() * len(names))]
    if kind not in _GENERATORS:
        raise ValueError(f"unknown terrain {kind!r}; choose one of {', '.join(kinds())}")
    layout = _GENERATORS[kind](level, _rng(kind, seed, index), config)
    primitives = np.asarray(layout.primitives, np.float32).reshape(-1, 6)
    return Terrain(kind, level, seed, index, primitives, layout.floor, config.half_extent, layout.platform)
