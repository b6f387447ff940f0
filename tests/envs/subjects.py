"""Environments with their compiled functions, and ways to put a robot somewhere."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import envs
import terrains


def config(randomised=True, **changes):
    """A small map of 24 mixed terrains, two of each level."""
    terrain = terrains.TerrainConfig(kind="mixed", num_terrains=24, half_extent=2.0)
    randomisation = envs.RandomisationConfig(enabled=randomised)
    return dataclasses.replace(
        envs.EnvConfig(terrain=terrain, randomisation=randomisation, stand_share=0.0, stop_share=0.0),
        **changes,
    )


class Subject:
    """An environment; its functions are compiled when they are first called."""

    def __init__(self, config, *, auto_reset=False):
        self.config = config
        self.env = envs.make(config)
        self.auto = envs.AutoReset(self.env) if auto_reset else self.env
        self.reset = jax.jit(self.auto.reset)
        self.step = jax.jit(self.auto.step)
        self.observe = jax.jit(self.env.observe)
        self.begin = jax.jit(self.env.begin)
        self.data = mujoco.MjData(self.env.mj_model)

    @functools.cached_property
    def state(self):
        """After a reset."""
        return self.reset(jax.random.key(1))

    def rollout(self, state, steps, seed=0, scale=0.3):
        """States after each of so many steps with random actions."""
        found = []
        for key in jax.random.split(jax.random.key(seed), steps):
            state = self.step(state, jnp.clip(scale * jax.random.normal(key, (14,)), -1, 1))
            found.append(state)
        return found

    def terrain(self, k):
        """Instance k on the host."""
        c, difficulty = self.config.terrain, self.env.bank.difficulty
        return terrains.make_terrain(c.kind, float(difficulty[k]), c.seed, c, index=int(k))

    def find(self, kind, level):
        """The first instance of a kind whose level is at least this."""
        bank = self.env.bank
        kinds = np.asarray(bank.kind_id) == bank.kinds.index(kind)
        return int(np.flatnonzero(kinds & (np.arange(bank.num_terrains) % self.env.levels >= level))[0])

    def kinematics(self, qpos):
        """MuJoCo's data of a pose (19,)."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.env.mj_model, self.data)
        return self.data


def change(state, **changes):
    """A state with other fields of its episode; their types stay."""
    episode = state.pipeline_state
    return state.replace(pipeline_state=change_episode(episode, **changes))


def change_episode(episode, **changes):
    """An episode with other fields; their types stay."""
    typed = {
        name: jax.tree.map(lambda new, old: jnp.asarray(new, old.dtype), value, getattr(episode, name))
        for name, value in changes.items()
    }
    return episode.replace(**typed)


def standing(env, *, xy=(0.0, 0.0), z=0.0, yaw=0.0, joints=None):
    """qpos (19,) of the robot level at rest, its trunk raised by z (m)."""
    qpos = np.array(env.standing)
    qpos[:2], qpos[2] = xy, qpos[2] + z
    qpos[3:7] = np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)
    if joints is not None:
        qpos[7:] = joints
    return qpos


def cell_centres(bank, xy):
    """The centres (..., 2) m of the heightfield's cells that hold points (..., 2) m."""
    index = np.floor((np.asarray(xy, np.float64) + bank.half_extent) / bank.cell)
    return (index + 0.5) * bank.cell - bank.half_extent
