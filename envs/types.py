"""What an episode consists of. Letters: L = 4 legs, J = 12 joints."""

import flax
import jax

from tg import ControllerState


class Randomised(flax.struct.PyTreeNode):
    """Parameters drawn once an episode."""

    friction: jax.Array
    """() between foot and terrain."""
    payload: jax.Array
    """() kg on the trunk."""
    kp_factor: jax.Array
    """()"""
    kd_factor: jax.Array
    """()"""
    latency: jax.Array
    """() int32, physics substeps."""
    map_offset: jax.Array
    """(3,) m, error of the perceived map."""


class Episode(flax.struct.PyTreeNode):
    """Everything that belongs to an episode: a reset replaces all of it."""

    qpos: jax.Array
    """(19,) trunk position (m) and quaternion w x y z, joint angles (rad)."""
    qvel: jax.Array
    """(18,) trunk linear (world, m/s) and angular (trunk, rad/s) velocity, joint speeds (rad/s)."""
    warmstart: jax.Array
    """(18,) the constraint solver's last accelerations."""
    torque: jax.Array
    """(12,) N·m, of the last substep."""
    controller: ControllerState
    """Phase, histories, last targets."""
    terrain: jax.Array
    """() int32, instance in the bank."""
    level: jax.Array
    """() int32, level of the ladder that this episode is on."""
    practice: jax.Array
    """() bool, whether footholds are practised above shallow pits."""
    floor: jax.Array
    """() m, how deep the feet can fall."""
    command: jax.Array
    """(2,) unit vector in the world, or 0 to stand."""
    stop: jax.Array
    """(2,) int32, control steps from and to which the robot is told to stand, whatever the command."""
    origin: jax.Array
    """(2,) m, where the robot started."""
    heading: jax.Array
    """() rad, yaw at the start."""
    progress: jax.Array
    """() m, largest progress along the command so far."""
    lift_off: jax.Array
    """(L,) m, terrain height below each foot when it last stood."""
    step: jax.Array
    """() int32, control steps so far."""
    randomised: Randomised
    """What was drawn for this episode."""
    key: jax.Array
    """Random key of the next step."""
