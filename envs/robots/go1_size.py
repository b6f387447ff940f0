"""A robot of the Unitree Go1's size, 12 kg, its inertias those of homogeneous primitives. SI units.

It differs from Max where code could be tempted to assume: hip and knee turn about +y, so their angles have
the other sign; link lengths, offsets and limits are others too.
"""

from __future__ import annotations

import dataclasses

import mujoco

from envs.robots.quadruped import (
    LegFigures,
    build_quadruped,
    combine,
    mirrored_legs,
    solid_box,
    solid_cylinder,
    solid_sphere,
)

TRUNK_BOX = (0.3762, 0.0935, 0.114)
TRUNK = solid_box(5.2, TRUNK_BOX)
FRONT = LegFigures(
    hip=(0.188, 0.047, 0.0),
    offset=0.08,
    thigh=0.213,
    shank=0.213,
    links=(
        solid_cylinder(0.6, 0.046, 0.04),
        # Hip and knee motors sit together at the top of the thigh.
        combine(
            solid_cylinder(0.7, 0.046, 0.05, (0.0, -0.02, 0.0)),
            solid_box(0.22, (0.034, 0.0245, 0.213), (0.0, 0.0, -0.1065)),
        ),
        combine(
            solid_box(0.12, (0.016, 0.016, 0.213), (0.0, 0.0, -0.1065)),
            solid_sphere(0.06, 0.023, (0, 0, -0.213)),
        ),
    ),
    ranges=((-0.863, 0.863), (-0.686, 4.501), (-2.818, -0.888)),
    torques=(23.7, 23.7, 35.5),
    speeds=(30.1, 30.1, 20.06),
    axis_signs=(1.0, 1.0, 1.0),
    foot_radius=0.023,
)
HIND = dataclasses.replace(FRONT, hip=(-0.188, 0.047, 0.0))


def build_go1_size() -> mujoco.MjSpec:
    """Spec of the Go1-sized robot without ground, 12 kg."""
    return build_quadruped("go1_size", TRUNK, TRUNK_BOX, mirrored_legs(FRONT, HIND))
