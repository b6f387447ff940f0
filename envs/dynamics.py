"""The physics substep of a trunk with four legs of three hinges, as MJX computes it, but for nothing else.

MJX treats any mechanism: under `jax.vmap` its substep is hundreds of gathers, scatters, small matrix products and
18 x 18 factorisations. This robot's matrices have a shape that needs none of them. Every constraint, a joint's limit
or a foot's contact, moves the trunk (6 degrees of freedom) and one leg (3) alone, so the mass matrix and the Newton
solver's Hessian both are arrowheads: a block of 6 x 6, four of 3 x 3, and what couples each of these with the first.
They are solved leg by leg (Featherstone 2008, Rigid Body Dynamics Algorithms, section 6.5: branches induce sparsity).

The batch is the last axis of every array, along which a processor's vector units work: (..., L, B). What is small is
written out by components (`envs.algebra`), all in one frame T: the trunk's axes at its origin. Velocities of the trunk,
which MuJoCo has in the world's axes, are turned into T and back; as that is a rotation, the solver takes the same
steps. Units: m, rad, s, kg, N. Letters: B environments, L = 4 legs, S spheres that touch the terrain (the feet, or feet
and knees), N planes a sphere, R rows of constraints.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import algebra
from envs.algebra import (
    Component,
    Matrix,
    Symmetric,
    Vector,
    apply,
    columns,
    constant,
    cross,
    dot,
    matrix_columns,
    minus,
    plus,
    scaled,
    symmetric_apply,
    times,
    total,
)

NUM_LEGS, LEG_JOINTS = 4, 3
_EPS = float(np.finfo(np.float32).eps)
_FAR = 1e6
"""The range of a joint without limits (rad)."""


class Inertia(NamedTuple):
    """Of a body, or of several that move as one, about T's origin."""

    mass: Component
    """kg."""
    moment: Vector
    """Mass times the centre's position, kg m."""
    matrix: Symmetric
    """kg m²."""


class Motion(NamedTuple):
    """A spatial velocity or acceleration at T's origin."""

    angular: Vector
    linear: Vector


class Force(NamedTuple):
    """A spatial force at T's origin."""

    torque: Vector
    force: Vector


class Legs(NamedTuple):
    """Where the legs are, in T."""

    axes: Vector
    """Of the joints, (3, L, B)."""
    anchors: Vector
    """Points on them (m), (3, L, B)."""
    frames: Matrix
    """Of the links, (3, L, B)."""
    spheres: tuple[Vector, ...]
    """Centres (m) of what touches the terrain, (L, B): of the feet, and of the knees if these do."""


def pin(tree: Any) -> Any:
    """The same, computed once: the compiler would rather compute it again wherever it is used."""
    leaves, structure = jax.tree.flatten(tree)
    arrays = [x for x in leaves if isinstance(x, jax.Array)]
    held = iter(jax.lax.platform_dependent(*arrays, cpu=_hold, default=_barrier))
    return jax.tree.unflatten(structure, [next(held) if isinstance(x, jax.Array) else x for x in leaves])


def _barrier(*arrays: jax.Array) -> tuple[jax.Array, ...]:
    return tuple(jax.lax.optimization_barrier(arrays))


def _hold(*arrays: jax.Array) -> tuple[jax.Array, ...]:
    """XLA drops barriers on CPUs before it fuses, but fuses nothing across a loop, even one that is never entered."""
    first = arrays[0].reshape(-1)[0]
    never = first * first < -1.0
    change = lambda c: (c[0] & False, *(0.5 * x for x in c[1:]))  # noqa: E731
    return tuple(jax.lax.while_loop(lambda c: c[0], change, (never, *arrays))[1:])


# Arrowheads -------------------------------------------------------------------------------------------------------


class Joints(NamedTuple):
    """Generalised velocities, accelerations or forces."""

    trunk: jax.Array
    """(6, B): linear, angular, both in the trunk's axes."""
    legs: jax.Array
    """(3, L, B): abduction, hip, knee."""

    @property
    def each(self) -> jax.Array:
        """(9, L, B): what each leg sees of them, the trunk's first."""
        shape = (6, *self.legs.shape[1:-1], self.trunk.shape[-1])
        return jnp.concatenate([jnp.broadcast_to(self.trunk[:, None], shape), self.legs])


class Arrowhead(NamedTuple):
    """A symmetric matrix over `Joints` without entries between legs."""

    trunk: jax.Array
    """(6, 6, B)."""
    legs: jax.Array
    """(3, 9, L, B): rows of a leg's joints, the trunk's columns first."""


def multiply(m: Arrowhead, x: Joints) -> Joints:
    """m x."""
    legs = jnp.sum(m.legs * x.each, axis=1)
    trunk = jnp.sum(m.trunk * x.trunk, axis=1) + jnp.sum(m.legs[:, :6] * x.legs[:, None], axis=(0, 2))
    return Joints(trunk, legs)


def solve(m: Arrowhead, b: Joints) -> Joints:
    """m⁻¹ b: four legs of 3 x 3, then the trunk's 6 x 6 less what they take, then the legs again."""
    # Each leg's rows turn into [A⁻¹ C, 1, A⁻¹ b].
    legs = eliminate(jnp.concatenate([m.legs, b.legs[:, None]], axis=1), 6)
    rest = jnp.concatenate([legs[:, :6], legs[:, 9:]], axis=1)
    taken = jnp.sum(m.legs[:, :6, None] * rest[:, None], axis=(0, 3))
    trunk = eliminate(jnp.concatenate([m.trunk, b.trunk[:, None]], axis=1) - taken, 0)[:, 6]
    return Joints(trunk, legs[:, 9] - jnp.sum(legs[:, :6] * trunk[:, None], axis=1))


