"""A robot that is led about: commands, time, pushes, newer policies, clips."""

import os
import shutil

import numpy as np
import pytest

import rewards
import tg
from tests.tlq.policies import trained
from tlq import insight, session
from tlq.render import RenderError
from tlq.senses import PerceptionConfig
from tlq.session import Session

# A gait that stays up for a second or two without a policy.
GAIT = {
    "env.tg.base_frequency": 1.6,
    "env.tg.step_length": 0.2,
    "env.tg.retraction": 0.0,
    "env.robot.foot_height": -0.28,
}
SMALL = {"policy.encoder": 8, "policy.head": 8, "policy.memory_width": 4, **GAIT}


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """A policy that leaves walking to the trajectory generator."""
    return trained(spread=0.0, **SMALL).export(tmp_path_factory.mktemp("policy") / "policy.npz")


@pytest.fixture(scope="module")
def other(tmp_path_factory):
    """Another policy of the same robot, with a larger memory."""
    settings = SMALL | {"policy.memory_width": 6}
    return trained(spread=0.0, **settings).export(tmp_path_factory.mktemp("other") / "policy.npz")


@pytest.fixture
def flat(file):
    return Session(str(file), "flat")


def run(session, steps):
    for _ in range(steps):
        session.step()


def newer(source, target):
    """Puts a copy of a file in the place of another, a second younger, whatever the clock's resolution."""
    shutil.copy(source, target)
    later = target.stat().st_mtime + 1
    os.utime(target, (later, later))


def test_it_walks_where_it_is_told_and_stands_when_told(flat):
    assert not flat.direction.any()
    flat.walk(np.pi / 2)
    run(flat, 60)
    x, y, _ = flat.sim.data.qpos[:3]
    assert y > 0.2 and y > abs(x)
    assert flat.distance == pytest.approx(y, abs=1e-6)
    assert flat.energy_per_metre == pytest.approx(flat.work / y)
    assert flat.time == pytest.approx(60 * 0.02)
    flat.stand()
    run(flat, 60)
    before = flat.sim.data.qpos[1]
    run(flat, 10)
    assert flat.sim.data.qpos[1] == pytest.approx(before, abs=0.02)


def test_time_passes_as_the_clock_does(flat):
    assert flat.advance(0.05) == 2  # 2.5 control periods of 20 ms
    assert flat.advance(0.01) == 1  # the half that was left, and another
    flat.speed = 0.25
    assert [flat.advance(0.04) for _ in range(4)] == [0, 1, 0, 1]
    flat.speed, flat.paused = 1.0, True
    assert flat.advance(1.0) == 0
    flat.paused = False
    # What came due in the pause is gone, and what can't be caught up is dropped: 0.1 s are 5 periods.
    assert flat.advance(0.0) == 0 and flat.advance(3.0) == 5


def test_a_step_while_paused_is_one_period(flat):
    flat.paused = True
    flat.step()
    assert flat.sim.data.time == pytest.approx(0.02)


def test_a_push_changes_the_velocity(flat):
    flat.push(np.pi / 2, 0.5)
    np.testing.assert_allclose(flat.sim.data.qvel[:3], [0, 0.5, 0], atol=1e-12)
    with pytest.raises(ValueError, match=r"push of 9 m/s must be in \[0, 3.0\]"):
        flat.push(0.0, 9)


def test_it_starts_anew_after_a_fall_and_at_the_edge(flat):
    flat.walk(0.0)
    run(flat, 5)
    flat.sim.data.qpos[3:7] = [0, 1, 0, 0]  # on its back
    flat.step()
    assert flat.falls == 1 and flat.time == 0 and "fell after" in flat.news
    assert flat.direction[0] == 1 and abs(flat.sim.data.qpos[0]) < 0.1
    flat.sim.data.qpos[1] = -flat.sim.terrain.half_extent
    flat.step()
    assert flat.falls == 1 and "edge of the map" in flat.news and abs(flat.sim.data.qpos[1]) < 0.1


def test_another_terrain_is_built_and_a_wrong_one_changes_nothing(flat):
    flat.build("blocks", 0.5, 3)
    terrain = flat.sim.terrain
    assert (terrain.kind, terrain.difficulty, terrain.seed) == ("blocks", 0.5, 10_003)
    for arguments, message in (
        (("pole", 0.5, 0), "unknown terrain 'pole'"),
        (("poles", 2.0, 0), "unknown difficulty 2.0"),
        (("poles", 0.5, -1), "seed=-1 must be 0 or more"),
    ):
        with pytest.raises(ValueError, match=message):
            flat.build(*arguments)
    assert flat.sim.terrain is terrain and flat.kind == "blocks"
    flat.step()


