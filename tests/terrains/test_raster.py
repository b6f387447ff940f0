"""The heightfield and the MuJoCo geoms are views of the same terrain."""

import mujoco
import numpy as np
import pytest

import terrains

KINDS = [kind for kind in terrains.kinds() if kind != "mixed"]


def centres(size=560, cell=0.02):
    x = (np.arange(size) + 0.5) * cell - size * cell / 2
    return np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1)


@pytest.mark.parametrize("kind", KINDS)
def test_raster_is_the_true_height_at_cell_centres(kind):
    terrain = terrains.make_terrain(kind, 0.7, 5)
    heights = terrains.rasterise(terrain)
    assert heights.shape == (560, 560) and heights.dtype == np.int16
    np.testing.assert_allclose(heights * 0.001, terrains.exact_height(terrain, centres()), atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_raster_agrees_with_rays_on_the_mujoco_geoms(kind):
    terrain = terrains.make_terrain(kind, "paper", 2)
    heights = terrains.rasterise(terrain)
    spec = mujoco.MjSpec()
    names = terrains.add_to_spec(spec, terrain, friction=0.7)
    model = spec.compile()
    assert len(names) == model.ngeom == len(terrain.primitives) + 1
    assert (model.geom_friction[:, 0] == 0.7).all()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    rng = np.random.default_rng(0)
    geom = np.zeros(1, np.int32)
    xy = centres()
    off = 2e-4 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    compared = 0
    for i, j in rng.integers(0, 560, (300, 2)):
        if np.ptp(terrains.exact_height(terrain, xy[i, j] + off)):  # on an edge either height is right
            continue
        start = np.array([*xy[i, j], 3.0]) + [1e-4, 1.1e-4, 0]  # mj_ray may miss the seam between two boxes
        compared += 1
        hit = 3.0 - mujoco.mj_ray(model, data, start, np.array([0.0, 0.0, -1.0]), None, 1, -1, geom)
        assert hit == pytest.approx(terrains.exact_height(terrain, start[:2]), abs=1e-6)
        assert hit == pytest.approx(heights[i, j] * 0.001, abs=1e-6)
    assert compared > 200


@pytest.mark.parametrize("kind", KINDS)
def test_turned_terrain_has_turned_heights(kind):
    terrain = terrains.make_terrain(kind, "paper", 4)
    heights = terrains.rasterise(terrain)
    turned = terrains.rasterise(terrain.turned(1))
    # A quarter turn takes (x, y) to (-y, x): element [i, j] of the turned map is [j, n-1-i] of the first.
    np.testing.assert_array_equal(turned, heights.T[::-1, :])
    np.testing.assert_array_equal(terrain.turned(4).primitives, terrain.primitives)
    assert terrain.turned(1).platform[:2] == terrain.platform[1::-1]


def test_higher_primitives_hide_lower_ones_whatever_their_shape_and_order():
    box, low_box = terrains.boxes(-400, 400, -400, 400, 300), terrains.boxes(-2000, 2000, -2000, 2000, 50)
    pole, stub = terrains.cylinders(0, 0, 200, 500), terrains.cylinders(600, 0, 300, 100)
    expected = None
    for rows in ([box, low_box, pole, stub], [stub, pole, low_box, box]):
        terrain = terrains.Terrain("x", 0.0, 0, 0, np.concatenate(rows), -0.5, 5.6, (0.1, 0.1, 0.0))
        heights = terrains.rasterise(terrain)
        np.testing.assert_allclose(heights * 0.001, terrains.exact_height(terrain, centres()), atol=1e-6)
        assert expected is None or (heights == expected).all()
        expected = heights
    assert set(np.unique(expected)) == {-500, 25, 50, 150, 250}


def test_other_cells_and_sizes():
    terrain = terrains.make_terrain("poles", "paper", 0)
    fine = terrains.rasterise(terrain, cell=0.01)
    assert fine.shape == (1120, 1120)
    part = terrains.rasterise(terrain, cell=0.01, size=200)
    np.testing.assert_array_equal(part, fine[460:660, 460:660])
    with pytest.raises(ValueError, match=r"multiple of 0.0005"):
        terrains.rasterise(terrain, cell=0.0203)


def test_round_rectangles_have_no_geom():
    row = np.array([[0, 0, 0.1, 0.1, 0.05, 0.1]], np.float32)
    terrain = terrains.Terrain("x", 0.0, 0, 0, row, 0.0, 5.6, (0.1, 0.1, 0.0))
    with pytest.raises(ValueError, match=r"choose a box or a cylinder"):
        terrains.add_to_spec(mujoco.MjSpec(), terrain)