def eliminate(rows: jax.Array, first: int) -> jax.Array:
    """Gauss-Jordan: rows (n, m, ...) of which columns first to first + n become the unit matrix, by symmetry stable."""
    size = rows.shape[0]
    place = jnp.arange(size).reshape((size,) + (1,) * (rows.ndim - 1))

    def step(k: jax.Array, rows: jax.Array) -> jax.Array:
        row = jax.lax.dynamic_index_in_dim(rows, k, 0)
        row = row / jax.lax.dynamic_index_in_dim(row, first + k, 1)
        column = jax.lax.dynamic_index_in_dim(rows, first + k, 1)
        return jnp.where(place == k, row, rows - column * row)

    return jax.lax.fori_loop(0, size, step, rows)


def inner(a: Joints, b: Joints) -> jax.Array:
    """a · b, (B,)."""
    return jnp.sum(a.trunk * b.trunk, axis=0) + jnp.sum(a.legs * b.legs, axis=(0, 1))


def difference(a: Joints, b: Joints) -> Joints:
    """a - b."""
    return Joints(a.trunk - b.trunk, a.legs - b.legs)


def moved(a: Joints, alpha: Component, b: Joints) -> Joints:
    """a + alpha b."""
    return Joints(a.trunk + alpha * b.trunk, a.legs + alpha * b.legs)


# Constraints ------------------------------------------------------------------------------------------------------


class Contacts(NamedTuple):
    """What one plane a foot does, or one a knee."""

    jacobian: jax.Array
    """(3, 9, L, B): speed of the point that touches along normal and two tangents, by what a leg sees."""
    mass: jax.Array
    """(L, B): D, regularised mass of each edge of the pyramid; 0 where it doesn't touch."""
    aref: jax.Array
    """(4, L, B): acceleration of reference along each of the edges."""


class Limits(NamedTuple):
    """What the joints' limits do, (3, L, B) each."""

    sign: jax.Array
    mass: jax.Array
    """D, 0 within the range."""
    aref: jax.Array


def edges(c: jax.Array, x: jax.Array, mu: jax.Array) -> jax.Array:
    """J x (4, L, B) along the edges of the pyramid: n + μ t, n - μ t, for both tangents; x is `Joints.each`."""
    n, s, t = jnp.sum(c * x, axis=1)
    return jnp.stack([n + mu * s, n - mu * s, n + mu * t, n - mu * t])


class Problem(NamedTuple):
    """What the solver minimises: ½ (x - x0)ᵀ M (x - x0) + ½ Σ D min(J x - a, 0)² (MuJoCo documentation, Computation).

    Rows R: 4 edges of each contact, 3 limits.
    """

    matrix: Arrowhead
    force: Joints
    """M x0: all forces but the constraints'."""
    free: Joints
    """x0: accelerations without constraints."""
    contacts: tuple[Contacts, ...]
    limits: Limits
    mass: jax.Array
    """(R, L, B): D."""
    mu: jax.Array
    """(B,): friction."""

    def rows(self, x: Joints) -> jax.Array:
        """J x (R, L, B)."""
        each = x.each
        parts = [edges(c.jacobian, each, self.mu) for c in self.contacts]
        return jnp.concatenate([*parts, self.limits.sign * x.legs])

    @property
    def aref(self) -> jax.Array:
        """a (R, L, B)."""
        return jnp.concatenate([*(c.aref for c in self.contacts), self.limits.aref])

    def transposed(self, f: jax.Array) -> Joints:
        """Jᵀ f."""
        trunk, legs = jnp.zeros((6, f.shape[-1])), self.limits.sign * f[-3:]
        for i, c in enumerate(self.contacts):
            a, b, p, q = f[4 * i : 4 * i + 4]
            along = jnp.stack([a + b + p + q, self.mu * (a - b), self.mu * (p - q)])
            each = c.jacobian * along[:, None]
            trunk, legs = trunk + jnp.sum(each[:, :6], axis=(0, 2)), legs + jnp.sum(each[:, 6:], axis=0)
        return Joints(trunk, legs)

    def hessian(self, d: jax.Array) -> Arrowhead:
        """M + Jᵀ D J."""
        trunk, legs = self.matrix
        for i, c in enumerate(self.contacts):
            a, b, p, q = d[4 * i : 4 * i + 4]
            ns, nt = self.mu * (a - b), self.mu * (p - q)
            ss, tt = self.mu * self.mu * (a + b), self.mu * self.mu * (p + q)
            n, s, t = c.jacobian
            pressed = jnp.stack([(a + b + p + q) * n + ns * s + nt * t, ns * n + ss * s, nt * n + tt * t])
            pressed = pin(pressed)
            trunk = trunk + jnp.sum(c.jacobian[:, :6, None] * pressed[:, None, :6], axis=(0, 3))
            legs = legs + jnp.sum(c.jacobian[:, 6:, None] * pressed[:, None], axis=0)
        unit = np.eye(9)[6:, :, None, None]
        return Arrowhead(trunk, legs + jnp.asarray(unit, jnp.float32) * d[-3:, None])

    def gauss(self, x: Joints, mx: Joints) -> jax.Array:
        """½ (x - x0)ᵀ M (x - x0), given M x, (B,)."""
        return 0.5 * inner(difference(mx, self.force), difference(x, self.free))

    def penalty(self, residual: jax.Array) -> jax.Array:
        """½ Σ D min(r, 0)², (B,)."""
        return 0.5 * jnp.sum(self.mass * jnp.square(jnp.minimum(residual, 0.0)), axis=(0, 1))


def minimise(problem: Problem, warm: Joints, iterations: int, ls_iterations: int, tolerance: float) -> Joints:
    """Accelerations by so many Newton steps, from the last accelerations or the free ones, whichever cost less."""
    m_warm = multiply(problem.matrix, warm)
    residual, free = problem.rows(warm) - problem.aref, problem.rows(problem.free) - problem.aref
    better = problem.gauss(warm, m_warm) + problem.penalty(residual) < problem.penalty(free)
    start = jax.tree.map(
        lambda a, b: jnp.where(better, a, b), (warm, m_warm, residual), (problem.free, problem.force, free)
    )
    step = functools.partial(newton, problem, ls_iterations, tolerance)
    return jax.lax.fori_loop(0, iterations, lambda _, now: step(*now), start)[0]


