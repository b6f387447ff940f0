"""Look-ups on the device against plain NumPy over all primitives, and contact against MuJoCo's."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import terrains
from terrains.lookup import FAR, MAX_DEPTH

KINDS = [kind for kind in terrains.kinds() if kind != "mixed"]
LEVELS = [0.0, 0.45, "paper", 1.0]


@functools.cache
def bank_and_terrains(kind):
    bank = terrains.make_bank(kind, 4, 0, LEVELS)
    return bank, [terrains.make_terrain(kind, level, 0, index=k) for k, level in enumerate(LEVELS)]


def brute_force(terrain, points):
    """Signed distance (n,) of points (n, 3) to all primitives and the floor."""
    rows = terrain.primitives.astype(np.float64)
    each = [terrains.signed_distance(rows, p).min(initial=np.inf) for p in points]
    return np.minimum(each, points[:, 2] - terrain.floor)


def points_near_surface(terrain, count, seed=0, spread=0.04):
    """Half of them on edges of primitives, half anywhere."""
    rng = np.random.default_rng(seed)
    xy = rng.uniform(-5.55, 5.55, (count, 2))
    if len(terrain.primitives):
        rows = terrain.primitives[rng.integers(0, len(terrain.primitives), count // 2)].astype(np.float64)
        angle = rng.uniform(0, 2 * np.pi, count // 2)
        side = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        side = side / np.where(rows[:, 4:5] > 0, 1, abs(side).max(axis=-1, keepdims=True))
        edge = rows[:, :2] + side * (rows[:, 2:4] + rows[:, 4:5])
        xy[: count // 2] = edge + rng.normal(0, 0.02, edge.shape)
    xy = np.clip(xy, -5.55, 5.55)
    z = terrains.exact_height(terrain, xy) + rng.uniform(-spread, spread, count)
    z[::3] = rng.uniform(terrain.floor - 0.01, 0.05, len(z[::3]))
    return np.concatenate([xy, z[:, None]], axis=-1)


@pytest.mark.parametrize("kind", KINDS)
def test_height_is_the_cells(kind):
    bank, _ = bank_and_terrains(kind)
    rng = np.random.default_rng(0)
    xy = rng.uniform(-5.59, 5.59, (2, 300, 2)).astype(np.float32)
    for k in range(4):
        i, j = np.moveaxis(np.floor((xy.astype(np.float64) + 5.6) / 0.02).astype(int), -1, 0)
        expected = np.asarray(bank.heights)[k, i, j] * 0.001
        wrong = abs(np.asarray(terrains.height(bank, k, xy)) - expected) > 1e-6
        assert wrong.mean() < 0.005  # float32 on a cell's edge


def test_outside_the_map_is_its_edge():
    bank, _ = bank_and_terrains("blocks")
    far = jnp.array([[7.0, 0.305], [-7.0, 0.305], [0.305, 9.0]])
    edge = jnp.clip(far, -5.59, 5.59)
    np.testing.assert_array_equal(terrains.height(bank, 2, far), terrains.height(bank, 2, edge))
    smooth = functools.partial(terrains.height_bilinear, bank, 2)
    np.testing.assert_allclose(smooth(far), smooth(edge), atol=1e-4)
    distance, *_ = terrains.contact(bank, 2, jnp.array([[9.0, 9.0, 0.01]]), bank.floor[2])
    assert distance[0, 0] == pytest.approx(0.01)


def test_bilinear_height_and_normal_of_a_plane():
    """z = 0.05 x - 0.1 y in whole millimetres: 1 mm a cell along x, -2 mm along y."""
    bank, _ = bank_and_terrains("flat")
    i, j = np.meshgrid(np.arange(560), np.arange(560), indexing="ij")
    heights = jnp.asarray(np.broadcast_to(i - 2 * j, (4, 560, 560)), jnp.int16)
    bank = terrains.Bank(**{**vars(bank), "heights": heights})
    xy = np.random.default_rng(0).uniform(-5.5, 5.5, (200, 2))
    expected = ((xy[:, 0] + 5.59) / 0.02 - 2 * (xy[:, 1] + 5.59) / 0.02) * 0.001
    np.testing.assert_allclose(terrains.height_bilinear(bank, 1, xy), expected, atol=5e-6)
    normal = np.array([-0.05, 0.1, 1.0]) / np.sqrt(1 + 0.05**2 + 0.1**2)
    np.testing.assert_allclose(terrains.normal(bank, 1, xy), np.tile(normal, (200, 1)), atol=1e-5)


@pytest.mark.parametrize("planes", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_contact_is_the_nearest_of_all_primitives(kind, planes):
    bank, all_terrains = bank_and_terrains(kind)
    look_up = jax.jit(terrains.contact, static_argnums=4)
    for k, terrain in enumerate(all_terrains):
        points = points_near_surface(terrain, 400, seed=k).astype(np.float32)
        distance, normal, point = map(np.asarray, look_up(bank, k, points, bank.floor[k], planes))
        assert distance.shape == (400, planes) and normal.shape == point.shape == (400, planes, 3)
        length = np.linalg.norm(normal, axis=-1)
        np.testing.assert_allclose(length, 1.0, atol=0.01)
        np.testing.assert_allclose(length[distance > 0.01], 1.0, atol=1e-4)
        np.testing.assert_allclose(point, points[:, None] - distance[..., None] * normal, atol=1e-6)
        true = brute_force(terrain, points.astype(np.float64))
        near = true < 0.03
        np.testing.assert_allclose(distance[near, 0], np.maximum(true[near], -MAX_DEPTH), atol=4e-6)
        assert (distance[~near, 0] >= 0.03 - 4e-6).all() and near.sum() > 50
        # The normal points along the steepest ascent of the distance, and the point lies on the surface.
        outside = near & (true > 1e-3)
        ahead = points + 1e-4 * normal[:, 0]
        climb = (brute_force(terrain, ahead.astype(np.float64)) - true) / 1e-4
        assert (abs(climb[outside] - 1.0) < 0.02).mean() > 0.98  # but midway between two surfaces
        np.testing.assert_allclose(brute_force(terrain, point[outside, 0].astype(np.float64)), 0.0, atol=4e-6)


def bank_of(monkeypatch, rows, floor):
    """A bank of one terrain made of the given primitives."""
    monkeypatch.setattr("terrains.registry._GENERATORS", {})
    layout = terrains.Layout(np.concatenate(rows), floor, (0.45, 0.35, 0.0))
    terrains.register("own")(lambda difficulty, rng, config: layout)
    return terrains.make_bank("own", 1, 0, [0.0])


def at_point(bank, *xyz, planes=2):
    distance, normal, _ = terrains.contact(bank, 0, jnp.array([xyz]), bank.floor[0], planes)
    return np.asarray(distance)[0], np.asarray(normal)[0]


def test_two_planes_hold_tread_and_riser():
    """On the platform of 10 cm stairs, 2 cm above the tread and 1.5 cm from the riser at x = 0.45."""
    config = terrains.TerrainConfig(stairs=terrains.StairsConfig(fixed_rise=0.1))
    bank = terrains.make_bank("stairs", 1, 0, [0.5], config)
    distance, normal = at_point(bank, 0.435, 0.1, 0.02)
    np.testing.assert_allclose(distance, [0.015, 0.02], atol=1e-6)
    np.testing.assert_allclose(normal, [[-1, 0, 0], [0, 0, 1]], atol=1e-6)
    distance, normal = at_point(bank, 0.42, 0.1, 0.02)
    np.testing.assert_allclose(distance, [0.02, 0.03], atol=1e-6)
    np.testing.assert_allclose(normal, [[0, 0, 1], [-1, 0, 0]], atol=1e-6)
    distance, normal = at_point(bank, 0.2, 0.1, 0.02)
    np.testing.assert_allclose(distance, [0.02, FAR], atol=1e-6)


def test_two_planes_hold_a_foot_between_two_poles(monkeypatch):
    """Poles of 10 cm, their axes 14 cm apart, tops at 0: a foot midway with its centre 1 cm up."""
    bank = bank_of(monkeypatch, [terrains.cylinders([-140, 140], [0, 0], 100, 0)], -0.5)
    distance, normal = at_point(bank, 0.0, 0.0, 0.01)
    np.testing.assert_allclose(distance, np.hypot(0.02, 0.01), atol=1e-6)
    expected = np.array([0.02, 0, 0.01]) / np.hypot(0.02, 0.01)
    np.testing.assert_allclose(abs(normal), [expected, expected], atol=1e-4)
    assert normal[0, 0] == pytest.approx(-normal[1, 0])


@pytest.mark.parametrize("step", [0, 20])
def test_a_seam_between_blocks_is_no_second_contact(monkeypatch, step):
    """5 mm deep and 1 cm beside a seam: the neighbour's edge lies in the first plane, or below it."""
    rows = [terrains.boxes([0, 500], [500, 1000], 0, 500, [200, 200 - step])]
    bank = bank_of(monkeypatch, rows, 0.0)
    distance, normal = at_point(bank, 0.24, 0.125, 0.12)
    np.testing.assert_allclose(distance, [0.02, FAR], atol=1e-6)
    np.testing.assert_allclose(normal[0], [0, 0, 1], atol=1e-6)


