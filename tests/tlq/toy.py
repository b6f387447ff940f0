"""A small environment with the protocol of `envs.AutoReset(envs.QuadrupedEnv)`, for tests of the learning part.

The state shows a target in {-1, 1} on the first step of an episode only; the reward is for acting like it later, so
that only a policy with a memory earns it.
"""

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State

ACTIONS = 14


class ToyEnv(Env):
    """Single instance, auto-reset inside the step."""

    def __init__(self, proprio: int = 10, heights: int = 100, privileged: int = 20, length: int = 8):
        self.proprio, self.heights, self.privileged, self.length = proprio, heights, privileged, length

    def reset(self, rng):
        inner = self._begin(rng)
        zero = jnp.float32(0)
        metrics = {f"reward/{k}": zero for k in ("match", "effort")} | {"level": zero + 0.5}
        metrics |= {
            f"episode/{k}": zero for k in ("ended", "distance", "length", "fell", "level", "exploded")
        }
        return State(inner, self._observe(inner), zero, zero, metrics, {"truncation": zero})

    def step(self, state, action):
        s = state.pipeline_state
        match = 1 - jnp.mean(jnp.abs(jnp.clip(action, -1, 1)[:1] - s["target"]))
        effort = -0.01 * jnp.mean(action**2)
        length, distance = s["length"] + 1, s["distance"] + match
        key, key_next = jax.random.split(s["key"])
        fell = (jax.random.uniform(key) < 0.05).astype(jnp.float32)
        out_of_time = jnp.where(length >= self.length, 1.0, 0.0)
        done = jnp.maximum(fell, out_of_time)
        inner = {"target": s["target"], "length": length, "distance": distance, "key": key_next}
        inner = jax.tree.map(lambda a, b: jnp.where(done > 0, a, b), self._begin(key_next), inner)
        metrics = dict(state.metrics) | {"reward/match": match, "reward/effort": effort}
        metrics |= {
            "episode/ended": done,
            "episode/distance": distance * done,
            "episode/length": length * done,
            "episode/fell": fell,
            "episode/level": 0.5 * done,
            "episode/exploded": 0 * done,
        }
        return State(
            inner, self._observe(inner), match + effort, done, metrics, {"truncation": done * (1 - fell)}
        )

    def _begin(self, key):
        key, key_target = jax.random.split(key)
        target = jnp.where(jax.random.bernoulli(key_target), 1.0, -1.0)
        return {"target": target, "length": jnp.float32(0), "distance": jnp.float32(0), "key": key}

    def _observe(self, s):
        shown = jnp.where(s["length"] == 0, s["target"], 0.0)
        state = jnp.zeros(self.proprio + self.heights).at[0].set(shown).at[1].set(s["length"])
        return {"state": state, "privileged_state": jnp.zeros(self.privileged).at[0].set(s["target"])}

    observation_size = property(
        lambda self: {"state": self.proprio + self.heights, "privileged_state": self.privileged}
    )
    action_size = property(lambda self: ACTIONS)
    backend = property(lambda self: "mjx")
