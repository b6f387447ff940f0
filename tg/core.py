"""The controller core: observation in, action in, desired joint angles out.

Everything the policy sees and does passes through `Core`, written against the array API, so that the same lines run
under JAX in training and under NumPy on the robot. Letters: L = 4 legs (LF, RF, LR, RR), J = 12 joints (leg by leg:
abduction, hip, knee), P = 25 sample points a foot (146 with `TGConfig.refine`), S = size of the observation.
"""

import dataclasses
import functools
import math
from typing import Any, NamedTuple

from tg import footholds, frames, leg, path, samples
from tg.arrays import stack
from tg.config import TGConfig

Array = Any

ACTION_SIZE = 14
"""δf, δh and twelve residual joint angles, each in [-1, 1]."""
ACTION_HISTORY = 2
TARGET_HISTORY = 2
HEIGHT_CLIP = 0.25
"""Heights below the foot are cut to ± this (m): deeper than that, a hole is a hole."""
TURN_CLIP = 0.5
"""The turn since the start is shown up to ± this (rad), so that a robot turned round by hand sees nothing new."""
LAG = 0.07
"""Time constant (s) with which joints catch up with what is asked of them: docs/experiments.md."""
SMOOTHING = 0.3
"""Share of a new measurement in the velocity that the stance legs tell of."""

SUNK = 0.06
"""By how much (m) the height of feet in swing is corrected at most (`TGConfig.touch_down`)."""
HANDED_BACK = 0.3
"""Share of stance in which that is given up again."""

NUDGE = 0.01
"""Joint angle (rad) by which the slope of the legs' kinematics is taken; long enough for single precision."""
_DOWN = 1e-3
"""Sine of the phase below which all feet are down."""
_LATE = 1e-4
"""Phase (rad) before lift-off and after touch-down at which a gait rests, so that rounding leaves no foot up."""

MIRRORED_LEG = (1, 0, 3, 2)
"""The leg that each leg is in the mirror."""


class Sensors(NamedTuple):
    """What a robot measures: no position, no velocity of the trunk."""

    orientation: Array
    """(4,) unit quaternion w, x, y, z, world from trunk; its yaw is not used."""
    angular_velocity: Array
    """(3,) rad/s, trunk frame."""
    joint_position: Array
    """(12,) rad."""
    joint_velocity: Array
    """(12,) rad/s."""


class ControllerState(NamedTuple):
    """What the controller remembers within an episode."""

    phase: Array
    """() rad, of LF, in [-π, π)."""
    frequency: Array
    """() Hz, f_base + δf of the last step."""
    lift: Array
    """(4,) m, H + δh of each leg, held from lift-off to touch-down."""
    stride: Array
    """(2,) the direction in which the feet are led (heading frame), the command faded in and out."""
    gate: Array
    """() in [0, 1], share of the vertical motion: 0 standing, 1 walking."""
    mirror: Array
    """() +1, or -1 while the policy sees the mirror image."""
    actions: Array
    """(2, 14) last actions, newest first, robot's own side."""
    targets: Array
    """(2, 12) m, last desired foot positions from the abduction joints (trunk frame), newest first."""
    desired: Array
    """(12,) rad, last desired joint angles."""
    turn: Array
    """() rad, heading since the start by the integrated gyro, left positive, in [-π, π)."""
    velocity: Array
    """(2,) m/s, the trunk's by the motion of the stance legs, heading frame."""


def layout(heights: bool) -> tuple[tuple[str, int], ...]:
    """Names and sizes of the parts of the observation, in order."""
    parts = [
        ("command", 2),
        ("up", 3),
        ("angular_velocity", 3),
        ("joint_position", 12),
        ("joint_velocity", 12),
        ("frequency", 1),
        ("phase", 2),
        ("actions", ACTION_HISTORY * ACTION_SIZE),
        ("targets", TARGET_HISTORY * 12),
        ("turn", 1),
    ]
    return (*parts, ("heights", 100)) if heights else tuple(parts)