def test_another_policy_goes_on_where_the_first_was(flat, file, other):
    flat.walk(0.0)
    run(flat, 20)
    state, qpos = flat.sim.controller.state, flat.sim.data.qpos.copy()
    flat.load(str(other))
    assert flat.sim.controller.memory.shape == (2 * 6,) and flat.path == other
    assert flat.sim.controller.state is state
    np.testing.assert_array_equal(flat.sim.data.qpos, qpos)
    run(flat, 60)
    assert flat.sim.data.qpos[0] > qpos[0] and flat.falls == 0
    with pytest.raises(ValueError, match="policy=nobody: no such policy"):
        flat.load("nobody")
    assert flat.path == other


def test_a_policy_of_another_robot_starts_anew(flat, tmp_path):
    foreign = trained(spread=0.0, **SMALL, **{"env.robot.name": "go1_size"}).export(tmp_path / "policy.npz")
    flat.record()
    with pytest.raises(ValueError, match="a clip is being recorded"):
        flat.load(str(foreign))
    flat.take_clip()
    run(flat, 5)
    flat.load(str(foreign))
    assert flat.sim.config.robot.name == "go1_size" and flat.time == 0
    flat.step()


def test_a_newer_file_is_taken_over_and_a_damaged_one_named_once(file, other, tmp_path):
    path = tmp_path / "policy.npz"
    shutil.copy(file, path)
    session = Session(str(path), "flat")
    assert not session.refresh()
    newer(other, path)
    assert session.refresh() and session.sim.controller.memory.shape == (2 * 6,)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(ValueError, match="policy.npz: damaged"):
        session.refresh()
    assert not session.refresh()
    session.step()
    path.unlink()
    assert not session.refresh()
    newer(file, path)
    assert session.refresh() and session.sim.controller.memory.shape == (2 * 4,)


def test_a_clip_is_what_happened(flat, tmp_path):
    flat.walk(0.0)
    flat.record()
    assert flat.recorded == 0.0
    with pytest.raises(ValueError, match="a clip is being recorded; save it first"):
        flat.build("poles", 0.1, 0)
    run(flat, 3)
    flat.stand()
    flat.step()
    assert flat.recorded == pytest.approx(0.08)
    clip = flat.take_clip()
    assert clip.qpos.shape == (5, 19)
    np.testing.assert_array_equal(clip.qpos[-1], flat.sim.data.qpos)
    np.testing.assert_array_equal(clip.command, [[1, 0], [1, 0], [1, 0], [1, 0], [0, 0]])
    with pytest.raises(ValueError, match="nothing is being recorded"):
        flat.take_clip()
    with pytest.raises(ValueError, match="must end in .mp4"):
        session.clip_path(tmp_path / "clip.avi")
    with pytest.raises(ValueError, match="there is no folder /no/where"):
        session.clip_path("/no/where/clip.mp4")


def test_a_clip_is_not_endless(flat, monkeypatch):
    monkeypatch.setattr(session, "LONGEST_CLIP", 0.1)
    flat.record()
    run(flat, 9)
    assert flat.recorded == pytest.approx(0.1)


def test_a_clip_is_written(flat, tmp_path):
    flat.record()
    run(flat, 4)
    try:
        written = flat.take_clip().write(tmp_path / "clip.mp4")
    except RenderError as error:  # no OpenGL here
        pytest.skip(str(error))
    assert written.stat().st_size > 1000


# -- range sensors


def test_heights_from_other_sensors(flat, tmp_path):
    flat.walk(0.0)
    run(flat, 5)
    true = flat.sim.heights
    assert len(insight.measured_cells(flat.sim, 1.0)) == 0
    flat.record()
    with pytest.raises(ValueError, match="a clip is being recorded"):
        flat.sense(PerceptionConfig())
    flat.take_clip()
    flat.sense(PerceptionConfig(kind="depth", drift=0.0))
    assert flat.time == 0 and flat.news == "heights from depth" and flat.direction[0] == 1
    run(flat, 5)
    assert 0 < np.abs(flat.sim.heights - true).max() < 0.03
    # The ground is flat: the map has it at 0, and so have the points that are drawn.
    cells, points = insight.measured_cells(flat.sim, 0.5), insight.sample_points(flat.sim)
    assert len(cells) > 500 and abs(np.median(cells[:, 2])) < 0.005 and np.abs(points[..., 2]).max() < 0.03
    with pytest.raises(ValueError, match=r"missing=2 must be in \[0, 1\]"):
        flat.sense(PerceptionConfig(missing=2))
    flat.build("blocks", 0.2, 0)
    assert flat.sim.perception.config.kind == "depth"
    flat.sense(None)
    assert flat.sim.perception is None


