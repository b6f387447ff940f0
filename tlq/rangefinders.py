"""Range sensors on a robot's trunk in MuJoCo: where their rays end, with the errors of the real ones.

Two lidars, at the nose and the tail, or four depth cameras, one to each side: a robot that walks in any direction has
to see in all of them. A sensor scans at every control step; cameras take turns. Frames: x forward, y left, z up; a
mount's own frame is the trunk's turned by its yaw, then pitched down. M: rays of a scan.
"""

import dataclasses
import math
from typing import NamedTuple

import mujoco
import numpy as np

import tg
from tlq.senses import SENSORS

FARTHEST = 1.0
"""Rays end after so many metres: beyond, nothing is read from the map."""


@dataclasses.dataclass(frozen=True)
class LidarConfig:
    """Of each lidar; figures of the Livox Mid-360 where nothing else is said."""

    highest: float = math.radians(7.0)
    """Upper end of the field of view (rad) against its own level, mounted upside down; all round."""
    lowest: float = math.radians(-52.0)
    """Lower end (rad)."""
    nearest: float = 0.1
    """Shortest range (m)."""
    deviation: float = 0.02
    """Standard deviation of the range (m); the manufacturer has at most 2 cm at 10 m, and 3 cm at 0.2 m."""
    rays: int = 2000
    """Points a control step. Assumed: the sensor gives 4,000; half of them is what time allows here.
    Taken from an even sequence (Roberts' R2) in place of the manufacturer's rosette; those that can't end on the ground
    near the robot aren't cast."""
    pitch: float = math.radians(35.0)
    """Assumed: tilted down by this (rad), so that it sees the ground straight below its front."""


@dataclasses.dataclass(frozen=True)
class DepthConfig:
    """Of each depth camera; figures of the Intel RealSense D435 where nothing else is said."""

    width: float = math.radians(87.0)
    """Horizontal field of view (rad)."""
    height: float = math.radians(58.0)
    """Vertical field of view (rad)."""
    nearest: float = 0.2
    """Shortest depth (m). Assumed: the camera's own depends on its resolution and settings."""
    deviation: float = 0.0036
    """Standard deviation of the depth at 1 m (m); it grows with the square of the depth: a subpixel of 0.08 over focal
    length (447 pixels) and base line (5 cm)."""
    columns: int = 32
    """Assumed: one pixel at random of each of so many columns..."""
    rows: int = 20
    """...and rows of the picture, one camera at a control step, so that each gives a picture at 12.5 Hz."""
    pitch: float = math.radians(60.0)
    """Assumed: looks down by this (rad), so that it sees the ground straight below."""


class Mount(NamedTuple):
    """Where a sensor sits."""

    position: np.ndarray
    """(3,) m, trunk frame."""
    yaw: float
    """rad, left positive, from the trunk's x."""
    pitch: float
    """rad, down positive."""

    def rotation(self) -> np.ndarray:
        """(3, 3), trunk from sensor."""
        cy, sy, cp, sp = math.cos(self.yaw), math.sin(self.yaw), math.cos(self.pitch), math.sin(self.pitch)
        return np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]]) @ np.array(
            [[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]]
        )


class Scan(NamedTuple):
    """What sensors saw at one moment."""

    origins: np.ndarray
    """(M, 3) m, of each ray, trunk frame."""
    points: np.ndarray
    """(M, 3) m, of each return that isn't the robot's own body, trunk frame."""
    variance: np.ndarray
    """(M,) m², along the ray, as the sensor's data sheet says."""


