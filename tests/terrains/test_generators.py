"""Every kind: what is promised about sizes and gaps for any difficulty and seed; a seed is for ever."""

import dataclasses
import hashlib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import terrains

KINDS = [kind for kind in terrains.kinds() if kind != "mixed"]
DIFFICULTY = st.sampled_from([0.0, 0.1, 0.35, 0.5, 0.8, 0.93, 1.0])
SEED = st.integers(0, 20000)
CONFIG = terrains.TerrainConfig()


def steps(primitives):
    """Edges x0, x1, y0, y1 of footprints and tops, whole steps of 0.5 mm."""
    cx, cy, hx, hy, radius, top = primitives.astype(np.float64).T / 0.0005
    edges = np.stack([cx - hx - radius, cx + hx + radius, cy - hy - radius, cy + hy + radius, top])
    assert abs(edges - edges.round()).max(initial=0) < 0.02
    return edges.round()


def limits(cfg, difficulty, *names):
    return [round(terrains.at(getattr(cfg, name), difficulty) / 0.0005) for name in names]


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=10, deadline=None)
@given(difficulty=DIFFICULTY, seed=SEED)
def test_start_platform_lies_at_zero_and_map_is_reached(kind, difficulty, seed):
    terrain = terrains.make_terrain(kind, difficulty, seed)
    hx, hy, top = terrain.platform
    assert top == 0.0 and 0.35 <= hx <= 0.55 and 0.25 <= hy <= 0.45
    u = np.linspace(-1, 1, 41)
    xy = np.stack(np.meshgrid(u * (hx - 1e-6), u * (hy - 1e-6)), axis=-1)
    np.testing.assert_array_equal(terrains.exact_height(terrain, xy), 0.0)
    if terrain.floor < 0:  # beside islands there must be more of them on all sides
        x0, x1, y0, y1, _ = steps(terrain.primitives) * 0.0005
        assert x0.min() < -5.3 and x1.max() > 5.3 and y0.min() < -5.3 and y1.max() > 5.3


@pytest.mark.parametrize("kind", KINDS)
def test_same_seed_same_terrain(kind):
    a = terrains.make_terrain(kind, "paper", 7)
    b = terrains.make_terrain(kind, 0.8, 7)
    np.testing.assert_array_equal(a.primitives, b.primitives)
    if kind not in ("flat", "stairs"):
        for other in (terrains.make_terrain(kind, 0.8, 8), terrains.make_terrain(kind, 0.8, 7, index=1)):
            assert a.primitives.shape != other.primitives.shape or (a.primitives != other.primitives).any()


