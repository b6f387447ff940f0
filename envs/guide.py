"""Where feet in swing had better go, as a cost of actions that training can lower. It learns nothing itself.

For the feet in swing, the true ground round the ends of their steps is searched for gaps. What an action costs is how
much gap the feet would meet where its residual joint angles lead them, if they land with some error, and how far that
is from where the robot keeps its balance. The policy-gradient finds out only by trial which of twelve joint angles
would have saved a footstep; this tells it, by its slope (`ppo.guide` is the weight). Imitating the best places instead
was tried: which one is best is ambiguous, and the mean of two poles is a gap (docs/experiments.md).
"""

import functools
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State, Wrapper

import tg
from envs.env import QuadrupedEnv, exact_sensors
from envs.types import Episode

CELL = 0.025
"""Spacing (m) of the points whose heights are compared."""
REACH = 7
"""A foot can be sent this many cells to each side of the end of its step."""
ERROR = 0.025
"""Standard deviation (m) of a landing foot from its place, by which the gaps near a place count."""
SIDE = 2 * REACH + 1
"""Places along one axis."""
NEAR = 2
"""Cells to each side of a place that count."""
FARTHER, ANOTHER = 1.0, 2.0
"""What a metre costs from where balance wants the foot, and one from where it is led already; to the reflex a place
that is nothing but gap costs 1."""
FAR = 0.17
"""So far (m) from where balance wants the foot costs 1, and goes with the square: wide steps aside upset the trunk, and
feet come down beside their places."""
GAP = 3.0
"""What it costs to lead a foot to nothing but gap. Robots have balance to spare, but not one footstep."""
LACKING = 20.0
"""What a metre to the nearest place with less gap than ground adds to a share of gap: in the middle of a wide gap the
share is 1 all round and says nothing of where the ground is."""
BALANCE = 0.15
"""Seconds of the trunk's excess speed that a foot is placed farther along, as a walking inverted pendulum asks for."""
ACROSS = 6.0
"""What a metre costs by which the line between two feet in swing is moved across, from where balance wants it."""
BEYOND = 10.0
"""What a metre costs by which a foot is led beyond the places that were looked at."""
HOLD, HELD = 0.5, 0.05
"""What it costs to lead a foot in stance by HELD (m) from where it was led when it came down; with the distance
squared. A foot that is let go pushes the trunk by as much as it was led aside."""
ALWAYS, IDLE = 0.05, 1.0
"""What it costs to move a leg's joints by the whole range of residual angles from where the rest of the policy would
have them, with the square; and beyond, where the guide asks for nothing. That holds for asked legs, too: how long a leg
in stance is keeps the balance, which the guide knows nothing of."""
STEADY = 0.06
"""Changing the place that a foot in swing is led to by that many metres from one step to the next costs 1, and with the
square of it: a foot follows its joints' targets late, so where those still move about it comes down beside them."""
LED = 0.02
"""Displacement (m) from which on a foot is held altogether."""
SETTLED = 2
"""Control steps after which a foot has come down: it goes on for some millimetres at first."""
SMOOTHING = 0.3
"""Share of each step's displacement in the one that is held: actions are noisy while a policy learns."""
CANDIDATES = 16
"""Places of each foot, the best ones alone, of which the best pair is taken."""
AWAY = 0.1
"""Largest displacement (m) for balance."""
SAFE = 0.02
"""Share of gap up to which a place is left alone."""
LIFTING = 0.3
"""Phase (rad) of swing up to which a foot isn't sent anywhere."""
FIRST = 0.3
"""Share from which where a foot is led already tells of where it will be led: before, it is mostly noise."""
ARRIVED = 1.5
"""Phase (rad) from which it is led all the way to its place; a share of it before: joints that jump upset the trunk."""


def places() -> np.ndarray:
    """(SIDE^2, 2) m, where a foot may be sent from the end of its step."""
    return _square(REACH).reshape(-1, 2)


def _square(reach: int) -> np.ndarray:
    """(2 reach + 1, 2 reach + 1, 2) m, cells round the end of a step."""
    axis = np.arange(-reach, reach + 1) * CELL
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1)


