"""How far a policy gets by its own range sensors, and how their errors compare with the noise of training.

    python -m benchmarks.perception policy=poles terrain=poles difficulty=0.3 json=FILE picture=FILE.png
    python -m benchmarks.perception policy=blocks terrain=blocks sweep=none

Distances are those of `tlq.evaluate`, in MuJoCo C, one source of error varied at a time and the others at their
defaults (`tlq.senses.PerceptionConfig`). Errors of heights are taken while the policy walks by them. Then the three
numbers of training's noise (`envs.RandomisationConfig`) are fitted to them.
"""

import dataclasses
import sys
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

import envs
import terrains
import tg
from benchmarks import timing
from tg.core import HEIGHT_CLIP
from tlq import cli, evaluate
from tlq.config import training_env
from tlq.files import whole
from tlq.runtime import Controller
from tlq.senses import SENSORS, PerceptionConfig
from tlq.simulation import Simulation

VALUES = {
    "drift": (0.0, 0.02, 0.05, 0.1),
    "latency": (0.05, 0.2, 0.5),
    "missing": (0.05, 0.4, 0.8),
    "range_noise": (0.0, 1.0, 3.0),
}
"""What is varied."""
LABELS = {
    "drift": "drift of the pose per metre (m)",
    "latency": "latency of scans (s)",
    "missing": "share of lost returns",
    "range_noise": "range noise, multiples of the sensor's",
}
OUTLIER = 0.05
"""Errors beyond this (m) are counted, and left out of means and deviations."""
EDGE = 0.02
"""A point is near an edge when the ground this far (m) to one of four sides of it is higher or lower by `OUTLIER`."""
EVERY = 10
"""Every so many control steps the map is compared with the terrain moved to all sides..."""
SHIFTS = 0.005 * np.arange(-8, 9)
"""...by these (m)."""
SHOWN = 20
"""Edge points that a step needs to tell of a shift."""


@dataclasses.dataclass(frozen=True)
class Options:
    """The command line."""

    policy: str = cli.option("poles", "policy file, run folder, or name of a policy that comes with tlq")
    terrain: str = cli.option("poles", "kind of terrain", choices=terrains.kinds)
    difficulty: str = cli.option("0.3", "number in [0, 1], or paper")
    sweep: str = cli.option("all", "what is varied", choices=lambda: ("all", "none", *VALUES))
    episodes: int = cli.option(18, "for each distance")
    walks: int = cli.option(6, "for the errors of heights")
    seed: int = cli.option(0, "of the terrains (10,000 more than this) and of the errors")
    workers: int = cli.option(1, "processes")
    json: str = cli.option("", "file for the result")
    picture: str = cli.option("", "PNG file for the curves")


# -- distances -------------------------------------------------------------------------------------------------------


def distance(options: Options, kind: str, **changes: float) -> dict[str, Any]:
    """Distance (m) and success rate of `tlq.evaluate` with a kind of perception."""
    asked = evaluate.Options(
        policy=options.policy,
        terrain=options.terrain,
        engine="mujoco",
        difficulty=options.difficulty,
        episodes=options.episodes,
        seed=options.seed,
        workers=options.workers,
        perception=kind,
        **changes,
    )
    found = evaluate.evaluate(asked, lambda line: None)
    walked = found["distance_m"]
    print(f"{kind} {changes}: {walked['mean']:.2f} m", file=sys.stderr, flush=True)
    error = walked["std"] / np.sqrt(options.episodes)
    return {"mean_m": walked["mean"], "error_m": error, "success": found["success_rate"]["mean"]}


def curves(options: Options) -> dict[str, Any]:
    """Distances: by the map, by each sensor at the defaults, and over what is varied."""
    found: dict[str, Any] = {kind: distance(options, kind) for kind in ("map", *SENSORS)}
    names = {"all": tuple(VALUES), "none": ()}.get(options.sweep, (options.sweep,))
    for name in names:
        default = getattr(PerceptionConfig(), name)
        found[name] = {
            kind: [
                {"value": v, **(found[kind] if v == default else distance(options, kind, **{name: v}))}
                for v in VALUES[name]
            ]
            for kind in SENSORS
        }
    return found