HASHES = {
    "flat": "e3b0c44298fc1c14",
    "blocks": "8c765276e3422f39",
    "stairs": "d4dcfe187d276782",
    "stepping_stones": "d80dcf75ea95f078",
    "poles": "dd93d489a35a1ce4",
    "gaps": "c6da24e3d640be56",
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_seed_means_the_same_terrain_for_ever(kind):
    terrain = terrains.make_terrain(kind, "paper", 7)
    assert hashlib.sha256(terrain.primitives.tobytes()).hexdigest()[:16] == HASHES[kind]


@settings(max_examples=10, deadline=None)
@given(difficulty=DIFFICULTY, seed=SEED)
def test_blocks_cover_the_map_with_heights_in_range(difficulty, seed):
    terrain = terrains.make_terrain("blocks", difficulty, seed)
    x0, x1, y0, y1, top = steps(terrain.primitives)
    highest = round(terrains.at(CONFIG.blocks.height, difficulty) * 1000) * 2
    assert (top > 0).all() and (top <= highest).all() and top.max() > 0.9 * highest - 2
    assert (x1 - x0).max() == (y1 - y0).max() == 500
    area = ((x1 - x0) * (y1 - y0)).sum() / 22400**2
    assert area > 1 - 1.2 / (highest / 2 + 1) - 0.02  # all but the platform and the blocks of height 0


@pytest.mark.parametrize(
    "difficulty, fixed, rise", [(0.8, None, 0.15), (1.0, None, 0.20), (0.8, 0.075, 0.075)]
)
def test_stairs_go_five_up_and_five_down(difficulty, fixed, rise):
    config = terrains.TerrainConfig(stairs=terrains.StairsConfig(fixed_rise=fixed))
    terrain = terrains.make_terrain("stairs", difficulty, 0, config)
    middle = np.arange(17) * 0.30 + 0.15
    profile = np.array([1, 2, 3, 4, 5, 4, 3, 2, 1, 0, 1, 2, 3, 4, 5, 4, 3])
    for direction in ([1, 0], [-1, 0], [0, 1], [0, -1]):
        start = 0.45 if direction[0] else 0.35
        heights = terrains.exact_height(terrain, np.outer(start + middle, direction))
        np.testing.assert_allclose(heights, rise * profile, atol=1e-9)


@settings(max_examples=15, deadline=None)
@given(difficulty=DIFFICULTY, seed=SEED)
def test_stepping_stone_gaps_stay_in_range(difficulty, seed):
    terrain = terrains.make_terrain("stepping_stones", difficulty, seed)
    low, high = limits(CONFIG.stepping_stones, difficulty, "gap_min", "gap_max")
    x0, x1, y0, y1, top = steps(terrain.primitives)
    assert (top == 0).all()
    size = np.stack([x1 - x0, y1 - y0])[:, 1:]  # row 0 is the platform
    assert size.min() >= 400 and size.max() <= 700
    dx, dy = (np.maximum(a[:, None] - b[None], a[None] - b[:, None]) for a, b in ((x0, x1), (y0, y1)))
    other = ~np.eye(len(x0), dtype=bool)
    assert np.maximum(dx, dy)[other].min() >= low
    inner = np.maximum(abs(y0), abs(y1)) < 10500  # nearer to the edge the next stone may not be on the map
    # Along a row: the nearest stone (or the platform) on either side.
    for sign in (1, -1):
        beyond = (dx < 0) & (sign * (y0 + y1)[None] > sign * (y0 + y1)[:, None])
        gap = np.where(beyond, dy, np.inf).min(axis=1)
        assert (gap[1:][inner[1:]] <= high).all()
    # Between rows: bands of x that stones share. Stones that face each other across two neighbouring bands.
    order = np.argsort(x0[1:]) + 1
    band = np.zeros(len(x0), int)
    band[order] = np.cumsum(np.append(0, x0[order][1:] > np.maximum.accumulate(x1[order])[:-1]))
    for number in range(band.max() + 1):
        row = (band == number) & (np.arange(len(band)) > 0)
        assert min(-y0[row].min(), y1[row].max()) >= 11200 - 200 - max(0, high - low - 400)
    facing = (band[:, None] + 1 == band[None]) & (dy < 0)
    facing[0] = facing[:, 0] = False
    assert facing.any() and (dx[facing] <= high).all()
    platform = (dy[0] < 0) & (x0 > 0)
    assert low <= dx[0][platform].min() <= high


@settings(max_examples=15, deadline=None)
@given(difficulty=DIFFICULTY, seed=SEED)
def test_pole_gaps_stay_in_range(difficulty, seed):
    terrain = terrains.make_terrain("poles", difficulty, seed)
    cfg = CONFIG.poles
    low, high = limits(cfg, difficulty, "gap_min", "gap_max")
    poles = terrain.primitives[1:].astype(np.float64) / 0.0005
    x, y, r = poles[:, 0], poles[:, 1], poles[:, 4]
    smallest, largest = (
        terrains.at(d, difficulty) / 2 / 0.0005 for d in (cfg.diameter_min, cfg.diameter_max)
    )
    assert r.min() >= smallest - 0.51 and r.max() <= largest + 0.51
    gap = np.hypot(x[:, None] - x, y[:, None] - y) - r[:, None] - r
    np.fill_diagonal(gap, np.inf)
    assert gap.min() >= low - 0.01
    px, py = np.array(terrain.platform[:2]) / 0.0005
    to_platform = np.hypot(np.maximum(abs(x) - px, 0), np.maximum(abs(y) - py, 0)) - r
    assert to_platform.min() >= low - 0.01
    near = (gap <= high + 0.01).sum(axis=1) + (to_platform <= high + 0.01)
    inner = (abs(x) < 10600) & (abs(y) < 10600)
    assert (near[inner] >= 4).all()
    # All along each side of the platform poles are within reach, at most two gaps and a pole apart.
    for along, across, half, half_across in ((x, y, px, py), (y, x, py, px)):
        for sign in (1, -1):
            first = (to_platform <= high + 0.01) & (sign * across > half_across) & (abs(along) < half)
            row = np.sort(along[first])
            assert np.diff(np.concatenate([[-half], row, [half]])).max() <= 2 * (largest + max(high, 0)) + 2


def test_poles_vary():
    rows = terrains.make_terrain("poles", "paper", 0).primitives[1:]
    diameter = 2 * rows[:, 4]
    assert diameter.std() > 0.01 and diameter.min() < 0.105 and diameter.max() > 0.145
    lattice = terrains.make_terrain(
        "poles", "paper", 0, terrains.TerrainConfig(poles=terrains.PolesConfig(sweeps=0))
    ).primitives[1:]
    assert np.std(rows[:, :2] - lattice[:, :2]) > 0.01


def test_gap_course_has_the_widths_asked_for():
    widths = (0.085, 0.17, 0.255)
    config = terrains.TerrainConfig(gaps=terrains.GapsConfig(widths=widths))
    terrain = terrains.make_terrain("gaps", "paper", 3, config)
    x0, x1, *_ = steps(terrain.primitives) * 0.0005
    for left, right in ((x0, x1), (-x1, -x0)):  # outwards along +x and along -x
        begin, end = np.sort(left[left > 0]), np.sort(right[right > 0])
        np.testing.assert_allclose(begin - end[:-1], widths, atol=1e-9)
        assert end[0] == pytest.approx(0.45) and end[-1] == pytest.approx(5.6)
    with pytest.raises(ValueError, match=r"fewer"):
        config = terrains.TerrainConfig(gaps=terrains.GapsConfig(widths=(0.3,) * 20))
        terrains.make_terrain("gaps", 0.8, 0, config)


@settings(max_examples=10, deadline=None)
@given(difficulty=DIFFICULTY, seed=SEED)
def test_gaps_and_landings_stay_in_range(difficulty, seed):
    terrain = terrains.make_terrain("gaps", difficulty, seed)
    low, high = limits(CONFIG.gaps, difficulty, "gap_min", "gap_max")
    x0, x1, y0, y1, _ = steps(terrain.primitives)
    order = np.argsort(x0)
    gap = x0[order][1:] - x1[order][:-1]
    assert low <= gap.min() and gap.max() <= high
    assert (y0 == -11200).all() and (y1 == 11200).all()
    np.testing.assert_array_equal(np.sort(x0), np.sort(-x1))


def test_mixed_draws_from_its_kinds():
    config = terrains.TerrainConfig(mixed=terrains.MixedConfig(kinds=("flat", "gaps")))
    drawn = [terrains.make_terrain("mixed", 0.5, 0, config, index=k) for k in range(40)]
    assert {t.kind for t in drawn} == {"flat", "gaps"}
    gaps = next(t for t in drawn if t.kind == "gaps")
    same = terrains.make_terrain("gaps", 0.5, 0, index=gaps.index)
    np.testing.assert_array_equal(gaps.primitives, same.primitives)


def test_sizes_run_linearly_through_the_named_level():
    levels = (0.0, 0.8, 1.8)
    found = [terrains.at(levels, d) for d in (0.0, 0.4, 0.8, 0.9, 1.0)]
    assert found == pytest.approx([0.0, 0.4, 0.8, 1.3, 1.8])


def test_errors_name_the_choices():
    with pytest.raises(ValueError, match=r"unknown terrain 'pole'; choose one of flat, .*poles, gaps, mixed"):
        terrains.make_terrain("pole", 0.5, 0)
    for wrong in (-0.1, 1.1, "hard", float("nan")):
        with pytest.raises(ValueError, match=r"'paper'"):
            terrains.make_terrain("poles", wrong, 0)
    with pytest.raises(ValueError, match=r"choose one or more of"):
        config = terrains.TerrainConfig(mixed=terrains.MixedConfig(kinds=("mixed",)))
        terrains.make_terrain("mixed", 0.5, 0, config)
    with pytest.raises(ValueError, match=r"exists already"):
        terrains.register("poles")(lambda difficulty, rng, config: None)
    with pytest.raises(ValueError, match=r"platform_length"):
        terrains.make_terrain("stepping_stones", 0.0, 0, dataclasses.replace(CONFIG, platform_length=0.37))


def test_a_kind_of_ones_own(monkeypatch):
    monkeypatch.setattr("terrains.registry._GENERATORS", dict(terrains.registry._GENERATORS))

    @terrains.register("curb")
    def curb(difficulty, rng, config):
        rows = terrains.boxes(2000, 2400, -11200, 11200, 200 * difficulty)
        return terrains.Layout(rows, floor=0.0, platform=(0.45, 0.35, 0.0))

    assert "curb" in terrains.kinds()
    terrain = terrains.make_terrain("curb", 1.0, 0)
    assert terrains.exact_height(terrain, [[1.1, 0.0], [0.9, 0.0]]).tolist() == [0.1, 0.0]
