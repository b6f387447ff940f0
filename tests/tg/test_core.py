"""The controller core: what it does with the phase, what it shows, and its symmetries."""

import dataclasses
import itertools
import math

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import tg
from tests.tg.mirror import SWAP, mirror_joints, mirror_sensors, mirror_state
from tests.tg.robots import SUBJECTS
from tg.core import load_share

LEFT = np.array([math.cos(0.7), math.sin(0.7)])
"""A command to the front left."""
STAND = np.zeros(2)


def random_sensors(core, seed, dtype=np.float64):
    rng = np.random.default_rng(seed)
    quaternion = np.array([1.0, 0, 0, 0]) + rng.normal(0, 0.15, 4)
    sensors = tg.Sensors(
        quaternion / np.linalg.norm(quaternion),
        rng.normal(0, 1, 3),
        core.default_pose + rng.normal(0, 0.2, 12),
        rng.normal(0, 3, 12),
    )
    return tg.Sensors(*(np.asarray(part, dtype) for part in sensors))


def level_sensors(core, dtype=np.float64):
    """A level robot in its default pose, at rest."""
    parts = [1, 0, 0, 0], np.zeros(3), core.default_pose, np.zeros(12)
    return tg.Sensors(*(np.asarray(part, dtype) for part in parts))


def walk(core, steps, command=LEFT, seed=0, state=None, action=None):
    """States and desired angles of so many steps with random actions, or always the same one."""
    rng = np.random.default_rng(seed)
    state = core.initial_state(np.asarray(0.5 * np.pi)) if state is None else state
    found = []
    for _ in range(steps):
        given = rng.uniform(-1.2, 1.2, 14) if action is None else action
        sensors = level_sensors(core) if action is not None else random_sensors(core, rng.integers(1000))
        state, desired = core.act(state, given, sensors, command)
        found.append((state, desired))
    return found


def test_legs_in_stance_are_damped_more_and_those_in_swing_are_not(subject):
    core = subject.make(np.float64, stance_damping=3.0)
    walking = core.initial_state(np.asarray(0.0))._replace(gate=np.asarray(1.0))

    def factor(phase, gate=1.0, of=core):
        state = walking._replace(phase=np.asarray(phase), gate=np.asarray(gate))
        return of.damping(state)

    first, second = [0, 1, 2, 9, 10, 11], [3, 4, 5, 6, 7, 8]
    for phase, up, down in ((0.5 * np.pi, first, second), (-0.5 * np.pi, second, first)):
        found = factor(phase)
        np.testing.assert_allclose(found[up], 1.0)
        np.testing.assert_allclose(found[down], 3.0)
        np.testing.assert_allclose(factor(phase, gate=0.0), 3.0)
        np.testing.assert_array_equal(factor(phase, of=subject.make(np.float64, stance_damping=1.0)), 1.0)
    np.testing.assert_allclose(factor(0.0), 3.0)
    cycle = np.array([factor(p) for p in tg.path.wrap(np.linspace(0, 2 * np.pi, 2001))])
    assert cycle.min() >= 1.0 and cycle.max() <= 3.0
    assert np.abs(np.diff(cycle, axis=0)).max() < 0.03


def test_more_damping_in_stance_brakes_no_joint_that_moves_as_the_gait_does(subject):
    """kp (desired - q) - damping q' is the same with it as without for a leg on its way in stance."""
    core, plain = (subject.make(np.float64, stance_damping=x) for x in (3.0, 1.0))
    state = core.initial_state(np.asarray(-1.8))._replace(gate=np.asarray(1.0), stride=LEFT)
    sensors = random_sensors(core, 3)
    after, desired = core.act(state, np.zeros(14), sensors, LEFT)
    _, before = plain.act(state, np.zeros(14), sensors, LEFT)

    def angles(time):
        phase = after.phase + 2 * np.pi * core.config.base_frequency * time
        targets = core.foot_targets(core.phases(phase), after.lift, LEFT, sensors, gate=after.gate)
        return tg.leg.inverse(core.geometry, targets).reshape(12)

    speed = (angles(core.dt) - angles(0.0)) / core.dt
    kp, kd = subject.config.kp, subject.config.kd
    stance = core.damping(after) == 3.0
    assert stance.sum() == 6 and np.abs(speed[stance]).max() > 0.5
    np.testing.assert_allclose(
        (kp * desired - 3 * kd * speed)[stance], (kp * before - kd * speed)[stance], rtol=1e-6
    )
    np.testing.assert_allclose(desired[~stance], before[~stance])
    # Told to stand, the feet stay where they came down: there is nothing to make up for.
    for of in (core, plain):
        standing = after
        for _ in range(30):
            standing, angles_now = of.act(standing, np.zeros(14), sensors, STAND)
        desired, before = angles_now, desired
    np.testing.assert_allclose(desired, before)


# Phase and gait -----------------------------------------------------------------------------------------------