def newton(
    problem: Problem, ls_iterations: int, tolerance: float, x: Joints, mx: Joints, residual: jax.Array
) -> tuple[Joints, Joints, jax.Array]:
    """One Newton step with a line search: x, M x and J x - a (R, L, B), before and after it."""
    active = jnp.where(residual < 0, problem.mass, 0.0)
    without = difference(mx, problem.force)
    gradient = difference(without, problem.transposed(-active * residual))
    step = solve(problem.hessian(active), Joints(-gradient.trunk, -gradient.legs))
    m_step, slope = pin((multiply(problem.matrix, step), problem.rows(step)))
    gauss = jnp.stack([problem.gauss(x, mx), inner(step, without), 0.5 * inner(step, m_step)])
    joints = problem.matrix.legs[:, 6:]
    trace = sum(problem.matrix.trunk[i, i] for i in range(6)) + sum(
        jnp.sum(joints[j, j], axis=0) for j in range(3)
    )
    smallest = tolerance * trace * jnp.sqrt(inner(step, step))
    alpha = line_search(problem.mass, residual, slope, gauss, smallest, ls_iterations)
    return moved(x, alpha, step), moved(mx, alpha, m_step), residual + alpha * slope


Three = tuple[jax.Array, jax.Array, jax.Array]


class Points(NamedTuple):
    """The cost at P places along a line, and its derivatives, (P, B) each."""

    alpha: jax.Array
    cost: jax.Array
    slope: jax.Array
    curvature: jax.Array


def line_search(
    mass: jax.Array,
    residual: jax.Array,
    slope: jax.Array,
    gauss: jax.Array,
    smallest: jax.Array,
    iterations: int,
) -> jax.Array:
    """How far to go (B,), as `mjx._src.solver._linesearch` finds it; 0 if nothing is better.

    Args:
      mass: D of each row, (R, L, B).
      residual: J x - a of each row.
      slope: J times the step.
      gauss: (3, B) coefficients of 1, α and α² of the rest of the cost.
      smallest: derivative that counts as 0 (B,).
      iterations: of the search.
    """

    def at(alpha: jax.Array) -> Points:
        def add_row(sums: Three, row: Three) -> tuple[Three, None]:
            d, r, s = row
            x = r + alpha[:, None] * s
            force = d * jnp.minimum(x, 0.0)
            curvature = jnp.where(x < 0, d * s * s, 0.0)
            return (sums[0] + force * x, sums[1] + force * s, sums[2] + curvature), None

        zero = jnp.zeros((alpha.shape[0], *residual.shape[1:]))
        sums = jax.lax.scan(add_row, (zero, zero, zero), (mass, residual, slope))[0]
        cost, first, second = (jnp.sum(x, axis=1) for x in sums)
        return Points(
            alpha,
            0.5 * cost + gauss[0] + alpha * (gauss[1] + alpha * gauss[2]),
            first + gauss[1] + 2.0 * alpha * gauss[2],
            second + 2.0 * gauss[2],
        )

    start = at(jnp.zeros_like(smallest)[None])
    quadratic = jnp.maximum(start.cost - gauss[0], 0.0) * jnp.maximum(0.5 * start.curvature - gauss[2], 0.0)
    enough = jnp.maximum(smallest, 8.0 * _EPS * (2.0 * jnp.sqrt(quadratic) + jnp.abs(gauss[1])))

    def flat(p: Points) -> jax.Array:
        return (jnp.abs(p.slope) < enough) & (p.cost < start.cost)

    first = at(start.alpha - start.slope / start.curvature)
    falls = first.slope < start.slope
    low, high = _either(falls, first, start), _either(falls, start, first)

    def narrow(_: jax.Array, now: tuple[Points, Points, jax.Array]) -> tuple[Points, Points, jax.Array]:
        low, high, going = now
        new_low, new_high, swapped = _narrowed(low, high, at, flat)
        low, high = _either(going, new_low, low), _either(going, new_high, high)
        return low, high, going & swapped & ~(flat(low) | flat(high))

    low, high, _ = jax.lax.fori_loop(0, iterations, narrow, (low, high, ~(flat(low) | flat(high))))
    improved = (low.cost < start.cost) | (high.cost < start.cost)
    return jnp.where(improved, jnp.where(low.cost < high.cost, low.alpha, high.alpha), 0.0)[0]


def _either(condition: jax.Array, a: Points, b: Points) -> Points:
    return Points(*(jnp.where(condition, x, y) for x, y in zip(a, b, strict=True)))


def _between(x: jax.Array, y: jax.Array) -> jax.Array:
    """Whether a slope y is nearer to 0 than x, on the same side."""
    return ((x < y) & (y < 0)) | ((x > y) & (y > 0))


def _narrowed(low: Points, high: Points, at: Any, flat: Any) -> tuple[Points, Points, jax.Array]:
    """The next bracket, and whether the search goes on."""
    places = [low.alpha - low.slope / low.curvature, high.alpha - high.slope / high.curvature]
    three = pin(at(jnp.concatenate([*places, 0.5 * (low.alpha + high.alpha)])))
    from_low, from_high, middle = (Points(*(a[i : i + 1] for a in three)) for i in range(3))
    swapped = jnp.zeros(low.alpha.shape, bool)
    new_low, new_high = low, high
    for point in (from_low, middle, from_high):
        swap = _between(new_low.slope, point.slope)
        new_low, swapped = _either(swap, point, new_low), swapped | swap
    for point in (from_high, middle, from_low):
        swap = _between(new_high.slope, point.slope)
        if point is from_high:
            # A Newton step from a place short of the minimum may cross it.
            swap |= (new_high.slope < 0) & (point.slope > 0)
        new_high, swapped = _either(swap, point, new_high), swapped | swap
    # A point where the slope is 0 ends it; of several the one that costs least.
    best, found = from_low, flat(from_low)
    for point in (from_high, middle):
        better = flat(point) & (~found | (point.cost < best.cost))
        best, found = _either(better, point, best), found | flat(point)
    return _either(found, best, new_low), _either(found, best, new_high), swapped & ~found


