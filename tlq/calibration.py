"""How good predicted probabilities are, in NumPy: Brier score, AUC, reliability, and Platt's calibration.

Letters: N predictions. `y` is 1.0 where it came true, else 0.0.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

BINS = 10


def sigmoid(x: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x)), without the overflow."""
    return 0.5 + 0.5 * np.tanh(0.5 * np.asarray(x, float))


def brier(p: np.ndarray, y: np.ndarray) -> float:
    """Mean of (p - y)²; that of the base rate r, always predicted, is r (1 - r)."""
    return float(np.mean((p - y) ** 2))


def log_loss(x: np.ndarray, y: np.ndarray) -> float:
    """Mean of -log of the probability that logits (N,) gave to what happened."""
    return float(np.mean(np.logaddexp(0.0, x) - y * x))


def auc(p: np.ndarray, y: np.ndarray) -> float:
    """Share of pairs of one that came true and one that didn't in which the former has the larger p; ties count half.

    NaN where there are no such pairs.
    """
    values, place, count = np.unique(p, return_inverse=True, return_counts=True)
    rank = np.cumsum(count) - 0.5 * (count - 1)  # the mean of those that are equal
    true = float(np.sum(y))
    pairs = true * (len(y) - true)
    return float((rank[place] @ y - 0.5 * true * (true + 1)) / pairs) if pairs else float("nan")


def reliability(p: np.ndarray, y: np.ndarray, bins: int = BINS) -> list[dict[str, float]]:
    """The curve: for bins of equal width, how many predictions fell there, their mean, and the share that came true."""
    place = np.minimum((p * bins).astype(int), bins - 1)
    found = []
    for k in range(bins):
        inside = place == k
        if inside.any():
            mean, share = float(p[inside].mean()), float(y[inside].mean())
            row = {"from": k / bins, "to": (k + 1) / bins, "steps": int(inside.sum())}
            found.append({**row, "predicted": mean, "observed": share})
    return found


def expected_error(p: np.ndarray, y: np.ndarray, bins: int = BINS) -> float:
    """Expected calibration error: mean distance of the reliability curve from the diagonal, weighted by count."""
    rows = reliability(p, y, bins)
    return sum(r["steps"] * abs(r["predicted"] - r["observed"]) for r in rows) / len(p)


def platt(x: np.ndarray, y: np.ndarray, steps: int = 50) -> tuple[float, float]:
    """Scale a and shift b with which sigmoid(a x + b) fits best (log loss), by Newton's method.

    A pull of a thousandth of one observation towards (1, 0) keeps them finite where the two classes can be told apart.
    """
    ones = np.stack([x, np.ones_like(x)], axis=-1)
    start = np.array([1.0, 0.0])
    found, pull = start.copy(), 1e-3 / len(x)
    for _ in range(steps):
        p = sigmoid(ones @ found)
        gradient = ones.T @ (p - y) / len(x) + pull * (found - start)
        curvature = (ones * (p * (1.0 - p))[:, None]).T @ ones / len(x) + pull * np.eye(2)
        step = np.linalg.solve(curvature, gradient)
        found -= step / max(1.0, float(np.abs(step).max()))
    return float(found[0]), float(found[1])


def bootstrap(
    groups: Sequence[Any], statistic: Callable[[list[Any]], float], *, draws: int = 400, seed: int = 0
) -> dict[str, float]:
    """Value of a statistic of groups (episodes) and its 95 % interval, by drawing whole groups anew."""
    random, values = np.random.default_rng(seed), []
    for _ in range(draws):
        values.append(statistic([groups[i] for i in random.integers(len(groups), size=len(groups))]))
    known = [value for value in values if np.isfinite(value)]
    low, high = np.percentile(known, [2.5, 97.5]) if known else (np.nan, np.nan)
    return {"value": float(statistic(list(groups))), "low": float(low), "high": float(high)}
