"""Steps per second of environment and training, and what they are compared with.

    python -m benchmarks.throughput                        # the comparisons, a few minutes
    python -m benchmarks.throughput scaling=true start=true json=FILE

Everything is measured in one process, the sides of a comparison in turn, medians of `rounds`:

- env_vs_mujoco_c: environment steps (trajectory generator, look-ups, sensors, rewards and resets included) on stepping
  stones, each environment on a terrain of its own, over control steps of MuJoCo C's `mujoco.rollout` with as many
  threads as cores: the same robot, timestep, substeps and solver iterations on a heightfield of the same resolution,
  following joint angles that the environment recorded. MuJoCo C does the physics alone there.
- training_vs_env: steps per second of training, everything included, over those of the environment.
- env_vs_playground: over MuJoCo Playground's Go1 joystick on rough terrain, if the package `playground` is installed.
- start: seconds from the command to the first update, with an empty compilation cache and with a filled one.
- scaling: environment steps per second by the number of environments, and by the number of terrains.
"""

import dataclasses
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tlq import cores

cores.use_all_cores()  # before JAX starts

import jax  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import mujoco  # noqa: E402
import mujoco.rollout  # noqa: E402
import numpy as np  # noqa: E402

import envs  # noqa: E402
import terrains  # noqa: E402
from benchmarks import timing  # noqa: E402
from envs.limits import check_values  # noqa: E402
from envs.robot import robot_spec  # noqa: E402
from tlq import cli  # noqa: E402
from tlq import config as settings  # noqa: E402
from tlq.training import make_learner  # noqa: E402

ROOT = Path(__file__).resolve().parents[1]
STEPS = 20
"""Control steps of one measurement."""


@dataclasses.dataclass(frozen=True)
class Options:
    """The command line."""

    num_envs: int = cli.option(1024, "environments of the comparisons")
    num_terrains: int = cli.option(1024, "terrains of the comparisons")
    rounds: int = cli.option(5, "times that each side is measured")
    scaling: bool = cli.option(False, "also by the number of environments and of terrains")
    start: bool = cli.option(False, "also the time to the first update")
    most_envs: int = cli.option(8192, "largest number of environments with scaling=true")
    json: str = cli.option("", "file for the result")


class Environments:
    """Environments without the policy: a function that makes some steps.

    guided: as in training, where a scripted guide to footholds is asked what it says.
    bank: of the same kind and number of terrains, if there is one already: building it takes longer than measuring.
    """

    def __init__(
        self,
        kind: str,
        num_envs: int,
        num_terrains: int,
        guided: bool = False,
        bank: terrains.Bank | None = None,
    ):
        changes = {"env.terrain.kind": kind, "env.terrain.num_terrains": num_terrains, "num_envs": num_envs}
        if not guided:
            changes["ppo.guide"] = 0.0
        self.config = settings.changed(settings.default_config(), changes)
        settings.validate(self.config)
        made = envs.QuadrupedEnv(self.config.env, bank)
        self.bank = made.bank
        env = envs.AutoReset(made)
        self.learner = make_learner(self.config, envs.Guided(env) if guided else env)
        self.state = self.learner.init(0)
        self._run = timing.env_steps(self.learner, STEPS)

    def run(self) -> None:
        """STEPS steps of every environment, which go on from the last ones."""
        env_state = self._run(self.state.env_state)
        self.state = jax.block_until_ready(self.state.replace(env_state=env_state))

    @property
    def steps(self) -> int:
        """Environment steps of one `run`."""
        return self.config.num_envs * STEPS

    def sizes(self) -> dict[str, float]:
        """Bytes of an environment's state, of its part of a rollout, of a terrain; number of parameters."""
        batch = jax.eval_shape(self.learner.batch, self.state)
        rollout = {name: part for name, part in batch.items() if name not in ("carry", "last")}
        return {
            "bytes_per_env": _bytes(self.state.env_state) / self.config.num_envs,
            "rollout_bytes_per_env": _bytes(rollout) / self.config.num_envs,
            "bytes_per_terrain": self.bank.nbytes / self.bank.num_terrains,
            "parameters": sum(x.size for x in jax.tree.leaves(self.state.params)),
        }


def _bytes(tree: Any) -> int:
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def rates(sides: dict[str, tuple[Callable[[], None], int]], rounds: int) -> dict[str, float]:
    """Median steps per second of functions and their steps, measured in turn."""
    seconds = timing.medians({name: function for name, (function, _) in sides.items()}, rounds)
    return {name: steps / seconds[name] for name, (_, steps) in sides.items()}


