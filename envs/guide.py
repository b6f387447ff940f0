"""Where feet in swing had better go, as a wish that training can follow. It learns nothing itself.

For the feet in swing, the true ground round the ends of their steps is searched for places where a foot that lands with
some error hits no gap, and between which the robot keeps its balance; the guide asks that the residual joint angles
lead there, all the way, from early in the swing on. The policy-gradient finds out only by trial which of twelve joint
angles would have saved a footstep; this tells it (`ppo.guide` is the weight). An earlier guide asked for a share of the
way as a change of the policy's own action: that has no fixed point but the ends of the action's range
(docs/experiments.md).
"""

from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State, Wrapper

import tg
from envs.env import QuadrupedEnv, exact_sensors
from envs.types import Episode

CELL = 0.025
"""Spacing (m) of the points whose heights are compared."""
REACH = 5
"""A foot can be sent this many cells to each side of the end of its step."""
ERROR = 0.025
"""Standard deviation (m) of a landing foot from its place, by which the gaps near a place count."""
NEAR = 2
"""Cells to each side of a place that count."""
FARTHER, ANOTHER = 1.0, 2.0
"""What a metre costs from where balance wants the foot, and one from where it is led already; a place that is nothing
but gap costs 1."""
BALANCE = 0.15
"""Seconds of the trunk's excess speed that a foot is placed farther along, as a walking inverted pendulum asks for."""
ACROSS = 6.0
"""What a metre costs by which the line between two feet in swing is moved across, from where balance wants it."""
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
    """((2 REACH + 1)^2, 2) m, where a foot may be sent from the end of its step."""
    axis = np.arange(-REACH, REACH + 1) * CELL
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)


def gap_shares(env: QuadrupedEnv, episode: Episode, ends: jax.Array) -> jax.Array:
    """How much gap (N, places) a foot meets that lands near one of `places`, from the ends (N, 2) m of the steps."""
    axis = np.arange(-REACH - NEAR, REACH + NEAR + 1) * CELL
    patch = jnp.asarray(np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1), jnp.float32)
    heights = env._heights(episode, ends[:, None, None] + patch)
    highest = jnp.max(heights, axis=(1, 2), keepdims=True)
    low = (highest - heights > env.config.rewards.gap_threshold).astype(jnp.float32)
    # A normal distribution is one along x times one along y.
    weights = np.exp(-0.5 * np.square(np.arange(-NEAR, NEAR + 1) * CELL / ERROR))
    n = 2 * REACH + 1
    rows = sum(w * low[:, i : i + n] for i, w in enumerate(weights / weights.sum()))
    shares = sum(w * rows[:, :, i : i + n] for i, w in enumerate(weights / weights.sum()))
    return shares.reshape(len(ends), -1)


