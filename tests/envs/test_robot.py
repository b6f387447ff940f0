"""The robots against their published figures, read from the compiled model."""

import dataclasses
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from envs.robot import ROBOTS, RobotConfig, make_robot, read_robot, robot_spec
from envs.robots.from_file import ModelFile
from envs.robots.quadruped import LEGS

MAX = RobotConfig()
MIRROR = [1, 0, 3, 2]  # LF <-> RF, LR <-> RR


@pytest.fixture(params=sorted(ROBOTS))
def config(request):
    return RobotConfig(name=request.param)


@pytest.fixture(scope="module")
def max_model():
    return robot_spec(MAX).compile()


def standing(config, *, iterations=None, seconds=2.0, timestep=0.005):
    """The robot after standing on a plane under its own PD controller."""
    spec = robot_spec(config)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 0.05))
    spec.option.timestep = timestep
    if iterations is not None:
        spec.option.iterations = iterations
    model = spec.compile()
    robot = read_robot(model, config)
    data = mujoco.MjData(model)
    data.qpos[:] = robot.standing_qpos
    for _ in range(round(seconds / timestep)):
        error = robot.default_pose - data.qpos[robot.qpos_ids]
        data.ctrl[robot.motor_ids] = config.kp * error - config.kd * data.qvel[robot.dof_ids]
        mujoco.mj_step(model, data)
    return model, robot, data


# Figures of Max ---------------------------------------------------------------------------------------------


def test_masses(max_model):
    expected = {"trunk": 5.76855}
    for leg in LEGS:
        front = leg[1] == "F"
        expected[f"{leg}_abduction"] = 0.60318
        expected[f"{leg}_thigh"] = 0.87783 + 0.06293 if front else 0.89043 + 0.120  # thigh and knee wheel
        expected[f"{leg}_shank"] = 0.16888 if front else 0.28839
    masses = {max_model.body(i).name: max_model.body_mass[i] for i in range(1, max_model.nbody)}
    assert masses == pytest.approx(expected)
    assert make_robot(MAX).mass == pytest.approx(13.0, abs=0.01)


@pytest.mark.parametrize(
    "body, com",
    [
        ("trunk", (-0.00458, 0.00307, 0.00948)),
        ("LF_abduction", (-0.00287, -0.00035, -0.00047)),
        ("RR_abduction", (0.00287, 0.00035, -0.00047)),
        # (0.87783 * -0.02582 + 0.06293 * 0.0355) / 0.94076 = -0.021718; mirrored on the right.
        ("LF_thigh", (-0.000653, -0.021718, -0.039668)),
        ("RF_thigh", (-0.000653, 0.021718, -0.039668)),
        ("LR_shank", (0.00171, 0.0, -0.08671)),
    ],
)
def test_centre_of_mass(max_model, body, com):
    np.testing.assert_allclose(max_model.body(body).ipos, com, atol=1e-6)


def test_principal_inertia(max_model):
    trunk = np.array(
        [[0.0478275, 0.000562, 0.000155], [0.000562, 0.105776, 0.000541], [0.000155, 0.000541, 0.121012]]
    )
    np.testing.assert_allclose(np.sort(max_model.body("trunk").inertia), np.linalg.eigvalsh(trunk), rtol=1e-5)
    front = np.sort(max_model.body("LF_shank").inertia)
    np.testing.assert_allclose(front, np.sort([0.00151605, 0.00153030, 0.00003410]), rtol=1e-6)


