"""How well a policy finds its footholds above pits, by itself and led by a reflex that doesn't learn.

    python -m benchmarks.footholds policy=flat difficulty=0.5 reflex=false
    python -m benchmarks.footholds policy=flat difficulty=0.5 reflex=true depth=0.5 json=FILE

The reflex follows the guide (envs/guide.py): a foot in swing whose step ends near a gap is led to better ground by
inverse kinematics, on top of the policy's residual joint angles, and held there while it stands. It knows the true map.

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
from tlq.config import training_env  # noqa: E402
from tlq.evaluate import FIRST_SEED  # noqa: E402
from tlq.runtime import Policy, load_policy  # noqa: E402

AHEAD = (1, 4, 8)
"""Control steps before a foot lands at which the point where it was said to land is judged."""
SETTLED = 3
"""Control steps after which a foot stands."""
AT_LIMIT = 0.9
"""Residual action from which it counts as being at its limit, 1."""
LET_GO, KEPT = 1.0, 0.85
"""Phase (rad) of swing up to which a foot that lifts off forgets where it was led, and the share that a step keeps."""


@dataclasses.dataclass(frozen=True)
class Options:
    """The command line."""

    policy: str = cli.option("flat", "policy file, run folder, or name of a policy that comes with tlq")
    terrain: str = cli.option("poles", "kind of terrain", choices=terrains.kinds)
    difficulty: float = cli.option(0.5, "in [0, 1]")
    depth: float = cli.option(0.02, "of the pits for the feet (m)")
    reflex: bool = cli.option(False, "lead the feet by the reflex")
    retraction: float = cli.option(-1.0, "share of retraction of the feet; negative: the policy's own")
    frequency: float = cli.option(0.0, "gait cycles per second at action 0 (Hz); 0: the policy's own")
    gait: str = cli.option("", "trot or walk; empty: the policy's own")
    swing_share: float = cli.option(0.0, "of the gait's cycle; 0: the policy's own")
    step_length: float = cli.option(0.0, "of the gait (m); 0: the policy's own")
    touch_down: float = cli.option(
        -1.0, "share of the trunk's motion that swing leaves out; negative: the policy's"
    )
    lead: float = cli.option(-1.0, "time by which feet are ahead on their way (s); negative: the policy's")
    stance_damping: float = cli.option(
        -1.0, "factor on the derivative gain of legs in stance; negative: the policy's"
    )
    robots: int = cli.option(96, "episodes, two on each terrain")
    seconds: float = cli.option(8.0, "longest episode")
    json: str = cli.option("", "file for the result")


def make_env(policy: Policy, options: Options) -> envs.QuadrupedEnv:
    """The policy's own environment on one level, without pushes."""
    own = training_env(policy.metadata)
    gait = {
        "tg.retraction": options.retraction if options.retraction >= 0 else own.tg.retraction,
        "tg.base_frequency": options.frequency or own.tg.base_frequency,
        "tg.gait": options.gait or own.tg.gait,
        "tg.swing_share": options.swing_share or own.tg.swing_share,
        "tg.step_length": options.step_length or own.tg.step_length,
        "tg.touch_down": options.touch_down if options.touch_down >= 0 else own.tg.touch_down,
        "tg.lead": options.lead if options.lead >= 0 else own.tg.lead,
        "tg.stance_damping": options.stance_damping if options.stance_damping >= 0 else own.tg.stance_damping,
    }
    config = settings.changed(
        own,
        gait
        | {
            "terrain.kind": options.terrain,
            "terrain.num_terrains": (options.robots + 1) // 2,
            "terrain.seed": FIRST_SEED,
            "curriculum": envs.CurriculumConfig(
                enabled=False, difficulty=(options.difficulty,), depth=(options.depth,), revisit=0.0
            ),
            "stand_share": 0.0,
            "stop_share": 0.0,
            "randomisation.push_speed": 0.0,
        },
    )
    return envs.make(config)


def lead(env: envs.QuadrupedEnv, episode: envs.Episode, led: jax.Array) -> jax.Array:
    """Where the reflex leads the feet: displacements (L, 2) m, heading frame, from those of the step before.

    A foot that has landed is held there: let go at once it would push the trunk.
    """
    wished, asked = guide.displacements(env, episode)
    phases = env.core.phases(episode.controller.phase)[:, None]
    kept = jnp.where((phases > 0) & (phases < LET_GO), KEPT * led, led)
    return jnp.where(asked[:, None], wished, kept)


