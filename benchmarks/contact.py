"""Foot contact: MJX with planes laid against the terrain bank, side by side with MuJoCo C on true boxes and cylinders.

    python -m benchmarks.contact             # a table
    python -m benchmarks.contact json=FILE   # and the same as JSON

A foot (sphere of 25 mm that carries 2 kg and doesn't roll) falls, slides and is pushed on real terrains at the paper's
level. Both engines have the timestep and contact settings of training; MuJoCo C iterates until it has converged.
"""

import dataclasses
import functools
import json
import sys
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

import terrains
from envs import RobotConfig, physics
from envs.robot import robot_spec

RADIUS, MASS, FRICTION, GRAVITY = 0.025, 2.0, 0.8, 9.81
TIMESTEP = 0.005
STEPS = 160
KINDS = ("blocks", "stairs", "stepping_stones", "poles")
STEP = 0.05
"""The edges that are looked for are at least this high (m)."""
SETTINGS = ((1, 1), (2, 1), (1, 2), (2, 2), (1, 4), (2, 4))
"""Planes a foot and Newton iterations that are compared."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One run of the foot."""

    name: str
    """What happens / on which kind."""
    terrain: int
    """Instance."""
    position: np.ndarray
    """(3,) m, of the sphere's centre at the start."""
    velocity: np.ndarray
    """(3,) m/s, at the start."""
    force: np.ndarray
    """(3,) N, all the time, besides the weight."""


@dataclasses.dataclass(frozen=True)
class Edge:
    """A place where the ground falls by at least `STEP`."""

    point: np.ndarray
    """(2,) m."""
    outward: np.ndarray
    """(2,) unit vector to the lower side."""
    top: float
    """m."""
    low: float
    """m."""
    centre: np.ndarray
    """(2,) m, of the primitive."""


# What is simulated ----------------------------------------------------------------------------------------------


def make_terrains(seed: int = 10_000) -> tuple[terrains.Bank, dict[str, int], list[terrains.Terrain]]:
    """One terrain of each of `KINDS`: as a bank, its instance by kind, and the terrains themselves."""
    config = terrains.TerrainConfig(half_extent=2.0, mixed=terrains.MixedConfig(kinds=KINDS))
    count = 16
    bank = terrains.make_bank("mixed", count, seed, ["paper"], config)
    each = [terrains.make_terrain("mixed", "paper", seed, config, index=k) for k in range(count)]
    return bank, {kind: [t.kind for t in each].index(kind) for kind in KINDS}, each


def find_edges(terrain: terrains.Terrain, count: int, seed: int = 0) -> list[Edge]:
    """Edges with level ground for 6 cm on the lower side and 3 cm on the upper one."""
    rng = np.random.default_rng(seed)
    rows = terrain.primitives.astype(np.float64)
    found: list[Edge] = []
    while len(found) < count:
        cx, cy, hx, hy, radius, top = rows[rng.integers(len(rows))]
        if radius > 0:
            angle = rng.uniform(0, 2 * np.pi)
            outward = np.array([np.cos(angle), np.sin(angle)])
            point = np.array([cx, cy]) + radius * outward
        else:
            outward = np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]])[rng.integers(4)]
            along = outward[::-1] * np.array([hx, hy]) * rng.uniform(-0.6, 0.6)
            point = np.array([cx, cy]) + np.array([hx, hy]) * outward + along
        across = np.array([-outward[1], outward[0]])
        side = np.array([-0.03, 0.0, 0.03])[:, None] * across
        outside = point + np.linspace(0.006, 0.06, 10)[:, None, None] * outward + side
        inside = point - np.linspace(0.006, 0.03, 5)[:, None] * outward
        if np.abs(outside).max() > terrain.half_extent - 0.2:
            continue
        low, high = terrains.exact_height(terrain, outside), terrains.exact_height(terrain, inside)
        if np.ptp(low) == 0 and np.allclose(high, top, atol=1e-6) and top - low[0, 0] >= STEP:
            found.append(Edge(point, outward, float(top), float(low[0, 0]), np.array([cx, cy])))
    return found


