"""Terrains: generators from difficulty to primitives, and every view of them.

    terrain = terrains.make_terrain("poles", "paper", seed=0)     # true geometry, host
    bank = terrains.make_bank("poles", num_terrains=1024, seed=0)  # arrays, device
    terrains.height(bank, k, xy); terrains.contact(bank, k, centre, bank.floor[k])
    terrains.add_to_spec(spec, terrain)                           # MuJoCo geoms

A new kind is a function in any file: see `terrains.registry`.
"""

from terrains import generators as _generators  # noqa: F401, registers the built-in kinds
from terrains.bank import Bank, make_bank
from terrains.config import (
    PAPER,
    BlocksConfig,
    GapsConfig,
    MixedConfig,
    PolesConfig,
    StairsConfig,
    SteppingStonesConfig,
    TerrainConfig,
    at,
    parse_difficulty,
)
from terrains.geometry import boxes, cylinders, footprint_distance, signed_distance, to_steps
from terrains.lookup import contact, height, height_bilinear, normal
from terrains.mujoco_view import add_to_spec
from terrains.raster import exact_height, rasterise
from terrains.registry import Layout, Terrain, kinds, make_terrain, register

__all__ = [
    "PAPER",
    "Bank",
    "BlocksConfig",
    "GapsConfig",
    "Layout",
    "MixedConfig",
    "PolesConfig",
    "StairsConfig",
    "SteppingStonesConfig",
    "Terrain",
    "TerrainConfig",
    "add_to_spec",
    "at",
    "boxes",
    "contact",
    "cylinders",
    "exact_height",
    "footprint_distance",
    "height",
    "height_bilinear",
    "kinds",
    "make_bank",
    "make_terrain",
    "normal",
    "parse_difficulty",
    "rasterise",
    "register",
    "signed_distance",
    "to_steps",
]
