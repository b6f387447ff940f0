"""Resets within the step, for training."""

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper

from envs.env import QuadrupedEnv


class AutoReset(Wrapper):
    """Starts a new episode in the step that ends one: new terrain of the same kind, new command, phase, level.

    Unlike Brax's wrapper it restores everything an episode has, draws it anew, and computes one observation instead of
    two: the reset happens before the observation. The step that ends an episode has `done` 1.
    """

    env: QuadrupedEnv

    def __init__(self, env: Env):
        super().__init__(env)

    def reset(self, key: jax.Array) -> State:
        """As the environment's."""
        return self.env.reset(key)

    def step(self, state: State, action: jax.Array) -> State:
        """As the environment's, and on to the next episode when one ends."""
        state = self.env.advance(state, action)
        ended = state.pipeline_state
        done = state.done > 0
        fell = done & (state.info["truncation"] == 0)
        level = jnp.where(done, self.env.next_level(ended, state.info["level"], fell), state.info["level"])
        # The next step's key may be NaN-free even if the physics exploded: it doesn't depend on it.
        fresh = self.env.begin(jax.random.fold_in(ended.key, 3), level, ended.terrain)
        episode = jax.tree.map(lambda new, old: jnp.where(done, new, old), fresh, ended)
        return state.replace(
            pipeline_state=episode, obs=self.env.observe(episode), info=state.info | {"level": level}
        )