# Spatial algebra --------------------------------------------------------------------------------------------------


def momentum(i: Inertia, v: Motion) -> Force:
    """I v (Featherstone 2008, table 2.1)."""
    torque = plus(symmetric_apply(i.matrix, v.angular), cross(i.moment, v.linear))
    return Force(torque, minus(scaled(i.mass, v.linear), cross(i.moment, v.angular)))


def motion_cross(v: Motion, w: Motion) -> Motion:
    """v × w."""
    return Motion(cross(v.angular, w.angular), plus(cross(v.angular, w.linear), cross(v.linear, w.angular)))


def force_cross(v: Motion, f: Force) -> Force:
    """v ×* f."""
    return Force(plus(cross(v.angular, f.torque), cross(v.linear, f.force)), cross(v.angular, f.force))


def power(s: Motion, f: Force) -> Component:
    """s · f."""
    return total(dot(s.angular, f.torque), dot(s.linear, f.force))


def add(*parts: Any) -> Any:
    """The sum of inertias, motions or forces."""
    sums = [plus(*part) if isinstance(part[0], tuple) else total(*part) for part in zip(*parts, strict=True)]
    return type(parts[0])(*sums)


def shifted(mass: Component, centre: Vector, matrix: Symmetric) -> Inertia:
    """Of a body about T's origin, from that about its centre of mass."""
    h = scaled(mass, centre)
    x, y, z = (times(h[i], centre[i]) for i in range(3))
    products = (
        *(total(y, z), total(x, z), total(x, y)),
        *(times(-1.0, times(h[i], centre[j])) for i, j in ((0, 1), (0, 2), (1, 2))),
    )
    return Inertia(mass, h, plus(matrix, products))


def turned(frame: Matrix, s: Symmetric) -> Symmetric:
    """F s Fᵀ."""
    x, y, z = (symmetric_apply(s, e) for e in algebra.IDENTITY)
    return algebra.outer_sum(algebra.compose(frame, (x, y, z)), frame)


def _matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4)."""
    found = np.zeros((*quaternions.shape[:-1], 9))
    for place in np.ndindex(quaternions.shape[:-1]):
        mujoco.mju_quat2Mat(found[place], quaternions[place])
    return found.reshape(*quaternions.shape[:-1], 3, 3)


def _along(axis: np.ndarray) -> np.ndarray:
    """A rotation (3, 3) whose first column is a unit vector (3,); of zeros and ones for a coordinate axis."""
    second = np.eye(3)[np.argmin(np.abs(axis))]
    second = second - axis * (axis @ second)
    second /= np.linalg.norm(second)
    return np.stack([axis, second, np.cross(axis, second)], axis=1)


class Impedance(NamedTuple):
    """Stiffness, damping and impedance of constraints (MuJoCo documentation, Modeling, Solver parameters)."""

    stiffness: Component
    damping: Component
    solimp: tuple[Component, ...]
    """d_0, d_width, width, midpoint."""
    power: float

    def at(self, pos: Component) -> Component:
        """Impedance at a violation of so many m or rad."""
        low, high, width, middle = self.solimp
        x = jnp.abs(pos) / width
        below = raised(x, self.power) / raised(middle, self.power - 1)
        above = 1.0 - raised(1.0 - x, self.power) / raised(1.0 - middle, self.power - 1)
        d = low + jnp.where(x < middle, below, above) * (high - low)
        return jnp.where(x > 1.0, high, jnp.clip(d, low, high))


def raised(x: Component, power: float) -> Component:
    """x^power, by products where they do."""
    if power in (0.0, 1.0, 2.0, 3.0):
        return functools.reduce(lambda a, b: a * b, [x] * int(power), 1.0)
    return x**power


def _impedance(model: mujoco.MjModel, solref: np.ndarray, solimp: np.ndarray) -> Impedance:
    """As `mjx._src.constraint._kbi` has it, of constraints (..., 2) and (..., 5)."""
    timeconst, ratio = np.moveaxis(solref, -1, 0)
    low, high, width, middle, power = np.moveaxis(solimp, -1, 0)
    low, high, middle = (np.clip(x, mujoco.mjMINIMP, mujoco.mjMAXIMP) for x in (low, high, middle))
    slow = np.maximum(timeconst, 2 * model.opt.timestep)
    standard = 1 / (high * slow * ratio) ** 2, 2 / (high * slow)
    stiffness = np.where(timeconst <= 0, -timeconst / high**2, standard[0])
    damping = np.where(ratio <= 0, -ratio / high, standard[1])
    width = np.maximum(mujoco.mjMINVAL, width)
    parts = (constant(x) for x in (low, high, width, middle))
    return Impedance(constant(stiffness), constant(damping), tuple(parts), float(max(power.flat[0], 1.0)))


class Sphere(NamedTuple):
    """What touches the terrain at each leg: its foot, or its knee."""

    link: int
    """Of a leg, to which it belongs: 2 the shank, 1 the thigh."""
    centre: Vector
    """In the link's frame, from its joint (m), (L, 1)."""
    radius: Component
    """m."""
    weight: Component
    """Inverse weight of the link, `body_invweight0`."""
    impedance: list[Impedance]
    """Of each plane."""
    margin: list[Component]
    """m, likewise."""


