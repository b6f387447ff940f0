"""Range sensors against the terrain's true geometry, the pose estimate's drift, heights by the robot's own sensors."""

import json

import mujoco
import numpy as np
import pytest

import terrains
import tg
from benchmarks import perception as benchmark
from envs.scene import build_scene
from tests.tlq.policies import trained
from tlq import evaluate
from tlq.config import training_env
from tlq.perception import YAW_PER_METRE, PoseEstimate
from tlq.rangefinders import SENSORS, DepthConfig, LidarConfig, RangeSensors, in_frame
from tlq.runtime import Controller
from tlq.senses import PerceptionConfig
from tlq.simulation import Simulation

EXACT = {"drift": 0.0, "latency": 0.0, "missing": 0.0, "range_noise": 0.0}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A policy that leaves walking to the trajectory generator, low enough for that to stay up."""
    return trained(spread=0.0, **{"env.robot.foot_height": -0.28}).export(
        tmp_path_factory.mktemp("perception") / "policy.npz"
    )


def simulation(file, kind, terrain="flat", difficulty=0.5, seed=0, **changes):
    controller = Controller(file)
    config = PerceptionConfig(kind=kind, **(EXACT | changes))
    where = terrains.make_terrain(terrain, difficulty, evaluate.FIRST_SEED)
    return Simulation(controller, where, training_env(controller.metadata), perception=config, seed=seed)


def inside(terrain, places):
    """How far (m) inside of what has the height there: of the deepest primitive that reaches as high as the ground."""
    rows = terrain.primitives.astype(float)
    d = terrains.footprint_distance(rows, places[:, 0, None], places[:, 1, None])
    return np.abs(d).min(axis=1) if len(rows) else np.full(len(places), np.inf)


# -- sensors ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SENSORS)
@pytest.mark.parametrize("place", [(0.0, 0.0), (2.3, -1.7)])
def test_rays_end_on_the_true_ground(file, kind, place):
    """Also far from the origin, where a plane's middle is beyond the cutoff."""
    sim = simulation(file, kind, "poles", 0.8)
    sim.data.qpos[:2] = place
    sim.data.qpos[3:7] = np.array([0.95, 0.05, -0.08, 0.3]) / np.linalg.norm([0.95, 0.05, -0.08, 0.3])
    random = np.random.default_rng(0)
    scans = [sim.perception.sensors.scan(sim.model, sim.data, random) for _ in range(8)]
    _, points, _ = (
        np.concatenate(p)
        for p in zip(*(in_frame(s, sim.data.qpos[:3], sim.data.qpos[3:7]) for s in scans), strict=True)
    )
    true = terrains.exact_height(sim.terrain, points[:, :2])
    clear = inside(sim.terrain, points) > 1e-3  # not on the side of a pole
    assert len(points) > 2000 and clear.mean() > 0.3
    np.testing.assert_allclose(points[clear, 2], true[clear], atol=1e-6)
    assert (points[~clear, 2] <= true[~clear].max() + 1e-6).all() and (points[~clear, 2] > -0.5).all()
    if place[0] > 0:
        assert (points[:, 2] < -0.49).any()  # the pit's floor


@pytest.mark.parametrize("kind", SENSORS)
def test_all_sides_are_seen(file, kind):
    """Within 10 to 35 cm of the feet's rectangle there is a return in each of 16 directions, within two rounds."""
    sim = simulation(file, kind)
    random = np.random.default_rng(0)
    scans = [sim.perception.sensors.scan(sim.model, sim.data, random) for _ in range(8)]
    points = np.concatenate([s.points for s in scans])
    feet = np.abs(sim.controller.core.feet(sim.exact_sensors())[:, :2]).max(axis=0)
    off = np.maximum(np.abs(points[:, :2]) - feet, 0.0)
    near = points[(np.hypot(*off.T) > 0.1) & (np.hypot(*off.T) < 0.35)]
    sector = np.floor(np.arctan2(near[:, 1], near[:, 0]) / (2 * np.pi) * 16).astype(int) % 16
    assert set(sector) == set(range(16))


