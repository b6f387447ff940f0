"""Fitting a monitor: episodes to labels and parts, alarms by hand, thresholds, and the whole of it in small."""

import dataclasses
import json

import numpy as np
import pytest

from tlq import calibration, cli, episodes, monitor, monitor_fit
from tlq.episodes import Episode
from tlq.monitor import Decision, Monitor

NAN = float("nan")


def episode(logits, *, standing=(), fell=False, speed=0.1):
    """An episode whose only feature is the logit that `PLAIN` gives."""
    count = len(logits)
    stood = np.zeros(count, bool)
    stood[list(standing)] = True
    way = np.cumsum(np.where(stood, 0.0, speed)).astype(np.float32)
    return Episode(np.array(logits, np.float16)[:, None], stood, way, fell)


ONE = np.ones(1, np.float32)
PLAIN = monitor.Network(0 * ONE, ONE, (ONE[:, None],), (0 * ONE,), np.float32(1.0), np.float32(0.0))
"""Gives its feature back (between -5 and 5)."""


def test_whole_episodes_are_split():
    parts = monitor_fit.split(list(range(100)), seed=3)
    assert sorted(k for part in parts.values() for k in part) == list(range(100))
    assert {name: len(part) for name, part in parts.items()} == {
        "fit": 54,  # 96 by shares, and one for each part
        "stopping": 15,
        "calibration": 16,
        "test": 15,
    }
    assert parts == monitor_fit.split(list(range(100)), seed=3) != monitor_fit.split(list(range(100)), seed=4)
    assert [len(part) for part in monitor_fit.split(range(4), seed=0).values()] == [1, 1, 1, 1]


def test_labels_say_what_comes_within_the_horizon():
    found = monitor_fit.labels(episode([0] * 6, fell=True), 2)
    np.testing.assert_array_equal(found, [0, 0, 0, 0, 1, 1])
    found = monitor_fit.labels(episode([0] * 6), 2)  # ended otherwise: what would have come isn't known
    np.testing.assert_array_equal(found, [0, 0, 0, 0, NAN, NAN])
    found = monitor_fit.labels(episode([0] * 8, standing=range(3, 6), fell=True), 2)
    np.testing.assert_array_equal(found, [0, NAN, NAN, 0, NAN, NAN, 1, 1])


def test_figures_are_of_walking_steps():
    x, y = monitor_fit.shown(PLAIN, [episode([1, 2, 3, 4, 5, 0], standing=range(3), fell=True)], 2)
    np.testing.assert_array_equal(x, [4, 5, 0])
    np.testing.assert_array_equal(y, [0, 1, 1])


def test_alarms_by_hand():
    """Steps of 0.1 s and 0.1 m; an alarm beyond 0.5 (logit 0), over when five steps were below 0.25 (logit -1.1)."""
    decision = Decision(0.5, 0.25, 0.5)
    calm = [-3.0] * 20
    foreseen = episode([*calm, 3, 3, 3, 3, 3], fell=True)  # alarm at step 20, fall at step 24: 0.4 s
    false = episode([3.0, *calm, 3.0, *calm, *calm])  # alarms at steps 0 and 21 of 62
    missed = episode(calm, fell=True)
    found = monitor_fit.alarms(PLAIN, [foreseen, false, missed], decision, 0.4, 0.1)
    assert (found["falls"], found["foreseen"], found["foreseen_by_0.3_s"]) == (2, 1, 1)
    assert found["lead_s"]["median"] == pytest.approx(0.4)
    # Ways from the first step on: 2.4 + 6.1 + 1.9 m; two false alarms; of the ways 2.0, 0 and 1.9 m are left.
    assert found["false_alarms_per_10_m"] == pytest.approx(10 * 2 / 10.4, rel=1e-4)
    assert found["distance_lost"] == pytest.approx(1 - 3.9 / 10.4, rel=1e-4)