def gap_shares(env: QuadrupedEnv, episode: Episode, ends: jax.Array) -> jax.Array:
    """How much gap (N, SIDE, SIDE) a foot meets that lands near one of `places`, from the ends (N, 2) m of N steps."""
    patch = jnp.asarray(_square(REACH + NEAR), jnp.float32)
    heights = env._heights(episode, ends[:, None, None] + patch)
    highest = jnp.max(heights, axis=(1, 2), keepdims=True)
    low = (highest - heights > env.config.rewards.gap_threshold).astype(jnp.float32)
    # A normal distribution is one along x times one along y.
    weights = np.exp(-0.5 * np.square(np.arange(-NEAR, NEAR + 1) * CELL / ERROR))
    weights /= weights.sum()
    rows = sum(w * low[:, i : i + SIDE] for i, w in enumerate(weights))
    return sum(w * rows[:, :, i : i + SIDE] for i, w in enumerate(weights))


def lacking(gaps: jax.Array) -> jax.Array:
    """(N, SIDE, SIDE) m, from each of `places` to the nearest with a share of gap (N, SIDE, SIDE) below one half; no
    more than a cell beyond REACH.
    """
    far = (REACH + 1) ** 2
    squares = jnp.where(gaps < 0.5, 0.0, jnp.float32(far))
    # The square of a distance is one along x and one along y. On a CPU shifts take a quarter of a table's time.
    for axis in (1, 2):
        beside = [(REACH, REACH) if a == axis else (0, 0) for a in range(3)]
        padded = jnp.pad(squares, beside, constant_values=far)
        shifted = [
            jax.lax.slice_in_dim(padded, i, i + SIDE, axis=axis) + (i - REACH) ** 2 for i in range(SIDE)
        ]
        squares = functools.reduce(jnp.minimum, shifted)
    return CELL * jnp.sqrt(squares)


class Steps(NamedTuple):
    """The two feet farthest into their swing, and the ground where they may land. Heading frame."""

    legs: jax.Array
    """(2,) int32."""
    ends: jax.Array
    """(2, 2) m from the trunk's centre, where the trajectory generator leads them."""
    share: jax.Array
    """(2,) of the way to a foothold that a foot should be led by now."""
    now: jax.Array
    """(2, 2) m, where they are led already, from `ends`, made up for what `share` holds back."""
    gaps: jax.Array
    """(2, SIDE, SIDE) share of gap that a foot meets that lands near one of `places`, and LACKING times what it lacks
    to ground."""
    ahead: jax.Array
    """(2,) m, the displacement that balance asks for."""
    asked: jax.Array
    """(2,) bool: in swing, and a gap near the end of the step or near where they are led."""


def steps(env: QuadrupedEnv, episode: Episode) -> Steps:
    """The steps that an episode's feet are about to end."""
    controller, sensors = episode.controller, exact_sensors(episode)
    phases = env.core.phases(controller.phase)
    _, legs = jax.lax.top_k(phases, 2)  # no gait has more in swing
    ends = env.step_ends(episode)[legs]
    gaps = gap_shares(env, episode, ends)
    gaps += LACKING * lacking(gaps)
    share = tg.path.smoothstep(jnp.clip((phases[legs] - LIFTING) / (ARRIVED - LIFTING), 0.0, 1.0))
    now = env.core.residual_displacement(controller, sensors)[legs, :2] / jnp.maximum(share, FIRST)[:, None]
    now = jnp.clip(now, -REACH * CELL, REACH * CELL)
    # The mean speed of feet in stance.
    speed = env.core.stance_speed(controller.frequency)
    ahead = jnp.clip(BALANCE * (env.velocity(episode) - speed * controller.stride), -AWAY, AWAY)
    danger = jnp.maximum(between(gaps, now), gaps[:, REACH, REACH]) > SAFE
    stepping = env.stepping(episode)
    return Steps(legs, ends, share, now, gaps, ahead, danger & (phases[legs] > LIFTING) & stepping)


