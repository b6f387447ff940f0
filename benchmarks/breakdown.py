"""Where the time of a training iteration goes: python -m benchmarks.breakdown [terrain=poles] [num_envs=1024] ...

Each part is timed on its own, in turn with the whole iteration, several rounds over; medians are printed as JSON. The
parts overlap a little and leave a little out (the compiler fuses across their borders), so they don't add up exactly.
"""

import json
import os
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import PartitionSpec as P
from mujoco import mjx

import terrains
from envs import physics
from tlq import config as settings
from tlq.training import make_learner

ROUNDS = 5


def parts(config: settings.TrainConfig) -> dict[str, Callable[[], Any]]:
    """Functions to time, by name, on one device."""
    learner = make_learner(config)
    state = learner.init(config.seed)
    for _ in range(3):  # robots that walk rather than all stand
        state, _ = learner.step(state)
    env = learner.env.unwrapped
    episodes = state.env_state.pipeline_state
    steps, batch = config.ppo.unroll, config.num_envs
    action = {"action": jnp.zeros((batch, env.action_size)), "carry": state.env_state.obs["carry"]}
    constants = learner._step_constants

    def env_steps(constants, env_state):
        return jax.lax.scan(
            lambda s, _: (learner._env_step(constants, s, action), None), env_state, None, length=steps
        )[0]

    def flat_contact(centre):
        points = centre[:, None] * jnp.array([1.0, 1.0, 0.0])
        points = jnp.broadcast_to(points, (4, env.config.num_planes, 3))
        return None, jnp.zeros_like(points).at[..., 2].set(1.0), points

    def physics_of(episode):
        data = mjx.make_data(env._model)

        def one(carry, _):
            now = data.replace(qpos=carry[0], qvel=carry[1], qacc_warmstart=carry[2])
            torque = env.config.robot.kp * (env.core.standing_target - carry[0][7:])
            force = jnp.concatenate([jnp.zeros(6), jnp.clip(torque - 0.7 * carry[1][6:], -18.0, 18.0)])
            now = physics.substep(env._model, now, env._planes, env.robot.foot_geom_ids, flat_contact, force)
            return (now.qpos, now.qvel, now.qacc_warmstart), None

        start = (episode.qpos, episode.qvel, episode.warmstart)
        return jax.lax.scan(one, start, None, length=steps * env.substeps)[0]

    def look_ups(bank, episodes):
        def one(total, _):
            def single(episode):
                centre = jnp.tile(episode.qpos[:3], (4, 1)) + total[0] * 1e-9
                found = [
                    terrains.contact(
                        bank, episode.terrain, centre - 0.28 + 0.001 * i, episode.floor, env.config.num_planes
                    )
                    for i in range(env.substeps)
                ]
                points = jnp.tile(centre[None, :, :2], (25, 1, 1)) + jnp.arange(25.0)[:, None, None] * 0.004
                heights = [terrains.height(bank, episode.terrain, points + 0.01 * i) for i in range(3)]
                return sum(jnp.sum(f[0]) for f in found) + sum(jnp.sum(h) for h in heights)

            return total + jnp.sum(jax.vmap(single)(episodes)), None

        return jax.lax.scan(one, jnp.zeros(1), None, length=steps)[0]

    def policy(state):
        def one(obs, key):
            parameters = learner.networks.policy_network.apply(state.normaliser, state.params.policy, obs)
            distribution = learner.networks.parametric_action_distribution
            raw = distribution.sample_no_postprocessing(parameters, key)
            chosen = distribution.postprocess(raw)
            return dict(obs, carry=chosen["carry"], state=obs["state"] + chosen["action"].sum() * 1e-9), None

        return jax.lax.scan(one, state.env_state.obs, jax.random.split(state.key, steps))[0]

    def on_mesh(function):
        return jax.jit(
            jax.shard_map(function, mesh=learner.mesh, in_specs=P(), out_specs=P(), check_vma=False)
        )

    _, rollout, _ = on_mesh(learner._rollout)(constants, state, state.key)
    carry, last = state.env_state.obs["carry"], state.env_state.obs["privileged_state"]
    update = on_mesh(learner._update)
    compiled = {"env": jax.jit(env_steps), "look_ups": jax.jit(look_ups), "policy": jax.jit(policy)}
    walk = jax.jit(jax.vmap(physics_of))
    return {
        "iteration": lambda: learner.step(state),
        "env": lambda: compiled["env"](constants, state.env_state),
        "physics": lambda: walk(episodes),
        "look_ups": lambda: compiled["look_ups"](env.bank, episodes),
        "policy": lambda: compiled["policy"](state),
        "update": lambda: update(state, carry, rollout, last, state.key),
    }


def measure(config: settings.TrainConfig) -> dict[str, Any]:
    """Median seconds of each part, and training steps per second."""
    functions = parts(config)
    times: dict[str, list[float]] = {name: [] for name in functions}
    for function in functions.values():
        jax.block_until_ready(function())
    for _ in range(ROUNDS):
        for name, function in functions.items():
            began = time.perf_counter()
            jax.block_until_ready(function())
            times[name].append(time.perf_counter() - began)
    seconds = {name: statistics.median(values) for name, values in times.items()}
    steps = config.num_envs * config.ppo.unroll
    return {
        "steps_per_second": {"training": steps / seconds["iteration"], "env": steps / seconds["env"]},
        "share_of_iteration": {name: value / seconds["iteration"] for name, value in seconds.items()},
        "seconds": seconds,
    }


def main() -> None:
    """Prints the measurement of the default training on poles, or with other settings as for train.py."""
    config = settings.default_config()
    for key, value in {"terrain": "poles", **dict(a.split("=", 1) for a in sys.argv[1:])}.items():
        path = {"terrain": "env.terrain.kind", "method": "env.method"}.get(key, key)
        config = settings.replace(config, path, int(value) if value.isdigit() else value)
    settings.use_cache(config.cache)
    result = measure(config)
    result["machine"] = {"devices": [d.device_kind for d in jax.devices()], "cores": os.cpu_count()}
    result["settings"] = {"terrain": config.env.terrain.kind, "num_envs": config.num_envs}
    print(json.dumps(result, indent=2))


if __name__ == "__main__":
    main()
