"""A robot under an exported policy in MuJoCo C, on a terrain's true boxes and cylinders, driven as a real one would be.

Letters: L = 4 legs (LF, RF, LR, RR), J = 12 joints, P = 25 sample points a foot.
"""

import mujoco
import numpy as np

import tg
from envs.config import EnvConfig, RandomisationConfig
from envs.physics import physics_model, settle
from envs.robot import read_robot
from envs.scene import build_scene
from terrains import Terrain, exact_height
from tlq.judge import Moment
from tlq.perception import Perception
from tlq.runtime import Controller
from tlq.senses import PerceptionConfig


class Simulation:
    """Physics, sensors and perception around a `Controller`. World frame, SI units."""

    def __init__(
        self,
        controller: Controller,
        terrain: Terrain,
        config: EnvConfig,
        *,
        timestep: float = 0.002,
        noise: RandomisationConfig | None = None,
        perception: PerceptionConfig | None = None,
        seed: int = 0,
    ):
        """Puts the robot on the terrain's start platform.

        Args:
          controller: of the robot; it is reset by `reset`.
          terrain: true geometry.
          config: the robot, and when it counts as fallen.
          timestep: of the physics (s).
          noise: errors of sensors and map; none: exact.
          perception: range sensors and elevation map that give the heights; none: the terrain itself does.
          seed: of the noise and of the perception's errors.
        """
        ratio = controller.control_dt / timestep
        if timestep <= 0 or abs(ratio - round(ratio)) > 1e-6:
            raise ValueError(
                f"timestep={timestep} doesn't divide the control period, {controller.control_dt} s"
            )
        self.controller, self.terrain, self.config, self.noise = controller, terrain, config, noise
        limbs, touch = perception is not None, config.knee_contact
        self.model = build_scene(config.robot, terrain, timestep=timestep, limbs=limbs, touch=touch)
        self.data = mujoco.MjData(self.model)
        self.robot = read_robot(self.model, config.robot)
        self.substeps = round(ratio)
        self._random = np.random.default_rng(seed)
        joints = [self.model.joint(name) for name in controller.joint_names]
        self._q = np.array([joint.qposadr[0] for joint in joints])
        self._v = np.array([joint.dofadr[0] for joint in joints])
        self._motors = np.array([self.model.actuator(name).id for name in controller.joint_names])
        flat, robot = physics_model(config.robot, config.physics_dt, config.num_planes)
        self._standing = settle(flat, robot, controller.core.standing_target)
        self.perception = None
        if perception is not None:
            core, dt = controller.core, controller.control_dt
            self.perception = Perception(perception, self.model, core, dt, seed)
        self._thighs = controller.core.geometry._replace(shank=np.zeros(4, np.float32))
        self.reset()

    def reset(self, phase: float = 0.5 * np.pi) -> None:
        """The robot stands on the start platform, yaw 0, at rest; `phase` as in `Controller.reset`."""
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = self._standing
        self.data.qpos[2] += exact_height(self.terrain, np.zeros(2))
        self.controller.reset(phase)
        if self.noise is not None:
            drift = np.array([self.noise.map_drift, self.noise.map_drift, self.noise.height_drift])
            self._offset = drift * self._random.uniform(-1.0, 1.0, 3)
        if self.perception is not None:
            feet = self.controller.core.feet(self.exact_sensors())
            self.perception.reset(self.data, feet, self.robot.foot_radius)
        self.look()

    def step(self, direction: np.ndarray) -> Moment:
        """One control period, towards a direction (2,) in the world (a unit vector; 0: stand)."""
        command = tg.frames.turn(np.asarray(-self.yaw), np.asarray(direction, float))
        desired = self.controller.step(self.sensors, self.heights, command)
        damping = self.controller.damping
        work = sum(self.substep(desired, damping) for _ in range(self.substeps))
        self.look()
        return self.moment(work)

    def moment(self, work: float = 0.0) -> Moment:
        """The present state, as the judge sees it."""
        return Moment(
            position=self.data.qpos[:2].copy(),
            yaw=np.asarray(self.yaw),
            phases=self.controller.core.phases(self.controller.state.phase),
            feet=self._feet[:, 2] + self.data.qpos[2],
            ground=self._ground,
            work=np.asarray(work),
            fell=np.asarray(self.fell()),
        )

    def exact_sensors(self) -> tg.Sensors:
        """What the robot would measure without errors."""
        return tg.Sensors(
            orientation=self.data.qpos[3:7].copy(),
            angular_velocity=self.data.qvel[3:6].copy(),
            joint_position=self.data.qpos[self._q],
            joint_velocity=self.data.qvel[self._v],
        )

    @property
    def yaw(self) -> float:
        """Heading of the trunk (rad)."""
        return float(tg.frames.yaw(self.data.qpos[3:7]))

    def fell(self) -> bool:
        """Whether trunk or (unless those push it) a knee hits the terrain, or the trunk tilts too far; as in
        `QuadrupedEnv`.
        """
        rotation = tg.frames.rotation(self.data.qpos[3:7])
        q = self.data.qpos[self._q].reshape(4, 3)
        knees = self._thighs.hip_position + tg.leg.forward(self._thighs, q)
        points = np.concatenate([self.robot.trunk_points, knees]) @ rotation.T + self.data.qpos[:3]
        if not np.isfinite(points).all():
            return True
        points[-4:, 2] -= self.config.knee_radius
        if self.config.knee_contact:
            points = points[:-4]
        hit = points[:, 2] < exact_height(self.terrain, points[:, :2])
        return bool(hit.any() or rotation[2, 2] < self.config.min_up)

    def substep(self, desired: np.ndarray, damping: np.ndarray) -> float:
        """One timestep under PD control to `desired` (J,) rad; returns sum of |torque x speed| dt (J).

        damping: (J,) N m s/rad, as `Controller.damping`.
        """
        c, data, limit = self.controller, self.data, self.controller.torque_limit
        speed = data.qvel[self._v]
        torque = np.minimum(
            np.maximum(c.kp * (desired - data.qpos[self._q]) - damping * speed, -limit), limit
        )
        data.ctrl[self._motors] = torque
        mujoco.mj_step(self.model, data)
        return float(np.abs(torque) @ np.abs(speed)) * self.model.opt.timestep

    def look(self, centres: np.ndarray | None = None) -> None:
        """Reads sensors, and the terrain at the feet: as it is, and as it is perceived.

        centres: (4, 2) m, heading frame, where the heights are wanted, NaN for the foot; None: where the controller
          wants them.
        """
        data, core, exact = self.data, self.controller.core, self.exact_sensors()
        self._feet = core.feet(exact)
        self._ground = self._height(core.around(self._feet))
        self.sensors, offset, error = exact._asdict(), np.zeros(3), np.zeros(())
        if self.noise is not None:
            self.sensors, offset = noisy(self.sensors, self.noise, self._random), self._offset
            error = self.noise.height_noise * self._random.standard_normal((4, core.points))
        self.points = self.controller.sample_points(self.sensors)
        if centres is not None:
            self.points = core.wanted(np.where(np.isfinite(centres), centres, self._feet[:, :2]))
        if self.perception is not None:
            self.perception.look(data)
            self.heights = self.perception.heights(data, self.points)
            return
        self.heights = self._height(self.points + offset[:2]) - data.qpos[2] + offset[2] + error

    def _height(self, points: np.ndarray) -> np.ndarray:
        """Terrain height (...) m in the world at points (..., 2) m of the heading frame."""
        return exact_height(self.terrain, self.data.qpos[:2] + tg.frames.turn(np.asarray(self.yaw), points))


def noisy(
    exact: dict[str, np.ndarray], noise: RandomisationConfig, random: np.random.Generator
) -> dict[str, np.ndarray]:
    """Sensors with errors, drawn as in training (`QuadrupedEnv.sense`)."""
    roll, pitch = 0.5 * noise.tilt_noise * random.standard_normal(2)
    w, x, y, z = exact["orientation"]
    turned = np.array(
        [
            w - x * roll - y * pitch,
            x + w * roll - z * pitch,
            y + w * pitch + z * roll,
            z + x * pitch - y * roll,
        ]
    )
    deviation = {
        "angular_velocity": noise.angular_velocity_noise,
        "joint_position": noise.joint_position_noise,
        "joint_velocity": noise.joint_velocity_noise,
    }
    errors = {k: exact[k] + d * random.standard_normal(exact[k].shape) for k, d in deviation.items()}
    return {"orientation": turned / np.linalg.norm(turned), **errors}
