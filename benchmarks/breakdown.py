"""Where the time of a training iteration goes.

    python -m benchmarks.breakdown                       # poles at the default settings
    python -m benchmarks.breakdown terrain=flat num_envs=512 json=FILE

Each part is compiled on its own, with the environments split over all devices as in training, and timed in turn with
the whole iteration; medians are printed. The parts leave a little out and, since the compiler fuses across their
borders, don't add up exactly: `rest of the environment` is what the environment's step takes beyond physics and
look-ups (trajectory generator, sensors, rewards, reset, observation, landing points).
"""

import dataclasses
import functools
import sys
from collections.abc import Callable, Sequence
from typing import Any
from unittest import mock

from tlq.cores import use_all_cores

use_all_cores()  # before JAX starts

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
from jax.sharding import PartitionSpec as P  # noqa: E402

import envs  # noqa: E402
import terrains  # noqa: E402
from benchmarks import timing  # noqa: E402
from envs import guide  # noqa: E402
from envs.env import exact_sensors  # noqa: E402
from envs.limits import check_values  # noqa: E402
from tlq import cli  # noqa: E402
from tlq import config as settings  # noqa: E402
from tlq.ppo import AXIS, hoist  # noqa: E402
from tlq.training import make_learner  # noqa: E402

HEIGHT_LOOK_UPS = 3
"""Look-ups of 100 heights in a step: for the reward, for the policy (drifted) and for the critic (exact)."""
NOTHING = 1e-12
"""Makes a result part of what the next round starts from, so that the compiler can't leave a round out."""


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


def flat_contact(bank: Any, k: Any, centres: jax.Array, floor: Any, num_planes: int) -> tuple[jax.Array, ...]:
    """In place of `terrains.contact`: the plane z = 0 below foot centres (..., 3)."""
    shape = (*centres.shape[:-1], num_planes)
    point = jnp.broadcast_to(centres[..., None, :] * jnp.array([1.0, 1.0, 0.0]), (*shape, 3))
    normal = jnp.broadcast_to(jnp.array([0.0, 0.0, 1.0]), (*shape, 3))
    return jnp.broadcast_to(centres[..., None, 2], shape), normal, point