def test_a_centre_inside_is_pushed_out_through_the_nearest_face_and_not_too_hard(monkeypatch):
    rows = [terrains.boxes(0, 500, 0, 500, 200), terrains.cylinders(-400, 0, 100, 200)]
    bank = bank_of(monkeypatch, rows, -0.5)
    for xyz, distance, normal in [
        ((0.125, 0.12, 0.09), -0.01, (0, 0, 1)),
        ((0.125, 0.12, 0.02), -MAX_DEPTH, (0, 0, 1)),
        ((0.245, 0.12, 0.05), -0.005, (1, 0, 0)),
        ((0.12, 0.002, 0.05), -0.002, (0, -1, 0)),
        ((-0.17, 0.0, 0.05), -0.02, (1, 0, 0)),
        ((-0.2, 0.04, 0.05), -0.01, (0, 1, 0)),
        ((-0.2, 0.0, 0.09), -0.01, (0, 0, 1)),
        ((0.9, 0.9, -0.51), -0.01, (0, 0, 1)),
        ((0.9, 0.9, -0.6), -MAX_DEPTH, (0, 0, 1)),
    ]:
        found, direction = at_point(bank, *xyz, planes=1)
        assert found[0] == pytest.approx(distance, abs=1e-6)
        np.testing.assert_allclose(direction[0], normal, atol=1e-5)


