"""Scores and calibration against plain arithmetic and slow loops."""

import numpy as np
import pytest

from tlq import calibration


def test_brier_score_of_the_base_rate_is_its_variance():
    y = np.array([1.0, 0.0, 0.0, 0.0])
    # 0.25 always: (0.75² + 3 x 0.25²) / 4 = (0.5625 + 0.1875) / 4 = 0.1875 = 0.25 x 0.75.
    assert calibration.brier(np.full(4, 0.25), y) == pytest.approx(0.1875)
    # (0.9 - 1)² + 0.2² + 0 + 0.1² = 0.01 + 0.04 + 0.01 = 0.06, over 4.
    assert calibration.brier(np.array([0.9, 0.2, 0.0, 0.1]), y) == pytest.approx(0.015)


def test_auc_is_the_share_of_pairs_in_order():
    random = np.random.default_rng(0)
    p, y = random.integers(0, 8, 60) / 8, (random.uniform(size=60) < 0.4).astype(float)
    pairs = [(a > b) + 0.5 * (a == b) for a in p[y == 1] for b in p[y == 0]]
    assert calibration.auc(p, y) == pytest.approx(np.mean(pairs))
    assert calibration.auc(y, y) == 1.0 and calibration.auc(1 - y, y) == 0.0
    assert np.isnan(calibration.auc(p, np.ones(60)))


def test_reliability_and_its_error():
    p, y = np.array([0.05, 0.15, 0.15, 1.0]), np.array([0.0, 0.0, 1.0, 1.0])
    rows = calibration.reliability(p, y)
    assert [(r["from"], r["steps"], r["predicted"], r["observed"]) for r in rows] == [
        (0.0, 1, pytest.approx(0.05), 0.0),
        (0.1, 2, pytest.approx(0.15), 0.5),
        (0.9, 1, 1.0, 1.0),  # 1 belongs to the last bin
    ]
    # 1 x 0.05 + 2 x 0.35 + 1 x 0 = 0.75, over 4.
    assert calibration.expected_error(p, y) == pytest.approx(0.1875)


def test_platt_finds_the_scale_and_shift_that_were_used():
    random = np.random.default_rng(1)
    x = random.normal(0.0, 3.0, 40_000)
    y = (random.uniform(size=x.size) < calibration.sigmoid(0.5 * x - 1.0)).astype(float)
    assert calibration.platt(x, y) == (pytest.approx(0.5, abs=0.03), pytest.approx(-1.0, abs=0.05))


def test_platt_stays_finite_where_classes_can_be_told_apart():
    found = calibration.platt(np.array([-2.0, -1.0, 1.0, 2.0]), np.array([0.0, 0.0, 1.0, 1.0]))
    assert np.isfinite(found).all() and found[0] > 1.0


def test_log_loss_is_that_of_the_probability():
    x, y = np.array([-1.0, 2.0, 0.3]), np.array([0.0, 1.0, 0.0])
    p = calibration.sigmoid(x)
    assert calibration.log_loss(x, y) == pytest.approx(-np.mean(np.log(np.where(y == 1, p, 1 - p))))


def test_bootstrap_draws_whole_groups():
    groups = [np.full(50, 0.0), np.full(50, 1.0)] * 8
    found = calibration.bootstrap(groups, lambda g: float(np.concatenate(g).mean()))
    # 16 coins: a deviation of 0.125, a 95 % interval of about ± 0.245. 800 single steps would give ± 0.035.
    assert found["value"] == 0.5
    assert found["high"] - found["low"] == pytest.approx(0.49, abs=0.1)