def test_a_blind_policy_takes_no_sensors(flat, tmp_path):
    blind = trained("blind", spread=0.0, **SMALL).export(tmp_path / "policy.npz")
    message = "perception=lidar is of no use to policy=.*policy.npz, which is blind; choose perception=map"
    with pytest.raises(ValueError, match=message):
        Session(str(blind), "flat", perception=PerceptionConfig())
    flat.sense(PerceptionConfig())
    with pytest.raises(ValueError, match=message):
        flat.load(str(blind))
    flat.sense(None)
    flat.load(str(blind))
    with pytest.raises(ValueError, match=message):
        flat.sense(PerceptionConfig())
    assert flat.sim.perception is None and flat.path == blind


# -- what is shown


def test_feet_are_where_the_model_has_them(flat):
    flat.walk(1.0)
    run(flat, 30)
    sim = flat.sim
    found = insight.feet(sim)
    # The site or geom of a foot: the simulation's kinematics is one substep behind its state.
    import mujoco

    mujoco.mj_kinematics(sim.model, sim.data)
    np.testing.assert_allclose(found, sim.data.geom_xpos[sim.robot.foot_geom_ids], atol=1e-5)
    # Gains are finite, so feet aren't quite where they are wanted.
    error = np.linalg.norm(insight.desired_feet(sim) - found, axis=1)
    assert 1e-4 < error.min() and error.max() < 0.1


def test_points_and_paths_are_at_the_feet(flat):
    flat.walk(0.0)
    run(flat, 30)
    feet, points, paths = (
        insight.feet(flat.sim),
        insight.sample_points(flat.sim),
        insight.foot_paths(flat.sim),
    )
    assert points.shape == (4, 25, 3) and paths.shape == (4, 24, 3)
    stance = tg.path.leg_phases(flat.sim.controller.state.phase) <= 0
    np.testing.assert_allclose(points[stance, 0, :2], feet[stance, :2], atol=1e-6)
    # Feet in swing will land in front of where they are, along the command.
    ahead = (points[~stance, 0, :2] - feet[~stance, :2])[:, 0]
    assert stance.sum() == 2 and (ahead > 0).all() and (ahead < 0.4).all()
    np.testing.assert_allclose(points[..., 2], 0.0, atol=1e-6)
    np.testing.assert_allclose(paths[:, 0], paths[:, -1], atol=1e-6)  # closed
    # As wide as the stride, along the command; as high as the foot is lifted.
    core = flat.sim.controller.core
    span = np.ptp(paths, axis=1)
    np.testing.assert_allclose(span[:, 0], core.config.step_length, atol=0.01)
    np.testing.assert_allclose(span[:, 2], flat.sim.controller.state.lift, atol=0.01)
    assert np.abs(flat.lift_change).max() < 1e-3 and abs(flat.frequency_change) < 5e-3


def test_reward_terms_are_those_of_training(flat):
    config = flat.sim.config.rewards
    flat.step()
    assert set(flat.terms) == {*"along across smooth energy terrain height yaw heading tilt".split(), "total"}
    # Standing: r_v is 1 at rest, and gaps there are none.
    assert flat.terms["along"] == pytest.approx(config.along, rel=0.1)
    assert flat.terms["terrain"] == flat.terms["height"] == 0
    flat.walk(0.0)
    run(flat, 50)
    speed = flat.sim.data.qvel[:2] @ flat.direction
    expected = config.along * float(rewards.along(speed, config.speed_low, config.speed_high))
    assert flat.terms["along"] == pytest.approx(expected, rel=1e-5)
    others = sum(value for name, value in flat.terms.items() if name != "total")
    assert flat.terms["total"] == pytest.approx(others, rel=1e-5)


def test_a_gap_below_a_standing_foot_costs(flat):
    """The share of low points: 3 of the 7 within 3 cm of one foot of four."""
    config = flat.sim.config.rewards
    moment = flat.sim.moment()
    below = moment.feet[:, None] - moment.ground
    below[2, :3] += config.gap_threshold + 0.01
    step = rewards.Step(
        velocity=np.zeros(2),
        angular_velocity=np.zeros(3),
        command=np.zeros(2),
        desired=np.zeros(12),
        previous=np.zeros(12),
        energy=0.0,
        swing=np.zeros(4, bool),
        near=below[:, :7],
        highest=below.min(axis=1),
        lift=np.zeros(4),
        rise=np.zeros(4),
        drift=0.0,
    )
    terms = insight.weighted_terms(config, step)
    assert float(terms["terrain"]) == pytest.approx(-config.terrain * 3 / 7 / 4)