class TreeDynamics:
    """The substep of one robot.

    Args:
      model: of `physics.physics_model`.
      planes: (S, N) geom ids of the terrain's planes.
      spheres: (S,) geom ids of the spheres that touch them: the feet, then the knees if these do.

    Raises:
      ValueError: the model has something that isn't covered here.
    """

    def __init__(self, model: mujoco.MjModel, planes: np.ndarray, spheres: np.ndarray):
        reason = not_covered(model, planes, spheres)
        if reason:
            raise ValueError(reason)
        self.timestep = float(model.opt.timestep)
        self.gravity = columns(model.opt.gravity[None])
        self.ls_iterations = int(model.opt.ls_iterations)
        self.tolerance = float(model.opt.tolerance * model.opt.ls_tolerance)
        self.impratio = float(model.opt.impratio)
        self.friction = float(model.pair_friction[0, 0])
        bodies = _chains(model, spheres[:NUM_LEGS])
        self._read_trunk(model, int(model.body_parentid[bodies[0, 0]]))
        anchors, along = self._read_links(model, bodies)
        self._read_joints(model, bodies)
        self.spheres = _spheres(model, bodies, planes, spheres, anchors, along)

    def _read_trunk(self, model: mujoco.MjModel, trunk: int) -> None:
        turn = _matrices(model.body_iquat[trunk])
        self.trunk_mass = float(model.body_mass[trunk])
        matrix = turn @ np.diag(model.body_inertia[trunk]) @ turn.T
        self.trunk_matrix = algebra.symmetric(matrix.tolist())
        self.trunk_centre = columns(model.body_ipos[trunk][None])

    def _read_links(self, model: mujoco.MjModel, bodies: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Each link in a frame of its own, at its joint's anchor and with the joint's axis as x; links first.

        Returns the anchors (3, L, 3) m, and these frames' axes as columns (3, L, 3, 3), in the bodies' frames.
        """
        bodies = bodies.T
        joints = model.body_jntadr[bodies]
        anchor, own = model.jnt_pos[joints], _matrices(model.body_quat[bodies])
        along = np.array([[_along(axis) for axis in row] for row in model.jnt_axis[joints]])
        # From the link before, in its frame of this kind, to this one's anchor; and the rotation at angle 0.
        before = np.concatenate([np.tile(np.eye(3), (1, NUM_LEGS, 1, 1)), along[:-1]])
        start = np.concatenate([np.zeros((1, NUM_LEGS, 3)), anchor[:-1]])
        offset = model.body_pos[bodies] + np.einsum("jlab,jlb->jla", own, anchor) - start
        self.offset = [columns(a) for a in np.einsum("jlba,jlb->jla", before, offset)]
        self.turn = [matrix_columns(a) for a in np.einsum("jlba,jlbc,jlcd->jlad", before, own, along)]
        self.centre = columns(np.einsum("jlba,jlb->jla", along, model.body_ipos[bodies] - anchor))
        principal = np.einsum("jlba,jlbc->jlac", along, _matrices(model.body_iquat[bodies]))
        matrix = np.einsum("jlab,jlb,jlcb->jlac", principal, model.body_inertia[bodies], principal)
        self.matrix = algebra.symmetric(matrix_columns(matrix))
        self.mass = constant(model.body_mass[bodies])
        return anchor, along

    def _read_joints(self, model: mujoco.MjModel, bodies: np.ndarray) -> None:
        joints = model.body_jntadr[bodies.T]
        self.qpos_ids, self.dof_ids = model.jnt_qposadr[joints], model.jnt_dofadr[joints]
        limited = model.jnt_limited[joints].astype(bool)
        self.lower = constant(np.where(limited, model.jnt_range[joints, 0], -_FAR))
        self.upper = constant(np.where(limited, model.jnt_range[joints, 1], _FAR))
        self.zero = model.qpos0[self.qpos_ids][..., None].astype(np.float32)
        self.margin = constant(model.jnt_margin[joints])
        self.armature = np.eye(3)[..., None] * model.dof_armature[self.dof_ids][:, None]
        self.joint_weight = constant(model.dof_invweight0[self.dof_ids])
        self.limit = _impedance(model, model.jnt_solref[joints], model.jnt_solimp[joints])

    # -- the substep

    def centres(self, qpos: jax.Array) -> jax.Array:
        """Centres (S, 3) m of the spheres in the world of a pose (19,)."""
        return _batched(self._centres)(qpos)

    def substep(
        self,
        qpos: jax.Array,
        qvel: jax.Array,
        warmstart: jax.Array,
        qfrc: jax.Array,
        contact: Any,
        iterations: int,
        payload: Any = 0.0,
        friction: Any = None,
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Advances the physics by one timestep.

        Args:
          qpos: (19,).
          qvel: (18,).
          warmstart: (18,) last accelerations.
          qfrc: (18,) generalised force.
          contact: surfaces near the spheres, a `physics.Contact`.
          iterations: Newton iterations of the constraint solver.
          payload: () kg on the trunk.
          friction: () of feet and knees, instead of the model's.

        Returns:
          The next qpos, qvel and warmstart.
        """
        centres = self.centres(qpos)
        _, normal, point = contact(centres)
        friction = self.friction if friction is None else friction
        numbers = (jnp.asarray(x, jnp.float32) for x in (payload, friction))
        advance = functools.partial(self._advance, iterations)
        return _batched(advance)(qpos, qvel, warmstart, qfrc, normal, point - centres[:, None], *numbers)

    def smooth(self, qpos: jax.Array, qvel: jax.Array, payload: Any = 0.0) -> tuple[Arrowhead, Joints]:
        """Mass matrix and bias force, in T, of poses (19, B) and velocities (18, B)."""
        _, world, legs = self._pose(qpos)
        return self._smooth(legs, world, self._joints(world, qvel), payload)

    def _advance(
        self,
        iterations: int,
        qpos: jax.Array,
        qvel: jax.Array,
        warmstart: jax.Array,
        qfrc: jax.Array,
        normal: jax.Array,
        way: jax.Array,
        payload: jax.Array,
        friction: jax.Array,
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """`substep` of a batch (..., B), given normals and ways from the centres to the planes (S, N, 3, B)."""
        quaternion, world, legs = self._pose(qpos)
        velocity = self._joints(world, qvel)
        mu = jnp.maximum(friction, mujoco.mjMINVAL)
        contacts = []
        for i in range(len(self.spheres)):
            mine = slice(i * NUM_LEGS, (i + 1) * NUM_LEGS)
            for plane in range(len(self.spheres[i].impedance)):
                n, w = ((a[mine, plane, 0], a[mine, plane, 1], a[mine, plane, 2]) for a in (normal, way))
                contacts.append(self._contacts(legs, world, i, plane, velocity, n, w, mu))
        limits = self._limits(qpos[self.qpos_ids], velocity.legs)
        matrix, bias = self._smooth(legs, world, velocity, payload)
        force = difference(self._joints(world, qfrc), bias)
        rows = jnp.concatenate([*(jnp.broadcast_to(c.mass, c.aref.shape) for c in contacts), limits.mass])
        problem = pin(Problem(matrix, force, solve(matrix, force), tuple(contacts), limits, rows, mu))
        warm = self._joints(world, warmstart)
        found = minimise(problem, warm, iterations, self.ls_iterations, self.tolerance)
        acceleration = self._vector(world, found)
        qvel = qvel + self.timestep * acceleration
        return self._integrated(qpos, quaternion, qvel), qvel, acceleration

    def _centres(self, qpos: jax.Array) -> jax.Array:
        _, world, legs = self._pose(qpos)
        parts = []
        for centre in legs.spheres:
            there = apply(world, centre)
            parts.append(jnp.stack([x + base for x, base in zip(there, qpos[:3], strict=True)], axis=1))
        return jnp.concatenate(parts)

    def _pose(self, qpos: jax.Array) -> tuple[list[Component], Matrix, Legs]:
        """The trunk's quaternion, its axes in the world, and the legs, of (19, B)."""
        quaternion = pin(_unit(list(qpos[3:7])))
        return quaternion, pin(_rotation(quaternion)), self._kinematics(qpos[self.qpos_ids])

    def _joints(self, world: Matrix, x: jax.Array) -> Joints:
        """Of (18, B) in MuJoCo's order and axes."""
        return pin(Joints(jnp.stack([*_into(world, (x[0], x[1], x[2])), *x[3:6]]), x[self.dof_ids]))

    def _vector(self, world: Matrix, x: Joints) -> jax.Array:
        """`_joints` the other way."""
        trunk = jnp.stack([*apply(world, (x.trunk[0], x.trunk[1], x.trunk[2])), *x.trunk[3:]])
        legs = x.legs.reshape(-1, x.legs.shape[-1])
        return jnp.concatenate([trunk, legs[np.argsort(self.dof_ids.reshape(-1))]])

    def _kinematics(self, angles: jax.Array) -> Legs:
        """Joint angles (3, L, B) to the legs in T."""
        turned = angles - self.zero
        cosines, sines = pin((jnp.cos(turned), jnp.sin(turned)))
        frame, origin = algebra.IDENTITY, algebra.ZERO
        found = []
        for j in range(LEG_JOINTS):
            origin = plus(origin, apply(frame, self.offset[j]))
            x, y, z = algebra.compose(frame, self.turn[j])
            c, s = cosines[j], sines[j]
            frame = x, plus(scaled(c, y), scaled(s, z)), minus(scaled(c, z), scaled(s, y))
            origin, frame = pin((origin, frame))
            found.append((origin, frame))
        spheres = []
        for sphere in self.spheres:
            joint, turn = found[sphere.link]
            spheres.append(pin(plus(joint, apply(turn, sphere.centre))))

        def stack(*parts: Component) -> jax.Array:
            return jnp.stack([jnp.broadcast_to(x, angles.shape[1:]) for x in parts])

        anchors, frames = pin(jax.tree.map(stack, *found))
        return Legs(frames[0], anchors, frames, tuple(spheres))

    def _smooth(
        self, legs: Legs, world: Matrix, velocity: Joints, payload: Component
    ) -> tuple[Arrowhead, Joints]:
        axes = Motion(legs.axes, cross(legs.anchors, legs.axes))
        centre = plus(legs.anchors, apply(legs.frames, self.centre))
        links = shifted(self.mass, centre, turned(legs.frames, self.matrix))
        links = jax.tree.map(lambda x: jnp.broadcast_to(x, velocity.legs.shape), links)
        axes, links = pin((axes, links))
        trunk = shifted(self.trunk_mass + payload, self.trunk_centre, self.trunk_matrix)
        bias = self._bias(trunk, links, axes, velocity, _into(world, self.gravity))
        return self._mass_matrix(trunk, links, axes), bias

    def _mass_matrix(self, trunk: Inertia, links: Inertia, axes: Motion) -> Arrowhead:
        """By composite inertias (Featherstone 2008, table 6.2), which in one frame merely add up."""
        composite = pin(jax.tree.map(_further, links))
        moving = momentum(composite, axes)
        force, along = jnp.stack([*moving.force, *moving.torque]), jnp.stack([*axes.linear, *axes.angular])
        force, along = pin((force, along))
        legs = jnp.sum(force[:, :, None] * along[:, None], axis=0)
        later = np.tri(LEG_JOINTS, dtype=bool)[..., None, None]
        legs = jnp.where(later, legs, jnp.swapaxes(legs, 0, 1)) + self.armature[..., None].astype(np.float32)
        whole = add(trunk, jax.tree.map(lambda x: jnp.sum(x[0], axis=0), composite))
        return Arrowhead(_block(whole), jnp.concatenate([jnp.swapaxes(force, 0, 1), legs], axis=1))

    def _bias(
        self, trunk: Inertia, links: Inertia, axes: Motion, velocity: Joints, gravity: Vector
    ) -> Joints:
        """Forces that keep all accelerations at 0 (recursive Newton-Euler, Featherstone 2008, table 5.1).

        They don't depend on the trunk's linear velocity, so it is taken as 0. `gravity` is in T.
        """
        v0 = Motion((velocity.trunk[3], velocity.trunk[4], velocity.trunk[5]), algebra.ZERO)
        a0 = Motion(algebra.ZERO, scaled(-1.0, gravity))
        s = Motion(*(scaled(velocity.legs, part) for part in axes))
        v = pin(add(v0, jax.tree.map(_so_far, s)))
        a = pin(add(a0, jax.tree.map(_so_far, motion_cross(v, s))))
        moving = pin(momentum(links, v))
        forces = pin(jax.tree.map(_further, pin(add(momentum(links, a), force_cross(v, moving)))))
        base = add(momentum(trunk, a0), force_cross(v0, momentum(trunk, v0)))
        base = add(base, jax.tree.map(lambda x: jnp.sum(x[0], axis=0), forces))
        return Joints(jnp.stack([*base.force, *base.torque]), power(axes, forces))

    def _limits(self, angles: jax.Array, speeds: jax.Array) -> Limits:
        """Of joints at angles and speeds (3, L, B)."""
        low, high = angles - self.lower, self.upper - angles
        sign = jnp.where(low < high, 1.0, -1.0)
        mass, aref = _row(self.limit, self.joint_weight, jnp.minimum(low, high) - self.margin)
        return Limits(sign, mass, aref - self.limit.damping * sign * speeds)

    def _contacts(
        self,
        legs: Legs,
        world: Matrix,
        sphere: int,
        plane: int,
        velocity: Joints,
        normal: Vector,
        way: Vector,
        mu: jax.Array,
    ) -> Contacts:
        """Of the feet, or the knees, with one plane each.

        Args:
          legs: in T.
          world: the axes of T in the world.
          sphere: which of `spheres`.
          plane: which of its planes.
          velocity: generalised.
          normal: unit vector out of the terrain, in the world.
          way: from the centre to a point of the plane, in the world (m).
          mu: friction (B,).
        """
        it, centre = self.spheres[sphere], legs.spheres[sphere]
        dist = -dot(way, normal) - it.radius
        n, s, t = pin(_tangents(normal))
        frame = pin((_into(world, n), _into(world, s), _into(world, t)))
        point = pin(minus(centre, scaled(it.radius + 0.5 * dist, frame[0])))
        arms = cross(legs.axes, minus(point, legs.anchors))
        if it.link < LEG_JOINTS - 1:  # joints beyond the link don't move it
            moving = (np.arange(LEG_JOINTS) <= it.link).astype(np.float32)[:, None, None]
            arms = scaled(moving, arms)
        arms = pin(arms)
        jacobian = pin(
            jnp.stack([jnp.concatenate([jnp.stack([*d, *cross(point, d)]), dot(arms, d)]) for d in frame])
        )
        weight = it.weight * (1.0 + mu * mu) * 2.0 * mu * mu / self.impratio
        impedance = it.impedance[plane]
        mass, aref = _row(impedance, weight, dist - it.margin[plane])
        return Contacts(jacobian, mass, aref - impedance.damping * edges(jacobian, velocity.each, mu))

    def _integrated(self, qpos: jax.Array, quaternion: list[Component], qvel: jax.Array) -> jax.Array:
        """The next pose (19, B), the trunk turned by its angular velocity (MuJoCo's mju_quatIntegrate)."""
        dt = self.timestep
        x, y, z = qvel[3:6]
        speed = jnp.sqrt(x * x + y * y + z * z)
        scale = jnp.sin(0.5 * dt * speed) / jnp.where(speed == 0.0, 1.0, speed)
        turn = (jnp.cos(0.5 * dt * speed), scale * x, scale * y, scale * z)
        turned = _unit(_hamilton(quaternion, turn))
        return jnp.concatenate([qpos[:3] + dt * qvel[:3], jnp.stack(turned), qpos[7:] + dt * qvel[6:]])


def _row(impedance: Impedance, weight: Component, pos: jax.Array) -> tuple[jax.Array, jax.Array]:
    """D and the position's part of the reference acceleration of constraints; D is 0 where none is violated."""
    d = impedance.at(pos)
    resistance = jnp.maximum(weight * (1.0 - d) / d, mujoco.mjMINVAL)
    return jnp.where(pos < 0, 1.0 / resistance, 0.0), -impedance.stiffness * d * pos


def _so_far(x: jax.Array) -> jax.Array:
    """Sums over a leg's links (3, L, B) from the trunk to each."""
    return jnp.stack([x[0], x[0] + x[1], x[0] + x[1] + x[2]])


def _further(x: jax.Array) -> jax.Array:
    """Sums over a leg's links (3, L, B) from each to the foot."""
    return jnp.stack([x[0] + x[1] + x[2], x[1] + x[2], x[2]])


def _block(i: Inertia) -> jax.Array:
    """The mass matrix (6, 6, B) of one body whose inertia is (B,), linear before angular."""
    m, o, (x, y, z) = i.mass, jnp.zeros_like(i.mass), i.moment
    xx, yy, zz, xy, xz, yz = i.matrix
    rows = (
        (m, o, o, o, z, -y),
        (o, m, o, -z, o, x),
        (o, o, m, y, -x, o),
        (o, -z, y, xx, xy, xz),
        (z, o, -x, xy, yy, yz),
        (-y, x, o, xz, yz, zz),
    )
    shape = jnp.broadcast_shapes(*(jnp.shape(a) for row in rows for a in row))
    return jnp.stack([jnp.stack([jnp.broadcast_to(a, shape) for a in row]) for row in rows])


def _unit(a: list[Component]) -> list[Component]:
    scale = jax.lax.rsqrt(sum(x * x for x in a))
    return [scale * x for x in a]


def _hamilton(a: Any, b: Any) -> list[Component]:
    """The product of two quaternions."""
    return [
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    ]


def _rotation(quaternion: list[Component]) -> Matrix:
    """The axes of a unit quaternion's frame."""
    w, x, y, z = quaternion
    return (
        (w * w + x * x - y * y - z * z, 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), w * w - x * x + y * y - z * z, 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), w * w - x * x - y * y + z * z),
    )


