"""What becomes of a robot that is told to stand at a random moment of a walk, by two ways of stopping, or walks on.

    python -m benchmarks.stopping policy=poles terrain=poles difficulty=0.8 episodes=30 json=FILE

`walk_on`: it isn't. `finish`: the feet end their step and stay (`tg.finish_step`). `fade`: the gait fades out wherever
in its cycle it is. `go_on`: as `finish` for 1.5 s, then it walks again. In MuJoCo C with training's
noise, on terrains of training's seeds; all of them from the same moment, 1.4 to 2.6 s after the start. Counted are
falls within three seconds.
"""

import copy
import dataclasses
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

import envs  # noqa: F401  (before Brax: its import of MJX prints on stdout)
import terrains
from benchmarks import timing
from tlq import cli, evaluate
from tlq.cli import find_policy, option
from tlq.config import training_env
from tlq.runtime import Controller
from tlq.simulation import Simulation

WAYS = ("walk_on", "finish", "go_on", "fade")
FROM, TO, WATCHED = 70, 130, 150
"""Control steps: the stop comes between the first two, and the robot is watched for so long."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What a user may set."""

    policy: str = option("poles", "policy file, run folder, or name of a policy that comes with tlq")
    terrain: str = option("poles", "kind of terrain", choices=terrains.kinds)
    difficulty: str = option("paper", "number in [0, 1], or paper")
    episodes: int = option(30, "number of episodes; those that end before the stop don't count")
    seed: int = option(9100, "of terrains, noise and moments")
    json: str = option("", "file for the figures")


def episode(options: Options, k: int) -> dict[str, bool] | None:
    """Whether the robot fell, by way of stopping; None if it did before the stop."""
    controller = Controller(find_policy(options.policy))
    config = training_env(controller.metadata)
    terrain = terrains.make_terrain(options.terrain, options.difficulty, options.seed, index=k)
    sim = Simulation(controller, terrain, config, noise=config.randomisation, seed=options.seed + k)
    sim.reset(evaluate.start_phase(k))
    moment = np.random.default_rng([options.seed, k]).integers(FROM, TO)
    if any(sim.step(evaluate.direction(k)).fell for _ in range(moment)):
        return None
    return {way: falls(branch(sim), way, evaluate.direction(k)) for way in WAYS}


def branch(sim: Simulation) -> Simulation:
    """A simulation that goes on from the same moment, by itself."""
    other = copy.copy(sim)
    other.data, other.controller = copy.copy(sim.data), copy.copy(sim.controller)
    other._random = copy.deepcopy(sim._random)
    return other


def falls(sim: Simulation, way: str, direction: np.ndarray) -> bool:
    """Whether the robot falls when it is stopped in a way from now on."""
    core = sim.controller.core
    config = dataclasses.replace(core.config, finish_step=way != "fade")
    sim.controller.core = dataclasses.replace(core, config=config)
    for k in range(WATCHED):
        walks = way == "walk_on" or (way == "go_on" and k >= WATCHED // 2)
        if sim.step((1.0 if walks else 0.0) * direction).fell:
            return True
    return False


def measure(options: Options, report: Callable[[str], None] = print) -> dict[str, Any]:
    """All episodes; what the JSON file holds."""
    found: list[dict[str, bool]] = []
    for k in range(options.episodes):
        one = episode(options, k)
        if one is not None:
            found.append(one)
        counts = {way: sum(f[way] for f in found) for way in WAYS}
        report(f"episode {k}: of {len(found)} fell {counts}")
    shares = {way: evaluate.wilson(sum(f[way] for f in found), len(found)) for way in WAYS if found}
    return {"moments": len(found), "fell": counts, "share": shares}


def main(arguments: Sequence[str]) -> None:
    """The command line."""
    options = cli.parse(Options, arguments, __doc__ or "")
    terrains.parse_difficulty(options.difficulty)
    if options.episodes < 1:
        raise ValueError(f"episodes={options.episodes} must be at least 1")
    if options.seed < 0:
        raise ValueError(f"seed={options.seed} must be 0 or more")
    cli.check_folders(options, "json")
    figures = measure(options, lambda line: print(line, file=sys.stderr, flush=True))
    timing.put_out(figures, dataclasses.asdict(options), options.json)


if __name__ == "__main__":
    cli.run(main)
