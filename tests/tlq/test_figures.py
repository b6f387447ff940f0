"""Figures of single walks: gaps are found where they are, and amplitudes are those of the swings across them."""

import dataclasses
import json

import numpy as np
import pytest

import terrains
from tests.tlq.policies import trained
from tlq import figures


@pytest.mark.parametrize("course", figures.COURSES)
def test_gaps_are_those_of_the_course(course):
    sizes = dataclasses.replace(terrains.GapsConfig(), widths=course)
    config = dataclasses.replace(terrains.TerrainConfig(), kind="gaps", gaps=sizes)
    edges = figures.gap_edges(terrains.make_terrain("gaps", "paper", 0, config))
    np.testing.assert_allclose([end - start for start, end in edges], course, atol=0.0025)
    assert all(0.25 <= b[0] - a[1] <= 0.31 for a, b in zip(edges[:-1], edges[1:], strict=True))


def test_amplitude_is_that_of_the_swings_across():
    """LF swings from 0.9 to 1.2 m with a hip range of 0.6 rad, RF from 1.3 m on: it doesn't cross the gap."""
    steps = 40
    feet, swing, desired = np.zeros((steps, 4, 3)), np.zeros((steps, 4), bool), np.zeros((steps, 12))
    swing[10:20, :2] = True
    feet[:, 0, 0] = np.interp(np.arange(steps), [10, 19], [0.9, 1.2])
    feet[:, 1, 0] = 1.3
    desired[:, 1] = np.interp(np.arange(steps), [10, 19], [-1.2, -0.6])
    trace = figures.Trace(feet, np.full((steps, 4), 0.06), swing, desired, 2.0, 100.0, False)
    assert figures.amplitude(trace, 1.0, 1.15) == pytest.approx(0.3)
    assert figures.amplitude(trace, 1.25, 1.4) is None


def test_both_figures_are_written(tmp_path, capsys):
    """By the trajectory generator alone, which doesn't get far."""
    small = {"policy.encoder": 8, "policy.head": 8, "policy.memory_width": 4}
    file = trained(spread=0.0, **small).export(tmp_path / "policy.npz")
    for name in ("stairs", "gaps"):
        picture, numbers = tmp_path / f"{name}.png", tmp_path / f"{name}.json"
        figures.main([f"figure={name}", f"ours={file}", f"picture={picture}", f"json={numbers}"])
        assert picture.stat().st_size > 10_000
        assert len(json.loads(numbers.read_text())) == {"stairs": 3, "gaps": 2}[name]
    assert "lift_median_m" in capsys.readouterr().out


def test_the_lift_follows_the_stairs(tmp_path):
    """By the shipped policy, over stairs of 3, 7.5 and 12 cm in MuJoCo C: about as high as each asks for."""
    picture, numbers = tmp_path / "stairs.png", tmp_path / "stairs.json"
    figures.main(["ours=stairs_lift", f"picture={picture}", f"json={numbers}"])
    walks = list(json.loads(numbers.read_text()).values())
    lifts = [walk["lift_median_m"] for walk in walks]
    assert lifts[0] <= 0.045 and lifts[0] + 0.01 < lifts[1] < lifts[2] - 0.01
    assert all(walk["distance_m"] == 5.0 and not walk["fell"] for walk in walks)


@pytest.mark.parametrize("seed", range(3))
def test_the_policy_for_stones_crosses_the_papers_gaps(tmp_path, seed):
    """In MuJoCo C, gaps of up to 25.5 cm; the hips swing wider over the widest gap than over the narrowest."""
    picture, numbers = tmp_path / "gaps.png", tmp_path / "gaps.json"
    figures.main(["figure=gaps", f"seed={seed}", f"picture={picture}", f"json={numbers}"])
    for name, course in json.loads(numbers.read_text()).items():
        assert not course["fell"] and course["distance_m"] > 2.1, name
        widths, amplitudes = json.loads(name), course["hip_amplitude_rad"]
        assert amplitudes[widths.index(max(widths))] > amplitudes[widths.index(min(widths))]


def test_wrong_settings_name_what_is_right(tmp_path):
    with pytest.raises(ValueError, match="unknown figure 'stair'"):
        figures.main(["figure=stair", "picture=x.png"])
    with pytest.raises(ValueError, match="picture= is missing"):
        figures.main([])
    with pytest.raises(ValueError, match="the figure of gaps is of the paper's method: set ours="):
        figures.main(["figure=gaps", "blind=mixed_blind", "picture=x.png"])
    with pytest.raises(ValueError, match="policy=nobody: no such policy"):
        figures.main(["ours=nobody", f"picture={tmp_path / 'x.png'}"])
