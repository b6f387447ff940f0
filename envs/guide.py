"""Where feet in swing had better go: a change of the action that training can imitate. It learns nothing itself.

For each foot in swing, the true ground round the point where the foot will come down is searched for the nearest place
without a gap; the guide asks for a share of the way there, by inverse kinematics. The policy-gradient finds out only by
trial which of twelve joint angles would have saved a footstep; this tells it (`ppo.guide` is the weight).
"""

from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env, State, Wrapper

import tg
from envs.env import QuadrupedEnv, exact_sensors
from envs.types import Episode

CELL = 0.02
"""Spacing (m) of the points whose heights are compared."""
REACH = 5
"""A foot can be sent this many cells to each side of where it will come down."""
GAIN = 0.3
"""Share of the way that one step asks for."""
LIMIT = 0.12
"""Displacement (m) of a foot from the trajectory generator's path, forwards or sideways, beyond which it isn't sent."""
SHORTER, CLOSER, OUTSIDE = 1.0, 0.3, 10.0
"""What a metre of the way costs, one from the trajectory generator's path, and one beyond LIMIT; a place that is
nothing but gap costs 1."""
LIFTING = 0.3
"""Phase (rad) of swing up to which a foot isn't sent anywhere."""


def places() -> np.ndarray:
    """((2 REACH + 1)^2, 2) m, where a foot may be sent from its landing point."""
    axis = np.arange(-REACH, REACH + 1) * CELL
    return np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)


def ways(env: QuadrupedEnv, episode: Episode) -> jax.Array:
    """From where each foot will come down to the best place near it: (L, 2) m, heading frame; zero in stance."""
    axis = np.arange(-REACH - 1, REACH + 2) * CELL
    patch = jnp.asarray(np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1), jnp.float32)
    heights = env._heights(episode, env.landing_points(episode)[:, None, None] + patch)  # (L, N + 2, N + 2)
    # A place is as good as the nine points on and around it.
    highest = jnp.max(heights, axis=(1, 2), keepdims=True)
    low = (highest - heights > env.config.rewards.gap_threshold).astype(jnp.float32)
    n = 2 * REACH + 1
    near = jnp.stack([low[:, i : i + n, j : j + n] for i in range(3) for j in range(3)])
    gaps = jnp.mean(near, axis=0).reshape(4, -1)
    displacement = env.core.residual_displacement(episode.controller, exact_sensors(episode))
    moved = displacement[:, None, :2] + places()
    beyond = jnp.maximum(jnp.max(jnp.abs(moved), axis=-1) - LIMIT, 0.0)
    cost = gaps + SHORTER * np.linalg.norm(places(), axis=-1) + CLOSER * jnp.linalg.norm(moved, axis=-1)
    cost = cost + OUTSIDE * beyond
    best = jnp.asarray(places(), jnp.float32)[jnp.argmin(cost, axis=1)]
    # Where nothing is wrong with the ground, nothing is to be changed.
    best = jnp.where((jnp.max(gaps, axis=1) > 0.0)[:, None], best, 0.0)
    swing = tg.path.leg_phases(episode.controller.phase) > LIFTING
    walking = jnp.sum(jnp.square(episode.command)) > 0.5
    return jnp.where((swing & walking)[:, None], best, 0.0)


def change(env: QuadrupedEnv, episode: Episode, target: jax.Array, shift: jax.Array) -> jax.Array:
    """Change of the action (14,) that moves the feet from `target` (L, 3) m in the trunk by `shift` (L, 2) m, level."""
    core, up = env.core, tg.frames.up_in_trunk(exact_sensors(episode).orientation)
    moved = target + jnp.pad(shift, ((0, 0), (0, 1))) @ tg.frames.heading_from_trunk(up)
    angles = tg.leg.inverse(core.geometry, moved) - tg.leg.inverse(core.geometry, target)
    residual = (angles / core.config.residual_range).reshape(-1)
    mirror = core.update_mirror(episode.controller.mirror, env.heading_command(episode))
    return core.mirror_action(mirror, jnp.concatenate([jnp.zeros(2), residual]))


def guide(env: QuadrupedEnv, episode: Episode) -> jax.Array:
    """Change of the action (14,) that moves feet in swing a share of the way to better ground."""
    return change(env, episode, episode.controller.targets[0].reshape(4, 3), GAIN * ways(env, episode))


class Guided(Wrapper):
    """An environment whose state's info has, as 'guide' (14,), what the guide would change of the next action."""

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
