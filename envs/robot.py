"""The robot as configuration: its model, and a record of the geometry read from the compiled model.

Letters: L = 4 legs (LF, RF, LR, RR); J = 12 joints, leg by leg: abduction, hip, knee. SI units, radians.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import mujoco
import numpy as np

from envs.robots.from_file import ModelFile, build_from_file
from envs.robots.go1_size import build_go1_size
from envs.robots.look import dress
from envs.robots.max import build_max
from envs.robots.quadruped import JOINTS, LEGS

JOINT_NAMES = tuple(f"{leg}_{joint}" for leg in LEGS for joint in JOINTS)
"""Names of the J joints and of their motors, in order."""

ROBOTS: dict[str, Callable[[], mujoco.MjSpec]] = {"max": build_max, "go1_size": build_go1_size}
"""Model builders by name; add to it with `register`."""


def register(name: str):
    """Decorator that adds a function () -> MjSpec to the robots, by name."""

    def add(build: Callable[[], mujoco.MjSpec]):
        ROBOTS[name] = build
        return build

    return add


@dataclasses.dataclass(frozen=True)
class RobotConfig:
    """Which robot, and the constants of its joints and of its controller."""

    name: str = "max"
    """Model: a name in `ROBOTS`."""
    kp: float = 50.0
    """Proportional gain of the joint controller, N m/rad."""
    kd: float = 0.7
    """Derivative gain of the joint controller, N m s/rad: 0.6, and 0.1 for the joints' own damping."""
    armature: float = 0.01
    """Reflected inertia of each motor's rotor, kg m^2; keeps an explicit kd stable at long time steps."""
    joint_friction: float = 0.0
    """Dry friction of each joint, N m. The published model has 0.5; costs about 9 % of the speed."""
    foot_friction: float = 0.8
    """Sliding friction between foot and terrain, whatever the terrain's own."""
    foot_height: float = -0.33
    """Height of a resting foot under its hip joint, m: the base position is
    (0, side * (offset + foot_spread), foot_height) from the abduction joint."""
    foot_spread: float = 0.0
    """How far a resting foot stands outside its hip joint, m."""
    file: ModelFile = dataclasses.field(default_factory=ModelFile)
    """Model file to read the robot from instead; its path is empty by default."""


@dataclasses.dataclass(frozen=True, eq=False)
class Robot:
    """What the code needs to know about a robot, read from a compiled model; all arrays NumPy.

    Ids belong to the model that was read: read again after adding bodies to it.
    """

    config: RobotConfig
    """The configuration the model was built from."""
    joint_names: tuple[str, ...]
    """(J,) names of joints and of their motors."""
    trunk_id: int
    """Body id of the trunk."""
    knee_ids: np.ndarray
    """(L,) body ids of the shanks, whose origins are the knees."""
    foot_geom_ids: np.ndarray
    """(L,) geom ids of the foot spheres."""
    foot_site_ids: np.ndarray
    """(L,) site ids of the feet's centres."""
    joint_ids: np.ndarray
    """(J,) joint ids."""
    qpos_ids: np.ndarray
    """(J,) places of the joint angles in qpos."""
    dof_ids: np.ndarray
    """(J,) places of the joint speeds in qvel."""
    motor_ids: np.ndarray
    """(J,) places of the joint torques in ctrl."""
    hip_position: np.ndarray
    """(L, 3) abduction joint in the trunk frame, m."""
    hip_offset: np.ndarray
    """(L,) lateral offset from the abduction joint to the hip joint, left positive, m."""
    thigh: np.ndarray
    """(L,) hip joint to knee joint, m."""
    shank: np.ndarray
    """(L,) knee joint to the foot's centre, m."""
    axis_sign: np.ndarray
    """(L, 3) sign of each joint's axis along +x (abduction), +y (hip), +y (knee): Max has (+1, -1, -1)."""
    joint_lower: np.ndarray
    """(J,) lower limits, rad."""
    joint_upper: np.ndarray
    """(J,) upper limits, rad."""
    torque_limit: np.ndarray
    """(J,) largest torque either way, N m."""
    speed_limit: np.ndarray
    """(J,) largest speed either way, rad/s (infinite where the model gives none)."""
    default_pose: np.ndarray
    """(J,) joint angles of the base foot positions, knees behind the hips, rad."""
    base_foot: np.ndarray
    """(L, 3) base foot position (0, side * (offset + foot_spread), foot_height) from the abduction joint, m."""
    foot_radius: float
    """m."""
    trunk_half_size: np.ndarray
    """(3,) half edges of the trunk's box, m."""
    trunk_points: np.ndarray
    """(13, 3) points of the trunk's box that detect its collisions, trunk frame, m: a 3 x 3 grid of the
    bottom face first, then the 4 top corners."""
    mass: float
    """Total, kg."""

    @property
    def joint_sign(self) -> np.ndarray:
        """(L, 3) joint angle = joint_sign * angle about the canonical axes +x, -y, -y."""
        return self.axis_sign * np.array([1.0, -1.0, -1.0])

    @property
    def standing_height(self) -> float:
        """Trunk height above flat ground with the feet at their base positions, m."""
        return float(self.foot_radius - self.base_foot[0, 2] - self.hip_position[0, 2])

    @property
    def standing_qpos(self) -> np.ndarray:
        """(7 + J,) position, quaternion (w first) and joint angles of the robot standing at the origin."""
        qpos = np.concatenate(
            [[0.0, 0.0, self.standing_height, 1.0, 0.0, 0.0, 0.0], np.zeros(len(JOINT_NAMES))]
        )
        qpos[self.qpos_ids] = self.default_pose
        return qpos


