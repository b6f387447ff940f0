"""Both robots, for tests."""

import dataclasses

import mujoco
import numpy as np

from envs import EnvConfig, RobotConfig
from envs.env import make_core
from envs.robot import ROBOTS, make_robot, robot_spec


class Subject:
    """A robot: its compiled model, what was read from it, and its controller core in double precision."""

    def __init__(self, name):
        self.config = RobotConfig(name=name)
        self.model = robot_spec(self.config).compile()
        self.data = mujoco.MjData(self.model)
        self.robot = make_robot(self.config)
        self.core = self.make(np.float64)
        self.geometry = self.core.geometry

    def make(self, dtype=np.float32, method="ours", **tg):
        """Its core with other settings of the trajectory generator."""
        config = EnvConfig(robot=self.config, method=method)
        config = dataclasses.replace(config, tg=dataclasses.replace(config.tg, **tg))
        core = make_core(config, self.robot)
        arrays = ("base_foot", "default_pose", "lower", "upper")
        changed = {name: np.asarray(getattr(core, name), dtype) for name in arrays}
        geometry = type(core.geometry)(*(np.asarray(part, dtype) for part in core.geometry))
        return dataclasses.replace(core, geometry=geometry, **changed)

    def place(self, pose, quaternion=(1, 0, 0, 0)):
        """MuJoCo's data with the trunk at the origin and joint angles (12,)."""
        self.data.qpos[:] = 0
        self.data.qpos[3:7] = quaternion
        self.data.qpos[self.robot.qpos_ids] = np.reshape(pose, -1)
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        return self.data


SUBJECTS = {name: Subject(name) for name in sorted(ROBOTS)}