def offset(part: str) -> int:
    """Where a part of the observation begins."""
    names, sizes = zip(*layout(heights=True), strict=True)
    return sum(sizes[: names.index(part)])


@dataclasses.dataclass(frozen=True, eq=False)
class Core:
    """Trajectory generator, observation and joint targets of one robot. All methods are pure."""

    config: TGConfig
    geometry: leg.LegGeometry
    base_foot: Array
    """(4, 3) m, foot positions of the standing robot from the abduction joints, horizontal frame."""
    default_pose: Array
    """(12,) rad, joint angles there."""
    lower: Array
    """(12,) rad."""
    upper: Array
    """(12,) rad."""
    dt: float
    """Control period (s)."""
    sag: float
    """Weight of the robot over kp (N·rad/(N·m)): how far a joint sags by a lever of 1 m."""
    slack: float
    """kd over kp (s): how far a joint that is damped stays behind per speed."""
    heights: bool = True
    """Whether the policy sees the terrain (not with `method=blind`)."""

    @functools.cached_property
    def layout(self) -> tuple[tuple[str, int], ...]:
        """Names and sizes of the parts of the observation, in order."""
        return layout(self.heights)

    @property
    def points(self) -> int:
        """P: how many heights are wanted round each foot, the policy's 25 and, with `TGConfig.refine`, the patch's."""
        return samples.COUNT + (footholds.COUNT if self.config.refine else 0)

    @property
    def observation_size(self) -> int:
        """S."""
        return sum(size for _, size in self.layout)

    @property
    def standing_target(self) -> Array:
        """Desired joint angles (12,) rad of the standing robot: the default pose, and what the weight asks for."""
        pose = self.default_pose.reshape(4, 3)
        load = (
            self.config.weight_compensation * self.sag * 0.25 * abs(self.geometry.thigh / self.geometry.thigh)
        )
        return (pose + leg.support_torque(self.geometry, pose, load)).reshape(-1)

    def phases(self, phase: Array) -> Array:
        """Phases (..., 4) rad of the legs from the gait's (...) rad: `path.leg_phases`."""
        return path.leg_phases(phase, self.config.swing_share, self.config.gait)

    def stance_speed(self, frequency: Array) -> Array:
        """Mean speed (...) m/s of feet in stance, against the trunk, at a frequency (...) Hz."""
        return frequency * (self.config.step_length / (1.0 - self.config.swing_share))

    def initial_state(self, phase: Array) -> ControllerState:
        """A standing robot's state, its gait to start at a phase () rad."""
        xp = phase.__array_namespace__()
        zero = 0.0 * phase
        targets = xp.reshape(xp.asarray(self.base_foot, dtype=phase.dtype), (12,))
        return ControllerState(
            phase=path.wrap(phase),
            frequency=zero + self.config.base_frequency,
            lift=xp.zeros((4,), dtype=phase.dtype) + self._lift(zero),
            stride=xp.zeros((2,), dtype=phase.dtype),
            gate=zero,
            mirror=zero + 1.0,
            actions=xp.zeros((ACTION_HISTORY, ACTION_SIZE), dtype=phase.dtype),
            targets=xp.stack([targets] * TARGET_HISTORY),
            desired=xp.asarray(self.standing_target, dtype=phase.dtype),
            turn=zero,
            velocity=xp.zeros((2,), dtype=phase.dtype),
        )

    def feet(self, sensors: Sensors) -> Array:
        """Foot centres (4, 3) m from the trunk's centre, heading frame."""
        xp = sensors.joint_position.__array_namespace__()
        q = xp.reshape(sensors.joint_position, (4, 3))
        in_trunk = self.geometry.hip_position + leg.forward(self.geometry, q)
        return in_trunk @ frames.heading_from_trunk(frames.up_in_trunk(sensors.orientation)).T

    def sample_points(self, state: ControllerState, sensors: Sensors) -> Array:
        """Points (4, P, 2) m at which the terrain's height is wanted, from the trunk's centre, heading frame."""
        return self.wanted(self.centres(state, sensors))

    def centres(self, state: ControllerState, sensors: Sensors) -> Array:
        """Centres (4, 2) m of the circles of `sample_points`: the feet, or where steps end (`TGConfig.look_ahead`)."""
        feet = self.feet(sensors)[:, :2]
        if not self.config.look_ahead:
            return feet
        xp = feet.__array_namespace__()
        ends = self.step_ends(state, sensors, self.odometry(state, sensors))
        if self.config.follow:
            ends = ends + self.residual_displacement(state, sensors)[:, :2]
        # A robot that stands still has feet in swing by their phase, but they stay where they are.
        ahead = self.phases(state.phase) > self.config.look_ahead_from
        share = xp.where(ahead, state.gate, 0.0 * state.gate)[:, None]
        return feet + share * (ends - feet)

    def around(self, centres: Array) -> Array:
        """The points (4, 25, 2) m of the circles round places (4, 2 or 3) m."""
        return centres[:, None, :2] + self._ring_offsets

    def patch(self, centres: Array) -> Array:
        """The points (4, N, 2) m of the patches of `tg.footholds` round places (4, 2) m."""
        return centres[:, None] + self._patch_offsets

    def wanted(self, centres: Array) -> Array:
        """Points (4, P, 2) m at which heights are wanted if centres (4, 2) m are the circles'."""
        circles = self.around(centres)
        if not self.config.refine:
            return circles
        xp = centres.__array_namespace__()
        return xp.concatenate([circles, self.patch(centres)], axis=1)

    def odometry(self, state: ControllerState, sensors: Sensors, level: Array | None = None) -> Array:
        """The trunk's velocity (2,) m/s in the heading frame, by the legs in stance, smoothed over a few steps.

        A foot that carries weight is taken to stand still: the trunk moves against it by what joints and gyro say.
        """
        xp = sensors.joint_position.__array_namespace__()
        q, speed = (xp.reshape(x, (4, 3)) for x in (sensors.joint_position, sensors.joint_velocity))
        moment = 0.01  # s; long enough for single precision
        now, then = leg.forward(self.geometry, q), leg.forward(self.geometry, q + moment * speed)
        share = load_share(self.phases(state.phase), state.gate)
        x, y, z = share @ (self.geometry.hip_position + now)
        a, b, c = sensors.angular_velocity
        turned = stack([b * z - c * y, c * x - a * z, a * y - b * x])
        velocity = -(share @ (then - now) / moment + turned)
        if level is None:
            level = frames.heading_from_trunk(frames.up_in_trunk(sensors.orientation))
        return state.velocity + SMOOTHING * ((level @ velocity)[:2] - state.velocity)

    def residual_displacement(self, state: ControllerState, sensors: Sensors) -> Array:
        """How far residual joint angles lead the feet (4, 3) m from the trajectory generator's, heading frame."""
        xp = state.targets.__array_namespace__()
        phases = self.phases(state.phase)
        target = self.foot_targets(phases, state.lift * state.gate, state.stride, sensors, gate=state.gate)
        level = frames.heading_from_trunk(frames.up_in_trunk(sensors.orientation))
        return (xp.reshape(state.targets[0], (4, 3)) - target) @ level.T

    def step_ends(self, state: ControllerState, sensors: Sensors, velocity: Array) -> Array:
        """Where the trajectory generator leads feet: (4, 2) m from the trunk's centre, heading frame.

        The end of the step, of feet in stance that of the next, and the trunk's way until then at its velocity (2,)
        m/s. Residual joint angles are left out, so that a foothold seen from there stays where it is while they lead
        the foot to it.
        """
        xp = state.targets.__array_namespace__()
        level = frames.heading_from_trunk(frames.up_in_trunk(sensors.orientation))
        end = 0.5 * self.config.step_length * state.stride
        place = (self.geometry.hip_position @ level.T + self.base_foot)[:, :2]
        return place + end + self._time_left(state, xp)[:, None] * velocity

    def landing_points(self, state: ControllerState, sensors: Sensors, velocity: Array) -> Array:
        """Where feet in swing will come down: (4, 2) m from the trunk's centre, heading frame.

        `step_ends`, the displacement by the residual joint angles, which are taken to stay as they are, and what will
        be left of the joints' lag.
        """
        xp = state.targets.__array_namespace__()
        level = frames.heading_from_trunk(frames.up_in_trunk(sensors.orientation))
        hips = self.geometry.hip_position @ level.T
        lag = self.feet(sensors) - hips - xp.reshape(state.targets[0], (4, 3)) @ level.T
        left = xp.exp(-(self._time_left(state, xp) + self.dt) / LAG)[:, None] * lag
        moved = self.residual_displacement(state, sensors) + left
        return self.step_ends(state, sensors, velocity) + moved[:, :2]

    def _time_left(self, state: ControllerState, xp: Any) -> Array:
        """Time (4,) s until feet come down that are in swing, or will be next."""
        phases, share = self.phases(state.phase), self.config.swing_share
        swing = xp.minimum(math.pi - phases, math.pi + 0.0 * phases)
        stance = xp.maximum(-phases, 0.0 * phases)
        return (share * swing + (1.0 - share) * stance) / (math.pi * state.frequency)

    def observe(
        self, state: ControllerState, sensors: Sensors, heights: Array | None, command: Array
    ) -> Array:
        """The policy's observation.

        Args:
          state: of the controller.
          sensors: of the robot.
          heights: (4, 25) m, the terrain's at the first 25 of `sample_points`, from the trunk's centre, up positive;
            None if blind.
          command: (2,) direction in the heading frame, a unit vector, or 0 to stand.

        Returns:
          (S,) in the order of `layout`, mirrored where `update_mirror` says so.
        """
        xp = command.__array_namespace__()
        parts = [
            command,
            frames.up_in_trunk(sensors.orientation),
            0.25 * sensors.angular_velocity,
            sensors.joint_position - self.default_pose,
            0.1 * sensors.joint_velocity,
            xp.reshape(state.frequency - self.config.base_frequency, (1,)),
            stack([xp.sin(state.phase), xp.cos(state.phase)]),
            xp.reshape(state.actions, (-1,)),
            xp.reshape(10.0 * (xp.reshape(state.targets, (TARGET_HISTORY, 4, 3)) - self.base_foot), (-1,)),
            xp.reshape(2.0 * xp.clip(state.turn, -TURN_CLIP, TURN_CLIP), (1,)),
        ]
        if self.heights:
            # z_ij = f_ij - h_ij: how far the terrain lies below the foot.
            below = self.feet(sensors)[:, 2:] - heights
            parts.append(xp.reshape(5.0 * xp.clip(below, -HEIGHT_CLIP, HEIGHT_CLIP), (-1,)))
        observation = xp.concatenate(parts)
        mirror = self.update_mirror(state.mirror, command)
        index, sign = self._observation_mirror
        return xp.where(mirror > 0, observation, observation[index] * sign)

    def act(
        self,
        state: ControllerState,
        action: Array,
        sensors: Sensors,
        command: Array,
        patch: Array | None = None,
    ) -> tuple[ControllerState, Array]:
        """One control step: the policy's action to desired joint angles.

        Args:
          state: of the controller.
          action: (14,) in [-1, 1], as the policy gave it (mirrored if its observation was).
          sensors: those of the observation.
          command: that of the observation.
          patch: (4, N) m, the terrain's heights at `patch` round the observation's centres; needed with
            `TGConfig.refine`.

        Returns:
          The next state, and the desired joint angles (12,) rad.
        """
        xp, c = action.__array_namespace__(), self.config
        mirror = self.update_mirror(state.mirror, command)
        action = self.mirror_action(mirror, xp.clip(action, -1.0, 1.0))
        frequency = c.base_frequency + c.frequency_range * action[0]
        moving = xp.where(xp.sum(command * command) > 0.25, 1.0 + 0.0 * frequency, 0.0 * frequency)

        phase = path.advance(state.phase, frequency, self.dt)
        step = self.dt / c.start_time
        gate = state.gate + xp.clip(moving - state.gate, -step, step)
        stride = state.stride + xp.clip(command - state.stride, -step, step)
        if c.finish_step:
            # Feet in swing come down where they were to, and all feet stay where they are then.
            swinging = self._unfinished(state)
            legs = self.phases(state.phase)
            leg_up = xp.argmax(legs)
            lift_off, down = xp.asarray(self._swings)[:, leg_up]
            landed = xp.where(path.wrap(phase - down) < 0, phase, down)
            # Feet that lift off or come down at this very moment are put down by rounding, if by nothing else.
            nearest = xp.where(legs[leg_up] > 0.5 * math.pi, down, lift_off)
            settled = xp.where((state.gate > 0) & (legs[leg_up] > 0), nearest, state.phase)
            finishing = xp.where(swinging, landed, settled)
            # From a step's end on the stride is there at once: so it's the phase that gathers speed. From the middle of
            # a step on, as after a reset, the stride is never ahead of the gate.
            rate = 1.0 - xp.maximum(xp.max(xp.abs(stride)) - gate, 0.0 * gate)
            starting = path.advance(state.phase, rate * frequency, self.dt)
            phase = xp.where(moving > 0, starting, finishing)
            gate = xp.where((moving > 0) | ~swinging, gate, state.gate)
            stride = xp.where(moving > 0, stride, state.stride)
        else:
            phase = xp.where(moving > 0, phase, state.phase)
        phases = self.phases(phase)
        lift = xp.where(phases > 0, state.lift, self._lift(action[1]))

        up = frames.up_in_trunk(sensors.orientation)
        level = frames.heading_from_trunk(up)
        targets = self.foot_targets(phases, lift * gate, stride, sensors, level, gate)
        tg_angles = leg.inverse(self.geometry, targets)
        residual = c.residual_range * xp.reshape(action[2:], (4, 3))
        if c.refine:
            assert patch is not None
            residual = self._refined(
                residual, tg_angles, targets, level, gate * footholds.share(phases), patch
            )
        wanted = tg_angles + residual
        reached = leg.forward(self.geometry, wanted)
        sag = leg.support_torque(
            self.geometry, wanted, c.weight_compensation * self.sag * load_share(phases, gate), reached
        )
        if c.stance_damping != 1.0:
            # Not `frequency`: told to stand, the gait stops where it is, while its gate fades out.
            passed = path.wrap(phase - state.phase) / (2.0 * math.pi * self.dt)
            sag = sag + self._drag(tg_angles, targets, stride, passed, phases, gate, level)
        desired = xp.clip(xp.reshape(wanted + sag, (12,)), self.lower, self.upper)
        velocity = self.odometry(state, sensors, level) if c.look_ahead else state.velocity
        rate = frames.yaw_rate(up, sensors.angular_velocity)
        state = ControllerState(
            phase=phase,
            frequency=frequency,
            lift=lift,
            stride=stride,
            gate=gate,
            mirror=mirror,
            actions=stack([action, *state.actions[: ACTION_HISTORY - 1]], axis=-2),
            targets=stack([xp.reshape(reached, (12,)), *state.targets[: TARGET_HISTORY - 1]], axis=-2),
            desired=desired,
            turn=path.wrap(state.turn + self.dt * rate),
            velocity=velocity,
        )
        return state, desired

    def _drag(
        self,
        tg_angles: Array,
        targets: Array,
        stride: Array,
        frequency: Array,
        phases: Array,
        gate: Array,
        level: Array,
    ) -> Array:
        """What makes up (4, 3) rad for the damping that legs in stance have beyond the others.

        So it brakes what the trunk does beside walking on, and not the walking. Residual angles aren't counted.

        Args:
          tg_angles, targets: (4, 3) rad and m, the trajectory generator's.
          stride: (2,) direction, heading frame.
          frequency: () Hz, at which the phase really advances.
          phases: (4,) rad.
          gate: () share of the vertical motion.
          level: (3, 3) `heading_from_trunk`.
        """
        xp, c = stride.__array_namespace__(), self.config
        way = -self.dt * self.stance_speed(frequency) * gate * stride  # of the feet, from the trunk
        ahead = targets + xp.concatenate([way, 0.0 * way[:1]]) @ level
        speed = (leg.inverse(self.geometry, ahead) - tg_angles) / self.dt
        return (c.stance_damping - 1.0) * self.slack * _standing(phases, gate)[:, None] * speed

    def _refined(
        self, residual: Array, tg_angles: Array, targets: Array, level: Array, share: Array, patch: Array
    ) -> Array:
        """Residual joint angles (4, 3) rad that lead the feet a little off the gaps near where they are led.

        Args:
          residual: (4, 3) rad, the policy's.
          tg_angles, targets: (4, 3) rad and m, the trajectory generator's.
          level: (3, 3) `heading_from_trunk`.
          share: (4,) which part of the shift counts.
          patch: (4, N) m.
        """
        xp, bound = residual.__array_namespace__(), self.config.residual_range
        led = ((leg.forward(self.geometry, tg_angles + residual) - targets) @ level.T)[:, :2]
        moved = share[:, None] * footholds.shift(led, patch, self.config.refine)
        angles, columns = tg_angles + residual, []
        for nudge in self._nudges:
            ahead, behind = (leg.forward(self.geometry, x) for x in (angles + nudge, angles - nudge))
            columns.append((((ahead - behind) / (2.0 * NUDGE)) @ level.T)[:, :2])
        slope = xp.stack(columns, axis=-1)  # (4, 2, 3) m/rad
        # The smallest change of the three angles that moves the foot so, in the plane.
        a, b = slope[:, 0], slope[:, 1]
        aa, bb, ab = (xp.sum(x * y, axis=-1) for x, y in ((a, a), (b, b), (a, b)))
        aa, bb = aa + 1e-6, bb + 1e-6
        p, q = moved[:, 0], moved[:, 1]
        scale = aa * bb - ab * ab
        u, v = (bb * p - ab * q) / scale, (aa * q - ab * p) / scale
        return xp.clip(residual + u[:, None] * a + v[:, None] * b, -bound, bound)

    def damping(self, state: ControllerState) -> Array:
        """Factor (12,) on the joint controller's derivative gain, which goes with `ControllerState.desired`."""
        xp, c = state.phase.__array_namespace__(), self.config
        factor = 1.0 + (c.stance_damping - 1.0) * _standing(self.phases(state.phase), state.gate)
        return xp.reshape(factor[:, None] + xp.zeros((1, 3), dtype=factor.dtype), (12,))

    def stepping(self, state: ControllerState, command: Array) -> Array:
        """Whether feet that are in swing by their phase move, () bool: with a command, and to the end of the last step.

        command: (2,) unit vector, or 0 to stand.
        """
        xp = command.__array_namespace__()
        told = xp.sum(command * command) > 0.25
        return told | self._unfinished(state) if self.config.finish_step else told

    def _unfinished(self, state: ControllerState) -> Array:
        """Whether feet are off the ground, () bool."""
        xp = state.phase.__array_namespace__()
        return (state.gate > 0) & (xp.max(xp.sin(self.phases(state.phase))) > _DOWN)

    def foot_targets(
        self,
        phases: Array,
        lift: Array,
        stride: Array,
        sensors: Sensors,
        level: Array | None = None,
        gate: Array | None = None,
    ) -> Array:
        """pos^d = [dx + X, dy + Y, dz + Z] of the paper, turned from the horizontal frame into the trunk's.

        Args:
          phases: (4,) rad.
          lift: (4,) m.
          stride: (2,) direction in the heading frame; the step is L times as long.
          sensors: whose roll and pitch are taken out.
          level: (3, 3) `heading_from_trunk` of those, where it is known already.
          gate: () share of the vertical motion; 1 if None.

        Returns:
          (4, 3) m from the abduction joints, trunk frame.
        """
        xp = phases.__array_namespace__()
        c = self.config
        early = path.wrap(phases + 2.0 * math.pi * c.base_frequency * c.lead) if c.lead else phases
        along = path.stride(early, c.retraction, c.swing_share)[:, None] * (c.step_length * stride)
        up = lift * path.height(phases)
        if level is None:
            level = frames.heading_from_trunk(frames.up_in_trunk(sensors.orientation))
        if c.touch_down:
            up = up + c.touch_down * self._sunk(phases, sensors, level, gate)
        motion = xp.concatenate([along, up[:, None]], axis=-1)
        share = c.levelling
        return (share * self.base_foot + motion) @ level + (1.0 - share) * self.base_foot

    def _sunk(self, phases: Array, sensors: Sensors, level: Array, gate: Array | None) -> Array:
        """How much higher (4,) m than below a level trunk's hips feet in swing come down; it fades out early in stance.

        The ground is where the feet in stance are.
        """
        xp = phases.__array_namespace__()
        gate = 1.0 + 0.0 * phases[0] if gate is None else gate
        feet = leg.forward(self.geometry, xp.reshape(sensors.joint_position, (4, 3)))
        heights = ((self.geometry.hip_position + feet) @ level.T)[:, 2]
        ground = load_share(phases, gate) @ heights
        standing = (self.geometry.hip_position @ level.T + self.base_foot)[:, 2]
        sunk = xp.clip(ground - standing, -SUNK, SUNK)
        # Taken up in the first half of swing, given back early in stance: there legs are to push a trunk back.
        u = xp.where(phases > 0, 2.0 * phases, (math.pi + phases) / HANDED_BACK) / math.pi
        share = path.smoothstep(xp.clip(u, 0.0, 1.0))
        return gate * xp.where(phases > 0, share, 1.0 - share) * sunk

    def update_mirror(self, mirror: Array, command: Array) -> Array:
        """+1 for commands to the left, -1 to the right, with hysteresis around straight ahead."""
        xp = command.__array_namespace__()
        if not self.config.mirror:
            return mirror
        return xp.where(command[1] * mirror < -self.config.mirror_hysteresis, -mirror, mirror)

    def mirror_action(self, mirror: Array, action: Array) -> Array:
        """An action (14,) turned into its mirror image where mirror () is -1."""
        xp = action.__array_namespace__()
        index, sign = self._action_mirror
        return xp.where(mirror > 0, action, action[index] * sign)

    def _lift(self, action: Array) -> Array:
        xp, c = action.__array_namespace__(), self.config
        return xp.clip(c.lift + c.lift_range * action, c.lift_min, c.lift_max)

    # Constants are arrays of the same library as the robot's (NumPy), made once: lists would cost a step 30 µs.

    @functools.cached_property
    def _ring_offsets(self) -> Array:
        return self._constant(samples.ring_offsets(self.config.sample_radius))

    @functools.cached_property
    def _patch_offsets(self) -> Array:
        return self._constant(footholds.offsets())

    @functools.cached_property
    def _nudges(self) -> Array:
        """(3, 3) rad, one joint of a leg after the other turned by `NUDGE`."""
        return self._constant([[NUDGE * (i == j) for i in range(3)] for j in range(3)])

    @functools.cached_property
    def _swings(self) -> Array:
        """(2, 4) rad, the gait's phase when each leg lifts off and when it comes down."""
        c, turn = self.config, 2.0 * math.pi
        # A trot with half of the cycle in swing has no moment with all feet down.
        late = _LATE if c.swing_share < path.LONGEST_SWING["trot"] else 0.0
        ends = [
            [end - offset for offset in path.GAITS[c.gait]] for end in (-late, turn * c.swing_share + late)
        ]
        return self._constant([[(x + math.pi) % turn - math.pi for x in row] for row in ends])

    @functools.cached_property
    def _action_mirror(self) -> tuple[Array, Array]:
        index, sign = _mirror_map([("scalar", 2), ("joints", 12)])
        return self.base_foot.__array_namespace__().asarray(index), self._constant(sign)

    @functools.cached_property
    def _observation_mirror(self) -> tuple[Array, Array]:
        kinds: list[tuple[str, int]] = []
        for name, size in self.layout:
            if name == "actions":
                kinds += [("scalar", 2), ("joints", 12)] * ACTION_HISTORY
            elif name == "targets":
                kinds += [("feet", 12)] * TARGET_HISTORY
            else:
                kinds.append((_KIND[name], size))
        index, sign = _mirror_map(kinds)
        return self.base_foot.__array_namespace__().asarray(index), self._constant(sign)

    def _constant(self, values: list[Any]) -> Array:
        return self.base_foot.__array_namespace__().asarray(values, dtype=self.base_foot.dtype)