def make_cases(where: dict[str, int], each: Sequence[terrains.Terrain], count: int = 12) -> list[Case]:
    """`count` runs of everything on every kind of terrain."""
    cases = []
    weight = np.array([0, 0, -MASS * GRAVITY])

    def add(name, kind, xy, z, velocity=(0, 0, 0), force=(0, 0, 0)):
        position = np.array([*xy, z])
        clearance = terrains.signed_distance(each[where[kind]].primitives.astype(np.float64), position).min()
        if clearance > RADIUS - 0.001:  # may be at rest on something, not inside of it
            vectors = (np.array(velocity, float), np.array(force, float))
            cases.append(Case(f"{name} / {kind}", where[kind], position, *vectors))

    for kind in KINDS:
        rng = np.random.default_rng(1)
        for edge in find_edges(each[where[kind]], count):
            out, top, low = edge.outward, edge.top + RADIUS, edge.low + RADIUS
            out3 = np.array([*out, 0.0])
            slant = np.array([-out[1], out[0], 0.0])
            add("dropped on top", kind, edge.point - rng.uniform(0.005, 0.03) * out, top + 0.05)
            add("dropped on the rim", kind, edge.point + rng.uniform(0.0, 0.02) * out, top + 0.05)
            add("slid over the rim", kind, edge.point - 0.025 * out, top - 0.0004, 0.8 * out3 + 0.1 * slant)
            near = edge.point + (RADIUS + 0.015) * out
            add(
                "pushed at the side",
                kind,
                near,
                max(top - 0.08, low + 0.01),
                -0.5 * out3,
                -20 * out3 - weight,
            )
            if kind in ("blocks", "stairs"):
                add(
                    "pushed into the corner", kind, near, low - 0.0004, -0.5 * out3, -30 * out3 + 0.5 * weight
                )
                add("dropped into the corner", kind, near, low + 0.03, -0.5 * out3, -30 * out3 + 5 * slant)
    return cases


# Two engines ----------------------------------------------------------------------------------------------------


def foot_spec() -> mujoco.MjSpec:
    """The foot with the physics options of training and the contact settings of the robot's feet."""
    spec = mujoco.MjSpec()
    training = robot_spec(RobotConfig()).option
    for name in ("integrator", "solver", "cone", "impratio", "iterations", "ls_iterations", "disableflags"):
        setattr(spec.option, name, getattr(training, name))
    spec.option.timestep = TIMESTEP
    spec.option.gravity = (0, 0, -GRAVITY)
    body = spec.worldbody.add_body(name="foot")
    for axis in np.eye(3):
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    body.add_geom(
        name="foot",
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=(RADIUS, 0, 0),
        mass=MASS,
        contype=0,
        conaffinity=1,
        condim=3,
        priority=1,
        friction=(FRICTION, 0.005, 1e-4),
    )
    return spec