def test_action_sets_frequency_and_lift_within_their_bounds(subject):
    core = subject.core
    c = core.config
    state = core.initial_state(np.asarray(0.5 * np.pi))
    action = np.zeros(14)
    for given, share in [(1.0, 1.0), (-0.5, -0.5), (3.0, 1.0)]:  # beyond ±1 is cut off
        action[:2] = given
        after, _ = core.act(state, action, level_sensors(core), LEFT)
        frequency = c.base_frequency + share * c.frequency_range
        assert after.frequency == pytest.approx(frequency)
        assert after.phase == pytest.approx(0.5 * np.pi + 2 * np.pi * frequency * core.dt)
        lift = min(max(c.lift + share * c.lift_range, c.lift_min), c.lift_max)
        # At π/2 LF and RR are in the air: theirs stays until they have landed.
        np.testing.assert_allclose(after.lift, [c.lift, lift, lift, c.lift])


def test_lift_is_held_from_lift_off_to_touch_down(subject):
    before = subject.core.initial_state(np.asarray(0.5 * np.pi))
    for state, _ in walk(subject.core, 200):
        swing = tg.path.leg_phases(state.phase) > 0
        np.testing.assert_array_equal(state.lift[swing], before.lift[swing])
        assert (state.lift[~swing] == state.lift[~swing][0]).all()
        before = state


@pytest.mark.parametrize("steps", range(38, 52))  # more than half a cycle: from any phase
def test_told_to_stand_it_finishes_its_step_and_stays(subject, steps):
    core, still = subject.core, np.zeros(14)
    walking = walk(core, steps, action=still)[-1][0]
    standing = walk(core, 40, command=STAND, state=walking, action=still)
    moving = [core.stepping(state, STAND) for state, _ in standing]
    # No longer than half a cycle, and without a pause in between.
    assert sum(moving) * core.dt < 0.5 / core.config.base_frequency + 1e-9
    assert moving == sorted(moving, reverse=True)
    for (before, _), (after, _) in itertools.pairwise([(walking, None), *standing]):
        if core.stepping(before, STAND):
            swing, phase = tg.path.leg_phases(before.phase) > 0, tg.path.leg_phases(after.phase)
            step = 2 * np.pi * core.config.base_frequency * core.dt
            ahead = np.minimum(tg.path.leg_phases(before.phase)[swing] + step, np.pi)
            np.testing.assert_allclose(np.abs(phase[swing]), ahead)
    last, _ = standing[-1]
    assert last.gate == 0.0 and not (tg.path.leg_phases(last.phase) > 0).any()
    # All feet are down, where their step led them: the ones that came down last in front.
    landed = np.array([1, -1, -1, 1]) * (1 if last.phase == -np.pi else -1)
    along = 0.5 * core.config.step_length * landed
    expected = core.base_foot + along[:, None] * np.array([*walking.stride, 0.0])
    np.testing.assert_allclose(last.targets[0].reshape(4, 3), expected, atol=1e-9)
    # And it goes on where it stopped, slowly at first.
    rest, full = np.abs(last.stride).max(), 2 * np.pi * core.config.base_frequency * core.dt
    before = last
    for k, (state, _) in enumerate(walk(core, 12, state=last, action=still)):
        share = min(1.0, 1.0 - rest + 0.1 * (k + 1))
        assert state.phase == pytest.approx(tg.path.wrap(before.phase + share * full))
        np.testing.assert_allclose(state.stride, last.stride)
        before = state


@pytest.mark.parametrize(("gait", "share"), [("trot", 0.4), ("walk", 0.24), ("walk", 0.15)])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_other_gaits_finish_their_step_with_all_feet_down(subject, gait, share, dtype):
    core = subject.make(dtype, gait=gait, swing_share=share)
    still, cycle = np.zeros(14, dtype), round(1.0 / core.config.base_frequency / core.dt)
    for steps in range(30, 30 + cycle):
        walking = walk(core, steps, action=still)[-1][0]
        standing = [state for state, _ in walk(core, 60, command=STAND, state=walking, action=still)]
        moving = [core.stepping(state, STAND) for state in standing]
        assert moving == sorted(moving, reverse=True) and not moving[-1]
        assert sum(moving) * core.dt < share / core.config.base_frequency + 1e-6
        assert standing[-1].gate == 0.0 and not (core.phases(standing[-1].phase) > 0).any()
        # One that has all feet down stays where it is at once.
        if not (core.phases(walking.phase) > 0).any():
            assert standing[-1].phase == walking.phase


def test_speed_of_feet_in_stance(subject):
    """The desired feet's, of a robot led ahead, against the difference of two targets."""
    core = subject.make(np.float64, gait="walk", swing_share=0.2)
    before, after = (
        state for state, _ in walk(core, 60, command=np.array([1.0, 0.0]), action=np.zeros(14))[-2:]
    )
    stance = (core.phases(before.phase) < 0) & (core.phases(after.phase) < 0)
    feet = (after.targets[0] - after.targets[1]).reshape(4, 3)[stance] / core.dt
    assert stance.sum() >= 3
    np.testing.assert_allclose(feet[:, 0], -core.stance_speed(after.frequency), rtol=1e-6)