def robot_spec(config: RobotConfig, *, look: bool = False) -> mujoco.MjSpec:
    """The robot's spec without ground: body "trunk", joints and motors `JOINT_NAMES`, geoms and sites
    "LF_foot"...

    Physics options are those of training (one Newton iteration, 5 ms); change them on the spec or the model.
    With `look`, geoms for the eye are added; they weigh nothing and touch nothing.
    """
    if config.file.path:
        spec = build_from_file(config.file)
    elif config.name in ROBOTS:
        spec = ROBOTS[config.name]()
    else:
        raise ValueError(f"unknown robot '{config.name}'; choose one of {', '.join(sorted(ROBOTS))}")
    if look:
        dress(spec)
    for joint in spec.joints:
        if joint.name in JOINT_NAMES:
            joint.armature = config.armature
            joint.frictionloss = config.joint_friction
            joint.damping = np.zeros_like(joint.damping)
    for geom in spec.geoms:
        if geom.name in _feet():
            geom.friction = (config.foot_friction, *geom.friction[1:])
    _set_training_physics(spec)
    return spec


def make_robot(config: RobotConfig = RobotConfig()) -> Robot:
    """The record of a robot that stands alone; its ids hold in any model that adds bodies after the
    robot's.
    """
    return read_robot(robot_spec(config).compile(), config)


def read_robot(model: mujoco.MjModel, config: RobotConfig) -> Robot:
    """The record of the robot in a compiled model, every entry looked up by name."""
    joints = np.array([model.joint(name).id for name in JOINT_NAMES])
    motors = np.array([model.actuator(name).id for name in JOINT_NAMES])
    feet = np.array([model.geom(name).id for name in _feet()])
    sites = np.array([model.site(name).id for name in _feet()])
    chain = model.jnt_bodyid[joints].reshape(len(LEGS), len(JOINTS))
    offset = model.body_pos[chain[:, 1]]
    thigh = model.body_pos[chain[:, 2]]
    shank = model.site_pos[sites]
    axes = model.jnt_axis[joints].reshape(len(LEGS), len(JOINTS), 3)
    _check_legs(offset, thigh, shank, axes)
    signs = np.stack([axes[:, 0, 0], axes[:, 1, 1], axes[:, 2, 1]], axis=1)
    base = np.zeros((len(LEGS), 3))
    base[:, 1] = offset[:, 1] + np.sign(offset[:, 1]) * config.foot_spread
    base[:, 2] = config.foot_height
    half = model.geom_size[model.geom("trunk").id].copy()
    return Robot(
        config=config,
        joint_names=JOINT_NAMES,
        trunk_id=model.body("trunk").id,
        knee_ids=chain[:, 2].copy(),
        foot_geom_ids=feet,
        foot_site_ids=sites,
        joint_ids=joints,
        qpos_ids=model.jnt_qposadr[joints],
        dof_ids=model.jnt_dofadr[joints],
        motor_ids=motors,
        hip_position=model.body_pos[chain[:, 0]],
        hip_offset=offset[:, 1],
        thigh=-thigh[:, 2],
        shank=-shank[:, 2],
        axis_sign=signs,
        joint_lower=model.jnt_range[joints, 0],
        joint_upper=model.jnt_range[joints, 1],
        torque_limit=model.actuator_ctrlrange[motors, 1],
        speed_limit=_speed_limit(model),
        default_pose=_standing_pose(offset[:, 1], -thigh[:, 2], -shank[:, 2], signs, base),
        base_foot=base,
        foot_radius=float(model.geom_size[feet[0], 0]),
        trunk_half_size=half,
        trunk_points=_box_points(half) + model.geom_pos[model.geom("trunk").id],
        mass=float(model.body_subtreemass[model.body("trunk").id]),
    )