def _tangents(n: Vector) -> Matrix:
    """MuJoCo's frame of a contact (mju_makeFrame): the normal, y or z made square to it, and their product."""
    steep = (n[1] <= -0.5) | (n[1] >= 0.5)
    along = jnp.where(steep, n[2], n[1])
    unit = 1.0 / jnp.sqrt(1.0 - along * along)
    first = (
        -along * n[0] * unit,
        (jnp.where(steep, 0.0, 1.0) - along * n[1]) * unit,
        (jnp.where(steep, 1.0, 0.0) - along * n[2]) * unit,
    )
    return n, first, cross(n, first)


def _into(world: Matrix, a: Vector) -> Vector:
    """A vector of the world in T."""
    return dot(world[0], a), dot(world[1], a), dot(world[2], a)


def _chains(model: mujoco.MjModel, feet: np.ndarray) -> np.ndarray:
    """(L, 3) body ids from the abduction link to the shank."""
    shanks = model.geom_bodyid[feet]
    thighs = model.body_parentid[shanks]
    return np.stack([model.body_parentid[thighs], thighs, shanks], axis=1)


def _pairs(model: mujoco.MjModel, planes: np.ndarray, spheres: np.ndarray) -> np.ndarray:
    """(S, N) ids of the contact pairs."""
    ids = {
        (int(a), int(b)): i for i, (a, b) in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True))
    }
    return np.array([[ids[int(p), int(f)] for p in row] for row, f in zip(planes, spheres, strict=True)])


