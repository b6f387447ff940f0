"""The substep for four legs: mass matrix and bias against MuJoCo C, everything against the substep by MJX."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

import tg
from envs import EnvConfig, RobotConfig, physics
from envs.dynamics import TreeDynamics, not_covered
from envs.env import check

BATCH = 32
TILTS = np.array([[0, 0, 1], [0.6, 0, 0.8]], np.float32)
"""Normals of the planes under every foot: level ground, and a slope that begins 2 cm lower."""


def make(name, num_planes=1, knees=0.0):
    """Model, record of the robot and the planes' ids; "random": every body turned and weighed in a way of its own."""
    config = RobotConfig("max" if name == "random" else name)
    model, robot = physics.physics_model(config, 0.005, num_planes, knees)
    if name == "random":
        rng = np.random.default_rng(5)
        turned = lambda n: rng.normal(0, 0.3, (n, 4)) + [1, 0, 0, 0]  # noqa: E731
        for quaternions in (model.body_quat, model.body_iquat):
            found = turned(12)
            quaternions[2:] = found / np.linalg.norm(found, axis=1, keepdims=True)
        model.body_ipos[1:] += rng.normal(0, 0.02, (13, 3))
        model.jnt_pos[1:] = rng.normal(0, 0.02, (12, 3))
        axes = model.jnt_axis[1:] + rng.normal(0, 0.3, (12, 3))
        model.jnt_axis[1:] = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        model.body_mass[1:] *= rng.uniform(0.5, 2, 13)
        model.body_inertia[1:] *= rng.uniform(0.5, 2, (13, 1))
        model.dof_armature[6:] *= rng.uniform(0.5, 2, 12)
        mujoco.mj_setConst(model, mujoco.MjData(model))
    return model, robot, physics.plane_ids(model, num_planes)


def states(standing, count=BATCH):
    """Poses (B, 19), velocities, last accelerations and forces (B, 18), payloads and frictions (B,).

    Standing, sliding and high up, a third each; a joint in four is beyond its limits.
    """
    rng = np.random.default_rng(0)
    qpos, qvel = np.tile(standing, (count, 1)), rng.normal(0, 1, (count, 18))
    qpos[:, :3] += rng.normal(0, [1, 1, 0.02], (count, 3))
    qpos[::3, 2] += 0.5
    qpos[:, 3:7] = [1, 0, 0, 0] + rng.normal(0, 0.15, (count, 4))
    qpos[:, 3:7] /= np.linalg.norm(qpos[:, 3:7], axis=1, keepdims=True)
    qpos[:, 7:] += rng.normal(0, 0.2, (count, 12)) + 2.0 * (rng.uniform(size=(count, 12)) < 0.25)
    others = rng.normal(0, 20, (count, 18)), rng.normal(0, 5, (count, 18))
    drawn = rng.uniform(-0.5, 1, count), rng.uniform(0.3, 1.2, count)
    return [np.asarray(a, np.float32) for a in (qpos, qvel, *others, *drawn)]


def slopes(num_planes):
    def contact(centre):
        normal = jnp.broadcast_to(TILTS[:num_planes], (len(centre), num_planes, 3))
        distance = jnp.sum(centre[:, None] * normal, axis=-1) + jnp.array([0.0, 0.02])[:num_planes]
        return distance, normal, centre[:, None] - distance[..., None] * normal

    return contact


def by_mjx(model, robot, planes, iterations):
    """The substep by MJX, of one environment."""
    device = mjx.put_model(model)
    empty = mjx.make_data(device)

    def one(qpos, qvel, warmstart, force, payload, friction):
        changed = device.replace(
            body_mass=device.body_mass.at[robot.trunk_id].add(payload),
            pair_friction=device.pair_friction.at[:, :2].set(friction),
        )
        data = empty.replace(qpos=qpos, qvel=qvel, qacc_warmstart=warmstart)
        contact = slopes(planes.shape[1])
        data = physics.substep(changed, data, planes, physics.sphere_ids(model), contact, force, iterations)
        return data.qpos, data.qvel, data.qacc_warmstart

    return one


def by_tree(model, robot, planes, iterations):
    """The same without MJX."""
    tree, contact = TreeDynamics(model, planes, physics.sphere_ids(model)), slopes(planes.shape[1])

    def one(qpos, qvel, warmstart, force, payload, friction):
        return tree.substep(qpos, qvel, warmstart, force, contact, iterations, payload, friction)

    return one


