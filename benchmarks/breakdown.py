"""Where the time of a training iteration goes.

    python -m benchmarks.breakdown                       # poles at the default settings
    python -m benchmarks.breakdown terrain=flat num_envs=512 json=FILE

Each part is compiled on its own, with the environments split over all devices as in training, and timed in turn with
the whole iteration; medians are printed. The parts leave a little out and, since the compiler fuses across their
borders, don't add up exactly: `rest of the environment` is what the environment's step takes beyond physics and
look-ups (trajectory generator, sensors, rewards, reset, observation).
"""

import dataclasses
import functools
import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any
from unittest import mock

from tlq.cores import use_all_cores

use_all_cores()  # before JAX starts

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
from jax.sharding import PartitionSpec as P  # noqa: E402

import terrains  # noqa: E402
from tlq import cli  # noqa: E402
from tlq import config as settings  # noqa: E402
from tlq.ppo import AXIS, hoist  # noqa: E402
from tlq.training import make_learner  # noqa: E402


@dataclasses.dataclass(frozen=True)
class Options:
    """The command line."""

    terrain: str = cli.option("poles", "kind of terrain", choices=terrains.kinds)
    num_envs: int = cli.option(1024, "environments over all devices")
    num_terrains: int = cli.option(1024, "terrains in the bank")
    unroll: int = cli.option(40, "environment steps of an iteration")
    rounds: int = cli.option(7, "times that each part is timed")
    warm_up: int = cli.option(3, "iterations before, so that the robots walk")
    json: str = cli.option("", "file for the result")


def make_config(options: Options) -> settings.TrainConfig:
    """Default training with the options' changes."""
    config = settings.default_config()
    for key, value in {
        "env.terrain.kind": options.terrain,
        "env.terrain.num_terrains": options.num_terrains,
        "num_envs": options.num_envs,
        "ppo.unroll": options.unroll,
    }.items():
        config = settings.replace(config, key, value)
    return config


def flat_contact(bank: Any, k: Any, centres: jax.Array, floor: Any, num_planes: int) -> tuple[jax.Array, ...]:
    """In place of `terrains.contact`: the plane z = 0 below foot centres (..., 3)."""
    shape = (*centres.shape[:-1], num_planes)
    point = jnp.broadcast_to(centres[..., None, :] * jnp.array([1.0, 1.0, 0.0]), (*shape, 3))
    normal = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), (*shape, 3))
    return jnp.broadcast_to(centres[..., None, 2], shape), normal, point


