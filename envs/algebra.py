"""Vectors and matrices written out by components, for many robots side by side.

A component is an array with the batch as last axis, (B,) for the trunk or (..., L, B) for the legs, or a constant: a
number or a NumPy array (..., L, 1). Plain sums and products of such components compile to loops over legs and batch
that use a processor's vector units, which small matrix products under `jax.vmap` don't. What is multiplied by a
constant 0 is left out on the host, so axes and offsets along the coordinate axes cost nothing.

A vector is a tuple of 3 components, a matrix a tuple of 3 columns, a symmetric matrix the 6 components xx, yy, zz, xy,
xz, yz.
"""

from typing import Any

import jax
import numpy as np

Component = Any
Vector = tuple[Component, Component, Component]
Matrix = tuple[Vector, Vector, Vector]
Symmetric = tuple[Component, Component, Component, Component, Component, Component]

ZERO: Vector = (0.0, 0.0, 0.0)
IDENTITY: Matrix = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
_PLACE = ((0, 3, 4), (3, 1, 5), (4, 5, 2))


def is_constant(a: Component, value: float) -> bool:
    """Whether a component is this number for all legs."""
    return not isinstance(a, jax.Array) and bool(np.all(np.asarray(a) == value))


def times(a: Component, b: Component) -> Component:
    """a b."""
    if is_constant(a, 0.0) or is_constant(b, 0.0):
        return 0.0
    if is_constant(a, 1.0):
        return b
    if is_constant(b, 1.0):
        return a
    if is_constant(a, -1.0):
        return -b
    if is_constant(b, -1.0):
        return -a
    return a * b


def total(*terms: Component) -> Component:
    """Their sum."""
    found = [term for term in terms if not is_constant(term, 0.0)]
    result = found[0] if found else 0.0
    for term in found[1:]:
        result = result + term
    return result


def dot(a: Any, b: Any) -> Component:
    """a · b of vectors of any length."""
    return total(*(times(x, y) for x, y in zip(a, b, strict=True)))


def plus(*vectors: Any) -> Any:
    """Their sum, of vectors of any length."""
    return tuple(total(*components) for components in zip(*vectors, strict=True))


def minus(a: Any, b: Any) -> Any:
    """a - b of vectors of any length."""
    return plus(a, scaled(-1.0, b))


def scaled(factor: Component, a: Any) -> Any:
    """factor a, of a vector of any length."""
    return tuple(times(factor, x) for x in a)


def cross(a: Vector, b: Vector) -> Vector:
    """a × b."""
    pairs = ((1, 2), (2, 0), (0, 1))
    x, y, z = (total(times(a[i], b[j]), times(-1.0, times(a[j], b[i]))) for i, j in pairs)
    return x, y, z


def apply(matrix: Matrix, a: Vector) -> Vector:
    """A matrix by a vector."""
    return plus(*(scaled(a[k], matrix[k]) for k in range(3)))


def compose(a: Matrix, b: Matrix) -> Matrix:
    """A matrix by a matrix."""
    return apply(a, b[0]), apply(a, b[1]), apply(a, b[2])


def symmetric_apply(s: Symmetric, a: Vector) -> Vector:
    """A symmetric matrix by a vector."""
    x, y, z = (dot([s[_PLACE[row][k]] for k in range(3)], a) for row in range(3))
    return x, y, z


def symmetric(rows: Any) -> Symmetric:
    """The components of a symmetric matrix from an indexable of rows or columns, of which half are looked at."""
    return rows[0][0], rows[1][1], rows[2][2], rows[0][1], rows[0][2], rows[1][2]


def outer_sum(a: Matrix, b: Matrix) -> Symmetric:
    """Σ_k a_k b_kᵀ over columns, which is known to be symmetric."""
    entry = {(i, j): dot([c[i] for c in a], [c[j] for c in b]) for i in range(3) for j in range(i, 3)}
    return entry[0, 0], entry[1, 1], entry[2, 2], entry[0, 1], entry[0, 2], entry[1, 2]


def columns(a: np.ndarray) -> Vector:
    """Constants (..., L, 3) as a vector; rounding that stands for 0 becomes 0."""
    a = np.where(np.abs(a) < 1e-12, 0.0, a)
    return constant(a[..., 0]), constant(a[..., 1]), constant(a[..., 2])


def matrix_columns(a: np.ndarray) -> Matrix:
    """Constants (..., L, 3, 3) as a matrix."""
    return columns(a[..., 0]), columns(a[..., 1]), columns(a[..., 2])


def constant(a: np.ndarray) -> Component:
    """A constant component (..., L): a number where all are the same, else an array (..., L, 1)."""
    return float(a.flat[0]) if np.all(a == a.flat[0]) else np.asarray(a, np.float32)[..., None]
