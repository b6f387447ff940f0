"""Shared builder: a quadruped with three joints a leg (abduction +x, hip and knee across) as a MuJoCo spec.

Frames: x forward, y left, z up; SI units; angles in radians.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import mujoco
import numpy as np

LEGS = ("LF", "RF", "LR", "RR")
"""Legs in the order used everywhere: left front, right front, left rear, right rear."""
JOINTS = ("abduction", "hip", "knee")
"""Joints of one leg in the order used everywhere."""
FOOT_GROUP, TRUNK_GROUP = 0, 1
"""Geom groups of the foot spheres and of the trunk's box."""


@dataclasses.dataclass(frozen=True)
class Link:
    """Mass properties of one rigid link."""

    mass: float
    """kg."""
    com: tuple[float, ...]
    """Centre of mass in the link's frame, m."""
    inertia: tuple[float, ...]
    """Matrix entries xx, yy, zz, xy, xz, yz about the centre of mass, kg m^2 (the signs of the matrix)."""

    def mirrored(self) -> Link:
        """The same link on the other side of the xz plane."""
        x, y, z = self.com
        xx, yy, zz, xy, xz, yz = self.inertia
        return Link(self.mass, (x, -y, z), (xx, yy, zz, -xy, xz, -yz))

    def matrix(self) -> np.ndarray:
        """Inertia about the centre of mass, (3, 3) kg m^2."""
        xx, yy, zz, xy, xz, yz = self.inertia
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


@dataclasses.dataclass(frozen=True)
class LegFigures:
    """Everything about one leg."""

    hip: tuple[float, ...]
    """Origin of the abduction joint in the trunk, m."""
    offset: float
    """Lateral way from the abduction joint to the hip joint, left positive, m."""
    thigh: float
    """Hip joint to knee joint, m."""
    shank: float
    """Knee joint to the foot sphere's centre, m."""
    links: tuple[Link, ...]
    """Abduction link, thigh, shank."""
    ranges: tuple[tuple[float, ...], ...]
    """Joint limits, rad."""
    torques: tuple[float, ...]
    """Torque limits, N m."""
    speeds: tuple[float, ...]
    """Speed limits, rad/s."""
    axis_signs: tuple[float, ...] = (1.0, -1.0, -1.0)
    """Abduction turns about +x (1) or -x (-1), hip and knee about +y (1) or -y (-1)."""
    foot_radius: float = 0.025
    """m."""

    def mirrored(self) -> LegFigures:
        """The same leg on the other side of the xz plane, axes unchanged."""
        x, y, z = self.hip
        low, high = self.ranges[0]
        return dataclasses.replace(
            self,
            hip=(x, -y, z),
            offset=-self.offset,
            links=tuple(link.mirrored() for link in self.links),
            ranges=((-high, -low), *self.ranges[1:]),
        )


def mirrored_legs(front: LegFigures, hind: LegFigures) -> tuple[LegFigures, ...]:
    """All legs in order from the left ones."""
    return (front, front.mirrored(), hind, hind.mirrored())


def combine(*links: Link) -> Link:
    """One rigid body from several given in the same frame (parallel axes)."""
    mass = sum(link.mass for link in links)
    com = np.sum([link.mass * np.array(link.com) for link in links], axis=0) / mass
    total = np.zeros((3, 3))
    for link in links:
        r = np.array(link.com) - com
        total += link.matrix() + link.mass * (r @ r * np.eye(3) - np.outer(r, r))
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    return Link(mass, tuple(com.tolist()), tuple(float(total[p]) for p in pairs))


def solid_box(mass: float, size: tuple[float, ...], com: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Link:
    """A homogeneous box of full edge lengths `size`, m."""
    x, y, z = (s * s for s in size)
    return Link(mass, com, (mass * (y + z) / 12, mass * (x + z) / 12, mass * (x + y) / 12, 0.0, 0.0, 0.0))


def solid_cylinder(
    mass: float, radius: float, length: float, com: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> Link:
    """A homogeneous cylinder along y, m."""
    across = mass * (3 * radius**2 + length**2) / 12
    return Link(mass, com, (across, mass * radius**2 / 2, across, 0.0, 0.0, 0.0))


def solid_sphere(mass: float, radius: float, com: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Link:
    """A homogeneous ball, m."""
    inertia = 0.4 * mass * radius**2
    return Link(mass, com, (inertia, inertia, inertia, 0.0, 0.0, 0.0))


def build_quadruped(
    name: str,
    trunk: Link,
    trunk_box: tuple[float, ...],
    legs: Sequence[LegFigures],
    box_centre: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> mujoco.MjSpec:
    """Spec of a quadruped without ground: free joint, legs in LF, RF, LR, RR order, one motor a joint.

    Only the foot spheres can collide (contype 0, conaffinity 1: with anything added to the world, not with
    each other), at their own friction (priority 1). The box "trunk" (full edge lengths, m) only marks the
    trunk's extent.
    """
    spec = mujoco.MjSpec()
    spec.modelname = name
    spec.compiler.degree = False
    spec.compiler.balanceinertia = False
    body = _add_body(spec.worldbody, "trunk", (0.0, 0.0, 0.0), trunk)
    body.add_freejoint(name="root")
    body.add_geom(
        name="trunk",
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[edge / 2 for edge in trunk_box],
        pos=box_centre,
        contype=0,
        conaffinity=0,
        group=TRUNK_GROUP,
        rgba=(0.3, 0.32, 0.36, 1.0),
        mass=0.0,
    )
    speeds = [speed for figures in legs for speed in figures.speeds]
    for leg, figures in zip(LEGS, legs, strict=True):
        _add_leg(spec, body, leg, figures)
    spec.add_numeric(name="joint_speed_limit", data=speeds, size=len(speeds))
    return spec


def _add_body(parent, name: str, pos, link: Link):
    body = parent.add_body(name=name, pos=pos)
    body.explicitinertial = True
    body.mass = link.mass
    body.ipos = link.com
    body.fullinertia = link.inertia
    return body


def _add_leg(spec: mujoco.MjSpec, trunk, leg: str, figures: LegFigures) -> None:
    origins = (figures.hip, (0.0, figures.offset, 0.0), (0.0, 0.0, -figures.thigh))
    roll, pitch, bend = figures.axis_signs
    axes = ((roll, 0.0, 0.0), (0.0, pitch, 0.0), (0.0, bend, 0.0))
    parent = trunk
    for i, part in enumerate(("abduction", "thigh", "shank")):
        parent = _add_body(parent, f"{leg}_{part}", origins[i], figures.links[i])
        joint = f"{leg}_{JOINTS[i]}"
        parent.add_joint(
            name=joint,
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=axes[i],
            range=figures.ranges[i],
            limited=mujoco.mjtLimited.mjLIMITED_TRUE,
        )
        motor = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        motor.ctrlrange = (-figures.torques[i], figures.torques[i])
        motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_TRUE
    foot = (0.0, 0.0, -figures.shank)
    parent.add_geom(
        name=f"{leg}_foot",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=(figures.foot_radius, 0, 0),
        pos=foot,
        contype=0,
        conaffinity=1,
        condim=3,
        priority=1,
        group=FOOT_GROUP,
        rgba=(0.06, 0.06, 0.07, 1.0),
        mass=0.0,
    )
    parent.add_site(name=f"{leg}_foot", pos=foot, size=(0.005, 0.005, 0.005), group=4)
