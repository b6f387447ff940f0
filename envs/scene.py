"""A robot on a terrain's true geometry in MuJoCo C: for evaluation, and for pictures."""

from __future__ import annotations

import colorsys
import math

import mujoco
import numpy as np

from envs.robot import RobotConfig, robot_spec
from envs.robots.look import HIDDEN_GROUP, LOOK_GROUP
from envs.robots.quadruped import LEGS
from terrains import Terrain, add_to_spec, footprint_distance

LIMBS = (0.021, 0.013)
"""Radii of thighs and shanks (m): about what is drawn (`envs.robots.look`)."""
HORIZON = (0.80, 0.86, 0.92)
"""Colour in which sky and ground meet."""
ZENITH = (0.42, 0.60, 0.82)
"""Colour of the sky above."""
SUN = (-0.28, 0.42, -1.0)
"""Direction of its rays."""
OFFSCREEN = (1920, 1080)
"""Largest picture, width and height in pixels."""


def build_scene(
    config: RobotConfig,
    terrain: Terrain | None = None,
    *,
    timestep: float = 0.002,
    iterations: int = 20,
    look: bool = False,
    path: np.ndarray | None = None,
    reach: float = 3.0,
    limbs: bool = False,
    touch: bool = False,
) -> mujoco.MjModel:
    """The robot on a terrain (without one: on a plane); only feet and ground collide, at the feet's friction.

    Args:
      config: the robot; its `foot_friction` holds whatever the ground's own is (the feet have priority).
      terrain: world geometry, its start platform at the origin.
      timestep: s.
      iterations: of the Newton solver, at most.
      look: add what is for the eye alone: shells, colours, sky, light, cameras "track" and "side". The
        physics is the same: what collides is hidden in group 3, and a coloured copy without contact is drawn.
      path: (N, 2) horizontal positions, m; draw only ground within `reach` of one of them.
      reach: m.
      limbs: give thighs and shanks capsules, which hide the ground from range sensors.
      touch: let these collide with the ground, at the feet's friction (and give them).
    """
    spec = robot_spec(config, look=look)
    spec.option.timestep = timestep
    spec.option.iterations = iterations
    spec.option.ls_iterations = 50
    if limbs or touch:
        _add_limbs(spec, config.foot_friction if touch else 0.0)
    group = HIDDEN_GROUP if look else 0
    if terrain is None:
        spec.worldbody.add_geom(
            name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 0.05), group=group
        )
    else:
        add_to_spec(spec, terrain, group=group)
    if look:
        _add_sky(spec)
        _add_light(spec)
        _add_cameras(spec)
        rows = np.zeros((0, 6)) if terrain is None else np.asarray(terrain.primitives, float)
        rows = drawn_pieces(rows)
        if path is not None:
            rows = rows[near(rows, path, reach)]
        _draw_ground(spec, rows, terrain.floor if terrain else 0.0)
    return spec.compile()


def _add_limbs(spec: mujoco.MjSpec, friction: float) -> None:
    """Capsules along thighs and shanks; with a friction they collide with the ground."""
    for name in LEGS:
        thigh, shank, foot = spec.body(f"{name}_thigh"), spec.body(f"{name}_shank"), spec.site(f"{name}_foot")
        for body, end, radius in zip((thigh, shank), (shank.pos, foot.pos), LIMBS, strict=True):
            body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE,
                size=(radius, 0, 0),
                fromto=(0, 0, 0, *end),
                contype=0,
                conaffinity=int(friction > 0),
                friction=(friction, 0.005, 0.0001),
                priority=1,
                group=HIDDEN_GROUP,
                mass=0.0,
            )


def near(primitives: np.ndarray, path: np.ndarray, reach: float) -> np.ndarray:
    """Which of the primitives (N, 6) lie within `reach` (m) of a point of `path` (M, 2); (N,) bool."""
    # A path is recorded at every control step: a point each 5 cm is plenty.
    points = np.unique(np.round(np.asarray(path, float) / 0.05), axis=0) * 0.05
    nearest = np.full(len(primitives), np.inf)
    for x, y in points:
        nearest = np.minimum(nearest, footprint_distance(primitives, x, y))
    return nearest <= reach


# What is drawn of the ground --------------------------------------------------------------------------------


def drawn_pieces(primitives: np.ndarray, largest: float = 0.5) -> np.ndarray:
    """The same solid as primitives (N, 6) that don't overlap, boxes in pieces of at most `largest` m a side.

    MuJoCo adds up the light on coinciding faces, which then glare, and computes fog at a box's corners only.
    """
    boxes, rest = primitives[primitives[:, 4] == 0], primitives[primitives[:, 4] > 0]
    boxes = boxes[np.argsort(-boxes[:, 5], kind="stable")]
    low, high = boxes[:, :2] - boxes[:, 2:4], boxes[:, :2] + boxes[:, 2:4]
    pieces = []
    for i in range(len(boxes)):
        over = np.all((low[:i] < high[i] - 1e-6) & (high[:i] > low[i] + 1e-6), axis=1)
        left = [(*low[i], *high[i])]
        for j in np.flatnonzero(over):
            left = [part for piece in left for part in _cut(piece, (*low[j], *high[j]))]
        pieces += [(*part, boxes[i, 5]) for piece in left for part in _split(piece, largest)]
    cut = np.array(pieces).reshape(-1, 5)
    centre, half = (cut[:, :2] + cut[:, 2:4]) / 2, (cut[:, 2:4] - cut[:, :2]) / 2
    return np.concatenate([np.column_stack([centre, half, np.zeros(len(cut)), cut[:, 4]]), rest])