def between(gaps: jax.Array, displacement: jax.Array) -> jax.Array:
    """Bilinear value (...) at displacements (..., 2) m, of a map (..., SIDE, SIDE); at its rim beyond it."""
    at = jnp.clip(
        displacement / CELL + REACH, 0.0, SIDE - 1.001
    )  # short of the last cell, which has no next one
    low = jnp.floor(at).astype(jnp.int32)
    x, y = jnp.moveaxis(at - low, -1, 0)
    flat = gaps.reshape(*gaps.shape[:-2], SIDE * SIDE)
    corner = low[..., 0] * SIDE + low[..., 1]

    def value(step: int) -> jax.Array:
        return jnp.take_along_axis(flat, corner[..., None] + step, axis=-1)[..., 0]

    return (1 - x) * ((1 - y) * value(0) + y * value(1)) + x * ((1 - y) * value(SIDE) + y * value(SIDE + 1))


def displacements(env: QuadrupedEnv, episode: Episode) -> tuple[jax.Array, jax.Array]:
    """The best places for the feet, which a reflex leads them to (`benchmarks.footholds`).

    Returns:
      Displacement (L, 2) m from the trajectory generator's path, heading frame, and (L,) bool: not in stance, nor where
      the ground has no gap near the end of the step, neither with the foot's displacement so far nor without.
    """
    s = steps(env, episode)
    away = jnp.linalg.norm(s.now[:, None] - places(), axis=-1)
    far = jnp.linalg.norm(s.ahead - places(), axis=-1)
    cost = s.gaps.reshape(2, -1) + jnp.square(far / FAR) + FARTHER * far + ANOTHER * away
    together = jnp.all(env.core.phases(episode.controller.phase)[s.legs] > 0)
    best = _best_pair(cost, s.ahead, s.ends[0] - s.ends[1], jnp.where(together, ACROSS, 0.0))
    led = jnp.zeros((4, 2)).at[s.legs].set(s.share[:, None] * best)
    return led, jnp.zeros(4, bool).at[s.legs].set(s.asked)


def _best_pair(
    cost: jax.Array, ahead: jax.Array, line: jax.Array, across: jax.Array | float = ACROSS
) -> jax.Array:
    """The places (2, 2) m of the two feet that cost least together.

    On two feet a robot topples across the line between them, not along it: what counts is how far the middle of that
    line is moved across, from where balance wants it.

    Args:
      cost: (2, N) of each place for each foot alone.
      ahead: (2,) m, the displacement that balance wants.
      line: (2,) m, between the ends of the two steps.
      across: what it costs to move the middle of that line across by a metre; 0 if one of the feet isn't in swing.
    """
    least, which = jax.lax.top_k(-cost, CANDIDATES)
    at = jnp.asarray(places(), jnp.float32)[which]
    off = (at - ahead) @ _across(line)
    together = -least[0][:, None] - least[1] + across * jnp.abs(off[0][:, None] + off[1]) / 2
    first, second = jnp.unravel_index(jnp.argmin(together), together.shape)
    return jnp.stack([at[0, first], at[1, second]])


def _across(line: jax.Array) -> jax.Array:
    """Unit vector (2,) across a line (2,) m."""
    return jnp.stack([-line[1], line[0]]) / jnp.maximum(jnp.linalg.norm(line), 0.1)


def residuals(env: QuadrupedEnv, episode: Episode, displacement: jax.Array) -> jax.Array:
    """Residual actions (L, 3) that lead the feet past the coming step's path by `displacement` (L, 2) m, level."""
    target, level = _target(env, episode)
    moved = target + jnp.pad(displacement, ((0, 0), (0, 1))) @ level
    geometry = env.core.geometry
    return (
        tg.leg.inverse(geometry, moved) - tg.leg.inverse(geometry, target)
    ) / env.core.config.residual_range