@pytest.mark.parametrize("leg", LEGS)
def test_thigh_carries_its_knee_wheel(max_model, leg):
    """Moment about the hip axis: thigh's own, and both masses at their distances."""
    front = leg[1] == "F"
    own, mass, (x, z) = (
        (0.00369602, 0.87783, (-0.00070, -0.02735)) if front else (0.00417229, 0.89043, (-0.00077, -0.02560))
    )
    expected = own + mass * (x**2 + z**2) + (0.06293 if front else 0.120) * 0.2115**2
    body = max_model.body(f"{leg}_thigh")
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, body.iquat)
    about_com = rotation.reshape(3, 3) @ np.diag(body.inertia) @ rotation.reshape(3, 3).T
    about_hip = about_com[1, 1] + body.mass[0] * (body.ipos[0] ** 2 + body.ipos[2] ** 2)
    assert about_hip == pytest.approx(expected, rel=1e-5)


def test_knee_inertia_includes_the_armature(max_model):
    """Front shank about its knee: 0.0015303 + 0.16888 * (0.00155^2 + 0.12442^2) = 0.004145, and the
    rotor's."""
    robot = make_robot(MAX)
    mass = leg_mass_matrix(max_model, robot, robot.default_pose)
    assert mass[0, 2, 0, 2] == pytest.approx(0.004145 + MAX.armature, abs=1e-6)


def test_limits_and_axes():
    robot = make_robot(MAX)
    lower, upper = robot.joint_lower.reshape(4, 3), robot.joint_upper.reshape(4, 3)
    np.testing.assert_allclose(lower[0], [-0.697, -4.3633, -2.4496])
    np.testing.assert_allclose(upper[0], [0.872, 1.2217, 2.5440])
    np.testing.assert_allclose(lower[3], [-0.872, -4.3633, -2.3995])
    np.testing.assert_allclose(upper[3], [0.697, 1.2217, 2.5855])
    np.testing.assert_array_equal(robot.axis_sign, np.tile([1, -1, -1], (4, 1)))
    np.testing.assert_array_equal(robot.torque_limit, np.full(12, 18.0))
    np.testing.assert_array_equal(robot.speed_limit, np.tile([20.0, 20.0, 33.0], 4))


@pytest.mark.parametrize("leg, lift", [(0, 0.144), (2, 0.153)])
def test_knee_limit_bounds_the_lift(leg, lift):
    """Law of cosines at the knee's upper limit: the foot comes no nearer to its hip than this."""
    robot = make_robot(MAX)
    a, b, knee = robot.thigh[leg], robot.shank[leg], robot.joint_upper[3 * leg + 2]
    shortest = np.sqrt(a**2 + b**2 + 2 * a * b * np.cos(knee))
    assert 0.28 - shortest == pytest.approx(lift, abs=1e-3)


# Any robot --------------------------------------------------------------------------------------------------


def test_names_and_order(config):
    model = robot_spec(config).compile()
    robot = read_robot(model, config)
    np.testing.assert_array_equal(robot.qpos_ids, np.arange(7, 19))
    np.testing.assert_array_equal(robot.dof_ids, np.arange(6, 18))
    np.testing.assert_array_equal(robot.motor_ids, np.arange(12))
    assert [model.body(i).name for i in robot.knee_ids] == [f"{leg}_shank" for leg in LEGS]
    assert model.nq == 19 and model.nv == 18 and model.nu == 12
    assert np.all(model.dof_damping == 0) and np.all(model.dof_armature[6:] == config.armature)


def test_default_pose_puts_the_feet_under_the_hips(config):
    model, robot = robot_spec(config).compile(), make_robot(config)
    data = mujoco.MjData(model)
    data.qpos[:] = robot.standing_qpos
    mujoco.mj_forward(model, data)
    expected = robot.hip_position + robot.base_foot + [0, 0, robot.standing_height]
    np.testing.assert_allclose(data.site_xpos[robot.foot_site_ids], expected, atol=1e-9)
    np.testing.assert_allclose(data.geom_xpos[robot.foot_geom_ids], expected, atol=1e-9)
    np.testing.assert_allclose(expected[:, 2], robot.foot_radius)
    knees = data.xpos[robot.knee_ids]
    assert np.all(knees[:, 0] < expected[:, 0] - 0.1)
    assert np.all(robot.default_pose > robot.joint_lower) and np.all(robot.default_pose < robot.joint_upper)