class Parts:
    """The parts of an iteration, each as a function without argument."""

    def __init__(self, options: Options):
        self.config = settings.changed(
            settings.default_config(),
            {
                "env.terrain.kind": options.terrain,
                "env.terrain.num_terrains": options.num_terrains,
                "num_envs": options.num_envs,
                "ppo.unroll": options.unroll,
            },
        )
        settings.validate(self.config)
        self.learner = make_learner(self.config)
        self.env: envs.QuadrupedEnv = self.learner.env.unwrapped
        self.state = self.learner.init(self.config.seed)
        for _ in range(options.warm_up):
            self.state, _ = self.learner.step(self.state)

    def all(self) -> dict[str, Callable[[], Any]]:
        """By name."""
        unroll = self.config.ppo.unroll
        steps = timing.env_steps(self.learner, unroll)
        guided = self.learner.guided
        return {
            "iteration": lambda: self.learner.step(self.state),
            "environment": lambda: steps(self.state.env_state),
            "physics": self.physics(unroll),
            "contact look-ups": self.repeated(self.contacts, unroll * self.env.substeps),
            "height look-ups": self.repeated(self.heights, unroll * HEIGHT_LOOK_UPS),
            **({"guide": self.repeated(self.guide, unroll // self.learner.stride)} if guided else {}),
            "policy": self.policy(unroll),
            "update": self.update(),
        }

    def repeated(self, step: Callable[[envs.Episode], envs.Episode], times: int) -> Callable[[], Any]:
        """So many steps of every environment's episode, with what `step` closes over passed along."""
        learner, episodes = self.learner, self.state.env_state.pipeline_state
        here = self.config.num_envs // learner.devices

        def run(episodes: envs.Episode) -> envs.Episode:
            return jax.lax.scan(lambda e, _: (jax.vmap(step)(e), None), episodes, length=times)[0]

        local = jax.tree.map(lambda x: jax.ShapeDtypeStruct((here, *x.shape[1:]), x.dtype), episodes)
        constants, pure = hoist(run, local)
        constants = jax.device_put(constants, jax.sharding.NamedSharding(learner.mesh, P()))
        compiled = self.jit(pure, (P(), P(AXIS)), P(AXIS))
        return lambda: compiled(constants, episodes)

    def jit(self, function: Callable[..., Any], in_specs: Any, out_specs: Any) -> Callable[..., Any]:
        """A function of one device's share, compiled for all of them."""
        shard = functools.partial(jax.shard_map, mesh=self.learner.mesh, check_vma=False)
        return jax.jit(shard(function, in_specs=in_specs, out_specs=out_specs))

    def physics(self, steps: int) -> Callable[[], Any]:
        """Control steps on a plane."""
        with mock.patch.object(terrains, "contact", flat_contact):  # while it is traced
            return self.repeated(lambda e: self.env._simulate(e, e.controller), steps)

    def contacts(self, e: envs.Episode) -> envs.Episode:
        """One look-up of the surfaces near four feet."""
        feet = jnp.asarray(self.env.core.base_foot)[:, :2]
        centres = e.qpos[:3] + jnp.concatenate([feet, -e.qpos[2] * jnp.ones((4, 1))], axis=1)
        found = terrains.contact(self.env.bank, e.terrain, centres, e.floor, self.config.env.num_planes)
        return e.replace(qpos=e.qpos + NOTHING * sum(jnp.sum(x) for x in found))

    def heights(self, e: envs.Episode) -> envs.Episode:
        """One look-up of 100 heights."""
        core = self.env.core
        seen = self.env._heights(e, core.around(core.feet(exact_sensors(e))))
        return e.replace(qpos=e.qpos + NOTHING * jnp.sum(seen))

    def guide(self, e: envs.Episode) -> envs.Episode:
        """What the guide to footholds says, once."""
        total = sum(jnp.sum(x, dtype=jnp.float32) for x in guide.guide(self.env, e, jnp.zeros((4, 2))))
        return e.replace(qpos=e.qpos + NOTHING * total)

    def policy(self, steps: int) -> Callable[[], Any]:
        """The policy's steps, with sampling."""
        networks, s = self.learner.networks, self.state
        distribution = networks.parametric_action_distribution

        def run(obs: dict[str, jax.Array], params: Any, normaliser: Any) -> dict[str, jax.Array]:
            def step(obs: dict[str, jax.Array], key: jax.Array) -> tuple[dict[str, jax.Array], None]:
                parameters = networks.policy_network.apply(normaliser, params, obs)
                done = distribution.postprocess(distribution.sample_no_postprocessing(parameters, key))
                state = obs["state"] + NOTHING * jnp.sum(done["action"])
                return obs | {"carry": done["carry"], "state": state}, None

            return jax.lax.scan(step, obs, jax.random.split(jax.random.PRNGKey(0), steps))[0]

        compiled = self.jit(run, (P(AXIS), P(), P()), P(AXIS))
        return lambda: compiled(s.env_state.obs, s.params.policy, s.normaliser)

    def update(self) -> Callable[[], Any]:
        """The gradient steps on a rollout."""
        learner, s = self.learner, self.state
        over_time = P(None, AXIS)
        roll = self.jit(learner._rollout, (P(), learner.specs, P()), (P(AXIS), over_time, P()))
        env_state, rollout, _ = roll(learner._constants, s, s.key)
        compiled = self.jit(learner._update, (learner.specs, P(AXIS), over_time, P(AXIS), P()), P())
        carry, last = s.env_state.obs["carry"], env_state.obs["privileged_state"]
        return lambda: compiled(s, carry, rollout, last, s.key)


def measure(options: Options) -> dict[str, Any]:
    """Median seconds of each part, its share of the iteration, and steps per second."""
    seconds = timing.medians(Parts(options).all(), options.rounds)
    known = ("physics", "contact look-ups", "height look-ups", "guide")
    seconds["rest of the environment"] = seconds["environment"] - sum(seconds.get(k, 0.0) for k in known)
    steps = options.num_envs * options.unroll
    return {
        "training_steps_per_second": steps / seconds["iteration"],
        "env_steps_per_second": steps / seconds["environment"],
        "training_vs_env": seconds["environment"] / seconds["iteration"],
        "share_of_iteration": {k: v / seconds["iteration"] for k, v in seconds.items()},
        "seconds": seconds,
    }


def main(arguments: Sequence[str]) -> None:
    """Prints the shares, and writes the JSON."""
    options = cli.parse(Options, arguments, __doc__ or "")
    cli.check_folders(options, "json")
    check_values(dataclasses.asdict(options), timing.LIMITS)
    settings.use_cache(settings.TrainConfig().cache)
    timing.put_out(measure(options), dataclasses.asdict(options), options.json)


if __name__ == "__main__":
    cli.run(main, sys.argv[1:])