@pytest.mark.parametrize("name", ["max", pytest.param("go1_size", marks=pytest.mark.slow), "random"])
def test_mass_matrix_and_bias_are_mujocos(name):
    model, robot, planes = make(name)
    tree = TreeDynamics(model, planes, physics.sphere_ids(model))
    qpos, qvel, *_ = states(robot.standing_qpos, 8)
    matrix, bias = jax.tree.map(np.asarray, jax.jit(tree.smooth)(qpos.T, qvel.T))
    data, full = mujoco.MjData(model), np.zeros((18, 18))
    for i in range(8):
        data.qpos[:], data.qvel[:] = qpos[i], qvel[i]
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        turn = np.eye(18)
        turn[:3, :3] = data.xmat[robot.trunk_id].reshape(3, 3)
        expected, forces = turn.T @ full @ turn, turn.T @ data.qfrc_bias
        found = np.zeros((18, 18))
        found[:6, :6] = matrix.trunk[..., i]
        for leg in range(4):
            own = slice(6 + 3 * leg, 9 + 3 * leg)
            found[own, :6], found[own, own] = matrix.legs[:, :6, leg, i], matrix.legs[:, 6:, leg, i]
            found[:6, own] = found[own, :6].T
        np.testing.assert_allclose(found, expected, atol=1e-5)
        np.testing.assert_allclose(bias.trunk[:, i], forces[:6], atol=3e-4)
        np.testing.assert_allclose(bias.legs[:, :, i].T.reshape(-1), forces[6:], atol=3e-4)


@pytest.mark.parametrize(
    "name, num_planes, iterations, knees",
    [
        ("max", 1, EnvConfig().solver_iterations, 0.0),
        # So large that most of those that stand touch the ground.
        ("max", 1, EnvConfig().solver_iterations, 0.2),
        pytest.param("random", 2, 4, 0.0, marks=pytest.mark.slow),
        pytest.param("random", 2, 4, 0.12, marks=pytest.mark.slow),
        pytest.param("go1_size", 2, 1, 0.0, marks=pytest.mark.slow),
        pytest.param("max", 1, 1, 0.0, marks=pytest.mark.slow),
    ],
)
def test_a_substep_is_mjxs(name, num_planes, iterations, knees):
    model, robot, planes = make(name, num_planes, knees)
    given = states(robot.standing_qpos)
    ours, theirs = (
        jax.tree.map(np.asarray, jax.jit(jax.vmap(how(model, robot, planes, iterations)))(*given))
        for how in (by_tree, by_mjx)
    )
    # In double precision they agree to 5e-8. In single precision either is up to 3e-5 off where limits and contacts are
    # hit hard, and positions by 5 ms of such an error in speeds.
    for found, expected, tolerance in zip(ours, theirs, (5e-6, 5e-5, 1e-4), strict=True):
        assert np.isfinite(found).all()
        size = 1.0 + np.abs(expected).max(axis=1, keepdims=True)
        assert (np.abs(found - expected) / size).max() < tolerance


@pytest.mark.slow
def test_one_environment_is_one_of_many():
    model, robot, planes = make("max")
    one, given = by_tree(model, robot, planes, 2), states(robot.standing_qpos, 4)
    many = jax.jit(jax.vmap(one))(*given)
    single = jax.jit(one)(*(a[1] for a in given))
    for a, b in zip(many, single, strict=True):
        np.testing.assert_allclose(a[1], b, rtol=1e-4, atol=1e-4)


def test_what_isnt_covered_is_named():
    model, robot, planes = make("max")
    feet = robot.foot_geom_ids
    assert not_covered(model, planes, feet) == ""
    assert not_covered(make("go1_size", 2)[0], planes=np.zeros((4, 2)), spheres=feet + 4) == ""
    rubbing, _ = physics.physics_model(RobotConfig(joint_friction=0.5), 0.005, 1)
    assert not_covered(rubbing, planes, feet) == "joint friction"
    with pytest.raises(ValueError, match="joint friction"):
        TreeDynamics(rubbing, planes, feet)
    for change, name in (
        (lambda m: m.dof_damping.__setitem__(8, 0.1), "joint damping or springs"),
        (lambda m: setattr(m.opt, "cone", 1), "other options"),
        (lambda m: setattr(m.opt, "solver", 1), "another solver"),
        (lambda m: m.pair_friction.__setitem__((0, 0), 0.1), "friction that differs"),
    ):
        changed = make("max")[0]
        change(changed)
        assert not_covered(changed, planes, feet) == name


def test_unknown_dynamics():
    with pytest.raises(ValueError, match="unknown dynamics 'three'; choose one of tree, mjx"):
        check(EnvConfig(dynamics="three"))


@pytest.mark.parametrize(
    ("method", "settings", "message"),
    [
        ("blind", {"follow": False}, "tg.refine=0.015 needs heights; set it to 0 with method=blind"),
        ("ours", {}, "tg.refine=0.015 needs tg.look_ahead=true and tg.follow=false"),
        ("ours", {"look_ahead": False, "follow": False}, "tg.refine=0.015 needs tg.look_ahead=true"),
    ],
)
def test_refining_needs_heights_round_the_ends_of_steps(method, settings, message):
    check(EnvConfig(tg=tg.TGConfig(refine=0.015, follow=False)))
    with pytest.raises(ValueError, match=message):
        check(EnvConfig(method=method, tg=tg.TGConfig(refine=0.015, **settings)))


def test_gaits_that_cannot_be():
    for gait, share, message in [
        ("pace", 0.5, "unknown gait 'pace'; choose one of trot, walk"),
        ("walk", 0.5, "tg.swing_share=0.5 must be at most 0.24 with tg.gait=walk"),
    ]:
        with pytest.raises(ValueError, match=message):
            check(EnvConfig(tg=tg.TGConfig(gait=gait, swing_share=share)))
