"""Leg kinematics against the compiled MuJoCo models of both robots."""

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tg
from tests.tg.robots import SUBJECTS

names = st.sampled_from(sorted(SUBJECTS))


def legs(*ranges):
    """Canonical angles (4, 3), each joint within its range."""
    one = st.tuples(*(st.floats(low, high) for low, high in ranges))
    return st.lists(one, min_size=4, max_size=4).map(np.array)


anywhere = legs((-0.8, 0.8), (-2.0, 2.0), (-2.4, 2.4))
knee_back = legs((-0.8, 0.8), (-1.2, 0.4), (0.02, 2.4))


@given(names, anywhere)
def test_forward_is_where_mujoco_has_the_feet(name, canonical):
    subject = SUBJECTS[name]
    q = canonical * subject.geometry.sign
    found = subject.geometry.hip_position + tg.leg.forward(subject.geometry, q)
    expected = subject.place(q).site_xpos[subject.robot.foot_site_ids]
    np.testing.assert_allclose(found, expected, atol=1e-7)


@given(names, knee_back)
def test_inverse_undoes_forward(name, canonical):
    geometry = SUBJECTS[name].geometry
    below = geometry.thigh * np.cos(canonical[:, 1]) + geometry.shank * np.cos(canonical[:, 1:].sum(axis=1))
    q = np.where(below[:, None] > 0.03, canonical, [0.1, -0.5, 1.0]) * geometry.sign
    found = tg.leg.inverse(geometry, tg.leg.forward(geometry, q))
    np.testing.assert_allclose(found, q, atol=1e-6)


@given(names, legs((-0.15, 0.15), (-0.1, 0.1), (-0.38, -0.2)))
def test_forward_undoes_inverse_within_reach(name, foot):
    geometry = SUBJECTS[name].geometry
    foot = foot + np.stack([0 * geometry.offset, geometry.offset, 0 * geometry.offset], axis=-1)
    found = tg.leg.forward(geometry, tg.leg.inverse(geometry, foot))
    np.testing.assert_allclose(found, foot, atol=1e-9)


@given(names, legs((-3.0, 3.0), (-3.0, 3.0), (-3.0, 3.0)))
def test_inverse_is_finite_everywhere(name, foot):
    geometry = SUBJECTS[name].geometry
    for dtype in (np.float64, np.float32):
        single = type(geometry)(*(part.astype(dtype) for part in geometry))
        q = tg.leg.inverse(single, foot.astype(dtype))
        assert q.dtype == dtype and np.isfinite(q).all()
        assert np.abs(q).max() < 2 * np.pi + 1e-3


@pytest.mark.parametrize("scale", [1.01, 2.0, 100.0])
def test_out_of_reach_the_stretched_leg_points_at_the_target(subject, scale):
    """Foot targets straight in line from the hip joint, further away than thigh and shank are long."""
    geometry = subject.geometry
    length = scale * (geometry.thigh + geometry.shank)
    angle = 0.4
    hip = np.stack([0 * length, geometry.offset, 0 * length], axis=-1)
    foot = hip + length[:, None] * [np.sin(angle), 0.0, -np.cos(angle)]
    q = tg.leg.inverse(geometry, foot)
    np.testing.assert_allclose(q * geometry.sign, np.tile([0.0, angle, 0.0], (4, 1)), atol=1e-6)


def test_a_foot_inside_the_hip_offset_folds_the_leg(subject):
    """At the abduction joint itself no leg is: the knee folds as far as it goes, all angles are finite."""
    q = tg.leg.inverse(subject.geometry, np.zeros((4, 3))) * subject.geometry.sign
    assert np.isfinite(q).all() and (q[:, 2] > 2.5).all()


def test_base_position_is_the_default_pose(subject):
    core = subject.core
    np.testing.assert_allclose(
        tg.leg.inverse(core.geometry, core.base_foot).reshape(-1), core.default_pose, atol=1e-6
    )


@given(names, anywhere, st.lists(st.floats(0, 100), min_size=4, max_size=4).map(np.array))
def test_support_torque_is_the_jacobians(name, canonical, load):
    """τ = -Jᵀ F with MuJoCo's Jacobian of the foot's site and F = (0, 0, load)."""
    subject = SUBJECTS[name]
    q = canonical * subject.geometry.sign
    data = subject.place(q)
    found = tg.leg.support_torque(subject.geometry, q, load)
    jacobian = np.zeros((3, subject.model.nv))
    for leg in range(4):
        mujoco.mj_jacSite(subject.model, data, jacobian, None, subject.robot.foot_site_ids[leg])
        joints = subject.robot.dof_ids[3 * leg : 3 * leg + 3]
        np.testing.assert_allclose(found[leg], -load[leg] * jacobian[2, joints], atol=1e-5)


def test_support_torque_is_the_slope_of_the_height(subject):
    """Halving the step of a central difference quarters its error."""
    q = np.tile([0.2, -0.7, 1.5], (4, 1)) * subject.geometry.sign
    exact = -tg.leg.support_torque(subject.geometry, q, np.ones(4))
    errors = []
    for step in (0.02, 0.01):
        slope = np.zeros((4, 3))
        for joint in range(3):
            change = np.zeros(3)
            change[joint] = step
            up, down = (tg.leg.forward(subject.geometry, q + s * change)[:, 2] for s in (1, -1))
            slope[:, joint] = (up - down) / (2 * step)
        errors.append(np.abs(slope - exact).max())
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.01)