def _target(env: QuadrupedEnv, episode: Episode) -> tuple[jax.Array, jax.Array]:
    """The trajectory generator's next foot targets (L, 3) m, trunk frame, and (3, 3) `heading_from_trunk`."""
    core, controller, sensors = env.core, episode.controller, exact_sensors(episode)
    phase = tg.path.advance(controller.phase, controller.frequency, core.dt)
    lift = controller.lift * controller.gate
    phases = core.phases(phase)
    target = core.foot_targets(phases, lift, controller.stride, sensors, gate=controller.gate)
    return target, tg.frames.heading_from_trunk(tg.frames.up_in_trunk(sensors.orientation))


class Guidance(NamedTuple):
    """What `cost` reads. Legs and sides are the policy's, mirrored if its observation is."""

    lead: jax.Array
    """(4, 2, 4) m: residual actions (3,) of a leg move its foot by lead[:, :3] @ residual + lead[:, 3], forwards and
    left. The height is left to the policy."""
    legs: jax.Array
    """(2,) int32, the feet in swing that the rest is about, but for the last two."""
    gaps: jax.Array
    """(2, SIDE, SIDE) float16, as in `Steps`."""
    ahead: jax.Array
    """(2,) m, the displacement that balance asks for."""
    across: jax.Array
    """(2,) unit vector across the line between the two steps' ends."""
    weight: jax.Array
    """(2,) how much each foot counts, 0 where it had better be left alone."""
    held: jax.Array
    """(4, 2) m, where feet in stance were led when they came down."""
    hold: jax.Array
    """(4,) how much that counts, 0 in swing."""
    last: jax.Array
    """(2, 2) m, where the last action would lead the two feet in swing."""
    error: jax.Array
    """(2, 2) m, how far from where they are led at last they come down; see `with_errors`."""
    known: jax.Array
    """(2,) 0 for feet that nothing is said of where they had better be led."""
    mirror: jax.Array
    """(), -1 if all this is mirrored."""


def guide(env: QuadrupedEnv, episode: Episode, held: jax.Array) -> Guidance:
    """What there is to say about the next action's footholds.

    held: (4, 2) m, of `Guided`.
    """
    s, controller = steps(env, episode), episode.controller
    stance = env.core.phases(controller.phase) <= 0
    lead, last = _lead(env, episode)
    own = Guidance(
        lead=lead,
        legs=s.legs.astype(jnp.int32),
        gaps=s.gaps.astype(jnp.float16),
        ahead=s.ahead,
        across=_across(s.ends[0] - s.ends[1]),
        weight=jnp.where(s.asked, s.share, 0.0),
        held=held,
        hold=jnp.where(stance, jnp.clip(jnp.linalg.norm(held, axis=-1) / LED, 0.0, 1.0), 0.0),
        last=last[s.legs],
        error=jnp.zeros((2, 2)),
        known=jnp.ones(2),
        mirror=jnp.float32(1.0),
    )
    mirror = env.core.update_mirror(controller.mirror, env.heading_command(episode))
    return jax.tree.map(lambda mine, other: jnp.where(mirror > 0, mine, other), own, _mirrored(own))


def _lead(env: QuadrupedEnv, episode: Episode) -> tuple[jax.Array, jax.Array]:
    """`Guidance.lead` (4, 2, 4) of the robot's own sides, and where the last action would lead the feet (4, 2) m.

    Round the last action: the next doesn't differ by much.
    """
    core, (target, level) = env.core, _target(env, episode)
    standing = tg.leg.inverse(core.geometry, target)

    def feet(action: jax.Array) -> jax.Array:
        reached = tg.leg.forward(core.geometry, standing + core.config.residual_range * action)
        return ((reached - target) @ level.T)[:, :2]

    last = episode.controller.actions[0][2:].reshape(4, 3)
    moved, change = jax.linearize(feet, last)
    slope = jnp.stack([change(jnp.zeros((4, 3)).at[:, joint].set(1.0)) for joint in range(3)], axis=-1)
    rest = moved - jnp.einsum("lij,lj->li", slope, last)
    return jnp.concatenate([slope, rest[..., None]], axis=-1), moved


