"""Each term stepped across its thresholds, with the arithmetic beside it."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rewards
from rewards import RewardConfig

LOW, HIGH = 0.4, 0.8


@pytest.mark.parametrize(
    "speed, expected",
    [
        (-1.0, -0.5),  # -1.0 / 0.4 = -2.5, cut to -0.5
        (-0.2, -0.5),  # -0.2 / 0.4, just at the cut
        (-0.1, -0.25),
        (0.0, 0.0),  # standing still earns nothing
        (0.1, 0.25),
        (0.399, 0.9975),
        (0.4, 1.0),
        (0.6, 1.0),
        (0.8, 1.0),
        (1.3, math.exp(-0.5)),  # exp(-2 · 0.5²)
    ],
)
def test_along(speed, expected):
    assert rewards.along(jnp.float32(speed), LOW, HIGH) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    "speed, expected",
    [
        (-0.6, math.exp(-2.0)),  # exp(-2 (−0.6 − 0.4)²)
        (0.0, math.exp(-0.32)),  # exp(-2 · 0.4²) = 0.726: the paper pays this for standing still
        (0.4, 1.0),
        (0.8, 1.0),
        (1.3, math.exp(-0.5)),
    ],
)
def test_along_as_the_paper_has_it(speed, expected):
    assert rewards.along(jnp.float32(speed), LOW, HIGH, literal=True) == pytest.approx(expected, abs=1e-6)


def test_knee():
    clearance = jnp.array([0.08, 0.06, 0.045, 0.0, -0.03])
    np.testing.assert_allclose(rewards.knee(clearance, 0.06), [0.0, 0.0, -0.25, -1.0, -1.0], atol=1e-6)


@pytest.mark.parametrize("literal", [False, True])
def test_along_is_continuous_and_never_falls_up_to_the_highest_speed(literal):
    speed = jnp.linspace(-1.0, 1.5, 2501)
    value = np.asarray(rewards.along(speed, LOW, HIGH, literal=literal))
    # A step of 1 mm/s changes it by 0.001 / 0.4 at most.
    assert np.abs(np.diff(value)).max() < 0.0026
    assert (np.diff(value[speed <= HIGH]) >= -1e-6).all()


@pytest.mark.parametrize(
    "velocity, expected", [((0, 0), 1), ((0.12, 0.16), 0.5), ((0, -0.4), 0), ((2, 0), 0)]
)
def test_standing(velocity, expected):
    """1 - |v| / 0.4: |(0.12, 0.16)| = 0.2 leaves a half."""
    assert rewards.standing(jnp.array(velocity, jnp.float32), LOW) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize(
    "velocity, expected",
    [
        ((0.5, 0.0), 1.0),  # perfect motion, whatever its speed
        ((-2.0, 0.0), 1.0),  # backward is not sideways
        ((0.0, 1.0), math.exp(-1.5)),
        ((0.5, 0.2), math.exp(-0.06)),  # 0.29 - 0.25 = 0.04; 1.5 · 0.04
    ],
)
@pytest.mark.parametrize("angle", [0.0, 2.0])
def test_across(velocity, expected, angle):
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    found = rewards.across(jnp.asarray(turn @ velocity), jnp.asarray(turn @ [1.0, 0.0]))
    assert found == pytest.approx(expected, abs=1e-6)


def test_across_with_no_command_is_all_of_the_speed():
    # exp(-1.5 (0.09 + 0.16))
    found = rewards.across(jnp.array([0.3, -0.4]), jnp.zeros(2))
    assert found == pytest.approx(math.exp(-0.375), abs=1e-6)


def test_energy():
    torque = jnp.array([2.0, -3.0, 1.0] + 9 * [0.0])
    speed = jnp.array([1.0, 2.0, -4.0] + 9 * [5.0])
    # |2·1| + |-3·2| + |1·-4| = 12 W; signed: 2 - 6 - 4 = -8, so braking earns.
    assert rewards.energy(torque, speed) == -12.0
    assert rewards.energy(torque, speed, literal=True) == 8.0
    both = rewards.energy(jnp.stack([torque, 2 * torque]), jnp.stack([speed, speed]))
    np.testing.assert_allclose(both, [-12.0, -24.0])


def test_terrain_step_by_step():
    stance = jnp.array([True, True, True, False])
    below = jnp.tile(jnp.array([0.02, 0.02, 0.05, 0.02]), (4, 1))
    highest = jnp.full(4, 0.02)
    for depth, graded, expected in [
        # Sample 0 lies `depth` under the foot, the highest one 2 cm: the gap is depth - 0.02.
        (0.269, False, [0, 0, 0, 0]),  # 24.9 cm is no gap
        (0.271, False, [-1, -1, -1, 0]),  # 25.1 cm is; a leg in swing isn't judged
        (0.271, True, [-0.25, -0.25, -0.25, 0]),  # one of four points
    ]:
        found = rewards.terrain(stance, below.at[:, 0].set(depth), highest, 0.25, graded=graded)
        np.testing.assert_allclose(found, expected, atol=1e-6)
    # Half of the points over the gap; the foot's own height doesn't matter.
    half = below.at[:, :2].set(0.5) + 0.3
    highest = highest + 0.3
    np.testing.assert_allclose(
        rewards.terrain(stance, half, highest, 0.25, graded=True), [-0.5, -0.5, -0.5, 0]
    )
    np.testing.assert_allclose(rewards.terrain(stance, half, highest, 0.25), [-1, -1, -1, 0])
    # All four points in a gap that is wider than the circle: the highest point is another one.
    np.testing.assert_allclose(rewards.terrain(stance, below + 0.6, highest, 0.25), [-1, -1, -1, 0])


def test_height_step_by_step():
    lift = jnp.array([0.08, 0.08, 0.08, 0.02])
    rise = jnp.array([0.0, 0.05, 0.075, 0.0])
    # 0.08 - 0.01; 0.08 - 0.05 - 0.01; 0.08 - 0.085 < 0: as high as the stair asks for; 0.02 - 0.01.
    np.testing.assert_allclose(rewards.height(lift, rise, 0.01), [-0.07, -0.02, 0.0, -0.01], atol=1e-7)


def test_smooth():
    previous = jnp.linspace(-1, 1, 12)
    assert rewards.smooth(previous, previous) == 1.0
    # Twelve joints by 0.1 rad: exp(-0.5 · 12 · 0.01).
    assert rewards.smooth(previous + 0.1, previous) == pytest.approx(math.exp(-0.06), abs=1e-6)
    # One joint by 2 rad: exp(-0.5 · 4).
    assert rewards.smooth(previous.at[3].add(2.0), previous) == pytest.approx(math.exp(-2.0), abs=1e-6)


# Total --------------------------------------------------------------------------------------------------------

WEIGHTS = {
    "along": 1.0,
    "across": 0.5,
    "smooth": 0.25,
    "energy": 0.001,
    "terrain": 0.4,
    "aim": 0.5,
    "height": 2.0,
    "yaw": 0.1,
    "heading": 0.3,
    "tilt": 0.2,
    "heave": 0.5,
    "knee": 2.0,
}
TERMS = {
    "along": 0.5,
    "across": 0.8,
    "smooth": 0.6,
    "energy": -100.0,
    "terrain": -0.25,
    "aim": -0.1,
    "height": -0.02,
    "yaw": -0.3,
    "heading": -0.1,
    "tilt": -0.05,
    "heave": -0.04,
    "knee": -0.03,
}


def total(literal=False, **changes):
    terms = {name: jnp.float32(value) for name, value in (TERMS | changes).items()}
    return rewards.total(RewardConfig(**WEIGHTS, literal=literal), terms)


def test_total_by_hand():
    reward, weighted = total()
    expected = {
        "along": 0.5,
        "across": 0.5 * 0.8 * 0.5,  # paid by the motion: times along = 0.5
        "smooth": 0.25 * 0.6 * 0.5,
        "energy": -0.1,
        "terrain": -0.1,
        "aim": -0.05,
        "height": -0.04,
        "yaw": -0.03,
        "heading": -0.03,
        "tilt": -0.01,
        "heave": -0.02,
        "knee": -0.06,
    }
    assert {name: float(value) for name, value in weighted.items()} == pytest.approx(expected, abs=1e-6)
    # 0.5 + 0.2 + 0.075 - 0.1 - 0.1 - 0.05 - 0.04 - 0.03 - 0.03 - 0.01 - 0.02 - 0.06
    assert reward == pytest.approx(0.335, abs=1e-6)


def test_literal_total_adds_the_gentle_terms_as_they_are():
    _, weighted = total(literal=True)
    assert weighted["across"] == pytest.approx(0.4) and weighted["smooth"] == pytest.approx(0.15)


@pytest.mark.parametrize("along, share", [(-0.5, 0.0), (0.0, 0.0), (0.3, 0.3), (1.0, 1.0)])
def test_a_robot_that_stands_earns_nothing_by_being_gentle(along, share):
    _, weighted = total(along=along)
    assert weighted["across"] == pytest.approx(0.4 * share, abs=1e-6)
    assert weighted["smooth"] == pytest.approx(0.15 * share, abs=1e-6)
    assert weighted["along"] == pytest.approx(along)


def test_total_leaves_the_terms_alone():
    terms = {name: jnp.float32(value) for name, value in TERMS.items()}
    before = dict(terms)
    rewards.total(RewardConfig(), terms)
    assert terms == before


def test_every_weight_has_a_term():
    """A number in the configuration that no term uses would be a dead setting."""
    thresholds = {"speed_low", "speed_high", "gap_threshold", "terrain_ring", "lift_threshold", "knee_margin"}
    switches = {"literal", "terrain_graded"}
    names = {field.name for field in dataclasses.fields(RewardConfig)}
    assert names - thresholds - switches == set(WEIGHTS)


def test_terms_can_be_differentiated_and_batched():
    speed = jnp.linspace(0.1, 0.3, 5)
    slope = jax.vmap(jax.grad(lambda s: rewards.along(s, LOW, HIGH)))(speed)
    np.testing.assert_allclose(slope, 1 / LOW, atol=1e-5)
