"""Look-ups in a `Bank`: height, normal and foot contact. Pure, for one instance; `vmap` over instances.

Outside the map a point sees the map's nearest cell.
"""

import jax
import jax.numpy as jnp

from terrains.bank import Bank
from terrains.geometry import UNIT

MAX_DEPTH = 0.03
"""Depth (m) beyond which a contact is reported as this deep."""
FAR = 1.0
"""Distance (m) reported where there is no surface near."""
_EDGE = 1e-4
"""Nearer than this (m) to an edge the normal is a face's. The compiler may round a difference of positions
one way here and another way there (fused multiply-add); divided by less, that would show in its length."""
_FRONT = 0.001
"""A second contact's point lies at least so far (m) in front of the first's plane."""


def _cells(bank: Bank, xy: jax.Array) -> jax.Array:
    """Coordinates (..., 2) in units of heightfield cells, cell centres at whole numbers."""
    return (xy + bank.half_extent) * (1.0 / bank.cell) - 0.5


def _take(bank: Bank, k: jax.Array, i: jax.Array, j: jax.Array) -> jax.Array:
    """Heights (...) m of cells, float32; indices outside the map are clamped."""
    i, j = jnp.clip(i, 0, bank.heights.shape[1] - 1), jnp.clip(j, 0, bank.heights.shape[2] - 1)
    return _get(bank.heights, k, i, j).astype(jnp.float32) * 0.001


def _get(array: jax.Array, *index: jax.Array) -> jax.Array:
    """array[index] for indices that are known to lie within it."""
    return array.at[index].get(mode="promise_in_bounds", wrap_negative_indices=False)


def height(bank: Bank, k: jax.Array, xy: jax.Array) -> jax.Array:
    """Terrain height (...) m at points xy (..., 2) m of instance k (): the nearest cell's."""
    index = jnp.round(_cells(bank, xy)).astype(jnp.int32)
    return _take(bank, k, index[..., 0], index[..., 1])


def _corners(bank: Bank, k: jax.Array, xy: jax.Array):
    """Heights of the four cells round each point, and the point's place (...) between them in x and y."""
    place = _cells(bank, xy)
    low = jnp.floor(place)
    i, j = low[..., 0].astype(jnp.int32), low[..., 1].astype(jnp.int32)
    u = place - low
    corners = [_take(bank, k, i + di, j + dj) for di in (0, 1) for dj in (0, 1)]
    return corners, u[..., 0], u[..., 1]


def height_bilinear(bank: Bank, k: jax.Array, xy: jax.Array) -> jax.Array:
    """Terrain height (...) m at points xy (..., 2) m of instance k (), linear between cell centres."""
    (h00, h01, h10, h11), u, v = _corners(bank, k, xy)
    return (1 - u) * ((1 - v) * h00 + v * h01) + u * ((1 - v) * h10 + v * h11)


def normal(bank: Bank, k: jax.Array, xy: jax.Array) -> jax.Array:
    """Unit normal (..., 3), world frame, of the surface of `height_bilinear` at points xy (..., 2) m."""
    (h00, h01, h10, h11), u, v = _corners(bank, k, xy)
    gx = ((1 - v) * (h10 - h00) + v * (h11 - h01)) * (1.0 / bank.cell)
    gy = ((1 - u) * (h01 - h00) + u * (h11 - h10)) * (1.0 / bank.cell)
    scale = jax.lax.rsqrt(1.0 + gx * gx + gy * gy)
    return jnp.stack([-gx * scale, -gy * scale, scale], axis=-1)


_Plane = tuple[jax.Array, ...]  # distance, nx, ny, nz