def test_one_told_to_stand_before_it_has_moved_stays(subject):
    core = subject.core
    start = core.initial_state(np.asarray(0.5 * np.pi))
    assert not core.stepping(start, STAND)
    for state, desired in walk(core, 10, command=STAND, state=start, action=np.zeros(14)):
        assert state.phase == start.phase and state.gate == 0.0
        np.testing.assert_allclose(desired, core.standing_target, atol=1e-6)


@pytest.mark.parametrize("library", [np, jnp])
@pytest.mark.parametrize("phase", [0.0, -math.pi])
def test_the_phase_at_rest_is_stance_for_all_feet_in_single_precision(library, phase):
    phases = tg.path.leg_phases(library.asarray(phase, dtype=library.float32))
    assert phases.dtype == np.float32 and not (phases > 0).any()


def test_without_finish_step_a_command_to_stand_freezes_the_phase(subject):
    core = subject.make(np.float64, finish_step=False)
    walking = walk(core, 40, action=np.zeros(14))[-1][0]
    standing = walk(core, 40, command=STAND, state=walking, action=np.zeros(14))
    assert all(state.phase == walking.phase for state, _ in standing)
    last, desired = standing[-1]
    assert last.gate == 0.0 and not last.stride.any()
    np.testing.assert_allclose(last.targets[0], core.base_foot.reshape(-1), atol=1e-9)
    np.testing.assert_allclose(desired, core.standing_target, atol=1e-6)
    # And it goes on where it stopped.
    again = walk(core, 1, state=last, action=np.zeros(14))[0][0]
    advance = 2 * np.pi * core.config.base_frequency * core.dt
    assert again.phase == pytest.approx(tg.path.wrap(walking.phase + advance))


def test_motion_fades_in_over_the_start_time(subject):
    core = subject.core
    states = [state for state, _ in walk(core, 20, command=np.array([1.0, 0]), action=np.zeros(14))]
    steps = round(core.config.start_time / core.dt)
    expected = np.minimum(np.arange(1, 21) / steps, 1.0)
    np.testing.assert_allclose([state.gate for state in states], expected)
    np.testing.assert_allclose([state.stride[0] for state in states], expected)


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_feet_follow_the_path_in_the_horizontal_frame(subject, tilt):
    """LF in mid-swing is H above its base, RF in mid-stance is at it; a quarter later they are ±L/4·... apart."""
    core = subject.make(np.float64, levelling=1.0)
    quaternion = np.array([math.cos(tilt / 2), math.sin(tilt / 2) * 0.6, math.sin(tilt / 2) * 0.8, 0])
    sensors = level_sensors(core)._replace(orientation=quaternion)
    lift, length = np.full(4, 0.08), core.config.step_length
    level = tg.frames.heading_from_trunk(tg.frames.up_in_trunk(quaternion))
    for phase, rise, along, back in [
        (np.pi / 2, 0.08, 0.0, 0.0),
        (np.pi / 4, 0.04, -0.4375, 0.25),  # 2 S(1/4) - 1/4 - ½ with S(1/4) = 3/16 - 2/64; in stance 3/4 - ½
        (3 * np.pi / 4, 0.04, 0.4375, -0.25),
    ]:
        phases = tg.path.leg_phases(np.asarray(phase))
        targets = core.foot_targets(phases, lift, LEFT, sensors) @ level.T - core.base_foot
        for leg, up, forward in [(0, rise, along), (3, rise, along), (1, 0.0, back), (2, 0.0, back)]:
            expected = [*(length * forward * LEFT), up]
            np.testing.assert_allclose(targets[leg], expected, atol=1e-9)


def test_levelling_scales_how_much_of_the_tilt_is_taken_out(subject):
    quaternion = np.array([math.cos(0.1), 0, math.sin(0.1), 0])
    phases, none = tg.path.leg_phases(np.asarray(0.5 * np.pi)), np.zeros(4)
    targets = {}
    for share in (0.0, 0.5, 1.0):
        core = subject.make(np.float64, levelling=share)
        sensors = level_sensors(core)._replace(orientation=quaternion)
        targets[share] = core.foot_targets(phases, none, STAND, sensors)
    np.testing.assert_allclose(targets[0.0], core.base_foot)
    np.testing.assert_allclose(targets[0.5], (targets[0.0] + targets[1.0]) / 2)


def test_a_lead_takes_feet_ahead_on_their_way_and_not_in_their_height(subject):
    core, plain = (subject.make(np.float64, lead=lead) for lead in (0.03, 0.0))
    early, lift, sensors = (
        2 * np.pi * core.config.base_frequency * 0.03,
        np.full(4, 0.08),
        level_sensors(core),
    )
    for phase in (0.4, 1.9, 3.1, -0.2, -2.0):
        now, then = (tg.path.leg_phases(np.asarray(p)) for p in (phase, phase + early))
        targets = core.foot_targets(now, lift, LEFT, sensors)
        np.testing.assert_allclose(
            targets[:, :2], plain.foot_targets(then, lift, LEFT, sensors)[:, :2], atol=1e-9
        )
        np.testing.assert_allclose(
            targets[:, 2], plain.foot_targets(now, lift, LEFT, sensors)[:, 2], atol=1e-9
        )