class RangeSensors:
    """All the range sensors of one kind on a robot."""

    def __init__(
        self, kind: str, model: mujoco.MjModel, hips: np.ndarray, *, noise: float = 1.0, missing: float = 0.0
    ):
        """Puts sensors on the trunk.

        Args:
          kind: one of `SENSORS`.
          model: robot and terrain.
          hips: (4, 3) m, abduction joints in the trunk frame: what tells how large the robot is.
          noise: standard deviation of ranges, in multiples of the sensor's own.
          missing: share of the returns that are lost, at random.
        """
        if kind not in SENSORS:
            raise ValueError(f"unknown range sensor '{kind}'; choose one of {', '.join(SENSORS)}")
        self.kind, self.noise, self.missing = kind, noise, missing
        self.lidar, self.depth = LidarConfig(), DepthConfig()
        self.trunk = model.body("trunk").id
        own = model.body_rootid == model.body_rootid[self.trunk]
        self._own = own[model.geom_bodyid]
        self._floors = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE)
        self.mounts = mounts(kind, hips, self.lidar.pitch if kind == "lidar" else self.depth.pitch)
        self.reset()

    def reset(self) -> None:
        """Starts from the first picture again."""
        self._count = 0

    def scan(self, model: mujoco.MjModel, data: mujoco.MjData, random: np.random.Generator) -> Scan:
        """One control step's rays, from the model's present positions."""
        mujoco.mj_kinematics(model, data)  # a step leaves bodies where they were before its last move
        mine = self.mounts if self.kind == "lidar" else self.mounts[self._count % len(self.mounts) :][:1]
        scans = [self._cast(model, data, mount, *self._rays(mount, random), random) for mount in mine]
        self._count += 1
        return Scan(*(np.concatenate(parts) for parts in zip(*scans, strict=True)))

    def _rays(self, mount: Mount, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Unit directions (M, 3) in the trunk frame, the standard deviation at 1 m and shortest range (M,) of each."""
        if self.kind == "lidar":
            c = self.lidar
            number = self._count * c.rays + np.arange(c.rays)
            along, up = (number * 0.7548776662466927) % 1.0, (number * 0.5698402909980532) % 1.0
            sine = math.sin(c.lowest) + up * (math.sin(c.highest) - math.sin(c.lowest))
            flat = np.sqrt(1.0 - sine**2)
            angle = 2.0 * np.pi * along
            rays = np.stack([flat * np.cos(angle), flat * np.sin(angle), sine], axis=-1) @ mount.rotation().T
            return rays, np.full(c.rays, c.deviation), np.full(c.rays, c.nearest)
        d = self.depth
        right, down = np.meshgrid(np.arange(d.columns), np.arange(d.rows))
        place = [
            (x + random.random(x.shape)) / n * 2.0 - 1.0 for x, n in ((right, d.columns), (down, d.rows))
        ]
        across, below = math.tan(d.width / 2) * place[0].ravel(), math.tan(d.height / 2) * place[1].ravel()
        rays = np.stack([np.ones_like(across), -across, -below], axis=-1)
        length = np.linalg.norm(rays, axis=-1)  # range over depth
        rays = (rays / length[:, None]) @ mount.rotation().T
        # Depth z = range / length; its deviation grows with z², the range's with length times that.
        return rays, d.deviation / length, d.nearest * length

    def _cast(self, model, data, mount: Mount, rays, deviation, nearest, random) -> Scan:
        rotation, trunk = data.xmat[self.trunk].reshape(3, 3), data.xpos[self.trunk]
        down = (rays @ rotation.T)[:, 2] < -0.3  # flatter ones end beyond FARTHEST
        rays, deviation, nearest = rays[down], deviation[down], nearest[down]
        count = len(rays)
        geoms, ranges = np.full(count, -1, np.int32), np.full(count, -1.0)
        origin = trunk + rotation @ mount.position
        world = np.ascontiguousarray(rays @ rotation.T)
        mujoco.mj_multiRay(
            model, data, origin, world.reshape(-1), None, True, -1, geoms, ranges, None, count, FARTHEST
        )
        # A plane whose middle is beyond the cutoff is left out there; the ground's are level.
        for floor in self._floors:
            below = (data.geom_xpos[floor, 2] - origin[2]) / world[:, 2]
            nearer = (below > 0.0) & ((ranges < 0.0) | (below < ranges))
            ranges[nearer], geoms[nearer] = below[nearer], floor
        power = 2 if self.kind == "depth" else 0
        deviation = deviation * np.maximum(ranges, 0.0) ** power
        seen = ranges + self.noise * deviation * random.standard_normal(count)
        # A robot knows where its own body is and leaves out what it sees of it.
        keep = (ranges >= 0) & (seen >= nearest) & (ranges <= FARTHEST) & ~self._own[geoms]
        keep &= random.random(count) >= self.missing
        points = mount.position + seen[:, None] * rays
        return Scan(np.broadcast_to(mount.position, points[keep].shape), points[keep], deviation[keep] ** 2)


def mounts(kind: str, hips: np.ndarray, pitch: float) -> tuple[Mount, ...]:
    """Where the sensors sit on a robot with its abduction joints at hips (4, 3) m, trunk frame. Assumed.

    Lidars 8 cm before and behind the hips and 3 cm above them, cameras there and 6 cm outside the hips.
    """
    x, y, z = np.abs(hips[:, 0]).max() + 0.08, np.abs(hips[:, 1]).max() + 0.06, hips[:, 2].max() + 0.03
    ends = [Mount(np.array([s * x, 0.0, z]), yaw, pitch) for s, yaw in ((1, 0.0), (-1, math.pi))]
    if kind == "lidar":
        return tuple(ends)
    sides = [Mount(np.array([0.0, s * y, z]), s * math.pi / 2, pitch) for s in (1, -1)]
    return (ends[0], sides[0], ends[1], sides[1])


def in_frame(
    scan: Scan, position: np.ndarray, orientation: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A scan in the frame of a pose: origins (M, 3) m, points (M, 3) m, variance (M,) m² of the points' heights.

    position: (3,) m, of the trunk; orientation: (4,) unit quaternion w, x, y, z, frame from trunk.
    """
    rotation = tg.frames.rotation(orientation)
    origins, points = (position + p @ rotation.T for p in (scan.origins, scan.points))
    along = points - origins
    steep = along[:, 2] ** 2 / np.maximum(np.sum(along * along, axis=-1), 1e-12)
    return origins, points, scan.variance * steep + 1e-5  # 3 mm for what the sensor's own error doesn't cover
