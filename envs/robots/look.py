"""What the robot looks like: geoms that are drawn and nothing else. Training leaves them out."""

from __future__ import annotations

import mujoco
import numpy as np

from envs.robots.quadruped import LEGS

LOOK_GROUP = 2
"""Geom group of what is drawn."""
HIDDEN_GROUP = 3
"""Geom group of what something prettier is drawn for; viewers hide it by default."""
SHELL = (0.90, 0.91, 0.93, 1.0)
FRAME = (0.17, 0.18, 0.21, 1.0)
MOTOR = (0.27, 0.29, 0.33, 1.0)
ACCENT = (0.98, 0.47, 0.10, 1.0)
EYE = (0.25, 0.85, 1.00, 1.0)
FOOT = (0.98, 0.47, 0.10, 1.0)


def dress(spec: mujoco.MjSpec) -> None:
    """Add shells, motors and a face to a robot of `build_quadruped`; sizes follow its own figures."""
    _add_materials(spec)
    _dress_trunk(spec)
    for leg in LEGS:
        _dress_leg(spec, leg)


def _add_materials(spec: mujoco.MjSpec) -> None:
    gloss = {"shell": (SHELL, 0.6, 0.5), "frame": (FRAME, 0.4, 0.3), "motor": (MOTOR, 0.7, 0.5)}
    gloss |= {"accent": (ACCENT, 0.5, 0.4), "eye": (EYE, 0.9, 0.9), "rubber": (FOOT, 0.1, 0.1)}
    for name, (rgba, specular, shininess) in gloss.items():
        spec.add_material(
            name=name,
            rgba=rgba,
            specular=specular,
            shininess=shininess,
            emission=0.8 if name == "eye" else 0.0,
        )


def _draw(body, kind: str, material: str, **place) -> None:
    body.add_geom(
        type=getattr(mujoco.mjtGeom, f"mjGEOM_{kind}"),
        contype=0,
        conaffinity=0,
        group=LOOK_GROUP,
        material=material,
        mass=0.0,
        **place,
    )


def _dress_trunk(spec: mujoco.MjSpec) -> None:
    trunk, box = spec.body("trunk"), spec.geom("trunk")
    box.group = HIDDEN_GROUP
    centre, (hx, hy, hz) = np.array(box.pos), box.size
    edge = 0.25 * min(hy, hz)
    _draw(trunk, "BOX", "shell", pos=centre, size=(hx - edge, hy, hz - edge))
    _draw(trunk, "BOX", "shell", pos=centre, size=(hx - edge, hy - edge, hz))
    for y in (-1, 1):
        for z in (-1, 1):
            ends = [centre + (x * (hx - 2 * edge), y * (hy - edge), z * (hz - edge)) for x in (-1, 1)]
            _draw(trunk, "CAPSULE", "shell", size=(edge, 0, 0), fromto=np.concatenate(ends))
    _draw(trunk, "BOX", "frame", pos=centre + (0, 0, hz), size=(0.72 * hx, 0.55 * hy, 0.004))
    _draw(trunk, "BOX", "accent", pos=centre + (-0.45 * hx, 0, hz), size=(0.05 * hx, 0.55 * hy, 0.006))
    _dress_ends(spec, trunk, centre, hy, hz)


def _dress_ends(spec: mujoco.MjSpec, trunk, centre: np.ndarray, hy: float, hz: float) -> None:
    """Nose and tail between the hips, and a face that shows which way is forward."""
    front = spec.body("LF_abduction").pos[0] + 0.03
    rear = spec.body("LR_abduction").pos[0] - 0.03
    width = 0.5 * min(hy, abs(spec.body("LF_abduction").pos[1]) + 0.02)
    _draw(
        trunk,
        "BOX",
        "frame",
        pos=(0.5 * (front + rear), centre[1], centre[2]),
        size=(0.5 * (front - rear), width, 0.6 * hz),
    )
    nose = np.array([front, centre[1], centre[2]])
    _draw(trunk, "ELLIPSOID", "shell", pos=nose, size=(0.05, 1.15 * width, 0.75 * hz))
    _draw(trunk, "BOX", "frame", pos=nose + (0.03, 0, 0.1 * hz), size=(0.018, 0.7 * width, 0.22 * hz))
    for y in (-1, 1):
        _draw(trunk, "SPHERE", "eye", pos=nose + (0.046, 0.4 * y * width, 0.1 * hz), size=(0.008, 0, 0))
    tail = np.array([rear, centre[1], centre[2]])
    _draw(trunk, "ELLIPSOID", "frame", pos=tail, size=(0.03, width, 0.55 * hz))


def _dress_leg(spec: mujoco.MjSpec, leg: str) -> None:
    abduction, thigh, shank = (spec.body(f"{leg}_{part}") for part in ("abduction", "thigh", "shank"))
    offset, knee, foot = thigh.pos[1], shank.pos[2], spec.site(f"{leg}_foot").pos[2]
    out = np.sign(offset)
    _draw(abduction, "CYLINDER", "motor", size=(0.042, 0, 0), fromto=(-0.035, 0, 0, 0.035, 0, 0))
    _draw(abduction, "CYLINDER", "frame", size=(0.036, 0, 0), fromto=(0, 0, 0, 0, offset - out * 0.02, 0))
    _draw(thigh, "CYLINDER", "motor", size=(0.045, 0, 0), fromto=(0, -out * 0.045, 0, 0, out * 0.02, 0))
    _draw(thigh, "CYLINDER", "accent", size=(0.030, 0, 0), fromto=(0, out * 0.02, 0, 0, out * 0.024, 0))
    _draw(thigh, "BOX", "shell", pos=(0, 0, 0.5 * knee), size=(0.023, 0.014, 0.42 * abs(knee)))
    _draw(thigh, "CAPSULE", "shell", size=(0.021, 0, 0), fromto=(0, 0, 0.15 * knee, 0, 0, knee))
    _draw(
        thigh, "CYLINDER", "motor", size=(0.028, 0, 0), fromto=(0, -out * 0.022, knee, 0, out * 0.022, knee)
    )
    _draw(shank, "CAPSULE", "frame", size=(0.015, 0, 0), fromto=(0, 0, 0, 0, 0, 0.45 * foot))
    _draw(shank, "CAPSULE", "frame", size=(0.011, 0, 0), fromto=(0, 0, 0.4 * foot, 0, 0, foot))
    sole = spec.geom(f"{leg}_foot")
    sole.material, sole.rgba = "rubber", FOOT
