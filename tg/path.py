"""Phase and foot path of the gait (paper, section III-B)."""

import math
from typing import Any

from tg.arrays import stack

Array = Any

GAITS = {
    "trot": (0.0, math.pi, math.pi, 0.0),
    "walk": (0.0, math.pi, 0.5 * math.pi, -0.5 * math.pi),
}
"""Phase offsets of LF, RF, LR, RR from LF (rad). The paper trots. A walk lifts one foot after the other, each hind foot
before the fore foot of its side, and stands on three."""
LONGEST_SWING = {"trot": 0.5, "walk": 0.24}
"""Largest share of the cycle that legs can be in swing, so that there are moments with all feet down."""


def wrap(angle: Array) -> Array:
    """Angle in [-π, π) (rad)."""
    xp = angle.__array_namespace__()
    return xp.remainder(angle + math.pi, 2.0 * math.pi) - math.pi


def smoothstep(u: Array) -> Array:
    """S(u) = 3u² - 2u³, for u in [0, 1]: from 0 to 1 with zero slope at both ends."""
    return u * u * (3.0 - 2.0 * u)


def advance(phase: Array, frequency: Array, dt: float) -> Array:
    """Next phase: wrap(p + 2π f T).

    The paper adds f T to a phase in radians; f counts cycles, hence the 2π.

    Args:
      phase: (...) rad.
      frequency: (...) Hz.
      dt: control period (s).
    """
    return wrap(phase + 2.0 * math.pi * frequency * dt)


def leg_phases(phase: Array, swing_share: float = 0.5, gait: str = "trot") -> Array:
    """Phases (..., 4) rad of the legs from the gait's phase (...) rad; swing is p > 0, stance is p ≤ 0.

    Args:
      phase: (...) rad, at 0 where LF lifts off.
      swing_share: of the gait's cycle that a leg is in swing, in (0, 0.5]. The paper's 0.5 makes each leg's phase run
        evenly; below it swing runs faster than stance, and between two pairs' swings all feet are down.
      gait: one of `GAITS`.
    """
    phases = wrap(stack([phase + offset for offset in GAITS[gait]]))
    if swing_share == 0.5:
        return phases
    xp = phases.__array_namespace__()
    end = 2.0 * math.pi * swing_share
    stance = 2.0 * (1.0 - swing_share)
    late = xp.where(phases > 0, (phases - end) / stance - math.pi, phases / stance)
    return xp.where((phases > 0) & (phases < end), phases / (2.0 * swing_share), late)


def stride(phase: Array, retraction: float = 0.0, swing_share: float = 0.5) -> Array:
    """d_l: position of a foot along its step, from -½ (lift-off) to ½ (touch-down) in swing and back in stance.

    The paper's is S(|p/π|) - ½. It stops the foot under the trunk at touch-down, so that it comes down with the trunk's
    speed, and moves in stance at any speed but the trunk's. With a retraction of 1 a foot in stance moves
    evenly and in swing has the ground's speed at both ends. Mean stance speed is f L / (1 - swing_share).

    Args:
      phase: (...) rad, a leg's.
      retraction: share r of that: S(u) - ½ ± r (S(u) - u) with u = |p/π|, + in swing, - in stance.
      swing_share: of the gait's cycle; in swing r is times swing_share / (1 - swing_share), as its u runs faster.
    """
    xp = phase.__array_namespace__()
    u = xp.abs(phase) / math.pi
    s = smoothstep(u)
    share = xp.where(phase > 0, swing_share / (1.0 - swing_share) + 0.0 * u, xp.sign(phase))
    return s - 0.5 + retraction * share * (s - u)


def height(phase: Array) -> Array:
    """dz / (H + δh) in [0, 1]: 0 in stance, up by S(t) to p = π/2, down by 1 - S(t - 1), with t = 2p/π.

    The paper's second half, 2t³ - 3t² + 1 on t in (1, 2], jumps at π/2 and ends at 5. Ours has zero vertical speed
    at lift-off, apex and touch-down.
    """
    xp = phase.__array_namespace__()
    t = xp.clip(2.0 * phase / math.pi, 0.0, 2.0)
    return smoothstep(1.0 - xp.abs(t - 1.0))
