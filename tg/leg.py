"""Closed-form kinematics of a leg with the joints abduction (x), hip (y) and knee (y).

The canonical joint axes are those of Max: +x, -y, -y. Other axes are handled by `LegGeometry.sign`.
"""

from typing import Any, NamedTuple

from tg.arrays import stack

Array = Any


class LegGeometry(NamedTuple):
    """Sizes of the four legs LF, RF, LR, RR, read from the compiled model."""

    hip_position: Array
    """(4, 3) m, abduction joint in the trunk's frame."""
    offset: Array
    """(4,) m, signed lateral offset from the abduction joint to the leg's plane (left positive)."""
    thigh: Array
    """(4,) m."""
    shank: Array
    """(4,) m."""
    sign: Array
    """(3,) ±1: joint angle = sign * canonical angle (axes +x, -y, -y)."""


def forward(leg: LegGeometry, q: Array) -> Array:
    """Foot positions from joint angles.

    Args:
      leg: geometry.
      q: (..., 4, 3) rad.

    Returns:
      (..., 4, 3) m, from each leg's abduction joint, in the trunk's frame.
    """
    xp = q.__array_namespace__()
    q = q * leg.sign
    abduction, hip, knee = q[..., 0], q[..., 1], q[..., 2]
    x = leg.thigh * xp.sin(hip) + leg.shank * xp.sin(hip + knee)
    down = leg.thigh * xp.cos(hip) + leg.shank * xp.cos(hip + knee)
    cos, sin = xp.cos(abduction), xp.sin(abduction)
    return stack([x, leg.offset * cos + down * sin, leg.offset * sin - down * cos])


def inverse(leg: LegGeometry, foot: Array) -> Array:
    """Joint angles that put the feet at given positions; the inverse of `forward` with the knee bent backwards.

    A target out of reach gives the nearest stretched (or folded) leg that points at it.

    Args:
      leg: geometry.
      foot: (..., 4, 3) m, from each leg's abduction joint, in the trunk's frame.

    Returns:
      (..., 4, 3) rad.
    """
    xp = foot.__array_namespace__()
    x, y, z = foot[..., 0], foot[..., 1], foot[..., 2]
    # Distance below the hip joint in the leg's plane; the bound keeps the root real for targets inside the offset.
    down = xp.sqrt(xp.maximum(y * y + z * z - leg.offset * leg.offset, 1e-6 + 0.0 * y))
    abduction = xp.arctan2(y, -z) - xp.arctan2(leg.offset + 0.0 * y, down)
    cosine = (x * x + down * down - leg.thigh**2 - leg.shank**2) / (2.0 * leg.thigh * leg.shank)
    knee = xp.arccos(xp.clip(cosine, -1.0, 1.0))
    hip = xp.arctan2(x, down) - xp.arctan2(leg.shank * xp.sin(knee), leg.thigh + leg.shank * xp.cos(knee))
    return stack([abduction, hip, knee]) * leg.sign


def support_torque(leg: LegGeometry, q: Array, load: Array, foot: Array | None = None) -> Array:
    """Joint torques with which massless legs carry loads: τ = -Jᵀ F, F the ground's upward force on the foot.

    Args:
      leg: geometry.
      q: (..., 4, 3) rad.
      load: (..., 4) N, along the trunk's z.
      foot: (..., 4, 3) m, `forward` of q, where it is known already.

    Returns:
      (..., 4, 3) N·m.
    """
    xp = q.__array_namespace__()
    foot = forward(leg, q) if foot is None else foot
    canonical = q * leg.sign
    # ∂z/∂abduction = y, ∂z/∂hip = x cos(abduction), ∂z/∂knee = shank sin(hip + knee) cos(abduction).
    cos = xp.cos(canonical[..., 0])
    slope = stack(
        [foot[..., 1], foot[..., 0] * cos, leg.shank * xp.sin(canonical[..., 1] + canonical[..., 2]) * cos]
    )
    return -load[..., None] * slope * leg.sign
