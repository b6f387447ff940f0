"""Walks a trained policy over terrains that training never saw, and measures how it does.

    python -m tlq.evaluate policy=FILE terrain=poles engine=mjx difficulty=paper episodes=18 seed=0 json=FILE

The robot starts with yaw 0 in the middle of the start platform and is told one direction of the paper's six, fixed in
the world. An episode ends at 5 m, at a fall, or after 10 s without progress. The policy acts by its mode.
"""

import concurrent.futures
import dataclasses
import json
import math
import multiprocessing
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import envs
import terrains
from tlq import judge
from tlq.cli import check_folders, find_monitor, find_policy, option, parse, run
from tlq.config import training_env
from tlq.files import whole
from tlq.monitor import Monitor
from tlq.runtime import Controller, load_policy
from tlq.senses import SensingOptions, check_use, described

ENGINES = ("mjx", "mujoco")
DIRECTIONS = (0.0, math.pi / 4, -math.pi / 4, -math.pi, -5 * math.pi / 4, -3 * math.pi / 4)
"""The paper's, rad; episode k takes number k % 6."""
KNEES = ("training", "fall", "touch")
FIRST_SEED = 10_000
"""Training's terrains have seeds below."""
STOOD = 3.0
"""An episode ends when a monitor has stopped the robot for good and it has stood for so long (s)."""


@dataclasses.dataclass(frozen=True)
class Options(SensingOptions):
    """What a user may set."""

    policy: str = option(
        "", "policy file, run folder, or name of a policy that comes with tlq", required=True
    )
    terrain: str = option("poles", "kind of terrain", choices=terrains.kinds)
    engine: str = option(
        "mjx", "mjx, as in training; mujoco: MuJoCo C on true geometry", choices=lambda: ENGINES
    )
    difficulty: str = option("paper", "number in [0, 1], or paper")
    episodes: int = option(18, "number of episodes")
    seed: int = option(0, "of the terrains (10,000 more than this) and of the noise")
    json: str = option("", "file to write the results to")
    noise: bool = option(False, "errors of sensors and map as in training")
    timestep: float = option(0.002, "of the physics (s); engine=mujoco only")
    monitor: str = option(
        "none", "file of a safety monitor, or name of one that comes with tlq; engine=mujoco only"
    )
    workers: int = option(1, "processes; engine=mujoco only")
    knees: str = option(
        "training",
        "what a knee that hits the terrain does: fall ends the episode, touch pushes it back; training: as there",
        choices=lambda: KNEES,
    )


def evaluate(options: Options, report: Callable[[str], None] = print) -> dict[str, Any]:
    """Runs the episodes; returns what the JSON file holds.

    Args:
      options: what to run.
      report: takes lines of text on the progress.
    """
    _check(options)
    path = find_policy(options.policy)
    policy = load_policy(path)
    check_use(options.sensing(), policy, options.policy)
    if options.engine == "mjx":
        return summary(options, policy.metadata, _walk_mjx(options, path, policy.metadata, report))
    monitor = find_monitor(options.monitor)
    if monitor is not None:
        Monitor(monitor, path)  # refuses a bad file before anything takes long
    walks = _walk_mujoco(options, path, policy.metadata, report)
    tallies = [walk.tally for walk in walks]
    return summary(options, policy.metadata, tallies, walks if monitor is not None else None)


def _check(options: Options) -> None:
    terrains.parse_difficulty(options.difficulty)
    for name in ("episodes", "workers"):
        if getattr(options, name) < 1:
            raise ValueError(f"{name}={getattr(options, name)} must be at least 1")
    if options.seed < 0:
        raise ValueError(f"seed={options.seed} must be 0 or more")
    if not 0 < options.timestep <= 0.02:
        raise ValueError(f"timestep={options.timestep} must be in (0, 0.02]")
    if options.monitor != "none" and options.engine != "mujoco":
        raise ValueError(f"monitor={options.monitor} needs engine=mujoco; engine=mjx has no monitor")
    if options.sensing() is not None and options.engine != "mujoco":
        raise ValueError(
            f"perception={options.perception} needs engine=mujoco; engine=mjx has no range sensors"
        )
    check_folders(options, "json")


