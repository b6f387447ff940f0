"""Frames: world, heading (the trunk's yaw only, at the trunk's centre) and trunk."""

from typing import Any

from tg.arrays import stack

Array = Any


def rotation(quaternion: Array) -> Array:
    """Rotation matrix (..., 3, 3), world from trunk, of a unit quaternion (..., 4) in the order w, x, y, z."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return stack([stack(row) for row in rows], axis=-2)


def up_in_trunk(quaternion: Array) -> Array:
    """The world's up direction (..., 3) in the trunk's frame: roll and pitch, but no yaw."""
    w, x, y, z = (quaternion[..., i] for i in range(4))
    return stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)])


def yaw(quaternion: Array) -> Array:
    """Heading (...) rad of the trunk in the world."""
    xp = quaternion.__array_namespace__()
    w, x, y, z = (quaternion[..., i] for i in range(4))
    return xp.arctan2(2 * (x * y + w * z), 1 - 2 * (y * y + z * z))


def yaw_rate(up: Array, angular_velocity: Array) -> Array:
    """Rate (...) rad/s at which the heading turns.

    Args:
      up: (..., 3) the world's up direction in the trunk's frame.
      angular_velocity: (..., 3) rad/s, trunk frame.
    """
    xp = up.__array_namespace__()
    # (ω_y sin roll + ω_z cos roll) / cos pitch
    across = up[..., 1] * angular_velocity[..., 1] + up[..., 2] * angular_velocity[..., 2]
    return across / xp.maximum(1.0 - up[..., 0] ** 2, 0.1 + 0.0 * across)


def heading_from_trunk(up: Array) -> Array:
    """Rotation (..., 3, 3) that turns vectors of the trunk's frame into the heading frame, from roll and pitch.

    Args:
      up: (..., 3) the world's up direction in the trunk's frame.
    """
    xp = up.__array_namespace__()
    # Rows of R_y(pitch) R_x(roll): heading x is the trunk's x made horizontal, heading z is up.
    cos_pitch = xp.sqrt(xp.maximum(1.0 - up[..., 0] ** 2, 1e-6 + 0.0 * up[..., 0]))
    cos_roll, sin_roll = up[..., 2] / cos_pitch, up[..., 1] / cos_pitch
    sin_pitch = -up[..., 0]
    zero = 0.0 * cos_pitch
    forward = stack([cos_pitch, sin_pitch * sin_roll, sin_pitch * cos_roll])
    left = stack([zero, cos_roll, -sin_roll])
    return stack([forward, left, up], axis=-2)


def turn(angle: Array, vector: Array) -> Array:
    """A vector (..., 2) turned by an angle (...) rad, counter-clockwise."""
    xp = vector.__array_namespace__()
    cos, sin = xp.cos(angle), xp.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return stack([cos * x - sin * y, sin * x + cos * y])
