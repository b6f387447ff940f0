"""A single foot on the bank's primitives in MJX, against MuJoCo C on true boxes and cylinders.

`python -m benchmarks.contact` prints the same comparison with more runs.
"""

import functools

import numpy as np
import pytest

from benchmarks import contact
from envs import EVALUATION_ITERATIONS, EnvConfig

CORNER = "corner"
TRAINING, CONVERGED = EnvConfig(), EVALUATION_ITERATIONS


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


@pytest.mark.slow
@pytest.mark.parametrize("num_planes", [1, 2])
def test_one_surface_at_a_time_is_mujocos(scene, num_planes):
    """Blocks, poles, stones and stairs, tops, rims and sides: no difference but rounding."""
    names, compared = scene
    found = {key: value[~chosen(names, CORNER)] for key, value in compared(num_planes, CONVERGED).items()}
    assert np.isfinite(found["height"]).sum() > 20
    assert np.nanmax(found["height"]) < 1e-4
    assert np.quantile(found["speed"], 0.95) < 1e-3
    # But on the edge between two ways down from a pole, or where a foot touches a substep sooner (g · 5 ms).
    assert found["speed"].max() < 0.15
    assert found["gain"].max() < 0.01
    assert (found["rise"] - found["rise_reference"]).max() < 0.01


@pytest.mark.slow
@pytest.mark.parametrize("num_planes, speed, position", [(1, 0.08, 0.005), (2, 0.03, 0.001)])
def test_tread_and_riser_at_once(scene, num_planes, speed, position):
    """In a concave corner one plane takes turns between tread and riser; two hold both."""
    names, compared = scene
    found = {key: value[chosen(names, CORNER)] for key, value in compared(num_planes, CONVERGED).items()}
    assert np.nanmax(found["height"]) < 0.002
    assert found["speed"].max() < speed
    assert found["position"].max() < position
    assert found["gain"].max() < 0.01
    # Where MuJoCo has a third contact, its springs give less.
    assert (found["rise"] - found["rise_reference"]).max() < 0.05


@pytest.mark.slow
def test_the_iterations_of_training_come_near(scene):
    names, compared = scene
    found, corner = compared(TRAINING.num_planes, TRAINING.solver_iterations), chosen(names, CORNER)
    assert np.nanmax(found["height"]) < 0.002
    assert found["gain"].max() < 0.01
    assert np.quantile(found["speed"][~corner], 0.9) < 0.002
    assert found["speed"].max() < 0.2
    assert found["position"][corner].max() < 0.01