# -- engines ---------------------------------------------------------------------------------------------------------


def direction(k: int) -> np.ndarray:
    """Unit vector (2,) of episode k."""
    angle = DIRECTIONS[k % len(DIRECTIONS)]
    return np.array([math.cos(angle), math.sin(angle)])


def start_phase(k: int) -> float:
    """Phase (rad) of episode k: one pair of legs swings first in one round of directions, the other in the next."""
    return 0.5 * math.pi * (-1) ** (k // len(DIRECTIONS))


def _walk_mjx(options: Options, path: Path, metadata: dict[str, Any], report: Any) -> list[judge.Tally]:
    from tlq import batch

    count = options.episodes
    sizes = terrains.TerrainConfig(kind=options.terrain, num_terrains=count, seed=FIRST_SEED + options.seed)
    level = terrains.parse_difficulty(options.difficulty)
    report(f"building {count} terrains, compiling")
    config = walked_in(metadata, options.knees)
    env = envs.make(batch.evaluation_config(config, sizes, level, options.noise))
    began = time.monotonic()

    def progress(tally: judge.Tally) -> None:
        ended = int(np.sum(tally.ended != judge.RUNNING))
        line = f"{ended} of {count} episodes ended, {np.minimum(tally.progress, judge.GOAL).mean():.2f} m"
        report(f"{line} on average, {time.monotonic() - began:.0f} s")

    directions = np.array([direction(k) for k in range(count)])
    phases = np.array([start_phase(k) for k in range(count)])
    found = batch.walk(load_policy(path), env, directions, phases, seed=options.seed, report=progress)
    return [judge.Tally(*(leaf[k] for leaf in found)) for k in range(count)]


def what_knees_do(metadata: dict[str, Any], knees: str) -> str:
    """fall or touch, given one of `KNEES`."""
    if knees != "training":
        return knees
    trained = metadata.get("training", {}).get("env", {})
    return "touch" if trained.get("knee_contact", False) else "fall"


def walked_in(metadata: dict[str, Any], knees: str) -> envs.EnvConfig:
    """The environment in which a policy was trained, with one of `KNEES`."""
    touch = what_knees_do(metadata, knees) == "touch"
    return dataclasses.replace(training_env(metadata), knee_contact=touch)


class Walk(NamedTuple):
    """One episode in MuJoCo C."""

    tally: judge.Tally
    """What it came to."""
    alarms: int
    """Of the monitor."""
    alarm_m: float | None
    """Progress at the first alarm (m); None if there was none."""
    stood: float
    """Time for which the monitor had the robot stand (s)."""
    highest: float
    """The largest probability that the monitor gave."""


def _walk_mujoco(options: Options, path: Path, metadata: dict[str, Any], report: Any) -> list[Walk]:
    walks: list[Any] = [None] * options.episodes

    def done(k: int, walk: Walk) -> None:
        walks[k] = walk
        ended = sum(w is not None for w in walks)
        report(f"episode {k}: {describe(walk.tally, metadata['control_dt'])} ({ended} of {options.episodes})")

    if options.workers == 1:
        for k in range(options.episodes):
            done(k, mujoco_walk(options, path, k))
        return walks
    context = multiprocessing.get_context("spawn")  # JAX's threads don't survive a fork
    with concurrent.futures.ProcessPoolExecutor(min(options.workers, options.episodes), context) as pool:
        jobs = {pool.submit(mujoco_walk, options, path, k): k for k in range(options.episodes)}
        for job in concurrent.futures.as_completed(jobs):
            done(jobs[job], job.result())
    return walks


def mujoco_walk(
    options: Options, path: Path, k: int, *, change: Callable[[Monitor], None] = lambda monitor: None
) -> Walk:
    """Episode k in MuJoCo C; `change` may set the monitor's thresholds before it begins."""
    from tlq.simulation import Simulation

    controller = Controller(path)
    config = walked_in(controller.metadata, options.knees)
    seed = FIRST_SEED + options.seed
    terrain = terrains.make_terrain(options.terrain, options.difficulty, seed, index=k)
    noise = config.randomisation if options.noise else None
    simulation = Simulation(
        controller,
        terrain,
        config,
        timestep=options.timestep,
        noise=noise,
        perception=options.sensing(),
        seed=seed + k,
    )
    simulation.reset(start_phase(k))
    moment = simulation.moment()
    tally, origin = judge.begin(moment), moment.position
    file = find_monitor(options.monitor)
    if file is None:
        while tally.ended == judge.RUNNING:
            moment = simulation.step(direction(k))
            tally = judge.update(tally, moment, origin, direction(k), controller.control_dt)
        return Walk(tally, 0, None, 0.0, 0.0)
    monitor = Monitor(file, path)
    change(monitor)
    return _watched(simulation, monitor, tally, origin, k)


def _watched(simulation: Any, monitor: Monitor, tally: judge.Tally, origin: np.ndarray, k: int) -> Walk:
    """Episode k, from its start on, with a monitor."""
    controller, stood, alarm, highest = simulation.controller, 0.0, None, 0.0
    while tally.ended == judge.RUNNING:
        stood += controller.control_dt * monitor.standing
        moment = simulation.step((0.0 if monitor.standing else 1.0) * direction(k))
        tally = judge.update(tally, moment, origin, direction(k), controller.control_dt)
        monitor.step(controller)
        if monitor.decision.alarms and alarm is None:
            alarm = float(tally.progress)
        highest = max(highest, monitor.last)
        if stood >= STOOD and not monitor.decision.resume and tally.ended == judge.RUNNING:
            tally = tally._replace(ended=np.asarray(1.0 * judge.STUCK))
    return Walk(tally, monitor.decision.alarms, alarm, stood, highest)


def describe(tally: judge.Tally, dt: float) -> str:
    """One episode in words."""
    progress, time_taken = min(float(tally.progress), judge.GOAL), float(tally.steps) * dt
    return f"{judge.ENDS[int(tally.ended)]} after {progress:.2f} m and {time_taken:.1f} s"


# -- figures ---------------------------------------------------------------------------------------------------------


def wilson(successes: int, trials: int, z: float = 1.959964) -> dict[str, float]:
    """Share of successes and its 95 % Wilson interval: {mean, low, high}."""
    mean = successes / trials
    middle = (mean + z * z / (2 * trials)) / (1 + z * z / trials)
    half = z / (1 + z * z / trials) * math.sqrt(mean * (1 - mean) / trials + z * z / (4 * trials * trials))
    return {"mean": mean, "low": max(middle - half, 0.0), "high": min(middle + half, 1.0)}


def summary(
    options: Options,
    metadata: dict[str, Any],
    tallies: Sequence[judge.Tally],
    watched: Sequence[Walk] | None = None,
) -> dict[str, Any]:
    """The figures over all episodes: JSON. `watched`: where there was a monitor, what came of it."""
    dt = metadata["control_dt"]
    runs = [_run(k, tally, dt) for k, tally in enumerate(tallies)]
    for walk, one in zip(watched or (), runs, strict=False):
        one |= {"alarms": walk.alarms, "first_alarm_m": walk.alarm_m, "stood_s": walk.stood}
    distance = np.array([r["distance_m"] for r in runs])
    swings, walked = sum(float(t.swings) for t in tallies), float(distance.sum())
    total = {name: sum(float(getattr(t, name)) for t in tallies) for name in ("work", "lift", "unsafe")}
    return {
        "terrain": options.terrain,
        "policy": options.policy,
        "engine": options.engine,
        "difficulty": terrains.parse_difficulty(options.difficulty),
        "episodes": len(runs),
        "seed": options.seed,
        "noise": options.noise,
        "knees": what_knees_do(metadata, options.knees),
        "perception": described(options.sensing()),
        "monitor": _monitored(options, watched),
        "method": metadata["method"],
        "commit": metadata["commit"],
        "distance_m": {"mean": distance.mean(), "std": distance.std(), "min": distance.min()},
        "success_rate": wilson(sum(r["ended_by"] == "reached" for r in runs), len(runs)),
        "by_direction": _by_direction(runs),
        "ended_by": {end: sum(r["ended_by"] == end for r in runs) for end in judge.ENDS[1:]},
        "energy_j_per_m": total["work"] / walked if walked > 0 else None,
        "swing_height_m": total["lift"] / swings if swings else None,
        "heading_drift_rad": float(np.mean([abs(r["turned_rad"]) for r in runs])),
        "unsafe_foothold_share": total["unsafe"] / swings if swings else None,
        "speed_m_s": walked / sum(r["time_s"] for r in runs),
        "runs": runs,
    }


def _monitored(options: Options, watched: Sequence[Walk] | None) -> dict[str, Any] | None:
    if watched is None:
        return None
    return {
        "monitor": options.monitor,
        "alarms": sum(walk.alarms for walk in watched),
        "episodes_with_alarm": sum(walk.alarms > 0 for walk in watched),
        "fell_after_alarm": sum(walk.alarms > 0 and int(walk.tally.ended) == judge.FELL for walk in watched),
        "stood_s": sum(walk.stood for walk in watched),
    }


def _run(k: int, tally: judge.Tally, dt: float) -> dict[str, Any]:
    return {
        "direction_rad": DIRECTIONS[k % len(DIRECTIONS)],
        "ended_by": judge.ENDS[int(tally.ended)],
        "distance_m": min(float(tally.progress), judge.GOAL),
        "time_s": float(tally.steps) * dt,
        "turned_rad": float(tally.turned),
    }


def _by_direction(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    found = []
    for angle in DIRECTIONS:
        part = [r for r in runs if r["direction_rad"] == angle]
        if part:
            found.append(
                {
                    "direction_rad": angle,
                    "episodes": len(part),
                    "distance_m": float(np.mean([r["distance_m"] for r in part])),
                    "success_rate": sum(r["ended_by"] == "reached" for r in part) / len(part),
                }
            )
    return found


def table(result: dict[str, Any]) -> str:
    """The figures as text."""

    def number(value: float | None, digits: int, unit: str) -> str:
        return "-" if value is None else f"{value:.{digits}f} {unit}".rstrip()

    distance, success = result["distance_m"], result["success_rate"]
    low, high = round(100 * success["low"]), round(100 * success["high"])
    rows = [
        ("distance", f"{distance['mean']:.3f} m (std {distance['std']:.3f}, min {distance['min']:.3f})"),
        ("success", f"{100 * success['mean']:.0f} % (95 %: {low} to {high} %)"),
        ("ended by", ", ".join(f"{end} {count}" for end, count in result["ended_by"].items())),
        *(
            (
                f"  {math.degrees(d['direction_rad']):5.0f}°",
                f"{d['distance_m']:.3f} m, {100 * d['success_rate']:.0f} %",
            )
            for d in result["by_direction"]
        ),
        ("speed", number(result["speed_m_s"], 3, "m/s")),
        ("energy", number(result["energy_j_per_m"], 1, "J/m")),
        ("swing height", number(result["swing_height_m"], 3, "m")),
        ("heading drift", number(result["heading_drift_rad"], 3, "rad")),
        ("unsafe footholds", number(result["unsafe_foothold_share"], 3, "")),
    ]
    if result["monitor"] is not None:
        said = "{episodes_with_alarm} episodes with an alarm, {fell_after_alarm} of them fell".format(
            **result["monitor"]
        )
        rows.append(("monitor", said))
    head = "{terrain}, difficulty {difficulty:g}, {engine}, {episodes} episodes".format(**result)
    head += ", knees touch" if result["knees"] == "touch" else ""
    return "\n".join([head, *(f"{name:<18}{value}" for name, value in rows)])


def write_json(path: str | os.PathLike[str], result: Any) -> None:
    """Writes a file whole or not at all."""
    with whole(path) as temporary, temporary.open("w") as file:
        json.dump(result, file, indent=2, allow_nan=False)
        file.write("\n")


def main(arguments: Sequence[str]) -> None:
    """Command line."""
    options = parse(Options, arguments, __doc__ or "")
    if options.engine == "mjx":
        from tlq.config import TrainConfig, use_cache

        use_cache(TrainConfig().cache)
    result = evaluate(options, lambda line: print(line, flush=True))
    print(table(result))
    if options.json:
        write_json(options.json, result)


if __name__ == "__main__":
    run(main)