Rectangle = tuple[float, float, float, float]
"""x and y of the lower corner, x and y of the upper corner, m."""


def _cut(piece: Rectangle, hole: Rectangle) -> list[Rectangle]:
    """What a hole leaves of a rectangle: up to four rectangles."""
    x0, y0, x1, y1 = piece
    a0, b0, a1, b1 = max(x0, hole[0]), max(y0, hole[1]), min(x1, hole[2]), min(y1, hole[3])
    if a0 >= a1 or b0 >= b1:
        return [piece]
    parts = [(x0, y0, a0, y1), (a1, y0, x1, y1), (a0, y0, a1, b0), (a0, b1, a1, y1)]
    return [part for part in parts if part[2] - part[0] > 1e-6 and part[3] - part[1] > 1e-6]


def _split(piece: Rectangle, largest: float) -> list[Rectangle]:
    """Equal parts of a rectangle with sides of at most `largest`."""
    x0, y0, x1, y1 = piece
    xs = np.linspace(x0, x1, math.ceil((x1 - x0) / largest - 1e-6) + 1)
    ys = np.linspace(y0, y1, math.ceil((y1 - y0) / largest - 1e-6) + 1)
    return [(xs[i], ys[j], xs[i + 1], ys[j + 1]) for i in range(len(xs) - 1) for j in range(len(ys) - 1)]


def _draw_ground(spec: mujoco.MjSpec, pieces: np.ndarray, floor: float) -> None:
    """Tops coloured by height, small ones in shades of their own; the plane below chequered, dark where it is
    a pit.
    """
    pit = floor < -0.05
    dark, bright = ((0.30, 0.34, 0.40), (0.34, 0.38, 0.44)) if pit else (_shade(0.0, -0.9), _shade(0.0, 0.3))
    spec.add_texture(
        name="tiles",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=dark,
        rgb2=bright,
        width=256,
        height=256,
    )
    tiles = spec.add_material(
        name="tiles", texrepeat=(1.0, 1.0), texuniform=True, specular=0.1, shininess=0.1
    )
    tiles.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    spec.add_material(name="stone", specular=0.15, shininess=0.2)
    common = {"contype": 0, "conaffinity": 0, "group": LOOK_GROUP}
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE, size=(0, 0, 0.05), pos=(0, 0, floor), material="tiles", **common
    )
    rng = np.random.default_rng(0)
    tones: dict[float, float] = {}
    for cx, cy, hx, hy, radius, top in pieces:
        half = (top - floor + 0.1) / 2
        # Pieces of one step, or of one landing, look alike; neighbouring steps don't.
        tone = rng.uniform(-1, 1)
        if max(hx, hy) >= 0.2:
            tone = tones.setdefault(round(top, 4), 0.9 * (-1) ** len(tones))
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER if radius > 0 else mujoco.mjtGeom.mjGEOM_BOX,
            size=(radius, half, 0) if radius > 0 else (hx, hy, half),
            pos=(cx, cy, top - half),
            material="stone",
            rgba=(*_shade(top, tone), 1.0),
            **common,
        )


def _shade(top: float, tone: float) -> tuple[float, float, float]:
    """Colour (red, green, blue) of a top at this height, m; `tone` in [-1, 1] sets neighbours apart."""
    level = math.tanh(3.0 * top)
    return colorsys.hsv_to_rgb(0.10 - 0.03 * level, 0.24 + 0.16 * level, 0.80 + 0.06 * level + 0.05 * tone)


# Sky, light, cameras ----------------------------------------------------------------------------------------


def _add_sky(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=HORIZON,
        rgb2=ZENITH,
        width=128,
        height=128 * 6,
    )
    spec.visual.rgba.haze = spec.visual.rgba.fog = (*HORIZON, 1.0)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = OFFSCREEN
    # MuJoCo scales the view's lengths by the model's extent; with 1 they are metres.
    spec.stat.extent = 1.0
    spec.visual.map.znear, spec.visual.map.zfar = 0.05, 60.0
    spec.visual.map.fogstart, spec.visual.map.fogend = 2.5, 7.0


def _add_light(spec: mujoco.MjSpec) -> None:
    """A sun that travels along with the robot, so that the shadow map covers little and stays sharp."""
    head, quality = spec.visual.headlight, spec.visual.quality
    head.ambient, head.diffuse, head.specular = (0.36, 0.37, 0.40), (0.24, 0.24, 0.24), (0.05, 0.05, 0.05)
    # Hundreds of cylinders are drawn in software on machines without a screen: half the facets, half the
    # time. quality.numslices, quality.numstacks, quality.numquads = 18, 8, 1
    quality.shadowsize = 2048
    spec.visual.map.shadowclip = 2.6
    spec.body("trunk").add_light(
        name="sun",
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK,
        pos=-4.0 * np.array(SUN),
        dir=SUN,
        diffuse=(0.60, 0.58, 0.54),
        specular=(0.25, 0.25, 0.25),
        castshadow=True,
    )


def _add_cameras(spec: mujoco.MjSpec) -> None:
    """Cameras that travel with the trunk: "track" from the right front, "side" square to the legs."""
    for name, eye in (("track", (1.1, -1.3, 0.8)), ("side", (0.0, -1.7, 0.35))):
        back = np.array(eye) / np.linalg.norm(eye)
        right = np.cross((0.0, 0.0, 1.0), back)
        right /= np.linalg.norm(right)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.stack([right, np.cross(back, right), back], axis=1).reshape(-1))
        spec.body("trunk").add_camera(
            name=name, mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK, pos=eye, quat=quat, fovy=45.0
        )
