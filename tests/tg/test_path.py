"""Phase, stride and height against the algebra of the paper's equations as corrected."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import tg
from tg import path

PI = math.pi
angles = st.floats(-50.0, 50.0).map(np.asarray)


@given(angles)
def test_wrap_keeps_the_direction_and_the_range(angle):
    wrapped = path.wrap(angle)
    assert -PI <= wrapped <= PI
    assert math.cos(wrapped) == pytest.approx(math.cos(angle), abs=1e-9)
    assert math.sin(wrapped) == pytest.approx(math.sin(angle), abs=1e-9)


def test_wrap_at_the_seam():
    found = path.wrap(np.array([-PI, 0.0, PI, 2 * PI, 3 * PI]))
    np.testing.assert_allclose(found, [-PI, 0.0, -PI, 0.0, -PI], atol=1e-12)


def test_advance_counts_cycles():
    """1.25 Hz at 20 ms: 40 steps are 1 s, 1.25 turns, a quarter turn ahead."""
    phase = np.asarray(0.3)
    for _ in range(40):
        phase = path.advance(phase, np.asarray(1.25), 0.02)
    for _ in range(10):
        phase = path.advance(phase, np.asarray(1.25), 0.02)
    # 50 steps: 1 s · 1.25 Hz = 1.25 cycles, so 0.3 + 2π·1.25 = 0.3 + π/2 after wrapping.
    assert phase == pytest.approx(0.3 + PI / 2)


@given(angles)
def test_trot_pairs_diagonal_legs(phase):
    lf, rf, lr, rr = path.leg_phases(phase)
    assert lf == rr and rf == lr
    assert abs(abs(lf - rf) - PI) < 1e-9  # half a cycle apart


@given(st.floats(-PI, PI).filter(lambda p: min(abs(p), abs(abs(p) - PI)) > 1e-6).map(np.asarray))
def test_one_pair_swings_while_the_other_stands(phase):
    height = path.height(path.leg_phases(phase))
    swing = path.leg_phases(phase) > 0
    assert swing.sum() == 2
    np.testing.assert_array_equal(height[~swing], 0.0)
    assert (height[swing] > 0).all()


def test_height_by_hand():
    # p = π/4: t = 1/2, S = 3/4 - 1/4 = 1/2. p = π/2: t = 1, S = 1. p = 3π/4: t = 3/2, 1 - S(1/2) = 1/2.
    found = path.height(np.array([0.0, PI / 4, PI / 2, 3 * PI / 4, PI, -1e-9, -PI / 2, -PI]))
    np.testing.assert_allclose(found, [0, 0.5, 1, 0.5, 0, 0, 0, 0], atol=1e-12)


def test_first_half_is_the_papers():
    """-2 t³ + 3 t² with t = 2p/π."""
    t = np.linspace(0, 1, 51)
    np.testing.assert_allclose(path.height(t * PI / 2), -2 * t**3 + 3 * t**2, atol=1e-12)


@pytest.mark.parametrize("where", [0.0, PI / 2, PI], ids=["lift-off", "apex", "touch-down"])
def test_no_vertical_speed_where_the_foot_changes(where):
    """The change of height over a step ε goes as ε²: halving it quarters the change."""
    for side in (-1.0, 1.0):
        small, smaller = (
            abs(path.height(np.asarray(where + side * step)) - path.height(np.asarray(where)))
            for step in (0.02, 0.01)
        )
        assert small < 3 * (2 * 0.02 / PI) ** 2 + 1e-12
        if small > 0:  # but in stance, where it stays 0
            assert small / smaller == pytest.approx(4.0, rel=0.02)


@pytest.mark.parametrize("function", [path.height, path.stride, lambda p: path.stride(p, 1.0)])
def test_the_path_is_continuous_over_the_whole_cycle(function):
    cycle = path.wrap(np.linspace(-2 * PI, 2 * PI, 40_001))
    # Steepest: 1.5 · 2/π per rad for the height, 2/π for the stride; a grid step is 2π/20000 rad.
    assert np.abs(np.diff(function(cycle))).max() < 1.01 * 1.5 * 2 / PI * 4 * PI / 40_000


def test_stride_by_hand():
    # Lift-off at -½, middle of the swing and of the stance at 0, touch-down at +½.
    found = path.stride(np.array([0.0, PI / 2, PI, -PI / 2, -PI, PI / 3, -PI / 3]))
    # q = 1/3: S = 3/9 - 2/27 = 7/27, less ½.
    np.testing.assert_allclose(found, [-0.5, 0, 0.5, 0, 0.5, 7 / 27 - 0.5, 7 / 27 - 0.5], atol=1e-12)


def test_stance_runs_backward_at_2fL():
    """f = 1.25 Hz, L = 0.2 m: 0.2 m in the 0.4 s of a stance, 0.5 m/s on average and 0.75 m/s at most."""
    frequency, length = 1.25, 0.2
    time = np.linspace(0.0, 0.5 / frequency, 4001)
    x = length * path.stride(-PI + 2 * PI * frequency * time)
    speed = np.diff(x) / np.diff(time)
    assert (speed < 1e-9).all()
    assert -(x[-1] - x[0]) / time[-1] == pytest.approx(2 * frequency * length)
    assert -speed.min() == pytest.approx(3 * frequency * length, rel=1e-4)


def test_retraction_gives_feet_the_grounds_speed():
    """Even in stance, and the same speed just before touch-down and just after lift-off; the ends of the step stay."""
    stance = path.stride(np.linspace(-PI + 1e-9, -1e-9, 101), 1.0)
    np.testing.assert_allclose(stance, np.linspace(0.5, -0.5, 101), atol=1e-8)
    small = 1e-5
    for phase in (0.0, PI - small):  # after lift-off, before touch-down
        slope = (path.stride(np.array(phase + small), 1.0) - path.stride(np.array(phase), 1.0)) / small
        assert slope == pytest.approx(-1 / PI, rel=1e-3)
    np.testing.assert_allclose(path.stride(np.array([0.0, PI / 2, PI, -PI / 2]), 1.0), [-0.5, 0, 0.5, 0])
    phases = np.linspace(-PI, PI, 50)
    half = 0.5 * (path.stride(phases) + path.stride(phases, 1.0))
    np.testing.assert_allclose(path.stride(phases, 0.5), half, atol=1e-12)


GAITS = [("trot", 0.5), ("trot", 0.4), ("walk", 0.24), ("walk", 0.2)]


@pytest.mark.parametrize(("gait", "share"), GAITS)
def test_each_leg_swings_for_its_share_of_the_cycle(gait, share):
    """Counted over an even grid of the cycle: who is up, for how long, in which order."""
    cycle = np.linspace(-PI, PI, 100_000, endpoint=False)
    phases = path.leg_phases(cycle, share, gait)
    swing = phases > 0
    np.testing.assert_allclose(swing.mean(axis=0), share, atol=1e-4)
    most = {"trot": 2, "walk": 1}[gait]
    assert set(swing.sum(axis=1)) <= {0, 1, most}  # 1: the grid's ends
    lift_off = [cycle[np.flatnonzero(swing[:, leg] & ~np.roll(swing[:, leg], 1))[0]] for leg in range(4)]
    after = path.wrap(np.array(lift_off) - lift_off[0]) / PI  # LF, RF, LR, RR
    if gait == "trot":
        np.testing.assert_allclose(np.abs(after), [0, 1, 1, 0], atol=1e-4)
    else:  # LR, LF, RR, RF: each hind foot a quarter cycle before the fore foot of its side
        np.testing.assert_allclose(after[2], -0.5, atol=1e-4)
        np.testing.assert_allclose(after[3], 0.5, atol=1e-4)
        assert abs(after[1]) == pytest.approx(1.0, abs=1e-4)
    # Both halves run evenly, from 0 to π and from -π to 0.
    rate = path.wrap(np.diff(phases, axis=0)) / np.diff(cycle)[:, None]
    assert rate.min() == pytest.approx(0.5 / (1 - share)) and rate.max() == pytest.approx(0.5 / share)


@pytest.mark.parametrize(("gait", "share"), GAITS)
def test_feet_come_down_with_the_grounds_speed_whatever_their_share_of_swing(gait, share):
    """f L / (1 - s) in stance, and the same in the first and last moment of swing."""
    frequency, length, small = 1.6, 0.2, 1e-6
    time = np.linspace(0.0, 1.0 / frequency, 8001)
    leg = path.leg_phases(path.wrap(2 * PI * frequency * time), share, gait)[:, 1]
    speed = np.diff(length * path.stride(leg, 1.0, share)) / np.diff(time)
    stance = (leg[1:] < 0) & (leg[:-1] < 0) & (np.diff(leg) > 0)
    np.testing.assert_allclose(speed[stance], -frequency * length / (1 - share), rtol=1e-6)
    for phase in (0.0, PI - small):
        slope = (
            path.stride(np.array(phase + small), 1.0, share) - path.stride(np.array(phase), 1.0, share)
        ) / small
        swing = share / frequency  # s, in which the phase goes by π
        assert length * slope * PI / swing == pytest.approx(-frequency * length / (1 - share), rel=1e-3)


@pytest.mark.parametrize(("third", "outer"), [(0.06, 0.10), (0.12, 0.24)])
def test_samples_lie_on_the_circles(third, outer):
    points = np.array(tg.samples.ring_offsets(outer))
    assert points.shape == (25, 2) and tg.samples.COUNT == 25
    start = 0
    for ring, (count, radius) in enumerate([(1, 0.0), (6, 0.03), (8, third), (10, outer)]):
        part = points[start : start + count]
        np.testing.assert_allclose(np.hypot(*part.T), radius, atol=1e-12)
        np.testing.assert_allclose(part[0], [radius, 0.0], atol=1e-12)  # the first lies in front
        turn = np.unwrap(np.arctan2(part[:, 1], part[:, 0]))
        if count > 1:
            np.testing.assert_allclose(np.diff(turn), 2 * PI / count, atol=1e-9)
        assert tg.samples.circles()[ring] == slice(start, start + count)
        start += count
        assert tg.samples.within(radius, outer) == slice(0, start)
        assert tg.samples.within(radius - 0.001, outer) == slice(0, start - count)


def test_samples_are_their_own_mirror_image():
    points = np.array(tg.samples.ring_offsets())
    np.testing.assert_allclose(points[tg.samples.mirrored_points()], points * [1, -1], atol=1e-12)
