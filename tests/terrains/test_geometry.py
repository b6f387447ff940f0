"""Primitives: the signed distance against sampled surfaces and against MuJoCo."""

import mujoco
import numpy as np
import pytest

import terrains
from terrains.geometry import to_units

SHAPES = {
    "box": [0.1, -0.2, 0.3, 0.15, 0.0, 0.25],
    "cylinder": [-0.05, 0.1, 0.0, 0.0, 0.12, 0.25],
    "rounded": [0.0, 0.0, 0.2, 0.1, 0.05, 0.25],
}


def surface(row, spacing=0.002):
    """Points (n, 3) on the top and on the side of a primitive, down to z = -0.5."""
    cx, cy, hx, hy, radius, top = row
    x = np.arange(cx - hx - radius, cx + hx + radius + spacing, spacing)
    y = np.arange(cy - hy - radius, cy + hy + radius + spacing, spacing)
    x, y = (a.ravel() for a in np.meshgrid(x, y))
    d = np.hypot(np.maximum(abs(x - cx) - hx, 0), np.maximum(abs(y - cy) - hy, 0))
    lid = np.stack([x, y, np.full(x.shape, top)], axis=-1)[d <= radius + 1e-9]
    # The outline: corner arcs of the rectangle's four corners, and the straight sides between them.
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)
    sx, sy = np.where(np.cos(angle) >= 0, 1, -1), np.where(np.sin(angle) >= 0, 1, -1)
    arc = np.stack([cx + sx * hx + radius * np.cos(angle), cy + sy * hy + radius * np.sin(angle)], axis=-1)
    t = np.arange(-1, 1.001, 0.01)
    sides = [np.stack([cx + hx * t, np.full(t.shape, cy + s * (hy + radius))], axis=-1) for s in (-1, 1)]
    sides += [np.stack([np.full(t.shape, cx + s * (hx + radius)), cy + hy * t], axis=-1) for s in (-1, 1)]
    outline = np.concatenate([arc, *sides])
    z = np.arange(top, -0.5, -0.005)
    wall = np.concatenate([np.repeat(outline, len(z), axis=0), np.tile(z, len(outline))[:, None]], axis=-1)
    return np.concatenate([lid, wall])


@pytest.mark.parametrize("name", SHAPES)
def test_signed_distance_is_the_distance_to_the_nearest_surface_point(name):
    row = np.array(SHAPES[name])
    cloud = surface(row)
    points = np.random.default_rng(0).uniform([-0.5, -0.5, 0.0], [0.5, 0.5, 0.45], (200, 3))
    nearest = np.array([np.linalg.norm(cloud - p, axis=-1).min() for p in points])
    inside = (terrains.footprint_distance(row, points[:, 0], points[:, 1]) < 0) & (points[:, 2] < row[5])
    distance = terrains.signed_distance(row, points)
    np.testing.assert_allclose(distance, np.where(inside, -nearest, nearest), atol=0.003)
    assert inside.any() and (~inside).any()


@pytest.mark.parametrize("name", ["box", "cylinder"])
def test_signed_distance_outside_is_mujocos(name):
    row = np.array(SHAPES[name])
    terrain = terrains.Terrain("x", 0.0, 0, 0, row[None].astype(np.float32), -0.5, 5.6, (0.4, 0.3, 0.0))
    spec = mujoco.MjSpec()
    _, geom = terrains.add_to_spec(spec, terrain)
    ball = spec.worldbody.add_body(name="ball", mocap=True)
    ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.025, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    for point in np.random.default_rng(1).uniform([-0.5, -0.5, 0.0], [0.5, 0.5, 0.45], (200, 3)):
        expected = terrains.signed_distance(row, point)
        if expected < 0.03:  # MuJoCo's distance of overlapping shapes is another quantity
            continue
        data.mocap_pos[0] = point
        mujoco.mj_kinematics(model, data)
        found = mujoco.mj_geomDistance(model, data, model.geom("ball").id, model.geom(geom).id, 2.0, None)
        assert found + 0.025 == pytest.approx(expected, abs=1e-5)


def test_units_are_exact_or_refused():
    rows = terrains.boxes([-3, 11001], [4, 11200], [0, 1], [1, 2], [-1000, 300])
    np.testing.assert_allclose(to_units(rows) * 0.00025, rows, atol=3e-7)
    with pytest.raises(ValueError, match=r"0.25 mm"):
        to_units(rows + np.float32(0.0001))
    with pytest.raises(ValueError, match=r"8.19 m"):
        to_units(rows + np.float32(8.0))