def _mirrored(guidance: Guidance) -> Guidance:
    """In the mirror left is right, and the abduction joints turn the other way."""
    side, swapped = jnp.array([1.0, -1.0]), jnp.array(tg.core.MIRRORED_LEG, jnp.int32)
    return Guidance(
        lead=guidance.lead[swapped] * jnp.array([[-1.0, 1.0, 1.0, 1.0], [1.0, -1.0, -1.0, -1.0]]),
        legs=swapped[guidance.legs],
        gaps=guidance.gaps[:, :, ::-1],
        ahead=guidance.ahead * side,
        across=guidance.across * side,
        weight=guidance.weight,
        held=guidance.held[swapped] * side,
        hold=guidance.hold[swapped],
        last=guidance.last * side,
        error=guidance.error * side,
        known=guidance.known,
        mirror=-guidance.mirror,
    )


def with_errors(guidance: Guidance, error: jax.Array, known: jax.Array) -> Guidance:
    """What the guide says with hindsight: it reckons with the error with which each foot came down.

    Joints follow late, legs give way under load and the trunk moves: feet come down centimetres beside the place to
    which they were led, in part always to the same side. What is taught then leaves room for all that, as far as the
    policy can't know it, and makes up for it as far as it can.

    Args:
      guidance: of an episode's step.
      error: (4, 2) m, how far from where they were led the feet came down next, heading frame, the robot's own sides.
      known: (4,) whether that is known.
    """
    swapped = jnp.array(tg.core.MIRRORED_LEG, jnp.int32)
    own = jnp.where(guidance.mirror > 0, guidance.legs, swapped[guidance.legs])
    side = jnp.stack([jnp.ones_like(guidance.mirror), guidance.mirror])
    return guidance._replace(error=error[own] * side, known=known[own].astype(jnp.float32))


def next_errors(missed: jax.Array, landed: jax.Array, done: jax.Array) -> tuple[jax.Array, jax.Array]:
    """For each of T steps the errors with which the feet come down next, and whether they do.

    Args:
      missed: (T, ..., 4, 2) m, errors of the feet that came down in a step.
      landed: (T, ..., 4) whether they did.
      done: (T, ...) whether the episode ended with the step.

    Returns:
      (T, ..., 4, 2) m and (T, ..., 4) of the landings in that step or later.
    """

    def back(later: tuple[jax.Array, jax.Array], now: tuple[jax.Array, ...]) -> tuple[Any, Any]:
        error, known = later
        missed, landed, done = now
        known = known & (done[..., None] == 0)
        error = jnp.where(landed[..., None], missed, error)
        return ((error, known | landed),) * 2

    nothing = jnp.zeros_like(missed[0]), jnp.zeros(landed.shape[1:], bool)
    return jax.lax.scan(back, nothing, (missed, landed, done), reverse=True)[1]


def cost(guidance: Guidance, action: jax.Array) -> jax.Array:
    """What the footholds cost (...) to which actions (..., 14) lead: gaps, imbalance, feet let go or led elsewhere.

    To be lowered by its slope: of several places an action slides into the nearest. The mean of the best places, which
    imitation ends at where they are ambiguous, may be a gap.
    """
    residual = action[..., 2:].reshape(*action.shape[:-1], 4, 1, 3)
    feet = jnp.sum(guidance.lead[..., :3] * residual, axis=-1) + guidance.lead[..., 3]
    let_go = jnp.sum(guidance.hold * jnp.sum(jnp.square((feet - guidance.held) / HELD), axis=-1), axis=-1)
    led = jnp.take_along_axis(feet, guidance.legs[..., None], axis=-2)
    beyond = jnp.sum(jnp.maximum(jnp.abs(led) - REACH * CELL, 0.0), axis=-1)
    off = led - guidance.ahead[..., None, :]
    far = jnp.sqrt(jnp.sum(jnp.square(off), axis=-1) + 1e-6)  # a slope at 0, too
    moved = jnp.sum(jnp.square((led - guidance.last) / STEADY), axis=-1)
    gap = between(guidance.gaps.astype(jnp.float32), led + guidance.error)
    each = GAP * gap + jnp.square(far / FAR) + FARTHER * far + BEYOND * beyond + moved
    middle = jnp.abs(jnp.sum(jnp.mean(off, axis=-2) * guidance.across, axis=-1))
    weight = guidance.weight * guidance.known
    both = jnp.min(weight, axis=-1)
    return jnp.sum(weight * each, axis=-1) + both * ACROSS * middle + HOLD * let_go