def test_stretches_end_where_standing_is_commanded():
    found = monitor_fit.stretches(episode([0] * 9, standing=(2, 3), fell=True))
    assert found == [(0, 2, False), (4, 9, True)]
    assert monitor_fit.stretches(episode([0] * 4, standing=(2, 3), fell=True)) == [(0, 2, False)]


def test_the_threshold_is_the_lowest_with_few_false_alarms():
    options = monitor_fit.Options(policy="x", out="y", horizon=0.4, false_alarms=1.0)
    noisy = episode(np.tile([-3.0] * 30 + [0.4], 20))  # a peak of 0.6 every 3.1 m
    found = monitor_fit.choose(PLAIN, [noisy], options, 0.1)
    # sigmoid(0.4) = 0.599. Below 0.047 a single alarm would last for good: few alarms, but no choice.
    assert found == 0.6
    assert monitor_fit.choose(PLAIN, [noisy], dataclasses.replace(options, false_alarms=9), 0.1) == 0.02


def test_a_fit_finds_what_foretells_falls():
    """Falls after a feature rose; the others are noise."""
    random = np.random.default_rng(0)

    def drawn(fell):
        x = random.normal(size=(60, 4)).astype(np.float16)
        x[-12:, 2] += 3.0 * fell
        return Episode(x, np.zeros(60, bool), np.linspace(0, 1, 60, dtype=np.float32), fell)

    part = [drawn(bool(k % 2)) for k in range(60)]
    network = monitor_fit.train(part[:30], part[30:45], 10, 0, lambda line: None)
    x, y = monitor_fit.shown(network, part[45:], 10)
    assert calibration.auc(x, y) > 0.95
    found = monitor_fit.measure(network, part[45:], 10)
    assert found["brier"]["value"] < 0.6 * found["brier_of_base_rate"]["value"]
    assert found["brier_skill"]["low"] > 0
    assert sum(row["steps"] for row in found["reliability"]) == found["steps"] == len(y)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["policy=x", "out=m.npz", "seed=10000"], r"seed=10000 must be in \[0, 9999\]"),
        (["policy=x", "out=m.npz", "episodes=3"], "episodes=3 must be at least 4"),
        (["policy=x", "out=m.npz", "horizon=0"], r"horizon=0.0 must be in \[0.1, 5\]"),
        (["policy=x", "out=/no/where/m.npz"], "there is no folder /no/where"),
        (["policy=x"], "out= is missing"),
    ],
)
def test_wrong_command_lines_name_what_is_right(arguments, message):
    with pytest.raises(ValueError, match=message):
        monitor_fit.main(arguments)


@pytest.mark.slow
def test_all_of_it(tmp_path, capsys):
    """A policy for flat ground on poles: it falls soon. A recording goes on where it was left, and isn't another's."""
    policy = cli.POLICIES / "flat.npz"
    setting = episodes.Setting(str(policy), "poles", 0.8, 0.1, 5)
    out, kept, picture = (tmp_path / name for name in ("m.npz", "kept.npz", "curve.png"))
    first = episodes.record(setting, 3, kept, lambda line: None)
    again = episodes.walk(setting, 2)
    np.testing.assert_array_equal(first[2].features, again.features)
    arguments = [f"policy={policy}", "terrain=poles", "difficulty=0.8", "seed=5", "episodes=8", f"out={out}"]
    json_file = tmp_path / "figures.json"
    monitor_fit.main([*arguments, f"recording={kept}", f"json={json_file}", f"picture={picture}"])
    printed = capsys.readouterr().out
    assert "episode 2:" not in printed and "episode 3:" in printed and "Brier score" in printed
    found = json.loads(json_file.read_text())
    assert sum(found["episodes"].values()) == 8 and sum(found["falls"].values()) >= 1
    assert picture.stat().st_size > 10_000
    command = Monitor(out, policy).metadata["command"]
    assert command.startswith("python -m tlq.monitor_fit policy=") and "recording" not in command
    with pytest.raises(ValueError, match="is of another policy, terrain, difficulty or seed"):
        episodes.record(dataclasses.replace(setting, seed=6), 4, kept)
