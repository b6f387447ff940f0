"""Many robots under an exported policy in MJX at once: the environment of training, without its randomness.

Letters: B episodes.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
import terrains
import tg
from envs.env import exact_sensors
from tlq import judge
from tlq.runtime import Policy

CHUNK = 250
"""Control steps between two reports."""


def evaluation_config(
    config: envs.EnvConfig, terrain: terrains.TerrainConfig, difficulty: float, noise: bool
):
    """The environment of training made exact: one difficulty, true pits, no end but a fall, no time limit.

    With `noise`, sensors and map keep their errors; robot and friction are nominal, and nothing pushes.
    """
    friction = config.robot.foot_friction
    randomisation = dataclasses.replace(
        config.randomisation,
        enabled=noise,
        friction=(friction, friction),
        payload=(0.0, 0.0),
        gain=(1.0, 1.0),
        latency=(0.0, 0.0),
        push_speed=0.0,
    )
    ladder = envs.CurriculumConfig(
        enabled=False, difficulty=(difficulty,), depth=(10.0,), start=0, revisit=0.0
    )
    return dataclasses.replace(
        config,
        terrain=terrain,
        randomisation=randomisation,
        curriculum=ladder,
        episode_time=1e6,
        stand_share=0.0,
        stop_share=0.0,
        spawn_yaw=0.0,
        spawn_offset=0.0,
        end_in_gap=False,
        solver_iterations=max(config.solver_iterations, envs.EVALUATION_ITERATIONS),
    )


def walk(
    policy: Policy,
    env: envs.QuadrupedEnv,
    directions: np.ndarray,
    phases: np.ndarray,
    *,
    seed: int = 0,
    report: Callable[[judge.Tally], None] = lambda tally: None,
) -> judge.Tally:
    """Walks every episode to its end, episode k on terrain k of the environment's bank.

    Args:
      policy: to run, by its mode.
      env: of `evaluation_config`, with B terrains.
      directions: (B, 2) unit vectors, world.
      phases: (B,) rad, where in their cycle the gaits start.
      seed: of the noise.
      report: called now and then with what has been reached.

    Returns:
      What the episodes came to, each leaf (B, ...), NumPy.
    """
    keys = jax.random.split(jax.random.PRNGKey(seed), len(directions))
    index, towards = jnp.arange(len(directions)), jnp.asarray(directions, jnp.float32)
    with jax.default_matmul_precision("highest"):
        start = jax.jit(jax.vmap(functools.partial(_begin, env)))
        state = start(keys, index, towards, jnp.asarray(phases, jnp.float32))
        tally = jax.jit(jax.vmap(lambda s: judge.begin(_moment(env, s.pipeline_state))))(state)
        memory = jnp.zeros((len(directions), policy.memory_size))
        step = jax.vmap(functools.partial(_step, policy, env))

        @jax.jit
        def chunk(carry):
            return jax.lax.scan(lambda carry, _: (step(*carry), None), carry, length=CHUNK)[0]

        while True:
            state, memory, tally = chunk((state, memory, tally))
            found = jax.tree.map(np.asarray, tally)
            report(found)
            if np.all(found.ended != judge.RUNNING):
                return found


def _begin(
    env: envs.QuadrupedEnv, key: jax.Array, k: jax.Array, direction: jax.Array, phase: jax.Array
) -> Any:
    """The environment's state with the robot on terrain k, yaw 0, told to walk in a direction (2,)."""
    state = env.reset(key)
    episode: envs.Episode = state.pipeline_state
    ground = terrains.height(env.bank, k, jnp.zeros(2))
    standing = jnp.asarray(env.standing, jnp.float32)
    episode = dataclasses.replace(
        episode,
        qpos=standing.at[2].add(ground),
        controller=env.core.initial_state(phase),
        terrain=k,
        floor=env.bank.floor[k],
        command=direction,
        origin=jnp.zeros(2),
        lift_off=jnp.zeros(4) + ground,
    )
    return state.replace(pipeline_state=episode)


def _step(
    policy: Policy, env: envs.QuadrupedEnv, state: Any, memory: jax.Array, tally: judge.Tally
) -> tuple[Any, jax.Array, judge.Tally]:
    """One control step of one episode; one that has ended stays as it is."""
    observation = env.observe(state.pipeline_state)["state"]
    action, after_memory = policy.graph(observation, memory)
    after = env.advance(state, action)
    episode: envs.Episode = after.pipeline_state
    fell = (after.done > 0) & (after.info["truncation"] == 0)
    moment = _moment(env, episode)._replace(fell=fell)
    after_tally = judge.update(tally, moment, episode.origin, episode.command, env.dt)
    running = tally.ended == judge.RUNNING
    new, old = (after, after_memory, after_tally), (state, memory, tally)
    return jax.tree.map(lambda a, b: jnp.where(running, a, b), new, old)


def _moment(env: envs.QuadrupedEnv, episode: envs.Episode) -> judge.Moment:
    """The episode's present state, as the judge sees it; work is taken from the last substep."""
    feet = env.core.feet(exact_sensors(episode))
    yaw = tg.frames.yaw(episode.qpos[3:7])
    points = episode.qpos[:2] + tg.frames.turn(yaw, env.core.around(feet))
    power = jnp.sum(jnp.abs(episode.torque * episode.qvel[6:]))
    return judge.Moment(
        position=episode.qpos[:2],
        yaw=yaw,
        phases=env.core.phases(episode.controller.phase),
        feet=feet[:, 2] + episode.qpos[2],
        ground=terrains.height(env.bank, episode.terrain, points),
        work=power * env.dt,
        fell=jnp.zeros((), bool),
    )
