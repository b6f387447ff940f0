"""The patch's shift, against loops that follow its definition."""

import math

import numpy as np
import pytest

from tg import footholds

POINTS = np.array(footholds.offsets())


def ground(*tops, radius=0.06):
    """Heights (1, N) m of round tops over a pit."""
    inside = [np.hypot(*(POINTS - top).T) < radius for top in tops]
    return np.where(np.any(inside, axis=0), -0.3, -0.8)[None]


def by_loops(led, patch, reach):
    """One foot's shift, point by point."""
    deepest = max(patch) - footholds.DEEP
    total, moved = 0.0, np.zeros(2)
    for i in range(footholds.CHOICES):
        for j in range(footholds.CHOICES):
            u, v = 2 * i / (footholds.CHOICES - 1) - 1, 2 * j / (footholds.CHOICES - 1) - 1
            if u * u + v * v > 1.3:
                continue
            x, y = led[0] + reach * u, led[1] + reach * v
            weights = [
                math.exp(-((px - x) ** 2 + (py - y) ** 2) / (2 * footholds.ERROR**2)) for px, py in POINTS
            ]
            gap = sum(w for w, h in zip(weights, patch, strict=True) if h < deepest) / sum(weights)
            far = math.hypot(x, y)
            cost = (
                footholds.GAP * gap
                + footholds.FARTHER * math.sqrt(far**2 + 1e-6)
                + (far / footholds.FAR) ** 2
            )
            weight = math.exp(-cost / footholds.SHARPNESS)
            total, moved = total + weight, moved + weight * reach * np.array([u, v])
    return moved / total


def test_the_patch_is_a_grid_round_the_end_of_the_step():
    assert POINTS.shape == (footholds.COUNT, 2)
    np.testing.assert_allclose(POINTS.mean(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(POINTS[1] - POINTS[0], [0, footholds.CELL])
    np.testing.assert_allclose(POINTS[-1], 0.15)


def test_it_is_what_the_definition_says():
    rng = np.random.default_rng(0)
    led = rng.uniform(-0.12, 0.12, (4, 2))
    patch = np.where(rng.random((4, footholds.COUNT)) < 0.5, -0.9, -0.3) + rng.normal(
        0, 0.02, (4, footholds.COUNT)
    )
    expected = [by_loops(*foot, 0.015) for foot in zip(led, patch, strict=True)]
    np.testing.assert_allclose(footholds.shift(led, patch, 0.015), expected, atol=1e-12)


def test_level_ground_shifts_nothing():
    patch = -0.3 + np.random.default_rng(0).uniform(-0.1, 0.1, (4, footholds.COUNT))
    np.testing.assert_array_equal(footholds.shift(np.full((4, 2), 0.07), patch, 0.015), 0)


@pytest.mark.parametrize("angle", np.linspace(0, 2 * math.pi, 7)[:-1])
def test_a_foot_that_misses_a_pole_goes_towards_it_no_farther_than_it_may(angle):
    away = np.array([math.cos(angle), math.sin(angle)])
    top = np.array([0.03, -0.02])
    moved = footholds.shift((top + 0.06 * away)[None], ground(top), 0.015)[0]
    assert moved @ -away > 0.006
    assert np.hypot(*moved) <= 0.015


@pytest.mark.parametrize("place", [(20.0, -30.0), (0.3, 0.3)])
def test_places_beyond_the_patch_give_numbers(place):
    for kind in (np.float32, np.float64):
        moved = footholds.shift(np.array([place], kind), ground((0.0, 0.0)).astype(kind), 0.015)
        assert moved.dtype == kind and np.isfinite(moved).all()


def test_in_the_mirror_it_is_mirrored():
    led, patch = np.array([[0.04, 0.05]]), ground((0.03, -0.02), (-0.1, 0.12))
    image = patch.reshape(-1, footholds.SIDE, footholds.SIDE)[:, :, ::-1].reshape(1, -1)
    np.testing.assert_allclose(
        footholds.shift(led * [1, -1], image, 0.015),
        footholds.shift(led, patch, 0.015) * [1, -1],
        atol=1e-12,
    )


def test_it_comes_in_during_swing():
    share = footholds.share(np.array([-1.0, 0.3, 0.9, 1.5, 3.0]))
    np.testing.assert_allclose(share, [0, 0, 0.5, 1, 1], atol=1e-12)