def test_a_patch_shifts_feet_in_swing_where_it_should_and_no_others(subject):
    """Where the two desired poses put the feet, by forward kinematics, with and without the patch."""
    core, plain = (
        subject.make(np.float64, refine=reach, follow=False, weight_compensation=0.0)
        for reach in (0.015, 0.0)
    )
    sensors = level_sensors(core)
    level = tg.frames.heading_from_trunk(tg.frames.up_in_trunk(sensors.orientation))
    rng = np.random.default_rng(0)
    patch = np.where(rng.random((4, tg.footholds.COUNT)) < 0.4, -0.9, -0.3)
    most_moved = 0.0
    for state, *_ in walk(plain, 40)[20:]:
        action = rng.uniform(-0.4, 0.4, 14)
        after, desired = core.act(state, action, sensors, LEFT, patch)
        before, _ = plain.act(state, action, sensors, LEFT)
        led = plain.residual_displacement(before, sensors)[:, :2]
        share = after.gate * tg.footholds.share(core.phases(after.phase))
        expected = share[:, None] * tg.footholds.shift(led, patch, 0.015)
        moved = (after.targets[0] - before.targets[0]).reshape(4, 3) @ level.T
        np.testing.assert_allclose(moved[:, :2], expected, atol=1.5e-3)
        most_moved = max(most_moved, np.abs(expected).max())
        assert (moved[core.phases(after.phase) <= 0] == 0).all()
        np.testing.assert_array_equal(after.actions, before.actions)
        # No residual angle goes beyond its range.
        most = np.concatenate([action[:2], np.ones(12)])
        none = np.concatenate([action[:2], np.zeros(12)])
        change = core.act(state, most, sensors, LEFT, patch)[1] - plain.act(state, none, sensors, LEFT)[1]
        assert np.abs(change).max() <= core.config.residual_range + 1e-9
    assert most_moved > 0.005


def test_a_patch_is_wanted_round_the_same_places(subject):
    core, plain = (subject.make(np.float64, refine=reach, follow=False) for reach in (0.015, 0.0))
    state, sensors = walk(plain, 13)[-1][0], random_sensors(core, 3)
    points = core.sample_points(state, sensors)
    assert points.shape == (4, core.points, 2) and core.points == 146 and plain.points == 25
    np.testing.assert_array_equal(points[:, :25], plain.sample_points(state, sensors))
    centres = core.centres(state, sensors)
    np.testing.assert_allclose(points[:, 25:], centres[:, None] + np.array(tg.footholds.offsets()))


@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_feet_come_down_where_the_feet_in_stance_are_whatever_the_trunk_does(subject, tilt):
    """A trunk 2 cm too low, and tilted: at the end of the step LF and RR are led to the height of the other feet."""
    core, plain = (subject.make(np.float64, touch_down=share) for share in (1.0, 0.0))
    quaternion = np.array([math.cos(tilt / 2), 0.6 * math.sin(tilt / 2), 0.8 * math.sin(tilt / 2), 0])
    level = tg.frames.heading_from_trunk(tg.frames.up_in_trunk(quaternion))
    hips = core.geometry.hip_position
    # All feet on one level plane 26 cm below the trunk's centre for its 28 cm.
    down = (hips + core.base_foot @ level) @ level.T
    down[:, 2] = core.base_foot[:, 2] + 0.02
    angles = tg.leg.inverse(core.geometry, down @ level - hips).reshape(12)
    sensors = level_sensors(core)._replace(orientation=quaternion, joint_position=angles)

    def heights(of, phase, gate=1.0):
        found = of.foot_targets(
            tg.path.leg_phases(np.asarray(phase)), np.zeros(4), STAND, sensors, gate=np.asarray(gate)
        )
        return ((hips + found) @ level.T)[:, 2]

    np.testing.assert_allclose(heights(core, np.pi - 1e-9)[[0, 3]], down[[0, 3], 2], atol=1e-6)
    # After the first third of stance the legs are as without, and push the trunk back.
    np.testing.assert_allclose(heights(core, 0.4 * np.pi)[[1, 2]], heights(plain, 0.4 * np.pi)[[1, 2]])
    np.testing.assert_allclose(heights(core, 0.7 * np.pi, gate=0.0), heights(plain, 0.7 * np.pi))
    cycle = np.array([heights(core, p) for p in tg.path.wrap(np.linspace(0, 2 * np.pi, 2001))])
    assert np.abs(np.diff(cycle, axis=0)).max() < 3e-4