@pytest.mark.parametrize("kind", SENSORS)
def test_ranges_have_the_noise_of_the_data_sheet(file, kind):
    sim = simulation(file, kind)
    hips = sim.controller.core.geometry.hip_position
    apart, ranges, told = [], [], []
    sensors = [RangeSensors(kind, sim.model, hips, noise=n) for n in (0.0, 1.0)]
    for k in range(8):
        exact, noisy = (s.scan(sim.model, sim.data, np.random.default_rng(k)) for s in sensors)
        if len(exact.points) != len(noisy.points):
            continue  # a return at the end of the range
        ranges.append(np.linalg.norm(exact.points - exact.origins, axis=-1))
        apart.append(np.linalg.norm(noisy.points - noisy.origins, axis=-1) - ranges[-1])
        told.append(noisy.variance)
    apart, ranges, told = (np.concatenate(x) for x in (apart, ranges, told))
    assert apart.mean() == pytest.approx(0.0, abs=0.1 * apart.std())
    assert np.mean(apart**2 / told) == pytest.approx(1.0, abs=0.1)
    if kind == "lidar":
        np.testing.assert_allclose(told, LidarConfig().deviation ** 2)
    else:
        # Depth z = range / length with 1 <= length <= 1.5 in the corners: deviation 0.0036 z² length.
        assert (np.sqrt(told) <= DepthConfig().deviation * ranges**2 + 1e-9).all()
        assert (np.sqrt(told) >= DepthConfig().deviation * ranges**2 / 1.5).all()


def test_lost_returns_are_as_many_as_said(file):
    sim = simulation(file, "depth")
    hips = sim.controller.core.geometry.hip_position
    count = []
    for missing in (0.0, 0.3, 1.0):
        sensors = RangeSensors("depth", sim.model, hips, noise=0.0, missing=missing)
        random = np.random.default_rng(0)
        count.append(sum(len(sensors.scan(sim.model, sim.data, random).points) for _ in range(8)))
    assert count[1] / count[0] == pytest.approx(0.7, abs=0.03) and count[2] == 0


def test_legs_hide_the_ground_and_change_nothing_else(file):
    sim = simulation(file, "depth")
    bare = build_scene(sim.config.robot, sim.terrain)
    assert sim.model.ngeom == bare.ngeom + 8
    np.testing.assert_array_equal(sim.model.body_mass, bare.body_mass)
    np.testing.assert_array_equal(sim.model.body_inertia, bare.body_inertia)
    added = sim.model.geom_type == mujoco.mjtGeom.mjGEOM_CAPSULE
    assert added.sum() == 8 and not sim.model.geom_contype[added].any()
    assert not sim.model.geom_conaffinity[added].any()
    # The same rays with and without them: fewer returns, none of them the robot's.
    data, counts = mujoco.MjData(bare), []
    data.qpos[:] = sim.data.qpos
    for model, state in ((sim.model, sim.data), (bare, data)):
        sensors = RangeSensors("depth", model, sim.controller.core.geometry.hip_position, noise=0.0)
        scans = [sensors.scan(model, state, np.random.default_rng(k)) for k in range(4)]
        points = np.concatenate([in_frame(s, np.zeros(3), state.qpos[3:7])[1] for s in scans])
        np.testing.assert_allclose(points[:, 2], -state.qpos[2], atol=1e-6)
        counts.append(len(points))
    assert 0.7 * counts[1] < counts[0] < 0.99 * counts[1]


# -- the estimate ----------------------------------------------------------------------------------------------------


def test_drift_is_a_random_walk_by_the_way():
    """After 1 m in 40 steps x and z are off by 2 cm, after 4 m by 4 cm (y by more: the heading turns it)."""
    random, ends = np.random.default_rng(0), {40: [], 160: []}
    for _ in range(300):
        pose = PoseEstimate(0.02)
        pose.reset(np.zeros(3))
        for k in range(1, 161):
            true = np.array([0.025 * k, 0.0, 0.0])
            pose.update(true, random)
            if k in ends:
                ends[k].append([*(pose.position - true), pose.turned])
    for k, metres in ((40, 1.0), (160, 4.0)):
        x, _, z, turned = np.std(ends[k], axis=0)
        assert x == pytest.approx(0.02 * metres**0.5, rel=0.12)
        assert z == pytest.approx(0.02 * metres**0.5, rel=0.12)
        assert turned == pytest.approx(YAW_PER_METRE * 0.02 * metres**0.5, rel=0.12)


def test_a_robot_that_stands_does_not_drift():
    pose = PoseEstimate(0.1)
    pose.reset(np.array([1.0, 2.0, 0.3]))
    for _ in range(10):
        pose.update(np.array([1.0, 2.0, 0.3]), np.random.default_rng(0))
    np.testing.assert_array_equal(pose.position, [1.0, 2.0, 0.3])
    assert pose.turned == 0.0


def test_the_heading_drifts_and_gravity_keeps_roll_and_pitch():
    pose, random = PoseEstimate(0.0), np.random.default_rng(1)
    pose.reset(np.zeros(3))
    for _ in range(20):
        true = random.normal(size=4)
        true /= np.linalg.norm(true)
        pose.turned = float(random.uniform(-3, 3))
        found = pose.orientation(true)
        turn = tg.frames.yaw(found) - tg.frames.yaw(true) - pose.turned
        assert np.cos(turn) == pytest.approx(1.0)
        np.testing.assert_allclose(tg.frames.up_in_trunk(found), tg.frames.up_in_trunk(true), atol=1e-12)


