"""One physics substep in MJX, with the feet on the terrain bank's true primitives.

MJX has no cheap collision of spheres with thousands of boxes and cylinders. Here each foot has planes of its own,
paired with it in the model, and every substep lays them against the surfaces nearest to the foot: plane-sphere contact
is then exactly sphere-box and sphere-cylinder contact. MJX's own functions run in the order of `mjx.step`; the planes
are placed between kinematics and collision, so nothing is computed twice.
"""

import dataclasses
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from envs.robot import Robot, RobotConfig, read_robot, robot_spec
from envs.robots.quadruped import LEGS

FEET = tuple(f"{leg}_foot" for leg in LEGS)
KNEES = tuple(f"{leg}_knee" for leg in LEGS)

Contact = Callable[[jax.Array], tuple[jax.Array, jax.Array, jax.Array]]
"""Centres (S, 3) m of spheres to the N nearest surfaces: distance (S, N) m, normal (S, N, 3), surface point (S, N, 3)
m. S: the feet, L, or feet and knees, 2 L.
"""


def physics_model(
    config: RobotConfig, timestep: float, num_planes: int, knee_radius: float = 0.0
) -> tuple[mujoco.MjModel, Robot]:
    """The robot with `num_planes` terrain planes a foot and no motors (torques are applied to the joints).

    With a `knee_radius` (m) its knees are spheres that touch the terrain as feet do, with as many planes each.
    The robot's ids in the returned record hold for this model; `Robot.motor_ids` do not.
    """
    spec = robot_spec(config)
    robot = read_robot(spec.compile(), config)
    for actuator in list(spec.actuators):
        spec.delete(actuator)
    spec.option.timestep = timestep
    for leg, knee in zip(LEGS, KNEES, strict=True) if knee_radius else ():
        spec.body(f"{leg}_thigh").add_geom(
            name=knee,
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            size=(knee_radius, 0, 0),
            pos=spec.body(f"{leg}_shank").pos,
            contype=0,
            conaffinity=0,
            mass=0.0,
        )
    for sphere in FEET + KNEES if knee_radius else FEET:
        add_planes(spec, sphere, num_planes, config.foot_friction)
    model = spec.compile()
    # The world's geoms come before the robot's, so the feet have other ids now.
    return model, dataclasses.replace(robot, foot_geom_ids=np.array([model.geom(foot).id for foot in FEET]))


def add_planes(spec: mujoco.MjSpec, sphere: str, num_planes: int, friction: float) -> None:
    """Adds terrain planes to a model, each paired with a foot's geom, or a knee's, and touching nothing else."""
    for plane in range(num_planes):
        name = f"{sphere}_plane{plane}"
        spec.worldbody.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_PLANE,
            # Where the planes aren't placed, as in `settle`, there is one ground, not two.
            pos=(0, 0, -plane),
            size=(1, 1, 0.1),
            contype=0,
            conaffinity=0,
            rgba=(0, 0, 0, 0),
        )
        spec.add_pair(
            geomname1=name, geomname2=sphere, condim=3, friction=[friction] * 2 + [0.005, 1e-4, 1e-4]
        )


def sphere_ids(model: mujoco.MjModel) -> np.ndarray:
    """(S,) geom ids of what touches the terrain in a `physics_model`: the feet, then the knees if they do."""
    names = {model.geom(i).name for i in range(model.ngeom)}
    return np.array([model.geom(name).id for name in FEET + KNEES if name in names])


def plane_ids(model: mujoco.MjModel, num_planes: int, spheres: Sequence[str] = ()) -> np.ndarray:
    """(S, num_planes) geom ids of the terrain planes; of other spheres than `sphere_ids` by their names."""
    spheres = spheres or [model.geom(i).name for i in sphere_ids(model)]
    return np.array([[model.geom(f"{name}_plane{i}").id for i in range(num_planes)] for name in spheres])


def frame(normal: jax.Array) -> jax.Array:
    """A rotation (..., 3, 3) whose last column is the unit normal (..., 3)."""
    x, y, z = normal[..., 0], normal[..., 1], normal[..., 2]
    # Turn that takes e_z to the normal the short way; normals never point straight down.
    k = 1.0 / (1.0 + jnp.maximum(z, -0.99))
    first = jnp.stack([1.0 - k * x * x, -k * x * y, -x], axis=-1)
    second = jnp.stack([-k * x * y, 1.0 - k * y * y, -y], axis=-1)
    return jnp.stack([first, second, normal], axis=-1)


def substep(
    model: mjx.Model,
    data: mjx.Data,
    planes: np.ndarray,
    spheres: np.ndarray,
    contact: Contact,
    qfrc: jax.Array,
    iterations: int,
) -> mjx.Data:
    """Advances the physics by one timestep.

    Args:
      model: of `physics_model`, on the device.
      data: state.
      planes: (S, N) geom ids.
      spheres: (S,) geom ids.
      contact: surfaces near them.
      qfrc: (nv,) generalised force.
      iterations: Newton iterations of the constraint solver.
    """
    with jax.default_matmul_precision("highest"):  # TF32, a GPU's default, ruins contact
        data = mjx.kinematics(model, data)
        _, normal, point = contact(data.geom_xpos[spheres])
        ids = planes.reshape(-1)
        data = data.replace(
            geom_xpos=data.geom_xpos.at[ids].set(point.reshape(-1, 3)),
            geom_xmat=data.geom_xmat.at[ids].set(frame(normal).reshape(-1, 3, 3)),
            qfrc_applied=qfrc,
        )
        data = mjx.com_pos(model, data)
        data = mjx.crb(model, data)
        data = mjx.factor_m(model, data)
        data = mjx.collision(model, data)
        data = mjx.make_constraint(model, data)
        data = mjx.com_vel(model, data)
        data = mjx.rne(model, data)
        data = mjx.fwd_acceleration(model, data)
        # The model asks for one iteration, which MJX runs without a loop; starting each from the last one's result
        # gives the same as more of them at once, and is faster than the loop that MJX has for those.
        for _ in range(iterations):
            data = mjx.solve(model, data)
            data = data.replace(qacc_warmstart=data.qacc)
        return mjx.euler(model, data)


def settle(model: mujoco.MjModel, robot: Robot, target: np.ndarray, seconds: float = 3.0) -> np.ndarray:
    """The robot at rest on flat ground under PD control: it sags by its own weight.

    Args:
      model: of `physics_model`, whose planes lie at z = 0.
      robot: whose gains are used.
      target: (12,) rad, desired joint angles.
      seconds: how long to wait.

    Returns:
      qpos (19,), above the origin, level in yaw.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = robot.standing_qpos
    limit = robot.torque_limit
    # Three times the damping: it changes the way there, not the rest.
    for _ in range(round(seconds / model.opt.timestep)):
        torque = robot.config.kp * (target - data.qpos[7:]) - 3.0 * robot.config.kd * data.qvel[6:]
        data.qfrc_applied[6:] = np.clip(torque, -limit, limit)
        mujoco.mj_step(model, data)
    qpos = data.qpos.copy()
    qpos[:2] = 0.0
    qpos[3:7] = [np.cos(np.arctan2(qpos[5], qpos[3])), 0.0, np.sin(np.arctan2(qpos[5], qpos[3])), 0.0]
    return qpos
