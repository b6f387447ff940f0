"""The substep against MJX's own step and against MuJoCo C, for the whole robot."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import mjx

from envs import EVALUATION_ITERATIONS, EnvConfig, RobotConfig, physics
from envs.config import DYNAMICS
from envs.dynamics import TreeDynamics
from envs.robot import ROBOTS, make_robot
from envs.scene import build_scene

MAX = RobotConfig()
STEPS = 40


def ground(num_planes, centre):
    """Level ground at z = 0 under feet (L, 3)."""
    normal = jnp.zeros_like(centre).at[:, 2].set(1.0)
    point = centre * jnp.array([1.0, 1.0, 0.0])
    tiled = [jnp.repeat(a[:, None], num_planes, axis=1) for a in (centre[:, 2:], normal, point)]
    return tiled[0][..., 0], tiled[1], tiled[2]


class Rig:
    """The robot on level ground under PD control."""

    def __init__(self):
        self.host, self.robot = physics.physics_model(MAX, 0.005, 1)
        self.model = mjx.put_model(self.host)
        self.empty = mjx.make_data(self.model)
        self.planes = physics.plane_ids(self.host, 1)
        self.tree = TreeDynamics(self.host, self.planes, self.robot.foot_geom_ids)
        self.settled = physics.settle(self.host, self.robot, self.robot.default_pose)

    def torque(self, qpos, qvel):
        limit = self.robot.torque_limit
        error = self.robot.default_pose - qpos[7:]
        return jnp.clip(MAX.kp * error - MAX.kd * qvel[6:], -limit, limit)

    def advance(self, data, force, iterations):
        contact, feet = functools.partial(ground, 1), self.robot.foot_geom_ids
        return physics.substep(self.model, data, self.planes, feet, contact, force, iterations)

    def run(self, iterations, dynamics, qpos, qvel):
        """(T, 19) and (T, 18)."""

        def by_tree(now, _):
            qpos, qvel, warmstart = now
            force = jnp.concatenate([jnp.zeros(6), self.torque(qpos, qvel)])
            now = self.tree.substep(qpos, qvel, warmstart, force, functools.partial(ground, 1), iterations)
            return now, now[:2]

        if dynamics == "tree":
            return jax.lax.scan(by_tree, (qpos, qvel, jnp.zeros(18)), length=STEPS)[1]

        def one(data, _):
            force = jnp.concatenate([jnp.zeros(6), self.torque(data.qpos, data.qvel)])
            data = self.advance(data, force, iterations)
            return data, (data.qpos, data.qvel)

        return jax.lax.scan(one, self.empty.replace(qpos=qpos, qvel=qvel), length=STEPS)[1]


@pytest.fixture(scope="module")
def rig():
    return Rig()


def starts(settled):
    """Standing, dropped level, dropped askew, and shoved."""
    qpos, qvel = np.tile(settled, (4, 1)), np.zeros((4, 18))
    qpos[1, 2] += 0.03
    qpos[2, 2] += 0.05
    qpos[2, 3:7] = np.array([1.0, 0.08, 0.05, 0.0]) / np.linalg.norm([1.0, 0.08, 0.05])
    qvel[3, :2] = 0.3, 0.2
    return qpos.astype(np.float32), qvel.astype(np.float32)


def mujoco_runs(rig, qpos, qvel):
    """The same by MuJoCo C with a plane and motors, iterated until it has converged."""
    model = build_scene(MAX, timestep=0.005, iterations=100)
    data = mujoco.MjData(model)
    found = []
    for q, v in zip(qpos, qvel, strict=True):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = q, v
        run = []
        for _ in range(STEPS):
            data.ctrl[:] = rig.torque(data.qpos, data.qvel)
            mujoco.mj_step(model, data)
            run.append(np.concatenate([data.qpos, data.qvel]))
        found.append(run)
    return np.array(found)


@pytest.mark.parametrize("dynamics", DYNAMICS)
@pytest.mark.parametrize(
    "iterations, position, speed",
    [
        # Standing, dropped level, dropped askew, shoved: largest deviation of the trunk within 0.2 s, m and m/s.
        (EVALUATION_ITERATIONS, [1e-4, 1e-4, 2e-4, 1e-4], [1e-3, 2e-3, 5e-3, 2e-3]),
        pytest.param(
            EnvConfig().solver_iterations,
            [2e-4, 2e-3, 4e-3, 2e-3],
            [0.005, 0.1, 0.1, 0.05],
            marks=pytest.mark.slow,
        ),
    ],
)
def test_the_robot_moves_as_in_mujoco(rig, dynamics, iterations, position, speed):
    qpos, qvel = starts(rig.settled)
    run = jax.jit(jax.vmap(functools.partial(rig.run, iterations, dynamics)))
    q, v = (np.asarray(part, np.float64) for part in run(qpos, qvel))
    reference = mujoco_runs(rig, qpos, qvel)
    away = np.linalg.norm(q[..., :3] - reference[..., :3], axis=-1).max(axis=1)
    faster = np.linalg.norm(v[..., :3] - reference[..., 19:22], axis=-1).max(axis=1)
    assert (away < position).all(), away
    assert (faster < speed).all(), faster


@pytest.mark.slow
def test_substep_is_mjxs_step(rig):
    """On level ground the planes lie where the model has them: the same functions on the same numbers."""
    qpos, qvel = starts(rig.settled)
    force = jnp.asarray(np.random.default_rng(0).normal(0, 3, 18) * (np.arange(18) > 5), jnp.float32)

    @jax.jit
    def both(qpos, qvel):
        data = rig.empty.replace(qpos=qpos, qvel=qvel)
        return rig.advance(data, force, 1), mjx.step(rig.model, data.replace(qfrc_applied=force))

    for q, v in zip(qpos, qvel, strict=True):
        ours, theirs = both(q, v)
        np.testing.assert_allclose(ours.qpos, theirs.qpos, atol=1e-6)
        np.testing.assert_allclose(ours.qvel, theirs.qvel, atol=2e-5)
        np.testing.assert_allclose(ours.qacc_warmstart, theirs.qacc_warmstart, atol=5e-3)


def test_frame_is_a_rotation_onto_the_normal():
    normal = np.random.default_rng(0).normal(size=(500, 3))
    normal[:, 2] = np.abs(normal[:, 2])
    normal[:100, 2] = 0.0  # risers
    normal[0], normal[1] = [0, 0, 1], [-1, 0, 0]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    found = np.asarray(physics.frame(jnp.asarray(normal, jnp.float32)))
    np.testing.assert_allclose(found[:, :, 2], normal, atol=1e-6)
    np.testing.assert_allclose(found.transpose(0, 2, 1) @ found, np.tile(np.eye(3), (500, 1, 1)), atol=2e-6)
    np.testing.assert_allclose(np.linalg.det(found), 1.0, atol=1e-5)
    np.testing.assert_array_equal(found[0], np.eye(3))


@pytest.mark.parametrize("num_planes", [1, 2])
@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_only_feet_touch_and_only_their_own_planes(name, num_planes):
    model, robot = physics.physics_model(RobotConfig(name=name), 0.005, num_planes)
    planes = physics.plane_ids(model, num_planes)
    assert planes.shape == (4, num_planes)
    assert model.nu == 0 and model.npair == 4 * num_planes
    pairs = {(int(a), int(b)) for a, b in zip(model.pair_geom1, model.pair_geom2, strict=True)}
    assert pairs == {
        (p, int(f)) for f, row in zip(robot.foot_geom_ids, planes.tolist(), strict=True) for p in row
    }
    assert not (model.geom_contype[planes] | model.geom_conaffinity[planes]).any()
    assert not model.geom_contype.any()  # no other two geoms are tested
    np.testing.assert_allclose(model.pair_friction[:, :2], robot.config.foot_friction)


@pytest.mark.parametrize("name", sorted(ROBOTS))
def test_settled_robot_stays_where_it_is(name):
    config = RobotConfig(name=name)
    robot = make_robot(config)
    found = []
    for num_planes in (1, 2):
        model, _ = physics.physics_model(config, 0.005, num_planes)
        found.append(physics.settle(model, robot, robot.default_pose))
    # The number of planes that a foot may touch on a terrain doesn't change the stand.
    np.testing.assert_allclose(found[0], found[1], atol=1e-6)
    qpos = found[0]
    assert not qpos[:2].any() and qpos[4] == qpos[6] == 0.0
    assert np.linalg.norm(qpos[3:7]) == pytest.approx(1.0)
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    for _ in range(100):
        data.qfrc_applied[6:] = config.kp * (robot.default_pose - data.qpos[7:]) - config.kd * data.qvel[6:]
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qpos[2:], qpos[2:], atol=6e-3)
    assert np.abs(data.qvel).max() < 0.02
