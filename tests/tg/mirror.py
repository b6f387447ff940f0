"""The mirror image in the x-z plane of what a robot measures and of what its controller remembers."""

import numpy as np

import tg

SWAP = [1, 0, 3, 2]
"""The legs' mirror images: LF <-> RF, LR <-> RR."""


def mirror_joints(q):
    """Joint angles (..., 12) of the mirror image in the x-z plane: sides swapped, abduction turned round."""
    legs = np.reshape(q, (*np.shape(q)[:-1], 4, 3))[..., SWAP, :] * [-1, 1, 1]
    return legs.reshape(np.shape(q))


def mirror_sensors(sensors):
    w, x, y, z = sensors.orientation
    return tg.Sensors(
        np.array([w, -x, y, -z]),
        sensors.angular_velocity * [-1, 1, -1],
        mirror_joints(sensors.joint_position),
        mirror_joints(sensors.joint_velocity),
    )


def mirror_state(state):
    """What the controller would remember had everything happened in the mirror."""
    actions = state.actions.copy()
    actions[:, 2:] = mirror_joints(actions[:, 2:])
    targets = (state.targets.reshape(2, 4, 3)[:, SWAP] * [1, -1, 1]).reshape(2, 12)
    return state._replace(
        phase=tg.path.wrap(state.phase + np.pi),
        lift=state.lift[SWAP],
        stride=state.stride * [1, -1],
        mirror=-state.mirror,
        actions=actions,
        targets=targets,
        desired=mirror_joints(state.desired),
        turn=-state.turn,
        velocity=state.velocity * [1, -1],
    )