def test_the_table_grows_with_the_primitives_and_leaves_out_hidden_ones(monkeypatch):
    crowd = [terrains.cylinders(100 + np.arange(8) * 8, 0, 3, 0)]
    assert bank_of(monkeypatch, crowd, -0.5).table.shape[-1] == 8
    hidden = [*crowd, terrains.boxes(-800, 800, -800, 800, 20)]
    assert bank_of(monkeypatch, hidden, -0.5).table.shape[-1] < 3


def test_only_one_or_two_planes():
    bank, _ = bank_and_terrains("flat")
    with pytest.raises(ValueError, match=r"choose 1 or 2"):
        terrains.contact(bank, 0, jnp.zeros((1, 3)), bank.floor[0], 3)


@pytest.mark.parametrize("kind", ["stairs", "stepping_stones", "poles"])
def test_contact_is_mujocos(kind):
    """A foot of 25 mm at random places: distance and normal of MuJoCo's nearest contact, true geoms."""
    bank, all_terrains = bank_and_terrains(kind)
    k, terrain = 2, all_terrains[2]
    spec = mujoco.MjSpec()
    terrains.add_to_spec(spec, terrain)
    ball = spec.worldbody.add_body(name="ball")
    ball.add_freejoint()
    ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.025, 0, 0])
    model = spec.compile()
    data = mujoco.MjData(model)
    points = points_near_surface(terrain, 300, seed=9, spread=0.03).astype(np.float32)
    distance, normal, _ = terrains.contact(bank, k, points, bank.floor[k])
    compared = 0
    found = zip(points, np.asarray(distance)[:, 0], np.asarray(normal)[:, 0], strict=True)
    for point, ours, direction in found:
        if not 0.002 < ours < 0.0249:  # outside, and touching
            continue
        data.qpos[:3] = point
        mujoco.mj_kinematics(model, data)
        mujoco.mj_collision(model, data)
        assert data.ncon, (point, ours)
        nearest = min(data.contact, key=lambda contact: contact.dist)
        sign = 1.0 if nearest.geom[1] == model.geom("ball").id else -1.0
        assert nearest.dist + 0.025 == pytest.approx(ours, abs=1e-5)
        np.testing.assert_allclose(sign * nearest.frame[:3], direction, atol=2e-3)
        compared += 1
    assert compared > 50


def test_batched_look_ups_are_the_single_ones():
    bank, all_terrains = bank_and_terrains("poles")
    k = jnp.array([3, 0, 2, 2, 1])
    points = [points_near_surface(all_terrains[i], 4, seed=i) for i in k.tolist()]
    points = jnp.asarray(np.stack(points), jnp.float32)
    batched = jax.jit(jax.vmap(functools.partial(terrains.contact, num_planes=2), in_axes=(None, 0, 0, 0)))
    together = batched(bank, k, points, bank.floor[k])
    heights = jax.vmap(terrains.height, in_axes=(None, 0, 0))(bank, k, points[..., :2])
    for row in range(5):
        alone = terrains.contact(bank, k[row], points[row], bank.floor[k[row]], 2)
        for a, b in zip(together, alone, strict=True):
            np.testing.assert_allclose(a[row], b, atol=2e-5)
        np.testing.assert_array_equal(heights[row], terrains.height(bank, k[row], points[row, :, :2]))
