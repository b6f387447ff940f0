"""A single foot on the bank's primitives in MJX, against MuJoCo C on true boxes and cylinders.

`python -m benchmarks.contact` prints the same comparison with more runs.
"""

import functools

import numpy as np
import pytest

from benchmarks import contact

CORNER = "corner"


@pytest.fixture(scope="module")
def scene():
    bank, where, each = contact.make_terrains()
    cases = contact.make_cases(where, each, count=4)
    reference = contact.simulate_c(each, cases)
    names = np.array([case.name for case in cases])

    @functools.cache
    def compared(num_planes, iterations):
        run = contact.simulate_mjx(bank, cases, num_planes, iterations)
        return contact.compare(bank, cases, reference, run)

    return names, compared


def chosen(names, *words):
    return np.array([any(word in name for word in words) for name in names])


def test_everything_happens_on_every_kind(scene):
    names, _ = scene
    for kind in contact.KINDS:
        for event in ("dropped on top", "dropped on the rim", "slid over the rim", "pushed at the side"):
            assert (names == f"{event} / {kind}").sum() >= 2
    assert chosen(names, CORNER).sum() >= 12


@pytest.mark.parametrize("num_planes", [1, 2])
def test_one_surface_at_a_time_is_mujocos(scene, num_planes):
    """Blocks, poles, stones and stairs, tops, rims and sides: no difference but rounding."""
    names, compared = scene
    found = {key: value[~chosen(names, CORNER)] for key, value in compared(num_planes, 20).items()}
    assert np.isfinite(found["height"]).sum() > 20
    assert np.nanmax(found["height"]) < 1e-4
    assert np.quantile(found["speed"], 0.95) < 1e-3
    # But where a foot touches a substep sooner or later: g · 5 ms = 0.05 m/s.
    assert found["speed"].max() < 0.1
    assert found["gain"].max() < 0.01
    assert (found["rise"] - found["rise_reference"]).max() < 0.01


@pytest.mark.parametrize("num_planes, speed, position", [(1, 0.08, 0.005), (2, 0.03, 0.001)])
def test_tread_and_riser_at_once(scene, num_planes, speed, position):
    """In a concave corner one plane takes turns between tread and riser; two hold both."""
    names, compared = scene
    found = {key: value[chosen(names, CORNER)] for key, value in compared(num_planes, 20).items()}
    assert np.nanmax(found["height"]) < 0.002
    assert found["speed"].max() < speed
    assert found["position"].max() < position
    assert found["gain"].max() < 0.01
    # Where MuJoCo has a third contact, its springs give less.
    assert (found["rise"] - found["rise_reference"]).max() < 0.05


def test_one_iteration_is_exact_where_nothing_slides(scene):
    """As in training: a foot that lands on a top or is set against a side."""
    names, compared = scene
    found = {
        key: value[chosen(names, "on top", "at the side / b", "at the side / s")]
        for key, value in compared(1, 1).items()
    }
    assert np.nanmax(found["height"]) < 1e-4
    assert found["speed"].max() < 0.002
    assert (found["rise"] - found["rise_reference"]).max() < 0.01


def test_one_iteration_rests_right_and_gains_no_energy(scene):
    """Where a foot slides, one iteration gets friction wrong on the way, but not where it ends, nor its energy."""
    _, compared = scene
    found = compared(1, 1)
    assert np.nanmax(found["height"]) < 0.002
    assert found["gain"].max() < 0.01