def test_residuals_add_to_the_angles_and_limits_hold(subject):
    core = subject.make(np.float64, weight_compensation=0.0)
    state, sensors = core.initial_state(np.asarray(0.5 * np.pi)), level_sensors(core)
    _, plain = core.act(state, np.zeros(14), sensors, STAND)
    residual = np.linspace(-1, 1, 12)
    after, desired = core.act(state, np.concatenate([np.zeros(2), residual]), sensors, STAND)
    np.testing.assert_allclose(desired - plain, core.config.residual_range * residual, atol=1e-12)
    # The history of targets shows where the feet were really sent.
    reached = tg.leg.forward(core.geometry, desired.reshape(4, 3))
    np.testing.assert_allclose(after.targets[0].reshape(4, 3), reached, atol=1e-9)
    for _, desired in walk(subject.make(np.float64, residual_range=5.0), 20):
        assert (desired >= core.lower).all() and (desired <= core.upper).all()


def test_load_is_shared_by_the_legs_in_stance():
    quarter = np.full(4, 0.25)
    np.testing.assert_allclose(load_share(tg.path.leg_phases(np.asarray(1.0)), np.asarray(0.0)), quarter)
    swinging = load_share(tg.path.leg_phases(np.asarray(0.5 * np.pi)), np.asarray(1.0))
    np.testing.assert_allclose(swinging, [0, 0.5, 0.5, 0])
    for phase in np.linspace(-np.pi, np.pi, 50):
        share = load_share(tg.path.leg_phases(np.asarray(phase)), np.asarray(1.0))
        assert share.sum() == pytest.approx(1.0) and (share >= 0).all()
    jump = [load_share(tg.path.leg_phases(np.asarray(p)), np.asarray(1.0)) for p in (-1e-6, 1e-6)]
    np.testing.assert_allclose(*jump, atol=1e-5)


def test_histories_are_newest_first(subject):
    core = subject.core
    (first, desired), (second, _) = walk(core, 2)
    np.testing.assert_array_equal(second.actions[1], first.actions[0])
    np.testing.assert_array_equal(second.targets[1], first.targets[0])
    np.testing.assert_array_equal(first.desired, desired)
    # The oldest entries came from the start: no action, feet at their base.
    np.testing.assert_array_equal(first.actions[1], 0.0)
    np.testing.assert_allclose(first.targets[1], core.base_foot.reshape(-1))


def test_fixed_height_moves_the_feet_up_and_down_only(subject):
    core = subject.make(np.float64, method="fixed_height")
    for action in (np.zeros(14), np.array([0, 1.0, *np.zeros(12)])):
        for state, _ in walk(core, 60, action=action):
            moved = state.targets[0].reshape(4, 3) - core.base_foot
            np.testing.assert_allclose(moved[:, :2], 0.0, atol=1e-9)
            np.testing.assert_allclose(state.lift, core.config.lift)
            up = state.gate * core.config.lift * tg.path.height(tg.path.leg_phases(state.phase))
            np.testing.assert_allclose(moved[:, 2], up, atol=1e-9)
    faster, _ = core.act(state, np.array([1.0, *np.zeros(13)]), level_sensors(core), LEFT)
    assert faster.frequency > core.config.base_frequency  # this the policy may still choose


# Observation --------------------------------------------------------------------------------------------------


def parts(core, observation):
    """The observation's parts by name."""
    ends = np.cumsum([size for _, size in core.layout])
    return {name: observation[end - size : end] for (name, size), end in zip(core.layout, ends, strict=True)}


def test_feet_are_mujocos(subject):
    """Feet in the heading frame, from the trunk's centre: sites turned by the trunk's rotation less its yaw."""
    sensors = random_sensors(subject.core, 3)
    data = subject.place(sensors.joint_position, sensors.orientation)
    yaw = tg.frames.yaw(sensors.orientation)
    world = data.site_xpos[subject.robot.foot_site_ids] - data.qpos[:3]
    expected = np.concatenate([tg.frames.turn(-yaw, world[:, :2]), world[:, 2:]], axis=-1)
    np.testing.assert_allclose(subject.core.feet(sensors), expected, atol=1e-7)


@pytest.mark.parametrize(("outer", "third"), [(0.10, 0.06), (0.24, 0.12)])
def test_points_lie_on_circles(subject, outer, third):
    settings = dataclasses.replace(subject.core.config, sample_radius=outer)
    core = dataclasses.replace(subject.core, config=settings)
    feet = core.feet(random_sensors(core, 3))
    points = core.around(feet)
    assert points.shape == (4, 25, 2)
    distance = np.linalg.norm(points - feet[:, None, :2], axis=-1)
    radii = np.repeat([0.0, 0.03, third, outer], [1, 6, 8, 10])
    np.testing.assert_allclose(np.sort(distance, axis=1), np.tile(radii, (4, 1)), atol=1e-7)