@pytest.mark.parametrize("spread", [-0.03, 0.06])
def test_feet_stand_outside_the_hips_by_their_spread(config, spread):
    config = dataclasses.replace(config, foot_spread=spread)
    model, robot = robot_spec(config).compile(), make_robot(config)
    data = mujoco.MjData(model)
    data.qpos[:] = robot.standing_qpos
    mujoco.mj_forward(model, data)
    feet, hips = data.site_xpos[robot.foot_site_ids], robot.hip_position[:, :2].copy()
    hips[:, 1] += robot.hip_offset + np.sign(robot.hip_offset) * spread
    np.testing.assert_allclose(feet[:, :2], hips, atol=1e-9)
    np.testing.assert_allclose(feet[:, 2], robot.foot_radius, atol=1e-9)
    assert np.all(data.xpos[robot.knee_ids][:, 0] < feet[:, 0] - 0.1)


@settings(max_examples=20, deadline=None)
@given(st.sampled_from(sorted(ROBOTS)), st.lists(st.floats(-1, 1), min_size=12, max_size=12))
def test_mirrored_legs_have_the_mirrored_mass_matrix(name, angles):
    """Reflection in the xz plane swaps sides, turns abduction round and keeps hip and knee."""
    config = RobotConfig(name=name)
    model, robot = robot_spec(config).compile(), make_robot(config)
    pose = np.array(angles).reshape(4, 3)
    sign = np.array([-1.0, 1.0, 1.0])
    own = leg_mass_matrix(model, robot, pose)
    mirrored = leg_mass_matrix(model, robot, pose[MIRROR] * sign)
    expected = own[MIRROR][:, :, MIRROR] * sign[:, None, None] * sign
    np.testing.assert_allclose(mirrored, expected, atol=1e-9)


def leg_mass_matrix(model, robot, pose):
    """(4, 3, 4, 3): generalised inertia of the joints with the trunk held; it has nothing of the trunk's
    own."""
    data = mujoco.MjData(model)
    data.qpos[robot.qpos_ids] = pose.reshape(-1)
    mujoco.mj_forward(model, data)
    columns = []
    for dof in robot.dof_ids:
        unit, product = np.zeros(model.nv), np.zeros(model.nv)
        unit[dof] = 1.0
        mujoco.mj_mulM(model, data, product, unit)
        columns.append(product[robot.dof_ids])
    return np.array(columns).reshape(4, 3, 4, 3)


def test_stands_under_pd(config):
    _, robot, data = standing(config)
    _, _, reference = standing(config, iterations=100, timestep=0.002)
    height = data.qpos[2]
    # The springs give way by weight / (legs' stiffness): centimetres at kp = 50.
    assert robot.standing_height - 0.05 < height < robot.standing_height
    assert data.qpos[3] > 0.99
    assert height == pytest.approx(reference.qpos[2], abs=0.005)
    assert len(data.contact) >= 4


def test_only_feet_collide(config):
    model, robot, data = standing(config, seconds=0.2)
    collidable = np.flatnonzero(model.geom_contype | model.geom_conaffinity)
    assert set(collidable) == {*robot.foot_geom_ids, int(np.flatnonzero(model.geom_bodyid == 0)[0])}
    # The plane has friction 1, the feet 0.8: priority makes theirs count.
    assert all(contact.friction[0] == config.foot_friction for contact in data.contact)


def test_trunk_points_lie_on_the_box(config):
    robot = make_robot(config)
    bottom, top = robot.trunk_points[:9, 2], robot.trunk_points[9:, 2]
    assert (
        np.ptp(bottom) == 0
        and np.ptp(top) == 0
        and top[0] - bottom[0] == pytest.approx(2 * robot.trunk_half_size[2])
    )
    np.testing.assert_allclose(np.abs(robot.trunk_points).max(axis=0), robot.trunk_half_size)


