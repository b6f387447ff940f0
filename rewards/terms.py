"""The reward terms, one function each (paper, section III-C-3). L = 4 legs, P = 25 sample points a foot."""

import jax
import jax.numpy as jnp


def along(speed: jax.Array, low: float, high: float, *, literal: bool = False) -> jax.Array:
    """r_v: speed along the command, s = v·c.

    The paper's form: 1 within [v_l, v_h], exp(-2 (s - v_l)²) below, exp(-2 (s - v_h)²) above. Below v_l it pays 0.8
    for standing still; by default we take clip(s / v_l, -½, 1) there.

    Args:
      speed: () m/s, s.
      low: v_l (m/s).
      high: v_h (m/s).
      literal: the paper's form.
    """
    too_fast = jnp.exp(-2.0 * jnp.square(jnp.maximum(speed - high, 0.0)))
    if literal:
        return too_fast * jnp.exp(-2.0 * jnp.square(jnp.maximum(low - speed, 0.0)))
    return too_fast * jnp.clip(speed / low, -0.5, 1.0)


def standing(velocity: jax.Array, low: float) -> jax.Array:
    """r_v for the command to stand: 1 at rest, 0 at v_l and beyond.

    Args:
      velocity: (2,) m/s.
      low: v_l (m/s).
    """
    return 1.0 - jnp.clip(jnp.linalg.norm(velocity) / low, 0.0, 1.0)


def across(velocity: jax.Array, command: jax.Array) -> jax.Array:
    """r_vo = exp(-1.5 (v·v - (v·c)²)): the squared speed across the command, horizontal.

    The paper prints v·v - v·c, which mixes units and would pay for drifting; this is the form of Lee et al. 2020.

    Args:
      velocity: (2,) m/s.
      command: (2,) unit vector, or 0.
    """
    return jnp.exp(-1.5 * (velocity @ velocity - jnp.square(velocity @ command)))


def energy(torque: jax.Array, joint_velocity: jax.Array, *, literal: bool = False) -> jax.Array:
    """r_tau = -Σ |τ_i q̇_i| (W); the paper's -τ·q̇ would reward braking.

    Args:
      torque: (..., 12) N·m.
      joint_velocity: (..., 12) rad/s.
      literal: the paper's form.
    """
    power = torque * joint_velocity
    return -jnp.sum(power if literal else jnp.abs(power), axis=-1)


def terrain(
    stance: jax.Array, below: jax.Array, highest: jax.Array, threshold: float, *, graded: bool = False
) -> jax.Array:
    """r_terrain,i: a foot in stance is punished for gaps around it.

    The paper's cases are exchanged; its text says what is meant: -1 if the leg is in stance and
    max_j h_ij - min_j h_ij > H_thre, else 0.

    Args:
      stance: (L,) bool.
      below: (L, N) m, z_ij = foot height minus terrain height at the points that are looked at.
      highest: (L,) m, min_j z_ij over all P points: with the points that are looked at alone, a foot in the middle of a
        wide gap would be as good as one on the ground.
      threshold: H_thre (m).
      graded: minus the share of points more than H_thre below the highest one.

    Returns:
      (L,) in [-1, 0].
    """
    low = below - highest[:, None] > threshold
    punished = jnp.mean(low, axis=-1) if graded else jnp.any(low, axis=-1)
    return -jnp.where(stance, punished, 0.0)


def height(lift: jax.Array, rise: jax.Array, threshold: float) -> jax.Array:
    """r_height,i = -max(H + δh - ΔH - F_thre, 0).

    ΔH is taken as the rise that the foot has to clear, max(max_j h_ij - h at lift-off, 0), by the samples round the
    foot and round the place where it will come down: the paper's "height difference in the neighbouring environment"
    would be the depth of the pit on stepping stones.

    Args:
      lift: (L,) m, H + δh.
      rise: (L,) m, ΔH.
      threshold: F_thre (m).

    Returns:
      (L,) m.
    """
    return -jnp.maximum(lift - rise - threshold, 0.0)


def knee(clearance: jax.Array, margin: float) -> jax.Array:
    """How near the knees come to the terrain: 0 from the margin on, -1 where they hit it.

    Args:
      clearance: (L,) m, from the terrain below a knee.
      margin: m.

    Returns:
      (L,) in [-1, 0].
    """
    return -jnp.clip(1.0 - clearance / margin, 0.0, 1.0)


def smooth(desired: jax.Array, previous: jax.Array) -> jax.Array:
    """r_smooth = exp(-½ ‖q_t - q_{t-1}‖²), on the desired joint angles (12,) rad."""
    return jnp.exp(-0.5 * jnp.sum(jnp.square(desired - previous)))