def test_heights_are_wanted_where_steps_end(subject):
    """Of feet early in stance, of a robot that stands, and without look-ahead: round the feet."""
    core, sensors = subject.core, random_sensors(subject.core, 3)
    core = dataclasses.replace(core, config=dataclasses.replace(core.config, follow=False))
    feet, state = core.feet(sensors)[:, :2], walk(core, 20)[-1][0]
    phases = tg.path.leg_phases(state.phase)
    swing = phases > core.config.look_ahead_from
    assert swing.sum() == 2 and state.gate == 1
    ends = core.step_ends(state, sensors, core.odometry(state, sensors))
    expected = np.where(swing[:, None], ends, feet)
    assert np.abs(ends - feet)[swing].max() > 0.02
    np.testing.assert_allclose(core.sample_points(state, sensors), core.around(expected))
    np.testing.assert_allclose(core.centres(state._replace(gate=0.0 * state.gate), sensors), feet)
    followed = dataclasses.replace(core, config=dataclasses.replace(core.config, follow=True))
    moved = core.residual_displacement(state, sensors)[:, :2]
    assert np.abs(moved)[swing].max() > 0.01
    expected = np.where(swing[:, None], ends + moved, feet)
    np.testing.assert_allclose(followed.sample_points(state, sensors), core.around(expected))
    late = float(phases[~swing].max())
    early = dataclasses.replace(core, config=dataclasses.replace(core.config, look_ahead_from=late - 0.01))
    np.testing.assert_allclose(early.sample_points(state, sensors), core.around(ends))
    behind = dataclasses.replace(core, config=dataclasses.replace(core.config, look_ahead=False))
    np.testing.assert_allclose(behind.sample_points(state, sensors), core.around(feet))


@pytest.mark.parametrize("share", [0.5, 0.3])
@pytest.mark.parametrize("phase", [-2.5, -0.4, 0.7, 2.9])
def test_time_left_until_feet_come_down(subject, share, phase):
    """By letting the gait run on in steps of a tenth of a millisecond."""
    core = dataclasses.replace(
        subject.core, config=dataclasses.replace(subject.core.config, swing_share=share)
    )
    state = core.initial_state(np.array(phase))
    times = 1e-4 * np.arange(10_000)
    swing = core.phases(tg.path.wrap(phase + 2 * np.pi * float(state.frequency) * times)) > 0
    landed = swing[:-1] & ~swing[1:]
    np.testing.assert_allclose(core._time_left(state, np), times[1:][landed.argmax(axis=0)], atol=2e-4)


def test_feet_land_where_the_generator_leads_them(subject):
    """Joints that follow at once, a trunk that doesn't move: at the end of the step, but for what comes down early."""
    core = subject.core
    level = random_sensors(core, 3)._replace(orientation=np.array([1.0, 0, 0, 0]))
    state = walk(core, 20)[-1][0]
    reached = state.targets[0].reshape(4, 3)
    sensors = level._replace(joint_position=tg.leg.inverse(core.geometry, reached).reshape(-1))
    found = core.landing_points(state, sensors, np.zeros(2))
    ends = core.foot_targets(np.full(4, np.pi), 0.0 * state.lift, state.stride, sensors)
    moved = core.residual_displacement(state, sensors)
    expected = (core.geometry.hip_position + ends + moved)[:, :2]
    np.testing.assert_allclose(found, expected, atol=1e-6)
    # Residuals lead the feet away from there, but not the place where heights are wanted.
    ends = core.step_ends(state, sensors, np.zeros(2))
    np.testing.assert_allclose(ends, expected - moved[:, :2], atol=1e-6)
    assert np.abs(moved).max() > 0.01
    ahead = core.landing_points(state, sensors, np.array([0.5, 0.0])) - found
    left = np.maximum(np.pi - tg.path.leg_phases(state.phase), 0) / (2 * np.pi * state.frequency)
    np.testing.assert_allclose(ahead, 0.5 * left[:, None] * [1, 0], atol=1e-6)


def test_odometry_is_the_trunks_velocity(subject):
    """A trunk that moves and turns over feet that stand still, by MuJoCo's kinematics; smoothed, it gets there."""
    core, random = subject.core, np.random.default_rng(4)
    sensors, state = random_sensors(core, 3), walk(core, 20)[-1][0]._replace(gate=np.float64(0.0))
    ids, data = subject.robot.foot_site_ids, subject.place(sensors.joint_position, sensors.orientation)
    model = subject.model
    velocity, turning = 0.3 * random.normal(size=3), 0.3 * random.normal(size=3)
    speeds = []
    for foot in ids:
        jacobian = np.zeros((3, model.nv))
        mujoco.mj_jacSite(model, data, jacobian, None, foot)
        speeds.append(jacobian)
    # Joint speeds (3 a leg) such that no foot moves.
    joint_velocity = np.zeros(12)
    for leg, jacobian in enumerate(speeds):
        own = subject.robot.dof_ids[3 * leg : 3 * leg + 3]
        given = jacobian[:, :3] @ velocity + jacobian[:, 3:6] @ turning
        joint_velocity[3 * leg : 3 * leg + 3] = np.linalg.solve(jacobian[:, own], -given)
    sensors = sensors._replace(joint_velocity=joint_velocity, angular_velocity=turning)
    for _ in range(40):
        state = state._replace(velocity=core.odometry(state, sensors))
    expected = tg.frames.turn(-tg.frames.yaw(sensors.orientation), velocity[:2])
    np.testing.assert_allclose(state.velocity, expected, atol=0.02)


