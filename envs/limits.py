"""Limits of every number in `EnvConfig`, by its dotted name, both ends included; a tuple's values each.

Wide enough for whatever makes sense, narrow enough that what lies within them runs.
"""

import dataclasses
import math
from collections.abc import Iterator, Mapping
from typing import Any

_LENGTH = (0.0, 1.0)
_SHARE = (0.0, 1.0)
_WEIGHT = (-1e3, 1e3)
_NOISE = (0.0, 10.0)

LIMITS: dict[str, tuple[float, float]] = {
    "robot.kp": (1e-3, 1e4),
    "robot.kd": (0.0, 1e3),
    "robot.armature": (0.0, 10.0),
    "robot.joint_friction": (0.0, 100.0),
    "robot.foot_friction": (1e-3, 10.0),
    "robot.foot_height": (-2.0, -0.01),
    "robot.foot_spread": (-0.2, 0.2),
    "terrain.num_terrains": (1, 1 << 20),
    "terrain.seed": (0, 2**31 - 1),
    "terrain.levels": (1, 1000),
    "terrain.cell": (0.002, 0.1),
    "terrain.half_extent": (1.5, 8.0),
    "terrain.table_cell": (0.05, 0.5),
    "terrain.contact_margin": (0.0, 0.2),
    "terrain.platform_length": (0.5, 2.0),
    "terrain.platform_width": (0.5, 2.0),
    "terrain.blocks.side": (0.05, 1.0),
    "terrain.blocks.height": _LENGTH,
    "terrain.stairs.tread": (0.05, 1.0),
    "terrain.stairs.rise": (0.0, 0.5),
    "terrain.stairs.steps": (1, 20),
    "terrain.stairs.fixed_rise": (0.0, 0.5),
    "terrain.stepping_stones.size_min": (0.05, 1.0),
    "terrain.stepping_stones.size_max": (0.05, 1.0),
    "terrain.stepping_stones.gap_min": _LENGTH,
    "terrain.stepping_stones.gap_max": _LENGTH,
    "terrain.stepping_stones.set_back": (0.0, 0.2),
    "terrain.stepping_stones.top_variation": (0.0, 0.5),
    "terrain.stepping_stones.depth": (0.05, 5.0),
    "terrain.poles.diameter_min": (0.03, 1.0),
    "terrain.poles.diameter_max": (0.03, 1.0),
    "terrain.poles.gap_min": (-0.5, 1.0),
    "terrain.poles.gap_max": (-0.5, 1.0),
    "terrain.poles.sweeps": (0, 100),
    "terrain.poles.top_variation": (0.0, 0.5),
    "terrain.poles.depth": (0.05, 5.0),
    "terrain.gaps.gap_min": _LENGTH,
    "terrain.gaps.gap_max": _LENGTH,
    "terrain.gaps.landing_min": (0.05, 1.0),
    "terrain.gaps.landing_max": (0.05, 1.0),
    "terrain.gaps.widths": _LENGTH,
    "terrain.gaps.depth": (0.05, 5.0),
    "tg.base_frequency": (0.1, 10.0),
    "tg.frequency_range": (0.0, 5.0),
    "tg.swing_share": (0.1, 0.5),
    "tg.step_length": (0.0, 0.5),
    "tg.retraction": _SHARE,
    "tg.lift": (0.0, 0.5),
    "tg.lift_range": (0.0, 0.5),
    "tg.lift_min": (0.0, 0.5),
    "tg.lift_max": (0.0, 0.5),
    "tg.residual_range": (0.0, math.pi),
    "tg.levelling": _SHARE,
    "tg.weight_compensation": (0.0, 2.0),
    "tg.lead": (0.0, 0.1),
    "tg.refine": (0.0, 0.05),
    "tg.look_ahead_from": (-math.pi, 0.0),
    "tg.touch_down": _SHARE,
    "tg.stance_damping": (0.0, 10.0),
    "tg.start_time": (1e-3, 10.0),
    "tg.mirror_hysteresis": _SHARE,
    "tg.sample_radius": (0.04, 0.5),
    "rewards.speed_low": (0.01, 10.0),
    "rewards.speed_high": (0.01, 10.0),
    "rewards.along": _WEIGHT,
    "rewards.across": _WEIGHT,
    "rewards.smooth": _WEIGHT,
    "rewards.energy": _WEIGHT,
    "rewards.terrain": _WEIGHT,
    "rewards.aim": _WEIGHT,
    "rewards.height": _WEIGHT,
    "rewards.yaw": _WEIGHT,
    "rewards.heading": _WEIGHT,
    "rewards.tilt": _WEIGHT,
    "rewards.heave": _WEIGHT,
    "rewards.knee": _WEIGHT,
    "rewards.knee_margin": (1e-3, 1.0),
    "rewards.gap_threshold": (0.01, 5.0),
    "rewards.terrain_ring": (0.0, 0.1),
    "rewards.lift_threshold": (0.0, 1.0),
    "randomisation.friction": (1e-3, 10.0),
    "randomisation.payload": (-5.0, 50.0),
    "randomisation.gain": (0.1, 10.0),
    "randomisation.latency": (0.0, 0.1),
    "randomisation.push_speed": (0.0, 10.0),
    "randomisation.push_interval": (1e-2, 1e6),
    "randomisation.joint_position_noise": _NOISE,
    "randomisation.joint_velocity_noise": _NOISE,
    "randomisation.tilt_noise": (0.0, 1.0),
    "randomisation.angular_velocity_noise": _NOISE,
    "randomisation.height_noise": (0.0, 1.0),
    "randomisation.height_drift": (0.0, 1.0),
    "randomisation.map_drift": (0.0, 1.0),
    "curriculum.difficulty": _SHARE,
    "curriculum.depth": (0.001, 10.0),
    "curriculum.start": (0, 1000),
    "curriculum.practice": _SHARE,
    "curriculum.practice_depth": (0.001, 10.0),
    "curriculum.up": _SHARE,
    "curriculum.down": _SHARE,
    "curriculum.revisit": _SHARE,
    "curriculum.leap": (1, 1000),
    "control_dt": (0.002, 0.1),
    "physics_dt": (0.0005, 0.02),
    "solver_iterations": (1, 100),
    "num_planes": (1, 2),
    "episode_time": (0.1, 1e7),
    "stand_share": _SHARE,
    "straight_share": _SHARE,
    "stop_share": _SHARE,
    "stop_time": (0.0, 1e7),
    "spawn_yaw": (0.0, math.pi + 1e-3),
    "spawn_offset": (0.0, 0.2),
    "gap_depth": (0.0, 1.0),
    "min_up": (-1.0, 1.0),
    "knee_radius": (0.0, 0.2),
}