def _spheres(
    model: mujoco.MjModel,
    bodies: np.ndarray,
    planes: np.ndarray,
    spheres: np.ndarray,
    anchors: np.ndarray,
    along: np.ndarray,
) -> list[Sphere]:
    """The feet, and the knees if these touch the terrain; anchors, along: of `TreeDynamics._read_links`."""
    pairs, found = _pairs(model, planes, spheres), []
    for first in range(0, len(spheres), NUM_LEGS):
        mine, link = spheres[first : first + NUM_LEGS], LEG_JOINTS - 1 - first // NUM_LEGS
        off = model.geom_pos[mine] - anchors[link]
        each = pairs[first : first + NUM_LEGS].T
        found.append(
            Sphere(
                link=link,
                centre=columns(np.einsum("lba,lb->la", along[link], off)),
                radius=constant(model.geom_size[mine, 0]),
                weight=constant(model.body_invweight0[bodies[:, link], 0]),
                impedance=[_impedance(model, model.pair_solref[p], model.pair_solimp[p]) for p in each],
                margin=[constant(model.pair_margin[p]) for p in each],
            )
        )
    return found


def _batched(function: Any) -> Any:
    """A function of arrays (..., B) as one of arrays (...), whose batch under `jax.vmap` is B."""

    @jax.custom_batching.custom_vmap
    def single(*args: jax.Array) -> Any:
        return jax.tree.map(lambda x: x[..., 0], function(*(x[..., None] for x in args)))

    @single.def_vmap
    def many(size: int, batched: Any, *args: jax.Array) -> Any:
        def last(x: jax.Array, is_batched: bool) -> jax.Array:
            return jnp.moveaxis(x, 0, -1) if is_batched else jnp.broadcast_to(x[..., None], (*x.shape, size))

        found = function(*(last(x, b) for x, b in zip(args, batched, strict=True)))
        return jax.tree.map(lambda x: jnp.moveaxis(x, -1, 0), found), jax.tree.map(lambda _: True, found)

    return single


