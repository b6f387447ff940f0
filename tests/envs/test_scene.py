"""A robot on true geometry in MuJoCo C: what touches, with which friction, and what is only drawn."""

import mujoco
import numpy as np
import pytest

import terrains
from envs.robot import RobotConfig, read_robot
from envs.scene import build_scene, drawn_pieces, near

CONFIG = RobotConfig()


def stand(model, seconds=1.0):
    """Data after the robot has held its default pose for a while."""
    robot, data = read_robot(model, CONFIG), mujoco.MjData(model)
    data.qpos[:] = robot.standing_qpos
    for _ in range(round(seconds / model.opt.timestep)):
        error = robot.default_pose - data.qpos[robot.qpos_ids]
        data.ctrl[robot.motor_ids] = CONFIG.kp * error - CONFIG.kd * data.qvel[robot.dof_ids]
        mujoco.mj_step(model, data)
    return robot, data


@pytest.mark.parametrize("kind", [None, "blocks", "stairs", "stepping_stones", "poles", "gaps"])
def test_stands_on_the_platform_of_every_terrain(kind):
    terrain = None if kind is None else terrains.make_terrain(kind, "paper", seed=3)
    model = build_scene(CONFIG, terrain)
    robot, data = stand(model)
    touching = {int(i) for contact in data.contact for i in contact.geom}
    assert touching & set(robot.foot_geom_ids) == set(robot.foot_geom_ids)
    assert all(contact.friction[0] == CONFIG.foot_friction for contact in data.contact)
    np.testing.assert_allclose(data.geom_xpos[robot.foot_geom_ids, 2], robot.foot_radius, atol=0.003)
    assert model.opt.timestep == 0.002


def test_legs_that_touch_push_the_ground():
    """Thighs and shanks collide with it at the feet's friction, with nothing else, and only if asked to."""
    bare, limbs, touching = (build_scene(CONFIG, **how) for how in ({}, {"limbs": True}, {"touch": True}))
    assert limbs.ngeom == touching.ngeom == bare.ngeom + 8
    assert (limbs.geom_conaffinity > 0).sum() == (bare.geom_conaffinity > 0).sum()
    legs = np.flatnonzero(
        (touching.geom_conaffinity > 0) & (touching.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE)
    )
    assert len(legs) == 8 and not touching.geom_contype[legs].any()
    np.testing.assert_allclose(touching.geom_friction[legs, 0], CONFIG.foot_friction)
    np.testing.assert_array_equal(touching.body_mass, bare.body_mass)
    robot, data = stand(touching, 0.2)
    _, plain = stand(bare, 0.2)
    np.testing.assert_allclose(data.qpos, plain.qpos, atol=1e-9)


def test_look_leaves_the_motion_as_it_is():
    terrain = terrains.make_terrain("poles", "paper", seed=3)
    _, plain = stand(build_scene(CONFIG, terrain), 0.2)
    _, dressed = stand(build_scene(CONFIG, terrain, look=True), 0.2)
    np.testing.assert_array_equal(plain.qpos, dressed.qpos)


def test_path_limits_what_is_drawn_and_not_what_is_solid():
    terrain = terrains.make_terrain("poles", "paper", seed=3)
    whole = build_scene(CONFIG, terrain, look=True)
    part = build_scene(CONFIG, terrain, look=True, path=np.zeros((1, 2)), reach=1.0)
    solid = len(terrain.primitives) + 1 + 4
    assert np.sum(whole.geom_contype | whole.geom_conaffinity) == solid
    assert np.sum(part.geom_contype | part.geom_conaffinity) == solid
    assert part.ngeom < whole.ngeom - 1000


def test_near_measures_to_the_edge():
    # Edges 0.5 m (box) and 0.4 m (cylinder) from the origin, and nearer ones from the second point.
    rows = np.array(
        [[1.0, 0.0, 0.5, 0.2, 0.0, 0.0], [0.0, 0.5, 0.0, 0.0, 0.1, 0.0], [3.0, 0.0, 0.5, 0.5, 0.0, 0.0]]
    )
    np.testing.assert_array_equal(near(rows, np.zeros((1, 2)), 0.45), [False, True, False])
    np.testing.assert_array_equal(near(rows, np.array([[0.0, 0.0], [2.2, 0.0]]), 0.72), [True, True, True])


@pytest.mark.parametrize("kind", ["stairs", "blocks", "gaps", "poles"])
def test_drawn_pieces_are_the_same_solid_without_overlap(kind):
    terrain = terrains.make_terrain(kind, "paper", seed=3)
    rows = np.asarray(terrain.primitives, float)
    pieces = drawn_pieces(rows)
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (400, 2))
    tops = []
    for x, y in points:
        inside = terrains.footprint_distance(pieces, x, y) < -1e-7
        assert inside.sum() <= 1
        tops.append(max(pieces[inside, 5], default=terrain.floor))
    np.testing.assert_allclose(tops, terrains.exact_height(terrain, points), atol=1e-6)
    boxes = pieces[pieces[:, 4] == 0]
    assert boxes[:, 2:4].max(initial=0) <= 0.25 + 1e-6