# -- all together ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", SENSORS)
@pytest.mark.parametrize("terrain", ["blocks", "stairs"])
def test_without_errors_a_standing_robot_maps_the_true_heights(file, kind, terrain):
    sim = simulation(file, kind, terrain, 0.8)
    for _ in range(60):
        sim.perception.look(sim.data)
    ground, c = sim.perception.ground, sim.perception.ground.config
    i = np.arange(-c.cells // 2, c.cells // 2)
    cells = ground.centre + np.stack(np.meshgrid(i, i, indexing="ij"), axis=-1).reshape(-1, 2)
    places = (cells + 0.5) * c.cell
    where = ground.index(cells)
    seen = np.isfinite(ground.variance[where]) & ~ground.bound[where]
    corners = places[:, None] + 0.75 * c.cell * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    true = terrains.exact_height(sim.terrain, corners)
    level = np.ptp(true, axis=1) == 0
    assert (seen & level).sum() > 2000 and (np.abs(places[seen]).max(axis=0) > 0.4).all()
    np.testing.assert_allclose(ground.height[where][seen & level], true[seen & level, 0], atol=1e-3)
    # And at the feet, the heights the policy gets: those beside the platform's edge aside, to the millimetre.
    np.testing.assert_allclose(sim.heights, sim._height(sim.points) - sim.data.qpos[2], atol=1e-3)


@pytest.mark.parametrize("kind", SENSORS)
def test_walking_by_sensors_that_are_exact_is_walking_by_the_map(file, kind):
    """On flat ground; sensors, limbs and map don't touch the physics."""
    sims = [simulation(file, kind, "flat")]
    sims.append(Simulation(Controller(file), sims[0].terrain, sims[0].config))
    for _ in range(60):
        for sim in sims:
            sim.step(np.array([0.0, 1.0]))
        np.testing.assert_allclose(sims[0].heights, sims[1].heights, atol=2e-3)
    np.testing.assert_allclose(sims[0].data.qpos, sims[1].data.qpos, atol=0.02)


def test_drift_in_height_is_followed(file):
    """The estimate's z is off by 2 cm a root of a metre, the heights against it by far less."""
    sim = simulation(file, "depth", drift=0.05, seed=2)
    off, estimate = [], 0.0
    for _ in range(120):
        sim.step(np.array([1.0, 0.0]))
        off.append(np.mean(sim.heights + sim.data.qpos[2]))
        estimate = max(estimate, abs(sim.perception.pose.position[2] - sim.data.qpos[2]))
    assert estimate > 0.02 and np.std(off) < 0.008 and abs(np.mean(off)) < 0.004


def test_latency_keeps_scans_waiting(file, monkeypatch):
    sim = simulation(file, "depth", latency=0.1)
    seen = []
    monkeypatch.setattr(sim.perception.ground, "fuse", lambda origin, points, variance: seen.append(points))
    scans = []
    scan = sim.perception.sensors.scan
    monkeypatch.setattr(sim.perception.sensors, "scan", lambda *how: scans.append(scan(*how)) or scans[-1])
    for _ in range(8):
        sim.perception.look(sim.data)
    # 0.1 s are five steps; the first five to come are from before.
    assert len(seen) == 8
    for k in range(3):
        np.testing.assert_allclose(seen[5 + k][:, :2], (scans[k].points)[:, :2], atol=0.05)
        assert len(seen[5 + k]) == len(scans[k].points)


def test_errors_are_those_of_the_seed(file):
    def heights(seed):
        sim = simulation(file, "lidar", "blocks", 0.8, seed, drift=0.02, missing=0.05, range_noise=1.0)
        for _ in range(5):
            sim.step(np.array([1.0, 0.0]))
        return sim.heights

    np.testing.assert_array_equal(heights(1), heights(1))
    assert np.abs(heights(1) - heights(2)).max() > 1e-4


def test_measured_cells_lie_on_the_true_ground(file):
    sim = simulation(file, "depth", "poles", 0.5)
    cells = sim.perception.measured(sim.data, 0.5)
    assert len(cells) > 500 and np.hypot(*(cells[:, :2] - sim.data.qpos[:2]).T).max() <= 0.5
    clear = inside(sim.terrain, cells[:, :2]) > 0.02
    true = terrains.exact_height(sim.terrain, cells[clear, :2])
    assert np.quantile(np.abs(cells[clear, 2] - true), 0.95) < 0.005


def test_a_wrong_heading_does_not_turn_what_the_robot_has_in_front(file):
    """What the estimate has 0.4 m ahead and 0.1 m below the trunk is there in the world too, wherever it has itself."""
    sim = simulation(file, "lidar")
    perception, ground = sim.perception, sim.perception.ground
    perception.pose.turned, perception.pose.position = 0.3, np.array([2.0, 1.0, 0.5])
    ground.reset(perception.pose.position, 0.0)
    point = perception.pose.position + [0.4 * np.cos(0.3), 0.4 * np.sin(0.3), -0.1]
    ground.fuse(point + [0.0, 0.0, 1.0], point[None], np.array([1e-4]))
    (cell,) = perception.measured(sim.data, 1.0)
    # The centre of a cell of 2 cm: up to 1.4 cm off.
    np.testing.assert_allclose(cell, sim.data.qpos[:3] + [0.4, 0.0, -0.1], atol=0.015)


# -- evaluation and benchmark ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["perception=sonar"], "unknown perception 'sonar'; choose one of map, lidar, depth"),
        (["perception=lidar"], "perception=lidar needs engine=mujoco; engine=mjx has no range sensors"),
        (["engine=mujoco", "drift=0.1"], "drift=0.1 needs perception=lidar or perception=depth"),
        (["missing=0.5"], "missing=0.5 needs perception=lidar or perception=depth"),
        (["engine=mujoco", "perception=depth", "drift=-1"], r"drift=-1.0 must be in \[0, 1\]"),
        (["engine=mujoco", "perception=depth", "latency=nan"], r"latency=nan must be in \[0, 1\]"),
        (["engine=mujoco", "perception=depth", "missing=1.5"], r"missing=1.5 must be in \[0, 1\]"),
        (["engine=mujoco", "perception=depth", "range_noise=99"], r"range_noise=99.0 must be in \[0, 20\]"),
    ],
)
def test_wrong_settings_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        evaluate.main(["policy=flat", "terrain=flat", *arguments])


