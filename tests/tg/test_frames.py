"""Frames against MuJoCo's rotations."""

import mujoco
import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from tg import frames

quaternions = (
    st.lists(st.floats(-1, 1), min_size=4, max_size=4)
    .map(np.array)
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)
turns = st.floats(-np.pi, np.pi)


def about_z(angle):
    return np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])


def mujoco_rotation(quaternion):
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion)
    return matrix.reshape(3, 3)


def times(a, b):
    product = np.zeros(4)
    mujoco.mju_mulQuat(product, a, b)
    return product


@given(quaternions)
def test_rotation_is_mujocos(quaternion):
    np.testing.assert_allclose(frames.rotation(quaternion), mujoco_rotation(quaternion), atol=1e-12)
    np.testing.assert_allclose(frames.up_in_trunk(quaternion), mujoco_rotation(quaternion)[2], atol=1e-12)


@given(quaternions)
def test_world_from_heading_from_trunk(quaternion):
    """R = R_z(yaw) R_heading: the heading frame has the trunk's yaw and nothing of its roll and pitch."""
    up = frames.up_in_trunk(quaternion)
    assume(abs(up[0]) < 0.99)  # not nose up
    world_from_heading = about_z(frames.yaw(quaternion))
    found = world_from_heading @ frames.heading_from_trunk(up)
    np.testing.assert_allclose(found, mujoco_rotation(quaternion), atol=1e-6)


@given(quaternions, turns)
def test_up_knows_no_yaw_and_yaw_adds_up(quaternion, angle):
    assume(abs(frames.up_in_trunk(quaternion)[0]) < 0.99)
    turned = times(np.array([np.cos(angle / 2), 0, 0, np.sin(angle / 2)]), quaternion)
    np.testing.assert_allclose(frames.up_in_trunk(turned), frames.up_in_trunk(quaternion), atol=1e-12)
    added = frames.yaw(turned) - frames.yaw(quaternion) - angle
    np.testing.assert_allclose([np.cos(added), np.sin(added)], [1, 0], atol=1e-6)


def test_heading_is_finite_nose_up():
    for up in ([1.0, 0, 0], [-1.0, 0, 0], [1.0, 1e-4, 0]):
        assert np.isfinite(frames.heading_from_trunk(np.array(up))).all()


@given(turns, turns, st.floats(-2, 2), st.floats(-2, 2))
def test_turns_are_a_group(a, b, x, y):
    vector = np.array([x, y])
    both = frames.turn(np.asarray(a), frames.turn(np.asarray(b), vector))
    np.testing.assert_allclose(frames.turn(np.asarray(a + b), vector), both, atol=1e-12)
    np.testing.assert_allclose(frames.turn(np.asarray(a), vector), about_z(a)[:2, :2] @ vector, atol=1e-12)


def test_batches():
    quaternion = np.random.default_rng(0).normal(size=(5, 3, 4))
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    together = frames.heading_from_trunk(frames.up_in_trunk(quaternion))
    assert together.shape == frames.rotation(quaternion).shape == (5, 3, 3, 3)
    alone = frames.heading_from_trunk(frames.up_in_trunk(quaternion[2, 1]))
    np.testing.assert_allclose(together[2, 1], alone, atol=1e-12)


@given(quaternions, st.lists(st.floats(-3, 3), min_size=3, max_size=3).map(np.array))
def test_yaw_rate_is_the_yaws_derivative(quaternion, velocity):
    assume(abs(mujoco_rotation(quaternion)[2, 0]) < 0.9)
    h = 1e-6
    after, before = quaternion.copy(), quaternion.copy()
    mujoco.mju_quatIntegrate(after, velocity, h)
    mujoco.mju_quatIntegrate(before, velocity, -h)
    change = np.angle(np.exp(1j * (frames.yaw(after) - frames.yaw(before)))) / (2 * h)
    np.testing.assert_allclose(frames.yaw_rate(frames.up_in_trunk(quaternion), velocity), change, atol=1e-4)