def not_covered(model: mujoco.MjModel, planes: np.ndarray, spheres: np.ndarray) -> str:
    """What of a model this substep doesn't compute, so that MJX has to; "" if nothing."""
    shanks = model.geom_bodyid[spheres[:NUM_LEGS]]
    hinges = (
        (model.nq, model.nv, model.njnt) == (19, 18, 13) and model.nbody == 14 and _is_tree(model, shanks)
    )
    if not hinges:
        return "a tree that isn't a free trunk with four legs of three hinges"
    option, flat = model.opt, mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    known = (
        (
            "other options",
            option.disableflags != flat or option.enableflags or option.integrator or option.cone,
        ),
        ("another solver", option.solver != mujoco.mjtSolver.mjSOL_NEWTON or option.iterations != 1),
        ("joint friction", model.dof_frictionloss.any()),
        ("joint damping or springs", model.dof_damping.any() or model.jnt_stiffness.any()),
        ("armature of the trunk", model.dof_armature[:6].any()),
        ("a fluid", option.density or option.viscosity or option.wind.any()),
        ("compensation of gravity", model.body_gravcomp.any()),
        ("equalities, tendons or motors", model.neq or model.ntendon or model.nu),
        (
            "other contacts than the feet's and the knees'",
            model.npair != planes.size or (model.geom_contype > 0).any(),
        ),
        ("contacts with other than sliding friction", np.any(model.pair_dim != 3)),
        ("friction that differs", np.ptp(model.pair_friction[:, :2]) > 0),
        (
            "impedances of different powers",
            np.ptp(model.pair_solimp[:, 4]) + np.ptp(model.jnt_solimp[1:, 4]) > 0,
        ),
    )
    return next((name for name, found in known if found), "")


def _is_tree(model: mujoco.MjModel, shanks: np.ndarray) -> bool:
    """Whether joint by joint, trunk first, it is this robot's tree."""
    types = model.jnt_type[0] == mujoco.mjtJoint.mjJNT_FREE and np.all(
        model.jnt_type[1:] == mujoco.mjtJoint.mjJNT_HINGE
    )
    thighs = model.body_parentid[shanks]
    chains = np.concatenate([model.body_parentid[thighs], thighs, shanks])
    trunk = model.body_parentid[model.body_parentid[thighs]]
    single = np.all(model.body_jntnum[1:] == 1) and len(set(chains.tolist())) == NUM_LEGS * LEG_JOINTS
    return bool(
        types and single and np.all(trunk == model.jnt_bodyid[0]) and model.body_parentid[trunk[0]] == 0
    )
