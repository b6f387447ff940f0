"""A robot from an MJCF file: its figures, read and rebuilt with primitives, in our order and names."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from envs.robots.quadruped import LegFigures, Link, build_quadruped

_TOLERANCE = 1e-4


@dataclasses.dataclass(frozen=True)
class ModelFile:
    """A model file and what it calls the parts of the robot. `{leg}` stands for the leg's name."""

    path: str = ""
    """File to read; empty: use the builder of the robot's name."""
    trunk: str = "trunk"
    """Body of the trunk."""
    legs: str = "FL FR RL RR"
    """The file's names of left front, right front, left rear, right rear, separated by spaces."""
    abduction: str = "{leg}_hip_joint"
    """Joint that moves the leg sideways."""
    hip: str = "{leg}_thigh_joint"
    """Joint that swings the thigh."""
    knee: str = "{leg}_calf_joint"
    """Joint that swings the shank."""
    foot: str = "{leg}"
    """Sphere geom of the foot."""


def build_from_file(source: ModelFile) -> mujoco.MjSpec:
    """Spec of the robot in a file: same masses, inertias, limits, lengths; no meshes, no fixed bodies."""
    spec = mujoco.MjSpec.from_file(source.path)
    spec.compiler.fusestatic = True
    model = spec.compile()
    trunk = _named(model, mujoco.mjtObj.mjOBJ_BODY, source.trunk)
    edges, centre = _trunk_box(model, trunk)
    legs = [_leg(model, source, name) for name in source.legs.split()]
    return build_quadruped(spec.modelname, _link(model, trunk), edges, legs, centre)


def _named(model: mujoco.MjModel, kind: mujoco.mjtObj, name: str) -> int:
    found = mujoco.mj_name2id(model, kind, name)
    if found < 0:
        label = kind.name.removeprefix("mjOBJ_").lower()
        count = {"body": model.nbody, "joint": model.njnt, "geom": model.ngeom}[label]
        names = filter(None, (mujoco.mj_id2name(model, kind, i) for i in range(count)))
        raise ValueError(f"unknown {label} '{name}' in the model file; it has {', '.join(names)}")
    return found


def _rotation(quat: np.ndarray) -> np.ndarray:
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix.reshape(3, 3)


def _link(model: mujoco.MjModel, body: int) -> Link:
    """Mass properties with the principal inertia turned back into the body's frame."""
    rotation = _rotation(model.body_iquat[body])
    m = rotation @ np.diag(model.body_inertia[body]) @ rotation.T
    inertia = (m[0, 0], m[1, 1], m[2, 2], m[0, 1], m[0, 2], m[1, 2])
    return Link(
        float(model.body_mass[body]), tuple(model.body_ipos[body].tolist()), tuple(map(float, inertia))
    )


def _leg(model: mujoco.MjModel, source: ModelFile, name: str) -> LegFigures:
    patterns = (source.abduction, source.hip, source.knee)
    joints = [_named(model, mujoco.mjtObj.mjOBJ_JOINT, pattern.format(leg=name)) for pattern in patterns]
    foot = _named(model, mujoco.mjtObj.mjOBJ_GEOM, source.foot.format(leg=name))
    bodies = model.jnt_bodyid[joints]
    hip, offset, thigh = model.body_pos[bodies]
    shank = model.geom_pos[foot]
    axes = model.jnt_axis[joints]
    _check_leg(
        name, model.body_quat[bodies], model.jnt_pos[joints], (offset[::2], thigh[:2], shank[:2]), axes
    )
    return LegFigures(
        hip=tuple(hip.tolist()),
        offset=float(offset[1]),
        thigh=float(-thigh[2]),
        shank=float(-shank[2]),
        links=tuple(_link(model, body) for body in bodies),
        ranges=tuple(map(tuple, model.jnt_range[joints].tolist())),
        torques=tuple(_torque_limit(model, joint) for joint in joints),
        speeds=(np.inf,) * 3,
        axis_signs=(float(axes[0, 0]), float(axes[1, 1]), float(axes[2, 1])),
        foot_radius=float(model.geom_size[foot, 0]),
    )


def _check_leg(name: str, turns: np.ndarray, shifts: np.ndarray, sideways: tuple, axes: np.ndarray) -> None:
    """The closed-form kinematics hold for legs of this one shape."""
    upright = np.allclose(np.abs(turns[:, 0]), 1, atol=_TOLERANCE) and np.allclose(shifts, 0, atol=_TOLERANCE)
    straight = all(np.allclose(part, 0, atol=_TOLERANCE) for part in sideways)
    along = np.allclose(np.abs(axes[np.arange(3), [0, 1, 1]]), 1, atol=_TOLERANCE)
    if not (upright and straight and along):
        raise ValueError(
            f"unsupported leg '{name}' in the model file: at zero angles the hip must lie beside the "
            "abduction joint, knee and foot straight below the hip, with frames aligned with the trunk's and "
            "axes x, y, y"
        )


def _torque_limit(model: mujoco.MjModel, joint: int) -> float:
    """From the joint, else from the actuator that drives it."""
    if model.jnt_actfrclimited[joint]:
        return float(model.jnt_actfrcrange[joint, 1])
    drives = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    for i in np.flatnonzero(drives & (model.actuator_trnid[:, 0] == joint)):
        if model.actuator_forcelimited[i]:
            return float(model.actuator_forcerange[i, 1])
        if model.actuator_ctrllimited[i] and model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE:
            return float(
                model.actuator_ctrlrange[i, 1] * model.actuator_gainprm[i, 0] * model.actuator_gear[i, 0]
            )
    raise ValueError(
        f"no torque limit for joint '{model.joint(joint).name}' in the model file; give it a forcerange"
    )


def _trunk_box(model: mujoco.MjModel, trunk: int) -> tuple[tuple, tuple]:
    """Edges and centre of the box around the trunk's colliding geoms (or, with none, all), trunk frame, m."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    own = model.geom_bodyid == trunk
    solid = own & ((model.geom_contype != 0) | (model.geom_conaffinity != 0))
    for geom in np.flatnonzero(solid if solid.any() else own):
        rotation = _rotation(model.geom_quat[geom])
        box = model.geom_aabb[geom]
        middle = model.geom_pos[geom] + rotation @ box[:3]
        reach = np.abs(rotation) @ box[3:]
        low, high = np.minimum(low, middle - reach), np.maximum(high, middle + reach)
    if not np.all(np.isfinite(low)):
        raise ValueError("the trunk has no geoms in the model file")
    return tuple((high - low).tolist()), tuple(((high + low) / 2).tolist())