def draw(found: dict[str, Any], options: Options) -> None:
    """Writes the curves as a picture."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    names = [name for name in VALUES if name in found]
    figure, axes = plt.subplots(
        1, len(names), figsize=(3.4 * len(names), 3.2), sharey=True, squeeze=False, constrained_layout=True
    )
    for axis, name in zip(axes[0], names, strict=True):
        axis.axhline(found["map"]["mean_m"], color="0.4", ls="--", lw=1, label="true map")
        axis.axhline(0.9 * found["map"]["mean_m"], color="0.7", ls=":", lw=1, label="90 % of it")
        for kind, colour in zip(SENSORS, ("C0", "C1"), strict=True):
            points = found[name][kind]
            value, mean, error = ([p[key] for p in points] for key in ("value", "mean_m", "error_m"))
            axis.errorbar(value, mean, error, color=colour, marker="o", ms=4, capsize=2, lw=1, label=kind)
        axis.set_xlabel(LABELS[name])
        axis.set_ylim(0, 5.2)
    axes[0, 0].set_ylabel("distance (m)")
    axes[0, 0].legend(fontsize=8, loc="lower left")
    with whole(options.picture) as temporary:
        figure.savefig(temporary, dpi=90, format="png")
    plt.close(figure)


# -- errors of heights -----------------------------------------------------------------------------------------------


class Errors(NamedTuple):
    """Heights as they were perceived, against the true ones; T control steps of P = 100 points."""

    error: np.ndarray
    """(T, P) m, perceived minus true, both cut to ±25 cm round the feet, as the policy sees them."""
    edge: np.ndarray
    """(T, P) whether the point is near an edge."""
    shift: np.ndarray
    """(T, 2) m, heading frame: how the terrain would have to be moved to look most like what is perceived; NaN where
    too little tells of it."""


def record(options: Options, kind: str) -> Errors:
    """Walks by a sensor at its defaults, and compares."""
    rows: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    path = cli.find_policy(options.policy)
    for k in range(options.walks):
        controller = Controller(path)
        seed = evaluate.FIRST_SEED + options.seed
        terrain = terrains.make_terrain(options.terrain, options.difficulty, seed, index=k)
        config = training_env(controller.metadata)
        sim = Simulation(controller, terrain, config, perception=PerceptionConfig(kind=kind), seed=seed + k)
        sim.reset(evaluate.start_phase(k))
        for step in range(round(10.0 / controller.control_dt)):
            moment = sim.step(evaluate.direction(k))
            if moment.fell or np.abs(moment.position).max() > terrain.half_extent - 0.6:
                break
            rows.append(compare(sim, step % EVERY == 0))
    return Errors(*(np.array(column) for column in zip(*rows, strict=True)))


def sensing_ms(options: Options, kind: str, count: int = 100) -> float:
    """Median time (ms of a core) of rays, fusion and reading in a control step, after half a second of walking."""
    controller = Controller(cli.find_policy(options.policy))
    terrain = terrains.make_terrain(options.terrain, options.difficulty, evaluate.FIRST_SEED + options.seed)
    config = training_env(controller.metadata)
    sim = Simulation(controller, terrain, config, perception=PerceptionConfig(kind=kind))
    for _ in range(25):
        sim.step(evaluate.direction(0))
    times = []
    for _ in range(count):
        began = time.process_time()
        sim.look()
        times.append(time.process_time() - began)
    return 1e3 * float(np.median(times))


def compare(sim: Simulation, fit: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One row of `Errors`; without `fit` the shift is NaN."""
    level = np.repeat(sim.controller.core.feet(sim.exact_sensors())[:, 2], sim.points.shape[1])
    points, z = sim.points.reshape(-1, 2), sim.data.qpos[2]

    def cut(heights: np.ndarray) -> np.ndarray:
        return np.clip(heights - level, -HEIGHT_CLIP, HEIGHT_CLIP)

    seen, true = cut(sim.heights.reshape(-1)), cut(height(sim, points) - z)
    sides = EDGE * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    beside = cut(height(sim, points + sides[:, None]) - z)
    edge = (np.abs(beside - true) > OUTLIER).any(axis=0)
    shift = np.full(2, np.nan)
    if fit and edge.sum() >= SHOWN:
        moves = np.stack(np.meshgrid(SHIFTS, SHIFTS, indexing="ij"), axis=-1).reshape(-1, 2)
        shift = best_shift(seen, cut(height(sim, points + moves[:, None]) - z), moves)
    return seen - true, edge, shift


def height(sim: Simulation, points: np.ndarray) -> np.ndarray:
    """True height (...) m in the world at points (..., 2) m of the heading frame."""
    return terrains.exact_height(sim.terrain, sim.data.qpos[:2] + tg.frames.turn(np.asarray(sim.yaw), points))