def test_look_changes_nothing_physical(config):
    plain, dressed = robot_spec(config).compile(), robot_spec(config, look=True).compile()
    for field in ("body_mass", "body_inertia", "body_ipos", "jnt_range", "dof_armature"):
        np.testing.assert_array_equal(getattr(plain, field), getattr(dressed, field))
    collidable = dressed.geom_contype | dressed.geom_conaffinity
    assert collidable.sum() == 4 and dressed.ngeom > plain.ngeom == 5


# Configuration ----------------------------------------------------------------------------------------------


def test_config_round_trips_through_omegaconf():
    assert OmegaConf.to_object(OmegaConf.structured(RobotConfig)) == RobotConfig()


def test_unknown_robot_names_the_choices():
    with pytest.raises(ValueError, match="unknown robot 'spot'; choose one of go1_size, max"):
        robot_spec(RobotConfig(name="spot"))


def test_stance_out_of_reach_is_refused():
    with pytest.raises(ValueError, match="out of the leg's reach"):
        make_robot(RobotConfig(foot_height=-0.5))
    with pytest.raises(ValueError, match="foot_spread=0.2 are out of the leg's reach"):
        make_robot(RobotConfig(foot_height=-0.43, foot_spread=0.2))


# A robot from a file ----------------------------------------------------------------------------------------

FILE_NAMES = {"LF": "FL", "RF": "FR", "LR": "RL", "RR": "RR"}
FILE_PARTS = {"abduction": "hip_joint", "hip": "thigh_joint", "knee": "calf_joint"}


def write_foreign_file(path):
    """Max as others would write it: other names, other leg order, a payload welded to the trunk."""
    spec = robot_spec(MAX)
    for leg, name in FILE_NAMES.items():
        for part, joint in FILE_PARTS.items():
            spec.joint(f"{leg}_{part}").name = f"{name}_{joint}"
            spec.actuator(f"{leg}_{part}").target = f"{name}_{joint}"
        spec.geom(f"{leg}_foot").name = name
    payload = spec.body("trunk").add_body(name="payload", pos=(0, 0, 0.1))
    payload.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=(0.05, 0.05, 0.02), mass=1.0)
    spec.compile()
    root = ElementTree.fromstring(spec.to_xml())
    trunk = root.find("./worldbody/body")
    legs = [body for body in trunk.findall("body") if body.get("name") != "payload"]
    for leg in legs:
        trunk.remove(leg)
    trunk.extend(legs[i] for i in MIRROR)
    path.write_text(ElementTree.tostring(root, encoding="unicode"))


def test_robot_from_a_file(tmp_path):
    path = tmp_path / "robot.xml"
    write_foreign_file(path)
    config = dataclasses.replace(MAX, file=ModelFile(path=str(path)))
    robot, own = make_robot(config), make_robot(MAX)
    for field in ("hip_position", "hip_offset", "thigh", "shank", "axis_sign", "joint_lower", "torque_limit"):
        np.testing.assert_allclose(getattr(robot, field), getattr(own, field), atol=1e-9, err_msg=field)
    np.testing.assert_array_equal(robot.qpos_ids, np.arange(7, 19))
    assert robot.mass == pytest.approx(own.mass + 1.0)
    pose = np.linspace(-0.5, 0.5, 12).reshape(4, 3)
    np.testing.assert_allclose(
        leg_mass_matrix(robot_spec(config).compile(), robot, pose),
        leg_mass_matrix(robot_spec(MAX).compile(), own, pose),
        atol=1e-7,
    )


def test_wrong_name_in_a_file_lists_what_it_has(tmp_path):
    path = tmp_path / "robot.xml"
    write_foreign_file(path)
    file = ModelFile(path=str(path), knee="{leg}_knee")
    with pytest.raises(ValueError, match="unknown joint 'FL_knee' in the model file; it has .*FL_calf_joint"):
        robot_spec(dataclasses.replace(MAX, file=file))