def parts(options: Options) -> dict[str, Callable[[], Any]]:
    """Functions without argument, by name, that run one part of an iteration each."""
    config = make_config(options)
    learner = make_learner(config)
    env, networks, unroll = learner.env.unwrapped, learner.networks, config.ppo.unroll
    state = learner.init(config.seed)
    for _ in range(options.warm_up):
        state, _ = learner.step(state)
    here = config.num_envs // learner.devices

    def spread(function: Callable[..., Any], specs: Any, *arguments: Any) -> Callable[[], Any]:
        """A function of the environments of one device, compiled for all of them, what it closes over passed along."""
        local = jax.tree.map(
            lambda spec, tree: jax.tree.map(
                lambda x: jax.ShapeDtypeStruct((here, *x.shape[1:]) if spec == P(AXIS) else x.shape, x.dtype),
                tree,
            ),
            tuple(specs),
            arguments,
            is_leaf=lambda x: isinstance(x, P),
        )
        constants, pure = hoist(function, *local)
        out = jax.tree.map(lambda _: P(AXIS), jax.eval_shape(function, *local))
        run = jax.jit(
            jax.shard_map(pure, mesh=learner.mesh, in_specs=(P(), *specs), out_specs=out, check_vma=False)
        )
        constants = jax.device_put(constants, jax.sharding.NamedSharding(learner.mesh, P()))
        return lambda: run(constants, *arguments)

    def repeated(step: Callable[[Any], Any], times: int = unroll) -> Callable[[Any], Any]:
        return lambda carried: jax.lax.scan(lambda c, _: (step(c), None), carried, length=times)[0]

    episodes, obs = state.env_state.pipeline_state, state.env_state.obs
    desired = jnp.asarray(env.core.standing_target)

    def physics(episode):
        return jax.vmap(lambda e: env._simulate(e, desired))(episode)

    def contacts(episode):
        def one(e):
            centres = e.qpos[:3] + jnp.concatenate(
                [jnp.asarray(env.core.base_foot)[:, :2], -e.qpos[2] * jnp.ones((4, 1))], 1
            )
            found = terrains.contact(env.bank, e.terrain, centres, e.floor, config.env.num_planes)
            # Moves on by nothing, which the compiler can't know.
            return e.replace(qpos=e.qpos + 1e-12 * sum(jnp.sum(x) for x in found))

        return jax.vmap(one)(episode)

    def heights(episode):
        def one(e):
            seen = env._heights(e, env.core.sample_points(env.core.feet(_exact(e))))
            return e.replace(qpos=e.qpos + 1e-12 * jnp.sum(seen))

        return jax.vmap(one)(episode)

    def env_step(env_state):
        action = {"action": jnp.zeros((here, env.action_size)), "carry": env_state.obs["carry"]}
        return learner.env.step(env_state, action)

    def policy(obs, params, normaliser):
        def step(obs, key):
            raw = networks.parametric_action_distribution.sample_no_postprocessing(
                networks.policy_network.apply(normaliser, params, obs), key
            )
            done = networks.parametric_action_distribution.postprocess(raw)
            return obs | {
                "carry": done["carry"],
                "state": obs["state"] + 1e-12 * jnp.sum(done["action"]),
            }, None

        return jax.lax.scan(step, obs, jax.random.split(jax.random.PRNGKey(0), unroll))[0]

    shard = functools.partial(jax.shard_map, mesh=learner.mesh, check_vma=False)
    roll = shard(
        learner._rollout, in_specs=(P(), learner.specs, P()), out_specs=(P(AXIS), P(None, AXIS), P())
    )
    env_state, rollout, _ = jax.jit(roll)(learner._step_constants, state, state.key)
    carry, last = obs["carry"], env_state.obs["privileged_state"]
    update = jax.jit(
        shard(
            learner._update,
            in_specs=(learner.specs, P(AXIS), P(None, AXIS), P(AXIS), P()),
            out_specs=P(),
        )
    )

    with mock.patch.object(terrains, "contact", flat_contact):
        on_a_plane = spread(repeated(physics), [P(AXIS)], episodes)
        jax.block_until_ready(on_a_plane())  # traced while the patch holds
    return {
        "iteration": lambda: learner.step(state),
        "environment": spread(repeated(env_step), [P(AXIS)], state.env_state),
        "physics": on_a_plane,
        "contact look-ups": spread(repeated(contacts, unroll * env.substeps), [P(AXIS)], episodes),
        "height look-ups": spread(repeated(heights, unroll * HEIGHT_LOOK_UPS), [P(AXIS)], episodes),
        "policy": spread(policy, [P(AXIS), P(), P()], obs, state.params.policy, state.normaliser),
        "update": lambda: update(state, carry, rollout, last, state.key),
    }


HEIGHT_LOOK_UPS = 3
"""Look-ups of 100 heights in a step: for the reward, for the policy (drifted) and for the critic (exact)."""


def _exact(episode: Any) -> Any:
    from envs.env import exact_sensors

    return exact_sensors(episode)


def measure(options: Options) -> dict[str, Any]:
    """Median seconds of each part, its share of the iteration, and steps per second."""
    functions = parts(options)
    times: dict[str, list[float]] = {name: [] for name in functions}
    for name, function in functions.items():
        began = time.perf_counter()
        jax.block_until_ready(function())
        print(f"{name}: compiled in {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    for _ in range(options.rounds):
        for name, function in functions.items():
            began = time.perf_counter()
            jax.block_until_ready(function())
            times[name].append(time.perf_counter() - began)
    seconds = {name: statistics.median(values) for name, values in times.items()}
    known = ("physics", "contact look-ups", "height look-ups")
    seconds["rest of the environment"] = seconds["environment"] - sum(seconds[k] for k in known)
    steps = options.num_envs * options.unroll
    return {
        "training_steps_per_second": steps / seconds["iteration"],
        "env_steps_per_second": steps / seconds["environment"],
        "training_vs_env": seconds["environment"] / seconds["iteration"],
        "share_of_iteration": {k: v / seconds["iteration"] for k, v in seconds.items()},
        "seconds": seconds,
        "settings": dataclasses.asdict(options),
        "machine": {
            "devices": len(jax.devices()),
            "kind": jax.devices()[0].device_kind,
            "cores": os.cpu_count(),
        },
    }


def main(arguments: Sequence[str]) -> None:
    """Prints the shares, and writes the JSON."""
    options = cli.parse(Options, arguments, __doc__ or "")
    settings.use_cache(settings.TrainConfig().cache)
    result = measure(options)
    text = json.dumps(result, indent=1)
    print(text)
    if options.json:
        with open(options.json, "w") as file:
            file.write(text + "\n")


if __name__ == "__main__":
    cli.run(main)
