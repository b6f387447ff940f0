"""The supervisor: every fault of a message, alone and mixed, ends in a safe stand, and is got over."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.tlq.policies import put, trained
from tlq.faults import BadLine, spoilt
from tlq.messages import MessageError, Sensing, unpack
from tlq.runtime import Controller
from tlq.supervisor import Mode, Supervisor, SupervisorConfig

DT = 0.02
FORWARD, STILL = np.array([1.0, 0.0]), np.zeros(2)
SMALL = {"policy.encoder": 8, "policy.head": 8, "policy.memory_width": 4}
NAN = float("nan")


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return trained(spread=0.0, **SMALL).export(tmp_path_factory.mktemp("supervisor") / "policy.npz")


class Rig:
    """A supervisor, virtual time, and a robot whose joints are where they should be."""

    def __init__(self, file, config=None):
        self.supervisor = Supervisor(Controller(file), config)
        self.core = self.supervisor.controller.core
        self.now, self.sequence, self.last = 100.0, 0, None
        self.joints = np.array(self.core.default_pose, float)

    def message(self, **changes):
        self.sequence += 1
        values = {
            "sequence": self.sequence,
            "time": round(1e9 * self.now),
            **self.supervisor.controller.example_sensors(),
            "joint_position": self.joints,
            "command": FORWARD,
            "heights": np.full((4, 25), -0.3),
        }
        return Sensing(**values | changes)

    def step(self, message="good"):
        """One control period; checks what must always hold."""
        self.now += DT
        desired = self.supervisor.step(self.message() if message == "good" else message, self.now)
        if desired is not None:
            assert desired.shape == (12,) and np.isfinite(desired).all()
            # From single precision: the core's own limits.
            assert (desired >= self.core.lower - 1e-5).all() and (desired <= self.core.upper + 1e-5).all()
            if self.last is not None:
                limit = self.supervisor.config.max_change
                assert np.abs(desired - self.last).max() <= limit + 1e-9
        self.last = desired
        return desired

    def walk(self, steps=30):
        for _ in range(steps):
            self.step()
        assert self.mode is Mode.WALK
        return self

    @property
    def mode(self):
        return self.supervisor.mode


BAD = {
    "orientation": [put(NAN, 0), put(0.9, 0), lambda q: 0 * q, lambda q: 1e30 + q],
    "angular_velocity": [put(NAN, 2), put(np.inf, 1), put(-36.0, 0)],
    "joint_position": [put(NAN, 11), put(-np.inf, 4), put(3.0, 2), put(-1.2, 0), lambda q: q + 100],
    "joint_velocity": [put(NAN, 5), put(51.0, 0)],
    "command": [put(NAN, 0), put(0.5, 0), lambda c: 3 * c],
    "heights": [put(NAN, (3, 24)), put(np.inf, (0, 0)), put(-3.1, (1, 1)), lambda h: np.tile(h, 2)],
}


@pytest.mark.parametrize(
    ("name", "change"), [(name, change) for name, changes in BAD.items() for change in changes]
)
def test_impossible_values_are_refused_by_name(file, name, change):
    rig = Rig(file).walk()
    good = rig.message()
    bad = dataclasses.replace(good, **{name: change(getattr(good, name))})
    rig.step(bad)
    assert rig.mode is Mode.HOLD and rig.supervisor.faults == {name: 1}
    assert rig.supervisor.last is not bad


def test_a_nonsense_stream_ends_in_the_standing_pose(file):
    rig = Rig(file).walk()
    modes = []
    for i in range(100):
        rig.step(rig.message(joint_position=np.full(12, NAN)))
        modes.append(rig.mode)
        if i == 27:
            assert not rig.supervisor.controller.state.gate.any()  # the gait has been faded out
    # 0.04 s are two steps; standing begins at 0.06 s and ends at 0.54 s, 27 steps after the last good message.
    assert modes[:2] == [Mode.HOLD] * 2
    assert modes[2:26] == [Mode.STAND] * 24
    assert modes[28:] == [Mode.POSE] * 72
    np.testing.assert_allclose(rig.last, rig.core.standing_target, atol=1e-6)


def test_held_steps_go_on_walking_as_if_the_message_had_come_again(file):
    rig, other = Rig(file).walk(), Rig(file).walk()
    other_message = other.supervisor.last
    for _ in range(2):
        desired = rig.step(None)
        controller = other.supervisor.controller
        wanted = controller.step(other_message.sensors, other_message.heights, other_message.command)
        np.testing.assert_allclose(desired, wanted, atol=1e-6)
    assert rig.supervisor.faults == {"missing": 2}


def test_late_messages_are_refused(file):
    rig = Rig(file).walk()
    for age, mode in ((0.055, Mode.WALK), (0.065, Mode.HOLD), (0.1, Mode.HOLD), (1e6, Mode.STAND)):
        rig.step(rig.message(time=round(1e9 * max(rig.now + DT - age, 0.0))))
        assert rig.mode is mode, age
    assert rig.supervisor.faults == {"late": 3}
    rig.step()
    assert rig.mode is Mode.WALK


def test_a_clock_that_goes_ahead_is_seen(file):
    rig = Rig(file).walk()
    rig.step(rig.message(time=round(1e9 * (rig.now + DT + 0.004))))
    assert rig.mode is Mode.WALK
    for time in (round(1e9 * (rig.now + DT + 0.5)), 2**64 - 1):
        rig.step(rig.message(time=time))
    assert rig.supervisor.faults == {"ahead": 2}


def test_messages_out_of_order_and_twice_are_refused(file):
    rig = Rig(file).walk()
    old, new = rig.message(), rig.message()
    rig.step(new)
    for message in (old, new):
        rig.step(message)
        assert rig.supervisor.last is new
    assert rig.supervisor.faults == {"order": 2}


def test_a_sender_that_starts_anew_is_accepted_when_the_old_one_is_gone(file):
    rig = Rig(file).walk()
    for _ in range(30):
        rig.step(None)
    rig.sequence = 0
    rig.step()
    assert not rig.supervisor.faults["order"] and rig.supervisor.last.sequence == 1


@pytest.mark.parametrize("missing", [1, 2, 3, 10, 26, 40, 500])
def test_it_recovers(file, missing):
    rig = Rig(file).walk()
    for _ in range(missing):
        rig.step(None)
    for _ in range(60):  # the pose may have been under way
        rig.step()
    assert rig.mode is Mode.WALK
    assert rig.supervisor.controller.state.gate == 1.0  # walking, not only allowed to


def test_after_standing_it_goes_on_from_the_end_of_its_step(file):
    rig = Rig(file).walk(37)
    controller = rig.supervisor.controller
    for _ in range(26):  # 0.24 s for the rest of the step, 0.2 s until the gate is shut
        rig.step(None)
    assert rig.mode is Mode.STAND and controller.state.gate == 0.0
    stood = controller.state
    rig.step(rig.message(command=STILL))
    assert controller.state.phase == stood.phase and np.sin(stood.phase) == pytest.approx(0.0, abs=1e-6)
    assert np.array_equal(controller.state.stride, stood.stride) and stood.stride.any()


def test_after_standing_a_gait_that_fades_out_starts_as_it_always_does(tmp_path):
    fading = trained(spread=0.0, **SMALL, **{"env.tg.finish_step": False})
    rig = Rig(fading.export(tmp_path / "policy.npz")).walk(37)
    controller = rig.supervisor.controller
    controller.state = controller.state._replace(turn=np.float32(0.2))
    for _ in range(20):
        rig.step(None)
    assert rig.mode is Mode.STAND and controller.state.gate == 0.0
    rig.step(rig.message(command=STILL))
    assert controller.state.phase == pytest.approx(0.5 * np.pi)  # every foot in the middle of its step
    assert controller.state.turn == pytest.approx(0.2, abs=1e-6)  # the heading to keep is the old one


def test_before_the_first_good_message_nothing_is_commanded(file):
    rig = Rig(file)
    for message in (None, rig.message(orientation=np.zeros(4)), rig.message(time=0)):
        assert rig.step(message) is None and rig.mode is Mode.WAIT
    assert rig.step() is not None


def test_a_standing_robot_goes_on_standing(file):
    rig = Rig(file)
    np.testing.assert_allclose(rig.step(rig.message(command=STILL)), rig.core.standing_target, atol=0.02)
    assert rig.mode is Mode.WALK


def test_a_crouching_robot_rises_slowly_and_walks_then(file):
    rig = Rig(file)
    rig.joints = rig.joints + np.tile([0.0, -0.5, 0.7], 4)
    first, steps = rig.step(), 1
    speed = rig.supervisor.config.pose_speed * DT
    assert np.abs(first - rig.joints).max() <= speed + 1e-6
    while rig.mode is Mode.POSE:
        before, rig.joints = rig.last, rig.last  # the joints follow
        desired = rig.step()
        steps += 1
        assert rig.mode is Mode.WALK or np.abs(desired - before).max() <= speed + 1e-6
        assert steps < 200
    # The knees lie 0.7 rad from the default pose, 0.81 rad from what holds the weight there: 0.01 rad a step.
    assert steps == pytest.approx(82, abs=3)


def test_a_robot_whose_legs_are_held_never_walks(file):
    rig = Rig(file)
    rig.joints = rig.joints + 0.5
    for _ in range(300):
        rig.step()
    assert rig.mode is Mode.POSE


def test_a_fallen_robot_is_led_to_the_pose_and_walks_when_it_is_up(file):
    rig = Rig(file).walk()
    fallen = np.array([np.cos(0.6), np.sin(0.6), 0.0, 0.0])  # 69° to the side
    for _ in range(50):
        rig.step(rig.message(orientation=fallen))
        assert rig.mode is Mode.POSE
    assert not rig.supervisor.faults
    rig.walk(60)


def test_a_pause_of_the_process_is_no_licence_to_walk_on(file):
    rig = Rig(file).walk()
    rig.now += 5.0
    rig.step(None)
    assert rig.mode is Mode.POSE
    rig.now += 5.0
    rig.supervisor.controller.state = rig.supervisor.controller.state._replace(turn=np.float32(0.3))
    rig.walk(60)
    assert rig.supervisor.controller.state.turn == 0.0  # it was reset


def test_a_policy_that_gives_nonsense_is_not_obeyed(file, monkeypatch):
    rig = Rig(file).walk()
    monkeypatch.setattr(rig.supervisor.controller, "step", lambda *_: np.full(12, NAN, np.float32))
    for _ in range(5):
        rig.step()
    assert rig.supervisor.faults["policy"] >= 1 and rig.mode in (Mode.POSE, Mode.WALK)


def test_a_policy_that_jumps_is_slowed_down(file, monkeypatch):
    rig = Rig(file).walk()
    jumps = iter(np.sign(np.sin(np.arange(100.0))))
    middle = 0.5 * (rig.core.lower + rig.core.upper)
    monkeypatch.setattr(rig.supervisor.controller, "step", lambda *_: middle + 0.9 * next(jumps))
    for _ in range(100):
        rig.step()  # checks the limit


def test_a_blind_policy_needs_no_heights(tmp_path):
    blind = trained("blind", spread=0.0, **SMALL).export(tmp_path / "policy.npz")
    rig = Rig(blind)
    rig.step(rig.message(heights=np.full((4, 25), NAN)))
    assert rig.mode is Mode.WALK and not rig.supervisor.faults


def test_limits_can_be_chosen(file):
    rig = Rig(file, SupervisorConfig(max_age=0.2, max_change=0.01)).walk()
    rig.step(rig.message(time=round(1e9 * (rig.now - 0.15))))
    assert rig.mode is Mode.WALK


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 1.0))
def test_whatever_the_line_does_the_commands_stay_tame(file, seed, share):
    rig, line = Rig(file), BadLine(share, seed)
    for _ in range(60):
        found = []
        for data in line.send(dataclasses.replace(rig.message(), time=round(1e9 * (rig.now + DT))), rig.now):
            try:
                found.append(unpack(data))
            except MessageError:
                pass
        rig.step(found[-1] if found else None)


@given(st.integers(0, 2**32 - 1))
def test_spoilt_messages_are_never_believed(file, seed):
    rig = Rig(file).walk(5)
    bad = spoilt(rig.message(time=round(1e9 * (rig.now + DT))), np.random.default_rng(seed))
    rig.step(bad)
    assert rig.supervisor.last is not bad