def _feet() -> tuple[str, ...]:
    return tuple(f"{leg}_foot" for leg in LEGS)


def _set_training_physics(spec: mujoco.MjSpec) -> None:
    """One iteration of Newton settles the same stand as a hundred; joints have no damping to integrate
    implicitly.
    """
    option = spec.option
    option.timestep = 0.005
    option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
    option.iterations = 1
    option.ls_iterations = 3
    option.impratio = 1.0
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP


def _check_legs(offset: np.ndarray, thigh: np.ndarray, shank: np.ndarray, axes: np.ndarray) -> None:
    """The closed-form leg kinematics hold for these legs only."""
    straight = (
        np.allclose(offset[:, [0, 2]], 0) and np.allclose(thigh[:, :2], 0) and np.allclose(shank[:, :2], 0)
    )
    along = np.abs(axes)[:, np.arange(3), [0, 1, 1]]
    if not (straight and np.allclose(along, 1)):
        raise ValueError(
            "unsupported leg: the hip must lie sideways of the abduction joint, knee and foot straight below "
            "the hip at zero angles, and the axes must be x, y, y"
        )


def _standing_pose(
    offset: np.ndarray, thigh: np.ndarray, shank: np.ndarray, signs: np.ndarray, base: np.ndarray
) -> np.ndarray:
    """Angles (J,) that put the feet at their base positions (L, 3), knees behind the hips (law of cosines)."""
    # The leg's plane turns about the abduction joint, at a distance from it.
    square = base[:, 1] ** 2 + base[:, 2] ** 2 - offset**2
    length = np.sqrt(np.maximum(square, 0.0))
    cosine = (square - thigh**2 - shank**2) / (2 * thigh * shank)
    if np.any(np.abs(cosine) > 1):
        reach = (thigh + shank).min()
        raise ValueError(
            f"foot_height={base[0, 2]} and foot_spread={abs(base[0, 1]) - abs(offset[0]):g} are out of the leg's "
            f"reach; choose feet nearer to the hip joints than {reach:g}"
        )
    abduction = np.arctan2(base[:, 1], -base[:, 2]) - np.arctan2(offset, length)
    knee = np.arccos(cosine)
    hip = -np.arctan2(shank * np.sin(knee), thigh + shank * np.cos(knee))
    # The first is a turn about x, the others about -y.
    pose = np.stack([signs[:, 0] * abduction, -signs[:, 1] * hip, -signs[:, 2] * knee], axis=1)
    return pose.reshape(-1)


def _speed_limit(model: mujoco.MjModel) -> np.ndarray:
    names = {model.numeric(i).name for i in range(model.nnumeric)}
    if "joint_speed_limit" not in names:
        return np.full(len(JOINT_NAMES), np.inf)
    return np.array(model.numeric("joint_speed_limit").data)


def _box_points(half: np.ndarray) -> np.ndarray:
    grid = np.array([(x, y, -1.0) for x in (-1, 0, 1) for y in (-1, 0, 1)])
    top = np.array([(x, y, 1.0) for x in (-1, 1) for y in (-1, 1)])
    return np.concatenate([grid, top]) * half
