"""How many Newton iterations the physics needs: the whole robot trotting in MJX, against MuJoCo C that has converged.

    python -m benchmarks.solver            # a table
    python -m benchmarks.solver json=FILE  # and the same as JSON

The controller trots from a stand in eight directions on flat ground (action 0); both engines have the timestep of
training. Deviations are of the trunk, medians over the directions. Speeds are of control and physics together, in
batches of 256, and mean something only relative to each other.
"""

import dataclasses
import json
import time
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import envs
import terrains
import tg
from envs.scene import build_scene
from tlq import cli
from tlq.files import whole

DIRECTIONS, BATCH, STEPS = 8, 256, 26
TIMES = (5, 10, 25)
"""Control steps (20 ms each) after which the engines are compared."""
SETTINGS = ((1, 1), (1, 2), (1, 3), (1, 4), (2, 1), (2, 3))
"""Planes a foot, Newton iterations."""


def make_env(num_planes: int = 1, iterations: int = 1) -> envs.QuadrupedEnv:
    """An environment on flat ground without randomisation, starting at the origin with heading 0."""
    config = envs.EnvConfig(
        terrain=terrains.TerrainConfig(kind="flat", num_terrains=1, half_extent=2.0),
        randomisation=envs.RandomisationConfig(enabled=False),
        num_planes=num_planes,
        solver_iterations=iterations,
        spawn_offset=0.0,
        spawn_yaw=0.0,
        stand_share=0.0,
        stop_share=0.0,
    )
    return envs.make(config)


def commands(count: int) -> np.ndarray:
    """(N, 2) unit vectors, the first eight all round."""
    angle = np.arange(count) * 2 * np.pi / DIRECTIONS
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1).astype(np.float32)


def trot_mjx(env: envs.QuadrupedEnv, count: int):
    """A jitted function of no argument: trunk positions and velocities (N, T, 2, 3) of `count` robots."""

    def run(command):
        episode = env.begin(jax.random.key(0), jnp.int32(0)).replace(command=command)
        start = env.core.initial_state(jnp.float32(0.5 * np.pi))

        def step(episode, _):
            sensors, heading = env.sense(episode), env.heading_command(episode)
            controller, _ = env.core.act(episode.controller, jnp.zeros(14), sensors, heading)
            episode = env._simulate(episode, controller).replace(controller=controller)
            return episode, jnp.stack([episode.qpos[:3], episode.qvel[:3]])

        return jax.lax.scan(step, episode.replace(controller=start), length=STEPS)[1]

    return jax.jit(lambda: jax.vmap(run)(commands(count)))


def trot_c(env: envs.QuadrupedEnv, iterations: int = 100) -> np.ndarray:
    """The same (8, T, 2, 3) by MuJoCo C, with the same start."""
    robot = env.robot
    model = build_scene(env.config.robot, None, timestep=env.config.physics_dt, iterations=iterations)
    data = mujoco.MjData(model)
    found = np.zeros((DIRECTIONS, STEPS, 2, 3))
    for i, command in enumerate(commands(DIRECTIONS)):
        mujoco.mj_resetData(model, data)
        data.qpos[:] = env.standing
        state = env.core.initial_state(np.asarray(0.5 * np.pi, np.float32))
        for t in range(STEPS):
            q, v = data.qpos.astype(np.float32), data.qvel.astype(np.float32)
            sensors = tg.Sensors(q[3:7], v[3:6], q[7:], v[6:])
            heading = tg.frames.turn(-tg.frames.yaw(q[3:7]), command)
            state, desired = env.core.act(state, np.zeros(14, np.float32), sensors, heading)
            damping = robot.config.kd * env.core.damping(state)
            for _ in range(env.substeps):
                torque = robot.config.kp * (desired - data.qpos[7:]) - damping * data.qvel[6:]
                data.ctrl[:] = np.clip(torque, -robot.torque_limit, robot.torque_limit)
                mujoco.mj_step(model, data)
            found[i, t] = data.qpos[:3], data.qvel[:3]
    return found


def measure() -> list[dict[str, float]]:
    """One row a setting."""
    rows, runs = [], []
    for planes, iterations in SETTINGS:
        env = make_env(planes, iterations)
        run = trot_mjx(env, BATCH)
        found = np.asarray(run())[:DIRECTIONS]
        apart = np.median(np.linalg.norm(found - trot_c(env), axis=-1), axis=0)
        row = {"planes": planes, "iterations": iterations}
        for t in TIMES:
            row[f"position_{20 * t}ms"], row[f"speed_{20 * t}ms"] = map(float, apart[t - 1])
        rows.append(row)
        runs.append(run)
    best = np.full(len(runs), np.inf)
    for _ in range(5):  # in turn, so that other load on the machine hits all of them
        for i, run in enumerate(runs):
            start = time.perf_counter()
            jax.block_until_ready(run())
            best[i] = min(best[i], time.perf_counter() - start)
    for row, seconds in zip(rows, best, strict=True):
        row["steps_per_second"] = BATCH * STEPS / float(seconds)
    return rows


@dataclasses.dataclass(frozen=True)
class Options:
    """The command line."""

    json: str = cli.option("", "file for the table")


def main(arguments: Sequence[str]) -> None:
    """Prints the table; `json=FILE` also writes it."""
    options = cli.parse(Options, arguments, __doc__ or "")
    cli.check_folders(options, "json")
    rows = measure()
    print(
        "planes  iterations  "
        + "".join(f"{f'{20 * t} ms: mm':>14}{'m/s':>8}" for t in TIMES)
        + "   env steps/s"
    )
    for r in rows:
        apart = "".join(
            f"{1e3 * r[f'position_{20 * t}ms']:14.2f}{r[f'speed_{20 * t}ms']:8.4f}" for t in TIMES
        )
        print(f"{r['planes']:6}{r['iterations']:12}  {apart}{r['steps_per_second']:14.0f}")
    if options.json:
        with whole(options.json) as temporary:
            temporary.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    cli.run(main)
