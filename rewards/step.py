"""All reward terms of one control step. L = 4 legs, P = 25 sample points a foot, N of them within `terrain_ring`."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rewards.config import RewardConfig
from rewards.terms import across, along, height, smooth, standing, terrain

Array = Any
"""Of JAX, or what JAX takes for one."""


class Step(NamedTuple):
    """What a control step has led to."""

    velocity: Array
    """(2,) m/s of the trunk, horizontal, world."""
    angular_velocity: Array
    """(3,) rad/s of the trunk, trunk frame."""
    command: Array
    """(2,) unit vector in the world, or 0 to stand."""
    desired: Array
    """(12,) rad, desired joint angles."""
    previous: Array
    """(12,) rad, those of the step before."""
    energy: Array
    """() W, r_tau."""
    swing: Array
    """(L,) bool, by the trajectory generator's phase, and none when the robot stands."""
    near: Array
    """(L, N) m, z_ij = foot height minus terrain height at the points that r_terrain looks at."""
    highest: Array
    """(L,) m, min_j z_ij over all P points."""
    lift: Array
    """(L,) m, H + δh."""
    rise: Array
    """(L,) m, ΔH."""
    drift: Array
    """() rad, heading since the start."""


def step_terms(c: RewardConfig, s: Step) -> dict[str, jax.Array]:
    """Every term () but `aim`, unweighted, by name."""
    walking = jnp.sum(jnp.square(s.command)) > 0.5
    speed = along(s.velocity @ s.command, c.speed_low, c.speed_high, literal=c.literal)
    gaps = terrain(~s.swing, s.near, s.highest, c.gap_threshold, graded=c.terrain_graded)
    lifted = height(s.lift, s.rise, c.lift_threshold)
    return {
        "along": jnp.where(walking, speed, standing(s.velocity, c.speed_low)),
        "across": across(s.velocity, s.command),
        "smooth": smooth(s.desired, s.previous),
        "energy": s.energy,
        "terrain": jnp.mean(gaps),
        "height": jnp.mean(jnp.where(s.swing, lifted, 0.0)),
        "yaw": -jnp.square(s.angular_velocity[2]),
        "heading": jnp.cos(s.drift) - 1.0,
        "tilt": -0.1 * jnp.sum(jnp.square(s.angular_velocity[:2])),
    }
