"""Phase and foot path of the trotting gait (paper, section III-B)."""

import math
from typing import Any

from tg.arrays import stack

Array = Any

TROT = (0.0, math.pi, math.pi, 0.0)
"""Phase offsets of LF, RF, LR, RR from LF (rad)."""


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


def leg_phases(phase: Array) -> Array:
    """Phases (..., 4) rad of the legs from LF's phase (...) rad; swing is p > 0, stance is p ≤ 0."""
    return wrap(stack([phase + offset for offset in TROT]))


def stride(phase: Array, retraction: float = 0.0) -> Array:
    """d_l: position of a foot along its step, from -½ (lift-off) to ½ (touch-down) in swing and back in stance.

    The paper's is S(|p/π|) - ½. It stops the foot under the trunk at touch-down, so that it comes down with the trunk's
    speed, and moves in stance at any speed but the trunk's. With a retraction of 1 a foot in stance moves
    evenly and in swing has the ground's speed at both ends. Mean stance speed is 2 f L.

    Args:
      phase: (...) rad.
      retraction: share r of that: S(u) - ½ ± r (S(u) - u) with u = |p/π|, + in swing, - in stance.
    """
    xp = phase.__array_namespace__()
    u = xp.abs(phase) / math.pi
    s = smoothstep(u)
    return s - 0.5 + retraction * xp.sign(phase) * (s - u)


def height(phase: Array) -> Array:
    """dz / (H + δh) in [0, 1]: 0 in stance, up by S(t) to p = π/2, down by 1 - S(t - 1), with t = 2p/π.

    The paper's second half, 2t³ - 3t² + 1 on t in (1, 2], jumps at π/2 and ends at 5. Ours has zero vertical speed
    at lift-off, apex and touch-down.
    """
    xp = phase.__array_namespace__()
    t = xp.clip(2.0 * phase / math.pi, 0.0, 2.0)
    return smoothstep(1.0 - xp.abs(t - 1.0))
