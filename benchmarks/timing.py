"""What the benchmarks share: timing in turn, a step of all environments, and how a result is put out."""

import json
import os
import statistics
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import State
from jax.sharding import PartitionSpec as P

from tlq.files import whole
from tlq.ppo import AXIS, Learner

LIMITS = {"rounds": (1, 1000)}
"""Of a number that the configuration of training doesn't check."""


def medians(functions: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, float]:
    """Median seconds of functions, called once to compile and then in turn, so that other load hits all of them."""
    times: dict[str, list[float]] = {name: [] for name in functions}
    for name, function in functions.items():
        began = time.perf_counter()
        jax.block_until_ready(function())
        print(f"{name}: ready in {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    for _ in range(rounds):
        for name, function in functions.items():
            began = time.perf_counter()
            jax.block_until_ready(function())
            times[name].append(time.perf_counter() - began)
    return {name: statistics.median(values) for name, values in times.items()}


def env_steps(learner: Learner, length: int) -> Callable[[State], State]:
    """A function that makes so many steps of all environments with action 0, split over the devices as in training."""
    here = learner.num_envs // learner.devices

    def steps(constants: list[jax.Array], env_state: State) -> State:
        zero = jnp.zeros((here, learner.env.action_size))

        def one(env_state: State, _: None) -> tuple[State, None]:
            action = {"action": zero, "carry": env_state.obs["carry"]}
            return learner._env_step(constants, env_state, action), None

        return jax.lax.scan(one, env_state, length=length)[0]

    compiled = jax.jit(
        jax.shard_map(steps, mesh=learner.mesh, in_specs=(P(), P(AXIS)), out_specs=P(AXIS), check_vma=False)
    )
    return lambda env_state: compiled(learner._constants["step"], env_state)


def put_out(result: dict[str, Any], settings: dict[str, Any], path: str) -> None:
    """Prints a result as JSON with its settings and the machine, and writes it to a file if there is a path."""
    devices = jax.devices()
    machine = {"devices": len(devices), "kind": devices[0].device_kind, "cores": os.cpu_count()}
    text = json.dumps(result | {"settings": settings, "machine": machine}, indent=1)
    print(text)
    if path:
        with whole(path) as temporary:
            temporary.write_text(text + "\n")