ORDERED = (
    ("terrain.stepping_stones.size_min", "terrain.stepping_stones.size_max"),
    ("terrain.stepping_stones.gap_min", "terrain.stepping_stones.gap_max"),
    ("terrain.poles.diameter_min", "terrain.poles.diameter_max"),
    ("terrain.poles.gap_min", "terrain.poles.gap_max"),
    ("terrain.gaps.gap_min", "terrain.gaps.gap_max"),
    ("terrain.gaps.landing_min", "terrain.gaps.landing_max"),
    ("tg.lift_min", "tg.lift_max"),
    ("rewards.speed_low", "rewards.speed_high"),
    ("curriculum.down", "curriculum.up"),
)
"""Pairs of which the first must not be larger than the second (element by element)."""
_LEVELS = 3  # values of a `terrains.config.Levels`
_PAIRS = (
    *("randomisation.friction", "randomisation.payload", "randomisation.gain", "randomisation.latency"),
    "stop_time",
)


def leaves(config: Any, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted name and value of everything in a nested dataclass."""
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from leaves(value, f"{prefix}{field.name}.")
        else:
            yield prefix + field.name, value


def check_values(found: Mapping[str, Any], limits: Mapping[str, tuple[float, float]]) -> None:
    """Raises ValueError where a number, or one of a tuple's, lies outside of its limits."""
    for name, value in found.items():
        if name not in limits or value is None:
            continue
        low, high = limits[name]
        for number in _tuple(value):
            if not (isinstance(number, int | float) and low <= number <= high):
                raise ValueError(f"{name}={_text(value)} must be from {_end(low)} to {_end(high)}")


def check_limits(config: Any) -> None:
    """Raises ValueError, which names what is valid, on an `EnvConfig` with a number out of its limits."""
    found = dict(leaves(config))
    check_values(found, LIMITS)
    for name, value in found.items():
        sizes = name.startswith("terrain.") and name in LIMITS and isinstance(value, tuple | list)
        if sizes and not name.endswith("widths") and len(value) != _LEVELS:
            raise ValueError(f"{name}={_text(value)} must be three values: at difficulty 0, at 0.8 and at 1")
    for name in _PAIRS:
        value = found[name]
        if len(value) != 2 or value[0] > value[1]:
            raise ValueError(f"{name}={_text(value)} must be two values, the smaller one first")
    for smaller, larger in ORDERED:
        pairs = zip(_tuple(found[smaller]), _tuple(found[larger]), strict=True)
        if any(a > b for a, b in pairs):
            raise ValueError(
                f"{smaller}={_text(found[smaller])} must not be above {larger}={_text(found[larger])}"
            )


def _tuple(value: Any) -> tuple[Any, ...]:
    return tuple(value) if isinstance(value, tuple | list) else (value,)


def _end(limit: float) -> str:
    return str(limit) if isinstance(limit, int) else f"{limit:g}"


def _text(value: Any) -> str:
    return f"[{','.join(map(str, value))}]" if isinstance(value, tuple | list) else str(value)
