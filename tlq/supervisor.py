"""Stands between the messages of a robot and its controller, so that no fault of theirs becomes a wild command.

    supervisor = Supervisor(Controller("policy.npz"))
    desired = supervisor.step(message or None, now)     # every control period; (12,) rad

Every message is judged before it is used. While good ones come, the controller walks, unless a `tlq.monitor` foresees a
fall: then it is told to stand. Without one, it goes on with the last good state for `grace`, then is told to stand, and
after `stand` more the joints are led slowly to the standing pose. It has no clock and no sockets: `now` is given, so
that it can be tested in no time.
"""

import collections
import dataclasses
import enum
import math

import numpy as np

import tg
from tlq.messages import Sensing
from tlq.monitor import Monitor
from tlq.runtime import Controller


class Mode(enum.IntEnum):
    """What the supervisor is doing."""

    WAIT = 0
    """No good message yet: nothing is known of the joints, nothing is commanded."""
    POSE = 1
    """Leads the joints slowly to the standing pose: at the start, after a fall, while messages stay away."""
    WALK = 2
    """The controller acts on the newest message (which may command standing)."""
    HOLD = 3
    """A message is missing: the controller acts on the last good one."""
    STAND = 4
    """Messages are missing: the controller is told to stand, and ends its step."""
    STOP = 5
    """The monitor foresees a fall: the controller is told to stand."""


@dataclasses.dataclass(frozen=True)
class SupervisorConfig:
    """Limits of what is believed and of what is commanded."""

    max_age: float = 0.06
    """Age at which a message is too old to act on (s)."""
    max_ahead: float = 0.005
    """A message further than this in the future shows that the clocks differ (s)."""
    grace: float = 0.04
    """Without a good message, the last good state serves this long (s): two control periods."""
    stand: float = 0.5
    """Then the controller stands for this long (s), its step being ended in the first 0.25 s."""
    max_change: float = 0.3
    """Change of a desired joint angle in a control period (rad). Walking needs up to 0.2."""
    pose_speed: float = 0.5
    """Speed at which the joints are led to the standing pose (rad/s)."""
    near: float = 0.4
    """Walking starts only when no joint is further than this from the standing pose (rad)."""
    min_up: float = 0.5
    """The robot has fallen when the cosine of its tilt is below this, as in training."""
    max_turn_rate: float = 35.0
    """Angular velocity beyond which a gyro isn't believed (rad/s): 2000 °/s, where most end."""
    joint_margin: float = 0.2
    """A joint further than this outside its limits isn't believed (rad)."""
    max_joint_speed: float = 50.0
    """Joint speed that isn't believed (rad/s); Max's joints reach 33."""
    max_height: float = 3.0
    """Terrain height, from the trunk's centre, that isn't believed (m)."""


