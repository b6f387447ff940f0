"""How well a policy finds its footholds above pits, by itself and led by a reflex that doesn't learn.

    python -m benchmarks.footholds policy=flat difficulty=0.5 reflex=false
    python -m benchmarks.footholds policy=flat difficulty=0.5 reflex=true depth=0.5 json=FILE

The reflex follows the guide (envs/guide.py): for each foot in swing it looks for the nearest ground without a gap round
the point where the foot will come down, and leads the foot there by inverse kinematics, on top of the policy's residual
joint angles: a share of the way at each step, kept until the next swing. It knows the true map.

Episodes as in training, in MJX, on terrains that training never saw: noise and randomisation but no pushes, all walk;
an episode ends with a foot in a gap, a fall, or at 5 m.
"""

import dataclasses
import functools
import sys
from collections.abc import Sequence
from typing import Any

from tlq.cores import use_all_cores

use_all_cores()  # before JAX starts

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import numpy as np  # noqa: E402

import envs  # noqa: E402
import terrains  # noqa: E402
import tg  # noqa: E402
from benchmarks import timing  # noqa: E402
from envs import guide  # noqa: E402
from tlq import cli  # noqa: E402
from tlq import config as settings  # noqa: E402
from tlq.evaluate import FIRST_SEED, training_env  # noqa: E402
from tlq.runtime import Policy, load_policy  # noqa: E402

DROP = 0.6
"""Phase (rad) up to which a foot that lifts off forgets where it was led, by a tenth each step."""


@dataclasses.dataclass(frozen=True)
class Options:
    """The command line."""

    policy: str = cli.option("flat", "policy file, run folder, or name of a policy that comes with tlq")
    terrain: str = cli.option("poles", "kind of terrain", choices=terrains.kinds)
    difficulty: float = cli.option(0.5, "in [0, 1]")
    depth: float = cli.option(0.02, "of the pits for the feet (m)")
    reflex: bool = cli.option(False, "lead the feet by the reflex")
    gain: float = cli.option(guide.GAIN, "share of the way to the best foothold at each step")
    robots: int = cli.option(96, "episodes, two on each terrain")
    seconds: float = cli.option(8.0, "longest episode")
    json: str = cli.option("", "file for the result")


def make_env(policy: Policy, options: Options) -> envs.QuadrupedEnv:
    """The policy's own environment on one level, without pushes."""
    config = settings.changed(
        training_env(policy.metadata),
        {
            "terrain.kind": options.terrain,
            "terrain.num_terrains": (options.robots + 1) // 2,
            "terrain.seed": FIRST_SEED,
            "curriculum": envs.CurriculumConfig(
                enabled=False, difficulty=(options.difficulty,), depth=(options.depth,), revisit=0.0
            ),
            "stand_share": 0.0,
            "randomisation.push_speed": 0.0,
        },
    )
    return envs.make(config)


def lead(env: envs.QuadrupedEnv, episode: envs.Episode, led: jax.Array, gain: float) -> jax.Array:
    """Where the reflex leads the feet: displacements (L, 2) m in the heading frame, from those of the step before."""
    led = jnp.clip(led + gain * guide.ways(env, episode), -guide.LIMIT, guide.LIMIT)
    phases = tg.path.leg_phases(episode.controller.phase)[:, None]
    return jnp.where((phases > 0) & (phases < DROP), 0.9 * led, led)


def with_reflex(
    env: envs.QuadrupedEnv, episode: envs.Episode, action: jax.Array, led: jax.Array
) -> jax.Array:
    """The policy's action (14,) with residual joint angles that move the feet by `led` (L, 2) m."""
    core, sensors = env.core, envs.env.exact_sensors(episode)
    controller, up = episode.controller, tg.frames.up_in_trunk(sensors.orientation)
    phases = tg.path.leg_phases(controller.phase)
    target = core.foot_targets(phases, controller.lift * controller.gate, controller.stride, sensors)
    shift = jnp.pad(led, ((0, 0), (0, 1))) @ tg.frames.heading_from_trunk(up)
    angles = tg.leg.inverse(core.geometry, target + shift) - tg.leg.inverse(core.geometry, target)
    mirror = core.update_mirror(controller.mirror, env.heading_command(episode))
    added = jnp.concatenate([jnp.zeros(2), (angles / core.config.residual_range).reshape(-1)])
    return jnp.clip(action + core.mirror_action(mirror, added), -1.0, 1.0)


def step(
    policy: Policy, env: envs.QuadrupedEnv, options: Options, carried: tuple[Any, jax.Array, jax.Array]
) -> tuple[tuple[Any, jax.Array, jax.Array], dict[str, jax.Array]]:
    """One control step of one robot, and what it shows."""
    state, memory, led = carried
    action, memory = policy.graph(state.obs["state"], memory)
    if options.reflex:
        led = lead(env, state.pipeline_state, led, options.gain)
        action = with_reflex(env, state.pipeline_state, action, led)
    state = env.step(state, action)
    episode = state.pipeline_state
    _, around = env._terrain_at_feet(episode)
    over = jnp.max(around, axis=1) - around[:, 0] > env.config.rewards.gap_threshold
    stance = tg.path.leg_phases(episode.controller.phase) <= 0
    shown = {
        "done": state.done > 0,
        "fell": (state.done > 0) & (state.info["truncation"] == 0),
        "progress": episode.progress,
        "over": jnp.sum(over & stance),
        "stance": jnp.sum(stance),
    }
    return (state, memory, led), shown


def measure(options: Options) -> dict[str, float]:
    """Mean distance, and shares of the episodes that fell and of the feet in stance that are over a gap."""
    policy = load_policy(cli.find_policy(options.policy))
    env = make_env(policy, options)
    length = round(options.seconds / env.dt)
    one = jax.vmap(functools.partial(step, policy, env, options))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(1), options.robots))
    start = (state, jnp.zeros((options.robots, policy.memory_size)), jnp.zeros((options.robots, 4, 2)))
    run = jax.jit(lambda carried: jax.lax.scan(lambda c, _: one(c), carried, length=length)[1])
    shown = {name: np.asarray(x) for name, x in run(start).items()}
    ended = np.where(shown["done"].any(axis=0), shown["done"].argmax(axis=0), length - 1)
    last = (ended, np.arange(options.robots))
    # From beyond the start platform to each episode's end.
    counts = (np.arange(length)[:, None] <= ended) & (shown["progress"] > 0.6)
    return {
        "distance_m": float(np.minimum(shown["progress"][last], envs.GOAL).mean()),
        "fell": float(shown["fell"][last].mean()),
        "stance_over_gap": float(shown["over"][counts].sum() / max(shown["stance"][counts].sum(), 1)),
    }


def main(arguments: Sequence[str]) -> None:
    """Prints the figures as JSON."""
    options = cli.parse(Options, arguments, __doc__ or "")
    cli.check_folders(options, "json")
    terrains.parse_difficulty(options.difficulty)
    if options.robots < 1 or not 0 < options.seconds <= 600:
        raise ValueError("robots= must be at least 1, and seconds= in (0, 600]")
    settings.use_cache(settings.TrainConfig().cache)
    timing.put_out(measure(options), dataclasses.asdict(options), options.json)


if __name__ == "__main__":
    cli.run(main, sys.argv[1:])