def _surface(rows: list[jax.Array], x: jax.Array, y: jax.Array, z: jax.Array) -> _Plane:
    """Signed distance and outward normal (nx, ny, nz) of primitives, six arrays (...), at points (...)."""
    cx, cy, hx, hy, radius, top = rows
    dx, dy, dz = x - cx, y - cy, z - top
    qx, qy = jnp.abs(dx) - hx, jnp.abs(dy) - hy
    ox, oy = jnp.maximum(qx, 0.0), jnp.maximum(qy, 0.0)
    length = jnp.sqrt(ox * ox + oy * oy)
    d = length + jnp.minimum(jnp.maximum(qx, qy), 0.0) - radius
    # Horizontal direction away from the footprint: from its core, or out through the core's nearest face.
    out = length > _EDGE
    inverse = 1.0 / jnp.where(out, length, 1.0)
    ux = jnp.where(out, ox * inverse, jnp.where(qx > qy, 1.0, 0.0))
    uy = jnp.where(out, oy * inverse, jnp.where(qx > qy, 0.0, 1.0))
    ux, uy = jnp.where(dx < 0.0, -ux, ux), jnp.where(dy < 0.0, -uy, uy)
    # The same again in the plane of d and dz.
    od, oz = jnp.maximum(d, 0.0), jnp.maximum(dz, 0.0)
    outside = jnp.sqrt(od * od + oz * oz)
    distance = outside + jnp.minimum(jnp.maximum(d, dz), 0.0)
    out = outside > _EDGE
    inverse = 1.0 / jnp.where(out, outside, 1.0)
    side = jnp.where(out, od * inverse, jnp.where(d > dz, 1.0, 0.0))
    up = jnp.where(out, oz * inverse, jnp.where(d > dz, 0.0, 1.0))
    return distance, ux * side, uy * side, up


def _choose(first: jax.Array, a: _Plane, b: _Plane) -> _Plane:
    """Element by element a where `first`, else b."""
    return tuple(jnp.where(first, x, y) for x, y in zip(a, b, strict=True))


def contact(
    bank: Bank, k: jax.Array, centre: jax.Array, floor: jax.Array, num_planes: int = 1
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Nearest terrain surfaces to the centres of feet: true boxes and cylinders, no heightfield.

    Args:
      k: () instance.
      centre: (F, 3) m, world frame.
      floor: () m, `bank.floor[k]`.
      num_planes: 1, or 2 to find tread and riser at once.

    Returns:
      distance: (F, num_planes) m from the centre to the surface, negative inside, within [-MAX_DEPTH, FAR].
        Entry 0 is the nearest surface, exact up to the bank's margin. Entry 1 is the nearest among the
        primitives near by and the floor whose normal differs from entry 0's (n · n0 < 0.9) and whose point
        lies in front of entry 0's plane, else FAR: behind it lie edges buried in a seam between two blocks.
      normal: (F, num_planes, 3) out of the terrain.
      point: (F, num_planes, 3) m, centre - distance normal: on the surface.
    """
    if num_planes not in (1, 2):
        raise ValueError(f"num_planes = {num_planes}; choose 1 or 2")
    x, y, z = centre[..., 0], centre[..., 1], centre[..., 2]
    n = bank.table.shape[1]
    place = (centre[..., :2] + bank.half_extent) * (1.0 / bank.table_cell)
    cell = jnp.clip(place.astype(jnp.int32), 0, n - 1)
    ids = _get(bank.table, k, cell[..., 0], cell[..., 1]).astype(jnp.int32)
    rows = _get(bank.primitives, k, ids).astype(jnp.float32) * UNIT

    found: list[_Plane] = [(z - floor, jnp.zeros_like(z), jnp.zeros_like(z), jnp.ones_like(z))]
    for m in range(ids.shape[-1]):
        found.append(_surface([rows[..., m, c] for c in range(6)], x, y, z))
    best = found[0]
    for other in found[1:]:
        best = _choose(other[0] < best[0], other, best)
    planes = [best]
    if num_planes == 2:
        second: _Plane = (jnp.full_like(z, FAR), jnp.zeros_like(z), jnp.zeros_like(z), jnp.ones_like(z))
        for other in found:
            cosine = other[1] * best[1] + other[2] * best[2] + other[3] * best[3]
            front = (cosine < 0.01) | (other[0] * cosine < best[0] - _FRONT)
            second = _choose((cosine < 0.9) & front & (other[0] < second[0]), other, second)
        planes.append(second)
    distance = jnp.clip(jnp.stack([p[0] for p in planes], axis=-1), -MAX_DEPTH, FAR)
    direction = jnp.stack([jnp.stack(p[1:], axis=-1) for p in planes], axis=-2)
    return distance, direction, centre[..., None, :] - distance[..., None] * direction