class Supervisor:
    """A controller that is fed with messages, or with none."""

    def __init__(
        self, controller: Controller, config: SupervisorConfig | None = None, monitor: Monitor | None = None
    ):
        """Takes a controller, which nobody else may step, the limits, and what may stop it.

        A stop for good by the monitor ends when the messages command standing, and then walking.
        """
        self.controller, self.config, self.monitor = controller, config or SupervisorConfig(), monitor
        self.mode = Mode.WAIT
        self.faults: collections.Counter[str] = collections.Counter()
        """How many control steps had no good message, by what was wrong: missing, late, order, orientation, ..."""
        self.last: Sensing | None = None
        """The newest good message."""
        self.stops = 0
        """How often the monitor had the robot stand."""
        self._heard = -math.inf  # when it was accepted
        self._told = False  # to stand, since the monitor stopped the robot
        self._standing = np.asarray(controller.core.standing_target, float)
        self._desired = self._standing

    def step(self, message: Sensing | None, now: float) -> np.ndarray | None:
        """One control period.

        Args:
          message: the newest that arrived since the last call; None if there was none, or none well formed.
          now: s, of the clock in which messages are stamped.

        Returns:
          Desired joint angles (12,) rad, always finite and within `max_change` of the last ones; None until the first
          good message, when there is nothing that could be commanded safely.
        """
        if self.last is not None and now - self._heard > self.config.grace + self.config.stand:
            self.mode = Mode.POSE
        fault = self.fault(message, now)
        if fault:
            self.faults[fault] += 1
        else:
            assert message is not None
            self._accept(message, now)
        if self.last is None:
            return None
        self._change_mode(not fault, now)
        core = self.controller.core
        wanted = np.clip(self._wanted(self.last), core.lower, core.upper)
        change = np.clip(wanted - self._desired, -self.config.max_change, self.config.max_change)
        self._desired = self._desired + change
        return self._desired.copy()

    def centres(self) -> np.ndarray:
        """Round which places (4, 2) m the next message's heights are wanted, as in `Targets`."""
        core, state = self.controller.core, self.controller.state
        if self.last is None or not core.config.look_ahead:
            return np.full((4, 2), np.nan)
        sensors = tg.Sensors(**self.last.sensors)
        ahead = (core.phases(state.phase) > core.config.look_ahead_from)[:, None]
        # The state is a step ahead of the sensors: that is when the next ones will be read.
        return np.where(ahead, core.centres(state, sensors), np.nan)

    def fault(self, message: Sensing | None, now: float) -> str:
        """What is wrong with a message, in one word; empty if it can be acted on."""
        c, core = self.config, self.controller.core
        if message is None:
            return "missing"
        age = now - 1e-9 * message.time
        if not -c.max_ahead <= age <= c.max_age:
            return "late" if age > 0 else "ahead"
        lost = now - self._heard > c.grace + c.stand  # the sender may have started anew, counting from 0
        if self.last is not None and not lost and message.sequence <= self.last.sequence:
            return "order"
        # Comparisons with NaN are false: each test is written so that false is bad.
        if not abs(math.hypot(*message.orientation.tolist()) - 1.0) <= 0.01:
            return "orientation"
        if not np.abs(message.angular_velocity).max() <= c.max_turn_rate:
            return "angular_velocity"
        outside = np.maximum(core.lower - message.joint_position, message.joint_position - core.upper)
        if not outside.max() <= c.joint_margin:
            return "joint_position"
        if not np.abs(message.joint_velocity).max() <= c.max_joint_speed:
            return "joint_velocity"
        length = math.hypot(*message.command.tolist())
        if not (length <= 1e-6 or abs(length - 1.0) <= 0.01):
            return "command"
        if core.heights and message.heights.shape != (4, core.points):
            return "heights"
        if core.heights and not np.abs(message.heights).max() <= c.max_height:
            return "heights"
        return ""

    def _accept(self, message: Sensing, now: float) -> None:
        first = self.last is None
        self.last, self._heard = message, now
        if first:
            # A robot that stands goes on standing; any other starts from where its joints are.
            near = self._near_standing(message)
            self._desired = self._standing if near else np.asarray(message.joint_position, float)

    def _change_mode(self, fresh: bool, now: float) -> None:
        c, silence = self.config, now - self._heard
        assert self.last is not None
        if self._fallen(self.last) or silence > c.grace + c.stand:
            self.mode = Mode.POSE
        elif self.mode in (Mode.WAIT, Mode.POSE):
            risen = np.abs(self._desired - self._standing).max() < 1e-6 and self._near_standing(self.last)
            self.mode = Mode.POSE
            if fresh and risen:
                self.controller.reset()
                self._release()
                self.mode = Mode.WALK
        elif fresh:
            if self._stopped(self.last):
                self.stops += self.mode is not Mode.STOP
                self.mode = Mode.STOP
                return
            fades = not self.controller.core.config.finish_step
            if self.mode in (Mode.STAND, Mode.STOP) and fades and not self.controller.state.gate > 0:
                self._start_again()
            self.mode = Mode.WALK
        else:  # half a period more: calls don't come at exact times
            held = silence <= c.grace + 0.5 * self.controller.control_dt
            self.mode = Mode.HOLD if held else Mode.STAND

    def _stopped(self, message: Sensing) -> bool:
        """Whether the monitor stops the robot; not after standing was commanded, and then walking."""
        if self.monitor is None or not self.monitor.standing:
            self._told = False
            return False
        if self._told and message.command.any():
            self._release()
            return False
        self._told |= not message.command.any()
        return True

    def _release(self) -> None:
        """Nothing that the monitor said before counts any more."""
        self._told = False
        if self.monitor is not None:
            self.monitor.reset()

    def _start_again(self) -> None:
        """A gait that was faded out starts as it always does, not from wherever in its cycle it was stopped."""
        turn = self.controller.state.turn
        self.controller.reset()
        self.controller.state = self.controller.state._replace(turn=turn)

    def _wanted(self, message: Sensing) -> np.ndarray:
        """Desired joint angles (12,) rad, before the limit of their change."""
        if self.mode is not Mode.POSE:
            sensors, command = message.sensors, message.command
            if self.monitor is not None and self.monitor.standing:
                command = 0.0 * command
            if self.mode is Mode.STAND:
                # The old speeds say nothing of now; the gyro's would be summed up into a turn that wasn't.
                still = {name: 0.0 * sensors[name] for name in ("angular_velocity", "joint_velocity")}
                sensors, command = sensors | still, 0.0 * command
            heights = message.heights if self.controller.core.heights else None
            desired = np.asarray(self.controller.step(sensors, heights, command), float)
            if self.monitor is not None:
                self.monitor.step(self.controller)
            if np.isfinite(desired).all():
                return desired
            self.faults["policy"] += 1
            self.mode = Mode.POSE
        step = self.config.pose_speed * self.controller.control_dt
        return self._desired + np.clip(self._standing - self._desired, -step, step)

    def _near_standing(self, message: Sensing) -> bool:
        away = np.abs(message.joint_position - self.controller.core.default_pose).max()
        return bool(away <= self.config.near) and not self._fallen(message)

    def _fallen(self, message: Sensing) -> bool:
        _, x, y, _ = message.orientation.tolist()
        return 1.0 - 2.0 * (x * x + y * y) < self.config.min_up
