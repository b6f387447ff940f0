"""A terrain as MuJoCo geoms: the true geometry, for simulation in MuJoCo C and for pictures."""

from collections.abc import Sequence

import mujoco

from terrains.geometry import UNIT, to_units
from terrains.registry import Terrain

_BELOW = 0.5
"""Geoms reach this far below the floor (m), so that a deep foot is pushed up, not down."""


def add_to_spec(
    spec: mujoco.MjSpec,
    terrain: Terrain,
    *,
    friction: float | Sequence[float] = 1.0,
    rgba: Sequence[float] = (0.55, 0.5, 0.45, 1.0),
    floor_rgba: Sequence[float] = (0.3, 0.32, 0.35, 1.0),
    contype: int = 1,
    conaffinity: int = 1,
    group: int = 0,
    prefix: str = "terrain_",
) -> list[str]:
    """Adds the terrain to a model: a plane at the floor, a box or a cylinder for each primitive.

    Args:
      spec: changed in place; geoms go to its world body.
      friction: sliding friction, or MuJoCo's (sliding, torsional, rolling).
      rgba, floor_rgba: colours of the primitives and of the plane.
      contype, conaffinity, group: as in MuJoCo.
      prefix: names are `{prefix}floor` and `{prefix}0`, `{prefix}1`, ... in the order of the primitives.

    Returns:
      The geoms' names, the floor first.
    """
    given = list(friction) if isinstance(friction, Sequence) else [friction]
    shared = {
        "contype": contype,
        "conaffinity": conaffinity,
        "group": group,
        "friction": given + [0.005, 0.0001][len(given) - 1 :],
    }
    extent = terrain.half_extent + 2.0
    names = [f"{prefix}floor"]
    spec.worldbody.add_geom(
        name=names[0],
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        pos=[0.0, 0.0, terrain.floor],
        size=[extent, extent, 0.1],
        rgba=floor_rgba,
        **shared,
    )
    for number, (cx, cy, hx, hy, radius, top) in enumerate(to_units(terrain.primitives) * UNIT):
        if radius > 0.0 and (hx > 0.0 or hy > 0.0):
            raise ValueError("a rectangle with round corners has no MuJoCo geom; choose a box or a cylinder")
        depth = (top - terrain.floor + _BELOW) / 2
        cylinder = radius > 0.0
        names.append(f"{prefix}{number}")
        spec.worldbody.add_geom(
            name=names[-1],
            type=mujoco.mjtGeom.mjGEOM_CYLINDER if cylinder else mujoco.mjtGeom.mjGEOM_BOX,
            pos=[cx, cy, top - depth],
            size=[radius, depth, 0.0] if cylinder else [hx, hy, depth],
            rgba=rgba,
            **shared,
        )
    return names