def test_a_blind_policy_needs_no_sensors(tmp_path):
    path = trained("blind").export(tmp_path / "policy.npz")
    with pytest.raises(
        ValueError, match="perception=lidar is of no use to .* which is blind; choose perception=map"
    ):
        evaluate.main([f"policy={path}", "terrain=flat", "engine=mujoco", "perception=lidar"])
    with pytest.raises(ValueError, match="is blind"):
        benchmark.main([f"policy={path}"])


def test_evaluation_says_how_it_was_perceived(file, tmp_path):
    out = tmp_path / "result.json"
    evaluate.main(
        [
            f"policy={file}",
            "terrain=flat",
            "engine=mujoco",
            "episodes=1",
            "perception=depth",
            "drift=0.01",
            f"json={out}",
        ]
    )
    found = json.loads(out.read_text())["perception"]
    assert (found["kind"], found["drift"], found["missing"]) == ("depth", 0.01, PerceptionConfig.missing)


def test_the_noise_of_training_is_found_again():
    """Errors made as `QuadrupedEnv.sense` makes them, of many episodes, on ground with edges."""
    random = np.random.default_rng(0)
    terrain = terrains.make_terrain("poles", 0.5, 0)
    moves = np.stack(np.meshgrid(benchmark.SHIFTS, benchmark.SHIFTS, indexing="ij"), axis=-1).reshape(-1, 2)
    error, edge, shift = [], [], []
    for _ in range(200):
        points = random.uniform(-3, 3, 2) + random.uniform(-0.4, 0.4, (100, 2))
        offset = random.uniform(-1, 1, 3) * [0.03, 0.03, 0.02]
        true, seen = (terrains.exact_height(terrain, points + d) for d in (np.zeros(2), offset[:2]))
        seen = seen + offset[2] + 0.004 * random.standard_normal(100)
        moved = terrains.exact_height(terrain, points + moves[:, None])
        error.append(seen - true)
        edge.append(np.abs(moved - true).max(axis=0) > benchmark.OUTLIER)
        shift.append(benchmark.best_shift(seen, moved, moves))
    found = benchmark.fitted(benchmark.Errors(np.array(error), np.array(edge), np.array(shift)))
    assert found["height_noise"] == pytest.approx(0.004, rel=0.05)
    assert found["height_drift"] == pytest.approx(0.02, rel=0.1)
    assert found["map_drift"] == pytest.approx(0.03, rel=0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["sweep=dirt"], "unknown sweep 'dirt'.*choose one of all, none, drift"),
        (["walks=0"], "walks=0 must be at least 1"),
        (["picture=x.jpg"], "picture=x.jpg must end in .png"),
        (["sweep=none", "picture=x.png"], "sweep=none gives no curves"),
    ],
)
def test_wrong_settings_of_the_benchmark_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        benchmark.main(arguments)