def simulate_mjx(
    bank: terrains.Bank, cases: Sequence[Case], num_planes: int, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """Positions (N, T, 3) m and velocities (N, T, 3) m/s of N cases."""
    spec = foot_spec()
    physics.add_planes(spec, "foot", num_planes, FRICTION)
    host = spec.compile()
    model = mjx.put_model(host)
    empty = mjx.make_data(model)
    planes = physics.plane_ids(host, num_planes, ("foot",))
    feet = np.array([host.geom("foot").id])

    def run(terrain, position, velocity, force):
        contact = functools.partial(
            terrains.contact, bank, terrain, floor=bank.floor[terrain], num_planes=num_planes
        )

        def step(data, _):
            data = physics.substep(model, data, planes, feet, contact, force, iterations)
            return data, (data.qpos, data.qvel)

        return jax.lax.scan(step, empty.replace(qpos=position, qvel=velocity), length=STEPS)[1]

    starts = [jnp.asarray(np.stack([getattr(c, f) for c in cases]), jnp.float32) for f in _VECTORS]
    positions, velocities = jax.jit(jax.vmap(run))(jnp.array([c.terrain for c in cases]), *starts)
    return np.asarray(positions, np.float64), np.asarray(velocities, np.float64)


def simulate_c(each: Sequence[terrains.Terrain], cases: Sequence[Case]) -> tuple[np.ndarray, np.ndarray]:
    """The same by MuJoCo C on boxes, cylinders and a plane."""
    models = {}
    for k in {case.terrain for case in cases}:
        spec = foot_spec()
        spec.option.iterations, spec.option.ls_iterations, spec.option.tolerance = 100, 50, 1e-12
        terrains.add_to_spec(spec, each[k])
        models[k] = spec.compile()
    runs = np.zeros((2, len(cases), STEPS, 3))
    for i, case in enumerate(cases):
        data = mujoco.MjData(models[case.terrain])
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = case.position, case.velocity, case.force
        for t in range(STEPS):
            mujoco.mj_step(models[case.terrain], data)
            runs[:, i, t] = data.qpos, data.qvel
    return runs[0], runs[1]


_VECTORS = ("position", "velocity", "force")


# Comparison -----------------------------------------------------------------------------------------------------


def energy(cases: Sequence[Case], positions: np.ndarray, velocities: np.ndarray) -> np.ndarray:
    """(N, T + 1) in units of m g r, from the start: kinetic, and potential of weight and force."""
    position, velocity, force = (np.stack([getattr(c, f) for c in cases])[:, None] for f in _VECTORS)
    positions = np.concatenate([position, positions], axis=1)
    velocities = np.concatenate([velocity, velocities], axis=1)
    kinetic = 0.5 * MASS * (velocities**2).sum(axis=-1)
    potential = MASS * GRAVITY * positions[..., 2] - (force * positions).sum(axis=-1)
    return (kinetic + potential) / (MASS * GRAVITY * RADIUS)


def normals(bank: terrains.Bank, cases: Sequence[Case], positions: np.ndarray) -> np.ndarray:
    """Normal (N, T, 3) of the surface nearest to each position (N, T, 3) m."""

    def one(k, centre):
        return terrains.contact(bank, k, centre, bank.floor[k])[1][:, 0]

    instances = jnp.array([case.terrain for case in cases])
    return np.asarray(jax.jit(jax.vmap(one))(instances, jnp.asarray(positions, jnp.float32)))


def compare(
    bank: terrains.Bank,
    cases: Sequence[Case],
    reference: tuple[np.ndarray, np.ndarray],
    other: tuple[np.ndarray, np.ndarray],
) -> dict[str, np.ndarray]:
    """Deviations of one engine from another, one number a case (N,).

    The first two are taken over the time in which the reference's foot hasn't yet fallen 15 cm: what comes after is the
    floor of a pit, met at 3 m/s a substep sooner or later.

    Returns:
      speed: m/s, largest difference of the speeds along the reference's normal at the same time.
      position: m, largest distance at the same time.
      height: m, difference of the heights at which both have come to rest at the end; NaN if they haven't.
      gain: m g r, largest energy above that of the start.
      rise: m g r, largest climb of the energy above its lowest so far. Contacts are springs: this isn't 0.
      rise_reference: m g r, the same of the reference.
    """
    (p, v), (q, w) = reference, other
    start = np.stack([case.position for case in cases])
    within = np.logical_and.accumulate(p[..., 2] > start[:, None, 2] - 0.15, axis=1)
    along = np.abs(((v - w) * normals(bank, cases, p)).sum(axis=-1))
    # A foot that chatters between tread and riser rests, too; where it does is the mean.
    still = np.linalg.norm(v[:, -20:], axis=-1).max(axis=1) < 0.02
    still &= (np.linalg.norm(w[:, -20:], axis=-1).mean(axis=1) < 0.1) & within.all(axis=1)
    ends = (p - q)[:, -20:, 2].mean(axis=1)
    ours, theirs = energy(cases, q, w), energy(cases, p, v)

    def rise(e):
        return (e - np.minimum.accumulate(e, axis=1)).max(axis=1)

    return {
        "speed": (along * within).max(axis=1),
        "position": (np.linalg.norm(p - q, axis=-1) * within).max(axis=1),
        "height": np.where(still, np.abs(ends), np.nan),
        "gain": (ours - ours[:, :1]).max(axis=1),
        "rise": rise(ours),
        "rise_reference": rise(theirs),
    }


def measure(count: int = 12) -> dict[str, dict[str, dict[str, float]]]:
    """Largest deviations by setting, what happens, and quantity; `speed_median` is the median over the runs."""
    bank, where, each = make_terrains()
    cases = make_cases(where, each, count)
    reference = simulate_c(each, cases)
    names = np.array([case.name for case in cases])
    table: dict[str, dict[str, dict[str, float]]] = {}
    for planes, iterations in SETTINGS:
        found = compare(bank, cases, reference, simulate_mjx(bank, cases, planes, iterations))
        rows = table[f"planes {planes}, iterations {iterations}"] = {}
        for name in dict.fromkeys(names):
            chosen = {key: value[names == name] for key, value in found.items()}
            resting = chosen["height"][~np.isnan(chosen["height"])]
            rows[str(name)] = {
                key: float(value.max()) for key, value in chosen.items() if key != "height"
            } | {
                "height": float(resting.max(initial=0.0)),
                "speed_median": float(np.median(chosen["speed"])),
                "runs": len(chosen["speed"]),
                "resting": len(resting),
            }
    return table


def show(table: dict[str, dict[str, dict[str, float]]]) -> str:
    """The table as text."""
    lines = []
    heads = ("runs", "rest mm", "speed m/s", "median", "away mm", "gain %", "rise %", "C %")
    head = " " * 44 + "".join(
        f"{text:>{width}}" for text, width in zip(heads, (5, 9, 11, 8, 9, 8, 8, 7), strict=True)
    )
    for setting, rows in table.items():
        lines += ["", setting, head]
        lines += [
            f"{name:44}{r['runs']:5.0f}{1e3 * r['height']:9.2f}{r['speed']:11.3f}{r['speed_median']:8.3f}"
            f"{1e3 * r['position']:9.2f}{100 * r['gain']:8.2f}{100 * r['rise']:8.1f}{100 * r['rise_reference']:7.1f}"
            for name, r in rows.items()
        ]
    return "\n".join(lines[1:])


def main(arguments: Sequence[str]) -> None:
    """Prints the table; `json=FILE` also writes it."""
    table = measure()
    print(show(table))
    for argument in arguments:
        key, _, path = argument.partition("=")
        if key != "json" or not path:
            raise SystemExit(f"unknown argument '{argument}'; choose json=FILE")
        with open(path, "w") as file:
            json.dump(table, file, indent=1)


if __name__ == "__main__":
    main(sys.argv[1:])