def test_observation_by_parts(subject):
    core = subject.core
    sensors, state = random_sensors(core, 1), walk(core, 7)[-1][0]
    feet = core.feet(sensors)
    heights = np.full((4, 25), -0.3)
    heights[:, 5], heights[:, 6] = -1.0, 0.5
    observation = core.observe(state, sensors, heights, LEFT)
    assert observation.shape == (core.observation_size,) == (188,)
    seen = parts(core, observation)
    np.testing.assert_allclose(seen["command"], LEFT)
    np.testing.assert_allclose(seen["up"], tg.frames.rotation(sensors.orientation)[2])
    np.testing.assert_allclose(seen["angular_velocity"], 0.25 * sensors.angular_velocity)
    np.testing.assert_allclose(seen["joint_position"], sensors.joint_position - core.default_pose)
    np.testing.assert_allclose(seen["joint_velocity"], 0.1 * sensors.joint_velocity)
    np.testing.assert_allclose(seen["frequency"], state.frequency - core.config.base_frequency)
    np.testing.assert_allclose(seen["phase"], [math.sin(state.phase), math.cos(state.phase)])
    np.testing.assert_allclose(seen["actions"], state.actions.reshape(-1))
    targets = state.targets.reshape(2, 4, 3) - core.base_foot
    np.testing.assert_allclose(seen["targets"], 10 * targets.reshape(-1), atol=1e-12)
    np.testing.assert_allclose(seen["turn"], 2.0 * state.turn)
    far = core.observe(state._replace(turn=np.asarray(-2.5)), sensors, heights, LEFT)
    np.testing.assert_allclose(parts(core, far)["turn"], -1.0)  # cut at half a radian
    # z = f - h: positive where the ground lies below the foot; a hole deeper than 25 cm is 25 cm deep.
    below = seen["heights"].reshape(4, 25)
    np.testing.assert_allclose(below[:, 0], 5 * (feet[:, 2] + 0.3))
    np.testing.assert_allclose(below[:, 5], 5 * 0.25)
    np.testing.assert_allclose(below[:, 6], -5 * 0.25)


def test_blind_sees_the_same_without_heights(subject):
    core, blind = subject.core, subject.make(np.float64, method="blind")
    assert blind.observation_size == core.observation_size - 100
    sensors, state = random_sensors(core, 1), walk(core, 3)[-1][0]
    seeing = core.observe(state, sensors, np.zeros((4, 25)), LEFT)
    np.testing.assert_array_equal(blind.observe(state, sensors, None, LEFT), seeing[:-100])


@pytest.mark.parametrize("angle", [0.4, -1.3, 3.0])
def test_absolute_yaw_is_neither_seen_nor_acted_on(subject, angle):
    core = subject.core
    sensors, state = random_sensors(core, 1), walk(core, 7)[-1][0]
    turned = np.zeros(4)
    mujoco.mju_mulQuat(
        turned, np.array([math.cos(angle / 2), 0, 0, math.sin(angle / 2)]), sensors.orientation
    )
    heights = np.random.default_rng(0).uniform(-0.4, -0.2, (4, 25))
    views = [
        (
            core.observe(state, seen, heights, LEFT),
            core.feet(seen),
            core.act(state, np.full(14, 0.3), seen, LEFT)[1],
        )
        for seen in (sensors, sensors._replace(orientation=turned))
    ]
    for one, other in zip(*views, strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9)


def test_the_turn_is_the_integrated_yaw_rate(subject):
    """A level robot that turns at 1 rad/s for 3 s, then at -0.5 rad/s for 1 s; beyond half a turn it wraps."""
    core = subject.core
    state = core.initial_state(np.asarray(0.5 * np.pi))
    level = random_sensors(core, 0)._replace(orientation=np.array([1.0, 0, 0, 0]))
    turned = 0.0
    for step in range(200):
        rate = 1.0 if step < 150 else -0.5
        sensors = level._replace(angular_velocity=np.array([0.3, -0.2, rate]))
        state, _ = core.act(state, np.zeros(14), sensors, LEFT)
        turned += rate * core.dt
        np.testing.assert_allclose(state.turn, turned, atol=1e-9)
    for _ in range(100):
        state, _ = core.act(state, np.zeros(14), level._replace(angular_velocity=np.array([0, 0, 1.0])), LEFT)
    np.testing.assert_allclose(state.turn, turned + 2.0 - 2.0 * np.pi, atol=1e-9)


# Mirror symmetry ----------------------------------------------------------------------------------------------


def test_the_mirrored_robot_is_the_models_own(subject):
    """The mirror of joint angles that is used here puts MuJoCo's feet at mirrored places."""
    q = random_sensors(subject.core, 5).joint_position
    feet = subject.place(q).site_xpos[subject.robot.foot_site_ids].copy()
    mirrored = subject.place(mirror_joints(q)).site_xpos[subject.robot.foot_site_ids]
    np.testing.assert_allclose(mirrored, feet[SWAP] * [1, -1, 1], atol=1e-9)