def load_share(phases: Array, gate: Array) -> Array:
    """Share (4,) of the weight on each leg: even over the legs in stance, handed over smoothly.

    Args:
      phases: (4,) rad.
      gate: () share of the vertical motion.
    """
    stance = _standing(phases, gate)
    return stance / stance.__array_namespace__().sum(stance)


def _standing(phases: Array, gate: Array) -> Array:
    """1 for legs (4,) in stance, 0 in swing, and smoothly from one to the other near the ground."""
    xp = phases.__array_namespace__()
    return 1.0 - gate * xp.minimum(4.0 * path.height(phases), 1.0 + 0.0 * phases)


_KIND = {
    "command": "polar",
    "up": "polar",
    "angular_velocity": "axial",
    "joint_position": "joints",
    "joint_velocity": "joints",
    "frequency": "scalar",
    "phase": "phase",
    "turn": "odd",
    "heights": "heights",
}


def _legwise(points: list[int], signs: tuple[float, ...]) -> tuple[list[int], list[float]]:
    size = len(points)
    index = [other * size + p for other in MIRRORED_LEG for p in points]
    return index, list(signs) * (4 * size // len(signs))


def _mirror_part(kind: str, size: int) -> tuple[list[int], list[float]]:
    """Index and sign that mirror one part of a vector in the trunk's x-z plane."""
    if kind == "polar":
        return list(range(size)), [1.0, -1.0, 1.0][:size]
    if kind == "axial":
        return list(range(size)), [-1.0, 1.0, -1.0][:size]
    if kind == "odd":
        return list(range(size)), [-1.0] * size
    if kind == "phase":  # LF's mirror image is RF, half a cycle away: sine and cosine change sign
        return list(range(size)), [-1.0] * size
    if kind == "joints":
        return _legwise([0, 1, 2], (-1.0, 1.0, 1.0))
    if kind == "feet":
        return _legwise([0, 1, 2], (1.0, -1.0, 1.0))
    if kind == "heights":
        return _legwise(samples.mirrored_points(), (1.0,))
    return list(range(size)), [1.0] * size


def _mirror_map(kinds: list[tuple[str, int]]) -> tuple[list[int], list[float]]:
    index: list[int] = []
    sign: list[float] = []
    for kind, size in kinds:
        part, part_sign = _mirror_part(kind, size)
        index += [len(sign) + i for i in part]
        sign += part_sign
    return index, sign