def with_reflex(
    env: envs.QuadrupedEnv, episode: envs.Episode, action: jax.Array, led: jax.Array
) -> jax.Array:
    """The policy's action (14,) with residual joint angles that move the feet by `led` (L, 2) m."""
    mirror = env.core.update_mirror(episode.controller.mirror, env.heading_command(episode))
    change = jnp.concatenate([jnp.zeros(2), guide.residuals(env, episode, led).reshape(-1)])
    return jnp.clip(action + env.core.mirror_action(mirror, change), -1.0, 1.0)


def step(
    policy: Policy, env: envs.QuadrupedEnv, options: Options, carried: tuple[Any, jax.Array, jax.Array]
) -> tuple[tuple[Any, jax.Array, jax.Array], dict[str, jax.Array]]:
    """One control step of one robot, and what it shows."""
    state, memory, led = carried
    episode = state.pipeline_state
    action, memory = policy.graph(state.obs["state"], memory)
    if options.reflex:
        led = lead(env, episode, led)
        action = with_reflex(env, episode, action, led)
    state = env.step(state, action)
    before, episode = episode, state.pipeline_state
    _, around = env._terrain_at_feet(episode)
    over = jnp.max(around, axis=1) - around[:, 0] > env.config.rewards.gap_threshold
    stance = env.core.phases(episode.controller.phase) <= 0
    mirror = env.core.update_mirror(before.controller.mirror, env.heading_command(before))
    residual = env.core.mirror_action(mirror, action)[2:].reshape(4, 3)
    shown = {
        "done": state.done > 0,
        "fell": (state.done > 0) & (state.info["truncation"] == 0),
        "progress": episode.progress,
        "over": jnp.sum(over & stance),
        "stance": jnp.sum(stance),
        "swing": env.core.phases(before.controller.phase) > 0,
        "swing_after": ~stance,
        "at_limit": jnp.any(jnp.abs(residual) > AT_LIMIT, axis=-1),
        "said": in_world(before, env.landing_points(before)),
        "led": env.core.residual_displacement(episode.controller, envs.env.exact_sensors(episode))[:, :2],
        "feet": in_world(episode, env.core.feet(envs.env.exact_sensors(episode))[:, :2]),
        "command": episode.command,
    }
    return (state, memory, led), shown


def in_world(episode: envs.Episode, points: jax.Array) -> jax.Array:
    """Points (L, 2) m of the heading frame in the world."""
    return episode.qpos[:2] + tg.frames.turn(tg.frames.yaw(episode.qpos[3:7]), points)


def landing_errors(shown: dict[str, np.ndarray], landed: np.ndarray) -> dict[str, float]:
    """How far (m) feet that stand since SETTLED steps are from where they were said to land, by steps before landing.

    shown: arrays (T, B, ...); landed: (T, B, L), the step that ends a swing. Medians; and how far beyond what was said
    they are along the command, on average, at one step before. `moved_on_m`: how far they still go from the step before
    they land; `led_moves_m`: how far that step moves where the residuals lead them.
    """
    time, robot, leg = np.nonzero(landed[:-SETTLED])
    stands = shown["feet"][time + SETTLED, robot, leg]
    feet, led = shown["feet"], shown["led"]

    def median(moves: np.ndarray) -> float:
        return float(np.median(np.linalg.norm(moves, axis=-1)))

    errors = {
        "moved_on_m": median(stands - feet[time - 1, robot, leg]),
        "led_moves_m": median(led[time - 1, robot, leg] - led[time - 2, robot, leg]),
    }
    for steps in AHEAD:
        then = np.maximum(time - steps + 1, 0)
        swung = shown["swing"][then, robot, leg]
        away = (stands - shown["said"][then, robot, leg])[swung]
        errors[f"landing_error_{steps}_m"] = median(away)
        if steps == 1:
            along = np.sum(away * shown["command"][time, robot][swung], axis=-1)
            errors["landed_beyond_m"] = float(along.mean())
    return errors


def measure(options: Options) -> dict[str, float]:
    """Mean distance, shares of episodes that fell, of feet in stance over a gap and of steps in swing at the limit of
    residual angles, and errors of the predicted landing points.
    """
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
    landed = counts[..., None] & shown["swing"] & ~shown["swing_after"]
    landed[:-SETTLED] &= counts[SETTLED:, :, None]
    return landing_errors(shown, landed) | {
        "residuals_at_limit": float(shown["at_limit"][shown["swing"] & counts[..., None]].mean()),
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