@pytest.mark.parametrize("steps", [0, 1, 9, 24])
def test_the_mirror_image_looks_the_same_and_is_moved_likewise(subject, steps):
    core = subject.core
    state = walk(core, steps)[-1][0] if steps else core.initial_state(np.asarray(0.5 * np.pi))
    sensors = random_sensors(core, steps)
    heights = np.random.default_rng(steps).uniform(-0.4, -0.2, (4, 25))
    mirrored_heights = heights[SWAP][:, tg.samples.mirrored_points()]
    RIGHT = LEFT * [1, -1]
    image, image_sensors = mirror_state(state), mirror_sensors(sensors)
    np.testing.assert_allclose(
        core.observe(image, image_sensors, mirrored_heights, RIGHT),
        core.observe(state, sensors, heights, LEFT),
        atol=1e-9,
    )
    action = np.random.default_rng(steps).uniform(-1, 1, 14)
    after, desired = core.act(state, action, sensors, LEFT)
    image_after, image_desired = core.act(image, action, image_sensors, RIGHT)
    np.testing.assert_allclose(image_desired, mirror_joints(desired), atol=1e-9)
    for name, one, other in zip(after._fields, image_after, mirror_state(after), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-9, err_msg=name)


def test_mirror_has_hysteresis(subject):
    core = subject.core
    edge = core.config.mirror_hysteresis
    mirror = np.asarray(1.0)
    for lateral, expected in [(-0.9 * edge, 1), (-1.1 * edge, -1), (0.9 * edge, -1), (1.1 * edge, 1), (0, 1)]:
        command = np.array([math.sqrt(1 - lateral**2), lateral])
        mirror = core.update_mirror(mirror, command)
        assert mirror == expected
    assert subject.make(np.float64, mirror=False).update_mirror(np.asarray(1.0), np.array([0.0, -1.0])) == 1.0


def test_mirroring_twice_changes_nothing(subject):
    core = subject.core
    index, sign = core._observation_mirror
    np.testing.assert_array_equal(np.arange(188)[index][index], np.arange(188))
    np.testing.assert_array_equal(sign * sign[index], 1.0)
    action = np.random.default_rng(0).uniform(-1, 1, 14)
    once = core.mirror_action(np.asarray(-1.0), action)
    assert (once[:2] == action[:2]).all() and (once != action).any()
    np.testing.assert_array_equal(core.mirror_action(np.asarray(-1.0), once), action)
    np.testing.assert_array_equal(core.mirror_action(np.asarray(1.0), action), action)


# NumPy and JAX ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("refine", [0.0, 0.015])
@pytest.mark.parametrize("name", sorted(SUBJECTS))
def test_numpy_and_jax_give_the_same_numbers(name, refine):
    """Single precision, thirty steps of which each goes on from NumPy's state."""
    core = SUBJECTS[name].make(np.float32, refine=refine, follow=False)
    observe, act = jax.jit(core.observe), jax.jit(core.act)
    rng = np.random.default_rng(0)
    state = core.initial_state(np.asarray(0.5 * np.pi, np.float32))
    for step in range(30):
        sensors = random_sensors(core, step, np.float32)
        heights = rng.uniform(-0.5, 0.0, (4, 25)).astype(np.float32)
        angle = 0.6 * step
        command = np.array([math.cos(angle), math.sin(angle)], np.float32) * np.float32(step % 7 != 0)
        action = rng.uniform(-1, 1, 14).astype(np.float32)
        on_device = jax.tree.map(jnp.asarray, (state, sensors, heights, command))
        seen = core.observe(state, sensors, heights, command)
        assert seen.dtype == np.float32
        np.testing.assert_allclose(observe(*on_device), seen, atol=1e-6)
        patch = rng.uniform(-0.7, 0.0, (4, tg.footholds.COUNT)).astype(np.float32)
        after, desired = core.act(state, action, sensors, command, patch)
        there, wanted = act(on_device[0], jnp.asarray(action), *on_device[1:2], on_device[3], patch)
        assert desired.dtype == np.float32
        np.testing.assert_allclose(wanted, desired, atol=1e-6)
        for field, one, other in zip(after._fields, after, there, strict=True):
            assert np.asarray(one).dtype == np.float32, field
            np.testing.assert_allclose(other, one, atol=1e-6, err_msg=field)
        state = after


def test_act_changes_nothing_it_was_given(subject):
    core = subject.core
    state, sensors, action = walk(core, 2)[-1][0], random_sensors(core, 0), np.full(14, 1.5)
    copies = jax.tree.map(np.copy, (state, sensors, action))
    core.act(state, action, sensors, LEFT)
    core.observe(state, sensors, np.zeros((4, 25)), LEFT)
    jax.tree.map(np.testing.assert_array_equal, (state, sensors, action), copies)


def test_core_is_frozen(subject):
    with pytest.raises(dataclasses.FrozenInstanceError):
        subject.core.dt = 0.01
