"""Max, the paper's robot (Tencent Robotics X), built from the published figures of its URDF.

Figures: `max.urdf` in Tencent-RoboticsX/lifelike-agility-and-play (MIT), commit cc9eaa9. SI units.
"""

from __future__ import annotations

import mujoco

from envs.robots.quadruped import LegFigures, Link, build_quadruped, combine, mirrored_legs

TRUNK = Link(
    5.76855,
    (-0.00458, 0.00307, 0.00948),
    (0.0478275, 0.105776, 0.121012, 0.000562, 0.000155, 0.000541),
)
TRUNK_BOX = (0.283, 0.205, 0.11)
ABDUCTION_INERTIA = (0.00036534, 0.00064755, 0.00041528, 0.0, 0.0, 0.0)
FRONT = LegFigures(
    hip=(0.195, 0.06, 0.0),
    offset=0.09,
    thigh=0.2115,
    shank=0.24,
    links=(
        Link(0.60318, (-0.00287, -0.00035, -0.00047), ABDUCTION_INERTIA),
        # The knee wheel is bolted to the thigh; its own inertia is negligible, its mass is not.
        combine(
            Link(
                0.87783,
                (-0.00070, -0.02582, -0.02735),
                (0.00362810, 0.00369602, 0.00075378, 0.0, 0.0, -0.000522),
            ),
            Link(0.06293, (0.0, 0.0355, -0.2115), (0.0,) * 6),
        ),
        Link(0.16888, (0.00155, 0.0, -0.12442), (0.00151605, 0.00153030, 0.00003410, 0.0, 0.0, 0.0)),
    ),
    ranges=((-0.697, 0.872), (-4.3633, 1.2217), (-2.4496, 2.5440)),
    torques=(18.0, 18.0, 18.0),
    speeds=(20.0, 20.0, 33.0),
)
HIND = LegFigures(
    hip=(-0.195, 0.06, 0.0),
    offset=0.09,
    thigh=0.2115,
    shank=0.24,
    links=(
        Link(0.60318, (0.00287, -0.00035, -0.00047), ABDUCTION_INERTIA),
        combine(
            Link(
                0.89043,
                (-0.00077, -0.02622, -0.02560),
                (0.00366698, 0.00417229, 0.00119996, 0.0, 0.0, -0.000466),
            ),
            Link(0.120, (0.0, 0.04795, -0.2115), (0.0,) * 6),
        ),
        Link(0.28839, (0.00171, 0.0, -0.08671), (0.00208102, 0.00209717, 0.00006551, 0.0, 0.0, 0.0)),
    ),
    ranges=((-0.697, 0.872), (-4.3633, 1.2217), (-2.3995, 2.5855)),
    torques=(18.0, 18.0, 18.0),
    speeds=(20.0, 20.0, 33.0),
)


def build_max() -> mujoco.MjSpec:
    """Spec of Max without ground, 13.0 kg."""
    return build_quadruped("max", TRUNK, TRUNK_BOX, mirrored_legs(FRONT, HIND))
