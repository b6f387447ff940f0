"""The substep written for four legs beside MJX's: physics alone and whole environment steps, in turn.

    python -m benchmarks.dynamics                      # as JSON
    python -m benchmarks.dynamics num_envs=4096 rounds=7

Physics is control steps on a plane, as in `benchmarks.breakdown`; the environment walks on its terrain with action 0.
On one device, so that on a CPU both use the same share of its cores.
"""

import dataclasses
import sys
import time
from collections.abc import Callable, Sequence
from typing import Any
from unittest import mock

import jax
import jax.numpy as jnp

import envs
import terrains
from benchmarks import timing
from benchmarks.breakdown import flat_contact
from envs.config import DYNAMICS
from envs.limits import check_values
from tlq import cli


@dataclasses.dataclass(frozen=True)
class Options:
    """The command line."""

    terrain: str = cli.option("poles", "kind of terrain", choices=terrains.kinds)
    num_envs: int = cli.option(1024, "environments")
    num_terrains: int = cli.option(128, "terrains in the bank")
    steps: int = cli.option(10, "control steps that are timed at once")
    rounds: int = cli.option(5, "times that each is timed")
    json: str = cli.option("", "file for the result")


def functions(env: envs.QuadrupedEnv, options: Options) -> dict[str, tuple[Callable[[Any], Any], Any]]:
    """Physics and environment: a compiled function of its state, and the state; compiled when first called."""
    resetting = envs.AutoReset(env)
    keys = jax.random.split(jax.random.key(0), options.num_envs)
    state = jax.jit(jax.vmap(resetting.reset))(keys)

    def repeated(step: Callable[[Any], Any]) -> Callable[[Any], Any]:
        def run(x: Any) -> Any:
            return jax.lax.scan(lambda x, _: (jax.vmap(step)(x), None), x, length=options.steps)[0]

        return jax.jit(run)

    return {
        "physics": (repeated(lambda e: env._simulate(e, e.controller)), state.pipeline_state),
        "environment": (repeated(lambda s: resetting.step(s, jnp.zeros(env.action_size))), state),
    }


def measure(options: Options) -> dict[str, Any]:
    """Seconds to compile and to run, and ratios of MJX's to ours."""
    bank, compiled, seconds = None, {}, {}
    for name in DYNAMICS:
        terrain = terrains.TerrainConfig(kind=options.terrain, num_terrains=options.num_terrains)
        env = envs.QuadrupedEnv(envs.EnvConfig(terrain=terrain, dynamics=name), bank)
        bank = env.bank
        for part, (function, state) in functions(env, options).items():
            contact = flat_contact if part == "physics" else terrains.contact
            began = time.perf_counter()
            with mock.patch.object(terrains, "contact", contact):  # while it is traced
                ready = function.lower(state).compile()  # type: ignore[attr-defined]
            seconds[f"{part}/{name}"] = time.perf_counter() - began
            compiled[f"{part}/{name}"] = lambda ready=ready, state=state: ready(state)
    times = timing.medians(dict(sorted(compiled.items())), options.rounds)
    parts = sorted({name.partition("/")[0] for name in times})
    return {
        "mjx_vs_tree": {part: times[f"{part}/mjx"] / times[f"{part}/tree"] for part in parts},
        "steps_per_second": {name: options.num_envs * options.steps / value for name, value in times.items()},
        "compile_seconds": seconds,
    }


def main(arguments: Sequence[str]) -> None:
    """Prints the ratios, and writes the JSON."""
    options = cli.parse(Options, arguments, __doc__ or "")
    cli.check_folders(options, "json")
    check_values(dataclasses.asdict(options), timing.LIMITS)
    timing.put_out(measure(options), dataclasses.asdict(options), options.json)


if __name__ == "__main__":
    cli.run(main, sys.argv[1:])