class MujocoC:
    """The same robot in MuJoCo C on a heightfield, following recorded joint angles."""

    def __init__(self, config: envs.EnvConfig, num_envs: int):
        terrain = config.terrain
        self.substeps = round(config.control_dt / config.physics_dt)
        heights = np.asarray(terrains.make_bank(terrain.kind, 1, terrain.seed, ["paper"], terrain).heights[0])
        self.model = self._model(config, heights.astype(float).T * 1e-3)
        self.threads = cores.count()
        self.data = [mujoco.MjData(self.model) for _ in range(self.threads)]
        desired, start = recorded(config)
        control = np.repeat(desired, self.substeps, axis=1)
        repeats = -(-num_envs // len(control))
        self.control = np.tile(control, (repeats, 1, 1))[:num_envs]
        size = mujoco.mj_stateSize(self.model, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self.start = np.zeros((num_envs, size))
        data = mujoco.MjData(self.model)
        data.qpos[:] = start
        mujoco.mj_getState(self.model, data, self.start[0], mujoco.mjtState.mjSTATE_FULLPHYSICS)
        self.start[:] = self.start[0]
        self._pool = mujoco.rollout.Rollout(nthread=self.threads)

    def _model(self, config: envs.EnvConfig, heights: np.ndarray) -> mujoco.MjModel:
        spec = robot_spec(config.robot)
        spec.option.timestep = config.physics_dt
        spec.option.iterations = config.solver_iterations
        spec.option.ls_iterations = 3
        low, high = float(heights.min()), float(heights.max())
        extent = config.terrain.half_extent
        spec.add_hfield(
            name="ground",
            nrow=heights.shape[0],
            ncol=heights.shape[1],
            size=[extent, extent, max(high - low, 1e-3), 0.1],
            userdata=((heights - low) / max(high - low, 1e-3)).ravel(),
        )
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground", pos=[0, 0, low], name="ground"
        )
        for actuator in spec.actuators:  # the environment's PD control, as MuJoCo has it
            actuator.set_to_position(kp=config.robot.kp, kv=config.robot.kd)
        return spec.compile()

    def run(self) -> None:
        """STEPS control steps of every robot."""
        self._pool.rollout([self.model], self.data, self.start, self.control)


def recorded(config: envs.EnvConfig, robots: int = 64) -> tuple[np.ndarray, np.ndarray]:
    """Desired joint angles (robots, STEPS, 12) rad of a trot in all directions, and the standing qpos (19,)."""
    small = dataclasses.replace(config, terrain=dataclasses.replace(config.terrain, num_terrains=12))
    env = envs.make(small)

    def run(key):
        def step(state, _):
            state = env.step(state, jnp.zeros(env.action_size))
            return state, state.pipeline_state.controller.desired

        return jax.lax.scan(step, env.reset(key), length=STEPS)[1]

    desired = jax.jit(jax.vmap(run))(jax.random.split(jax.random.PRNGKey(0), robots))
    return np.asarray(desired, float), np.asarray(env.standing, float)


def compare(options: Options) -> dict[str, Any]:
    """The ratios, and the rates behind them."""
    plain = Environments("stepping_stones", options.num_envs, options.num_terrains)
    stones = Environments("stepping_stones", options.num_envs, options.num_terrains, True, plain.bank)
    c = MujocoC(stones.config.env, options.num_envs)

    def training() -> None:
        stones.state, _ = jax.block_until_ready(stones.learner.step(stones.state))

    found = rates(
        {
            "env": (plain.run, plain.steps),
            "mujoco_c": (c.run, stones.steps),
            "training": (training, stones.learner.steps_per_iteration),
        },
        options.rounds,
    )
    return {
        "env_vs_mujoco_c": found["env"] / found["mujoco_c"],
        "training_vs_env": found["training"] / found["env"],
        "env_vs_playground": playground(options, found["env"]),
        "steps_per_second": found,
        **stones.sizes(),
    }


def playground(options: Options, rate: float) -> float | str:
    """Our steps per second over those of MuJoCo Playground's Go1, or why there is no figure."""
    try:
        from mujoco_playground import registry
    except ImportError:
        return "skipped: the package playground isn't installed"
    try:
        name = "Go1JoystickRoughTerrain"
        env = registry.load(name, config_overrides={"impl": "jax"})
        state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), options.num_envs))
    except Exception as error:  # its meshes are fetched from the network
        return f"skipped: {cli.one_line(error)[:200]}"
    action = jnp.zeros((options.num_envs, env.action_size))
    run = jax.jit(
        lambda s: jax.lax.scan(lambda s, _: (jax.vmap(env.step)(s, action), None), s, length=STEPS)[0]
    )
    theirs = rates(
        {name: (lambda: jax.block_until_ready(run(state)), options.num_envs * STEPS)}, options.rounds
    )
    return rate / theirs[name]


def scaling(options: Options) -> dict[str, Any]:
    """Environment steps per second on poles by the number of environments and by the number of terrains."""
    by_envs, by_terrains = {}, {}
    number = 64
    while number <= options.most_envs:
        one = Environments("poles", number, min(number, options.num_terrains))
        by_envs[number] = rates({"env": (one.run, one.steps)}, options.rounds)["env"]
        number *= 2
    for number in (1, 16, 256, 1024, 4096):
        one = Environments("poles", options.num_envs, number)
        by_terrains[number] = rates({"env": (one.run, one.steps)}, options.rounds)["env"]
    return {"steps_per_second_by_envs": by_envs, "steps_per_second_by_terrains": by_terrains}


def start(options: Options) -> dict[str, float]:
    """Seconds from the command to the end of the first update, which compiles or finds what was compiled."""
    with tempfile.TemporaryDirectory() as folder:
        found = {}
        for name in ("cold", "cached"):
            command = [sys.executable, str(ROOT / "train.py"), "terrain=poles", "steps=1e9", "log_every=0"]
            command += [f"run={folder}/{name}", f"cache={folder}/cache", f"num_envs={options.num_envs}"]
            began = time.perf_counter()
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
            assert process.stdout is not None
            for line in process.stdout:
                if "steps " in line and "k/s" in line:
                    break
            found[name] = time.perf_counter() - began
            process.kill()
            process.wait()
    return {f"seconds_to_first_update_{name}": value for name, value in found.items()}


def main(arguments: Sequence[str]) -> None:
    """Prints the JSON."""
    options = cli.parse(Options, arguments, __doc__ or "")
    cli.check_folders(options, "json")
    check_values(dataclasses.asdict(options), timing.LIMITS)
    settings.use_cache(settings.TrainConfig().cache)
    result = compare(options)
    if options.scaling:
        result |= scaling(options)
    if options.start:
        result |= start(options)
    timing.put_out(result, dataclasses.asdict(options), options.json)


if __name__ == "__main__":
    cli.run(main)
