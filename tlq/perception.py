"""Heights as a robot's own sensors tell of them: range sensors, a pose estimate that drifts, and an elevation map.

Letters: L = 4 legs (LF, RF, LR, RR), P = 25 sample points a foot. The estimate's frame is level, as the world's.
"""

from collections import deque

import mujoco
import numpy as np

import tg
from tlq.elevation import ElevationMap
from tlq.rangefinders import RangeSensors, in_frame
from tlq.senses import PerceptionConfig

YAW_PER_METRE = 0.5
"""Assumed: the heading drifts by so many radians when the position drifts by a metre; 2 cm come with 0.6°."""
LOOK_ROUND = 25
"""Control steps for which a standing robot looks round before it starts."""
KNOWN = 0.1
"""The ground under the standing robot is known to so far (m) beyond its feet."""


class PoseEstimate:
    """Where a robot takes itself to be: right at the start, then with an error that grows as it walks."""

    def __init__(self, drift: float):
        """drift: see `PerceptionConfig`."""
        self.drift = drift

    def reset(self, position: np.ndarray) -> None:
        """The robot knows its true position (3,) m."""
        self._true = np.array(position)
        self.position = np.array(position)
        """(3,) m."""
        self.turned = 0.0
        """Error of the heading (rad)."""

    def update(self, position: np.ndarray, random: np.random.Generator) -> None:
        """The robot has moved to a true position (3,) m."""
        step = position - self._true
        error = self.drift * np.sqrt(np.hypot(step[0], step[1])) * random.standard_normal(4)
        self.position[:2] += tg.frames.turn(np.asarray(self.turned), step[:2])
        self.position[2] += step[2]
        self.position += error[:3]
        self.turned += YAW_PER_METRE * error[3]
        self._true = np.array(position)

    def orientation(self, true: np.ndarray) -> np.ndarray:
        """The estimate (4,), w x y z, of an orientation (4,): gravity tells roll and pitch, nothing tells the
        heading.
        """
        cos, sin = np.cos(0.5 * self.turned), np.sin(0.5 * self.turned)
        w, x, y, z = true
        return np.array([cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w])


class Perception:
    """Senses the ground of one simulated robot."""

    def __init__(
        self, config: PerceptionConfig, model: mujoco.MjModel, core: tg.Core, control_dt: float, seed: int = 0
    ):
        """Puts sensors on a robot.

        Args:
          config: which, and their errors.
          model: robot and terrain; the robot's trunk is the body "trunk".
          core: of the robot's controller.
          control_dt: time (s) from one `look` to the next.
          seed: of all errors.
        """
        config.check()
        self.config, self.model, self.core = config, model, core
        hips = np.asarray(core.geometry.hip_position)
        self.sensors = RangeSensors(
            config.kind, model, hips, noise=config.range_noise, missing=config.missing
        )
        self.pose = PoseEstimate(config.drift)
        self.ground = ElevationMap(config.elevation)
        self._random = np.random.default_rng(seed)
        self._late = round(config.latency / control_dt)
        self._waiting: deque[tuple[np.ndarray, np.ndarray, np.ndarray]] = deque()

    def reset(self, data: mujoco.MjData, feet: np.ndarray, foot_radius: float) -> None:
        """The robot stands on ground that it knows, with yaw 0, and looks round before it starts.

        Args:
          data: its state.
          feet: (4, 3) m, feet's centres from the trunk's centre, heading frame.
          foot_radius: m.
        """
        self.pose.reset(data.qpos[:3])
        self.sensors.reset()
        self._waiting.clear()
        ground = float(data.qpos[2] + feet[:, 2].mean() - foot_radius)
        half = np.abs(feet[:, :2]).max(axis=0) + KNOWN
        self.ground.reset(data.qpos[:2], ground, (float(half[0]), float(half[1])))
        for _ in range(LOOK_ROUND + self._late):
            self.look(data)

    def look(self, data: mujoco.MjData) -> None:
        """One control step: the estimate goes on, sensors scan, and a scan whose time has come is fused."""
        self.pose.update(data.qpos[:3], self._random)
        scan = self.sensors.scan(self.model, data, self._random)
        self._waiting.append(in_frame(scan, self.pose.position, self.pose.orientation(data.qpos[3:7])))
        self.ground.move(self.pose.position[:2])
        while len(self._waiting) > self._late:
            self.ground.fuse(*self._waiting.popleft())

    def heights(self, data: mujoco.MjData, points: np.ndarray) -> np.ndarray:
        """The map's heights (L, P) m from the trunk's centre, at points (L, P, 2) m of the heading frame."""
        yaw = tg.frames.yaw(data.qpos[3:7]) + self.pose.turned
        places = self.pose.position[:2] + tg.frames.turn(np.asarray(yaw), points)
        return self.ground.read(places) - self.pose.position[2]

    def measured(self, data: mujoco.MjData, reach: float) -> np.ndarray:
        """The map's measured cells (C, 3) m within `reach` (m), in the world: where they lie if the pose estimate is
        taken to be right now.
        """
        away = self.ground.measured(reach) - self.pose.position
        away[:, :2] = tg.frames.turn(np.asarray(-self.pose.turned), away[:, :2])
        return data.qpos[:3] + away