def idle(guidance: Guidance, added: jax.Array) -> jax.Array:
    """What it costs (...) that footholds add (..., 12) before tanh to residuals of legs which had better be left alone,
    and to add any more than it takes: lifting a foot leads it nowhere.
    """
    squares = jnp.sum(jnp.square(added.reshape(*added.shape[:-1], 4, 3)), axis=-1)
    swing = jnp.sum(guidance.weight[..., None] * (guidance.legs[..., None] == jnp.arange(4)), axis=-2)
    asked = jnp.maximum(guidance.hold, swing)
    return jnp.sum((ALWAYS + IDLE * (1.0 - asked)) * squares, axis=-1)


class Landings(NamedTuple):
    """How the feet come down, as `Guided` follows them. L = 4 legs."""

    led: jax.Array
    """(L, 2) m, world: the place to which a foot in swing is led, in stance to which it was led last."""
    stood: jax.Array
    """(L,) int32, control steps since it came down; 0 in swing."""
    landed: jax.Array
    """(L,) bool, whether it has come down now (`SETTLED`)."""
    missed: jax.Array
    """(L, 2) m, heading frame, from where it was led to where it is; of use where it has come down now."""


class Guided(Wrapper):
    """An environment with a method `guidance`, which says what the guide thinks of the next action.

    Its state's info has, as 'held' (4, 2) m, heading frame, where the feet are led by residual joint angles, smoothed;
    in stance, where they were led when they came down. And `Landings` as 'landings'.
    """

    def __init__(self, env: Env):
        super().__init__(env)

    def guidance(self, state: State) -> Guidance:
        """Of a state's next action."""
        return guide(cast(QuadrupedEnv, self.env.unwrapped), state.pipeline_state, state.info["held"])

    def _followed(self, state: State, held: jax.Array, landings: Landings) -> State:
        env = cast(QuadrupedEnv, self.env.unwrapped)
        episode: Episode = state.pipeline_state
        controller, sensors = episode.controller, exact_sensors(episode)
        now = env.core.residual_displacement(controller, sensors)[:, :2]
        swing = env.core.phases(controller.phase) > 0
        held = jnp.where(swing[:, None], held + SMOOTHING * (now - held), held)
        yaw = tg.frames.yaw(episode.qpos[3:7])
        led = episode.qpos[:2] + tg.frames.turn(yaw, env.step_ends(episode) + now)
        led = jnp.where(swing[:, None], led, landings.led)
        stood = jnp.where(swing, 0, landings.stood + 1)
        feet = episode.qpos[:2] + tg.frames.turn(yaw, env.core.feet(sensors)[:, :2])
        over = state.done > 0
        landings = Landings(
            led=led,
            # Feet of an episode that begins haven't been led anywhere.
            stood=jnp.where(over, SETTLED, stood),
            landed=(stood == SETTLED) & ~over,
            missed=tg.frames.turn(-yaw, feet - led),
        )
        return state.replace(info=state.info | {"held": jnp.where(over, 0.0, held), "landings": landings})

    def reset(self, key: jax.Array) -> State:
        """As the environment's."""
        nothing = Landings(
            jnp.zeros((4, 2)), jnp.full(4, SETTLED, jnp.int32), jnp.zeros(4, bool), jnp.zeros((4, 2))
        )
        return self._followed(self.env.reset(key), jnp.zeros((4, 2)), nothing)

    def step(self, state: State, action: jax.Array) -> State:
        """As the environment's."""
        return self._followed(self.env.step(state, action), state.info["held"], state.info["landings"])