def displacements(env: QuadrupedEnv, episode: Episode) -> tuple[jax.Array, jax.Array]:
    """Where the feet had better be led, and whether they are to be led at all.

    Returns:
      Displacement (L, 2) m from the trajectory generator's path, heading frame, and (L,) bool: not in stance, nor where
      the ground has no gap near the end of the step, neither with the foot's displacement so far nor without.
    """
    controller, sensors = episode.controller, exact_sensors(episode)
    phases = tg.path.leg_phases(controller.phase)
    _, legs = jax.lax.top_k(phases, 2)  # a trot has no more in swing
    ends = env.step_ends(episode)[legs]
    gaps = gap_shares(env, episode, ends)
    now = env.core.residual_displacement(controller, sensors)[legs, :2]
    share = tg.path.smoothstep(jnp.clip((phases[legs] - LIFTING) / (ARRIVED - LIFTING), 0.0, 1.0))[:, None]
    now = jnp.clip(now / jnp.maximum(share, FIRST), -REACH * CELL, REACH * CELL)
    away = jnp.linalg.norm(now[:, None] - places(), axis=-1)
    # The mean speed of feet in stance.
    speed = 2.0 * controller.frequency * env.core.config.step_length
    ahead = jnp.clip(BALANCE * (env.velocity(episode) - speed * controller.stride), -AWAY, AWAY)
    far = jnp.linalg.norm(ahead - places(), axis=-1)
    cost = gaps + FARTHER * far + ANOTHER * away
    best = _best_pair(cost, ahead, ends[0] - ends[1])
    here = jnp.take_along_axis(gaps, jnp.argmin(away, axis=1)[:, None], axis=1)[:, 0]
    danger = jnp.maximum(here, gaps[:, len(places()) // 2]) > SAFE
    walking = jnp.sum(jnp.square(episode.command)) > 0.5
    asked = danger & (phases[legs] > LIFTING) & walking
    led = jnp.zeros((4, 2)).at[legs].set(share * best)
    return led, jnp.zeros(4, bool).at[legs].set(asked)


def _best_pair(cost: jax.Array, ahead: jax.Array, line: jax.Array) -> jax.Array:
    """The places (2, 2) m of the two feet that cost least together.

    On two feet a robot topples across the line between them, not along it: what counts is how far the middle of that
    line is moved across, from where balance wants it.

    Args:
      cost: (2, N) of each place for each foot alone.
      ahead: (2,) m, the displacement that balance wants.
      line: (2,) m, between the ends of the two steps.
    """
    least, which = jax.lax.top_k(-cost, CANDIDATES)
    at = jnp.asarray(places(), jnp.float32)[which]
    across = jnp.stack([-line[1], line[0]]) / jnp.maximum(jnp.linalg.norm(line), 0.1)
    off = (at - ahead) @ across
    together = -least[0][:, None] - least[1] + ACROSS * jnp.abs(off[0][:, None] + off[1]) / 2
    first, second = jnp.unravel_index(jnp.argmin(together), together.shape)
    return jnp.stack([at[0, first], at[1, second]])


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
    target = core.foot_targets(tg.path.leg_phases(phase), lift, controller.stride, sensors)
    return target, tg.frames.heading_from_trunk(tg.frames.up_in_trunk(sensors.orientation))


def guide(env: QuadrupedEnv, episode: Episode) -> jax.Array:
    """The guide's wish for the next action: (L, 2, 4), zero where it has none.

    Of leg l, [:, :3] is how far (m) its residual actions move the foot, forwards and left, and [:, 3] how far they
    should. The leg's height is left to the policy. Legs and sides are the policy's, mirrored if its observation is.
    """
    led, asked = displacements(env, episode)
    target, level = _target(env, episode)
    # Half way there the slope is that of the whole way.
    half = tg.leg.inverse(env.core.geometry, target + 0.5 * jnp.pad(led, ((0, 0), (0, 1))) @ level)

    def feet(angles: jax.Array) -> jax.Array:
        return tg.leg.forward(env.core.geometry, angles) @ level.T

    def turned(joint: int) -> jax.Array:
        return jax.jvp(feet, (half,), (jnp.zeros_like(half).at[:, joint].set(1.0),))[1]

    slope = env.core.config.residual_range * jnp.stack([turned(j) for j in range(3)], axis=-1)[:, :2]
    wish = jnp.where(asked[:, None, None], jnp.concatenate([slope, led[..., None]], axis=-1), 0.0)
    mirror = env.core.update_mirror(episode.controller.mirror, env.heading_command(episode))
    # In the mirror left is right, and the abduction joints turn the other way.
    other = wish[jnp.array([1, 0, 3, 2])] * jnp.asarray([[-1.0, 1.0, 1.0, 1.0], [1.0, -1.0, -1.0, -1.0]])
    return jnp.where(mirror > 0, wish, other)


class Guided(Wrapper):
    """An environment whose state's info has, as 'guide' (L, 2, 4), the guide's wish for the next action."""

    def __init__(self, env: Env):
        super().__init__(env)

    def _with_guide(self, state: State) -> State:
        env = cast(QuadrupedEnv, self.env.unwrapped)
        return state.replace(info=state.info | {"guide": guide(env, state.pipeline_state)})

    def reset(self, key: jax.Array) -> State:
        """As the environment's."""
        return self._with_guide(self.env.reset(key))

    def step(self, state: State, action: jax.Array) -> State:
        """As the environment's."""
        return self._with_guide(self.env.step(state, action))
