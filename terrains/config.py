"""Configuration of the terrains: one frozen dataclass a kind, and `TerrainConfig` that holds them all.

A field typed `Levels` holds three values of one size, at difficulty 0, at the paper's level (0.8) and at 1;
between them it runs linearly (`at`). Lengths are in metres. Every class is an OmegaConf structured config.
"""

import dataclasses
from collections.abc import Sequence

PAPER = 0.8
"""The difficulty named "paper": the sizes the paper reports."""

Levels = tuple[float, float, float]


def at(levels: Sequence[float], difficulty: float) -> float:
    """Value of a `Levels` field at a difficulty in [0, 1]: piecewise linear through (0, PAPER, 1)."""
    trivial, paper, past = levels
    if difficulty <= PAPER:
        return trivial + (paper - trivial) * (difficulty / PAPER)
    return paper + (past - paper) * (difficulty - PAPER) / (1.0 - PAPER)


def parse_difficulty(difficulty: float | str) -> float:
    """Difficulty in [0, 1] from a number or from the name "paper".

    Rounded to 1e-6, so that a bank's float32 difficulty means the very terrain it was read from.
    """
    if difficulty == "paper":
        return PAPER
    try:
        value = float(difficulty)
    except ValueError:
        value = float("nan")
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"unknown difficulty {difficulty!r}; choose a number in [0, 1] or 'paper' ({PAPER})")
    return round(value, 6)


@dataclasses.dataclass(frozen=True)
class _Config:
    def __post_init__(self):
        """Lists, as OmegaConf hands them back, become tuples: equal configs are equal and can be hashed."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, list):
                object.__setattr__(self, field.name, tuple(value))


@dataclasses.dataclass(frozen=True)
class BlocksConfig(_Config):
    """Squares on a lattice, each with its own height."""

    side: float = 0.25
    """Side of a square (m)."""
    height: Levels = (0.01, 0.10, 0.15)
    """Largest top (m); tops are uniform in 0..height."""


@dataclasses.dataclass(frozen=True)
class StairsConfig(_Config):
    """Concentric rectangular flights round the start platform, up and down in turn."""

    tread: float = 0.30
    """Depth of a step (m)."""
    rise: Levels = (0.03, 0.15, 0.20)
    """Height of a step (m)."""
    steps: int = 5
    """Steps of a flight: so many up, so many down, and again."""
    fixed_rise: float | None = None
    """Height of a step (m) whatever the difficulty, for figures with a given stair."""


@dataclasses.dataclass(frozen=True)
class SteppingStonesConfig(_Config):
    """Rows of rectangular stones, each row with its own sequence, over a pit."""

    size_min: float = 0.20
    """Smallest side of a stone (m)."""
    size_max: float = 0.35
    """Largest side of a stone (m)."""
    gap_min: Levels = (0.01, 0.05, 0.05)
    """Smallest edge-to-edge gap (m), between stones of a row and between rows."""
    gap_max: Levels = (0.03, 0.25, 0.35)
    """Largest edge-to-edge gap (m), between stones of a row and between rows."""
    set_back: float = 0.03
    """A stone's edges may lie up to this (m) inside its row, as far as the gap between the rows allows."""
    top_variation: float = 0.0
    """Tops are uniform in ± this (m)."""
    depth: float = 0.5
    """Depth of the pit (m)."""


@dataclasses.dataclass(frozen=True)
class PolesConfig(_Config):
    """Round poles on a square lattice that is shaken within the limits below, over a pit."""

    diameter_min: Levels = (0.42, 0.10, 0.08)
    """Smallest diameter (m)."""
    diameter_max: Levels = (0.42, 0.15, 0.08)
    """Largest diameter (m)."""
    gap_min: Levels = (-0.12, 0.05, 0.05)
    """Smallest edge-to-edge gap to any neighbour (m). Trivial poles overlap and leave no hole: standing apart by a
    centimetre, round poles on a square lattice still leave a fifth of the ground open between four of them."""
    gap_max: Levels = (-0.08, 0.12, 0.12)
    """Largest edge-to-edge gap to each of the four lattice neighbours (m)."""
    sweeps: int = 16
    """Rounds of random moves; 0 leaves a perfect lattice of equal poles."""
    top_variation: float = 0.0
    """Tops are uniform in ± this (m)."""
    depth: float = 0.5
    """Depth of the pit (m)."""


@dataclasses.dataclass(frozen=True)
class GapsConfig(_Config):
    """Gaps across the x axis, mirrored on both sides of the start platform, over a pit."""

    gap_min: Levels = (0.01, 0.05, 0.05)
    """Smallest gap (m)."""
    gap_max: Levels = (0.03, 0.25, 0.35)
    """Largest gap (m)."""
    landing_min: float = 0.25
    """Shortest landing between two gaps (m)."""
    landing_max: float = 0.30
    """Longest landing between two gaps (m)."""
    widths: tuple[float, ...] = ()
    """Gap widths (m) from the platform outwards, whatever the difficulty; solid ground after the last one.
    Empty: gaps are drawn up to the map's edge."""
    depth: float = 0.5
    """Depth of the pit (m)."""


@dataclasses.dataclass(frozen=True)
class MixedConfig(_Config):
    """Each instance is of one kind drawn from a list."""

    kinds: tuple[str, ...] = ("blocks", "stairs", "stepping_stones", "poles")
    """Kinds to draw from, each with the same chance."""


@dataclasses.dataclass(frozen=True)
class TerrainConfig(_Config):
    """What to build, how many of it, and the sizes of every kind."""

    kind: str = "poles"
    """Kind of terrain: flat, blocks, stairs, stepping_stones, poles, gaps, mixed, or a registered one."""
    num_terrains: int = 1024
    """Instances in the bank (K)."""
    seed: int = 0
    """Seed of the bank; training uses seeds below 10,000, evaluation larger ones."""
    levels: int = 11
    """Difficulties of the bank, evenly over [0, 1]; instance k has level k % levels."""
    cell: float = 0.02
    """Side of a heightfield cell (m)."""
    half_extent: float = 5.6
    """The map covers ± this in x and y (m)."""
    table_cell: float = 0.1
    """Side of a cell of the table that finds primitives near a foot (m)."""
    contact_margin: float = 0.03
    """Contact is exact where the surface is nearer than this (m); further away the distance reported may be
    too large. A little more than a foot's radius."""
    platform_length: float = 0.9
    """Size of the start platform along x (m); kinds with a lattice take the nearest size that fits it."""
    platform_width: float = 0.7
    """Size of the start platform along y (m)."""
    blocks: BlocksConfig = dataclasses.field(default_factory=BlocksConfig)
    """Sizes of `blocks`."""
    stairs: StairsConfig = dataclasses.field(default_factory=StairsConfig)
    """Sizes of `stairs`."""
    stepping_stones: SteppingStonesConfig = dataclasses.field(default_factory=SteppingStonesConfig)
    """Sizes of `stepping_stones`."""
    poles: PolesConfig = dataclasses.field(default_factory=PolesConfig)
    """Sizes of `poles`."""
    gaps: GapsConfig = dataclasses.field(default_factory=GapsConfig)
    """Sizes of `gaps`."""
    mixed: MixedConfig = dataclasses.field(default_factory=MixedConfig)
    """Kinds of `mixed`."""