def best_shift(seen: np.ndarray, moved: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """The move (2,) m, of moves (S, 2) m, after which heights moved (S, P) m are nearest to those seen (P,) m."""
    apart = np.abs(moved - seen).mean(axis=1)
    # Several may be as good: their middle.
    return moves[apart <= apart.min() + 1e-9].mean(axis=0)


def usable(errors: Errors) -> tuple[np.ndarray, np.ndarray]:
    """(T, P) whether an error is of level ground and no outlier, and the mean (T,) of those at a step, NaN without."""
    good = ~errors.edge & (np.abs(errors.error) < OUTLIER)
    return good, np.array(
        [e[g].mean() if g.any() else np.nan for e, g in zip(errors.error, good, strict=True)]
    )


def fitted(errors: Errors) -> dict[str, float]:
    """Training's noise with the same spread: `height_noise`, `height_drift` and `map_drift` of `RandomisationConfig`.

    Training adds to the heights of an episode one offset that is uniform in ± `height_drift`, moves the map by one that
    is uniform in ± `map_drift` in x and in y, and adds normal noise of deviation `height_noise` to each height of each
    step. A uniform number in ± a has the deviation a / √3.
    """
    good, offset = usable(errors)
    alone = (errors.error - offset[:, None])[good]
    shift = errors.shift[np.isfinite(errors.shift).all(axis=1)]
    return {
        "height_noise": float(np.std(alone)),
        "height_drift": float(np.sqrt(3.0) * np.sqrt(np.nanmean(offset**2))),
        "map_drift": float(np.sqrt(3.0) * np.sqrt(np.mean(shift**2))) if len(shift) else 0.0,
    }


def described(errors: Errors) -> dict[str, float | None]:
    """What the errors look like: m, and shares."""
    good, offset = usable(errors)
    outlier = np.abs(errors.error) >= OUTLIER

    def share(where: np.ndarray, of: np.ndarray) -> float | None:
        return float(where[of].mean()) if of.any() else None

    return {
        "bias_m": float(np.mean(errors.error[good])),
        "deviation_m": float(np.std(errors.error[good])),
        "common_deviation_m": float(np.nanstd(offset)),
        "points_near_edges": float(errors.edge.mean()),
        "outliers": share(outlier, np.ones_like(errors.edge)),
        "outliers_near_edges": share(outlier, errors.edge),
        "outliers_elsewhere": share(outlier, ~errors.edge),
        "too_high_near_edges": share(errors.error >= OUTLIER, errors.edge),
        "too_low_near_edges": share(errors.error <= -OUTLIER, errors.edge),
    }


# -- all -------------------------------------------------------------------------------------------------------------


def check(options: Options) -> None:
    """Raises ValueError on options out of range, before anything takes long."""
    terrains.parse_difficulty(options.difficulty)
    for name in ("episodes", "walks", "workers"):
        if getattr(options, name) < 1:
            raise ValueError(f"{name}={getattr(options, name)} must be at least 1")
    if options.seed < 0:
        raise ValueError(f"seed={options.seed} must be 0 or more")
    if options.picture and not options.picture.endswith(".png"):
        raise ValueError(f"picture={options.picture} must end in .png")
    if options.picture and options.sweep == "none":
        raise ValueError(f"sweep=none gives no curves to draw; choose one of all, {', '.join(VALUES)}")
    cli.check_folders(options, "json", "picture")
    if not Controller(cli.find_policy(options.policy)).core.heights:
        raise ValueError(f"policy={options.policy} is blind: it needs no heights")


def main(arguments: Sequence[str]) -> None:
    """Prints the figures as JSON."""
    options = cli.parse(Options, arguments, __doc__ or "")
    check(options)
    noise = envs.RandomisationConfig()
    result: dict[str, Any] = {
        "training": {name: getattr(noise, name) for name in ("height_noise", "height_drift", "map_drift")}
    }
    for kind in SENSORS:
        errors = record(options, kind)
        result[f"{kind}_errors"] = described(errors)
        result[f"{kind}_fitted"] = fitted(errors)
        result[f"{kind}_sensing_ms"] = sensing_ms(options, kind)
    result["distance"] = curves(options)
    if options.picture:
        draw(result["distance"], options)
    timing.put_out(result, dataclasses.asdict(options), options.json)


if __name__ == "__main__":
    cli.run(main)
