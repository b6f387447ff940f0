"""A training run: environment, networks and PPO put together, and the folder that a run leaves behind.

run/config.yaml  metrics.csv  events.*  curve.png  policy.npz  checkpoints/  failed/ (after a failed update)
"""

import contextlib
import dataclasses
import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from brax.envs.base import Env
from brax.envs.wrappers.training import VmapWrapper

import tg
from tlq import memory
from tlq.checkpoint import Checkpoints, names, read_arrays
from tlq.config import TrainConfig, load_config, save_config, training_env
from tlq.export import commit
from tlq.files import whole
from tlq.logger import Logger
from tlq.networks import RESIDUALS, make_networks
from tlq.ppo import Learner, TrainState, make_mesh


class TrainingFailed(RuntimeError):
    """An update wasn't finite, or a checkpoint couldn't be written; the text says what was saved where."""


def wrap(env: Env, config: TrainConfig) -> Env:
    """Batched environment with the policy's memory in its observation; `env` is one that resets itself."""
    c = config.policy
    return memory.RecurrentWrapper(
        VmapWrapper(env), memory.carry_size(c.memory, c.memory_layers, c.memory_width)
    )


def make_learner(config: TrainConfig, env: Env | None = None, heights: int | None = None) -> Learner:
    """Learner of `config`; env: a single auto-resetting instance, by default the quadruped of `config.env`."""
    import envs

    if env is None:
        made = envs.make(config.env)
        env = envs.AutoReset(made)
        if config.ppo.guide and made.has_pits:
            env = envs.Guided(env)
    if heights is None:
        heights = 0 if config.env.method == "blind" else 100
    policy = config.policy
    if not isinstance(env, envs.Guided):  # nobody would teach that part of it
        policy = dataclasses.replace(policy, foothold_head=0)
    networks = make_networks(env.observation_size, env.action_size, config=policy, heights=heights)
    return Learner(wrap(env, config), networks, config.ppo, config.num_envs, make_mesh(config.devices))


def train(config: TrainConfig, env: Env | None = None, heights: int | None = None) -> dict[str, float]:
    """Runs or resumes a training run in `config.run`; returns the figures of its last iteration."""
    folder = check_folder(config)
    first = jax.process_index() == 0
    _meet("folder checked")  # before process 0 puts something into it
    if first:
        print(f"run {folder}: building terrain and program, which takes a minute or two", flush=True)
    learner = make_learner(config, env, heights)
    state = learner.init(config.seed)
    goes_on = config.resume and has_checkpoint(folder)
    if config.init and not goes_on:
        state = initialise(state, config.init, config)
        if not int(state.normaliser.count.lo):
            state = measure_rest(learner, state)
    folder.mkdir(parents=True, exist_ok=True)
    if first:
        save_config(config, folder / "config.yaml")
    checkpoints = Checkpoints(folder / "checkpoints", config.keep)
    if goes_on:
        state, _ = checkpoints.restore(state)
    elif config.resume and first:
        print(f"run {folder} was stopped before its first checkpoint; it starts at step 0", flush=True)
    logger = None
    if first:
        logger = Logger(folder, config.steps, int(state.iteration), config.log_every)
    try:
        return _loop(config, learner, state, checkpoints, logger)
    finally:
        if logger:
            with contextlib.suppress(OSError):  # a full disk, of which the first error tells
                logger.close()
        checkpoints.close()


def _loop(
    config: TrainConfig,
    learner: Learner,
    state: TrainState,
    checkpoints: Checkpoints,
    logger: Logger | None,
) -> dict[str, float]:
    iteration = int(state.iteration)  # a Python int, so that the count of steps can't overflow
    figures: dict[str, float] = {}
    saved_at = time.monotonic()
    saved = iteration if config.resume else None
    with _stop_on_signals() as stop:
        while iteration * learner.steps_per_iteration < config.steps and not stop:
            began = time.monotonic()
            before = state
            state, metrics = learner.step(before)
            measured = {k: float(v) for k, v in jax.device_get(metrics).items()}
            iteration += 1
            if not measured.pop("finite"):
                raise TrainingFailed(save_failed(config, learner, before, iteration))
            figures = {
                "iteration": float(iteration),
                "env_steps": float(iteration * learner.steps_per_iteration),
                "steps_per_second": learner.steps_per_iteration / (time.monotonic() - began),
                **measured,
            }
            if logger:
                logger.write(figures)
            if _agree(time.monotonic() - saved_at > config.checkpoint_every):
                save(config, learner, state, checkpoints, logger)
                saved_at, saved = time.monotonic(), iteration
            if _agree(bool(stop)) and not stop:
                stop.append(0)
    if saved != iteration:
        save(config, learner, state, checkpoints, logger)
    steps = iteration * learner.steps_per_iteration
    if not figures:
        print(f"{config.run} has its {steps} steps already; set steps= to a larger number to go on")
    elif stop and logger:
        print(f"stopped at {steps} steps; go on with run={config.run} resume=true")
    return figures


def save(
    config: TrainConfig,
    learner: Learner,
    state: TrainState,
    checkpoints: Checkpoints,
    logger: Logger | None,
) -> None:
    """Checkpoint, exported policy and picture of the run so far."""
    iteration = int(state.iteration)
    env_steps = iteration * learner.steps_per_iteration
    before = checkpoints.steps()
    try:
        checkpoints.save(iteration, state, {"env_steps": env_steps, "seed": config.seed})
    except Exception as error:  # a full disk shows as one of many
        reason = (str(error).strip().partition("\n")[0] or type(error).__name__)[:200]
        kept = f"checkpoint {before[-1]} is as it was" if before else "nothing was saved before"
        raise TrainingFailed(
            f"can't write checkpoint {iteration} in {checkpoints.folder}: {reason}; {kept}"
        ) from error
    if logger:
        logger.draw()
        export(config, state, env_steps)


def export(config: TrainConfig, state: TrainState, env_steps: int) -> None:
    """Refreshes policy.npz; a run on an environment that isn't the quadruped has none."""
    if config.env is None:
        return
    from tlq.export import export_policy

    path = Path(config.run) / "policy.npz"
    export_policy(path, config, state.average, state.normaliser, {"env_steps": env_steps})


def save_failed(config: TrainConfig, learner: Learner, before: TrainState, iteration: int) -> str:
    """Saves the whole state before a failed update, from which one `Learner.step` fails again, and the batch it read.

    Returns the message. The batch is `batch-<process>.npz`, with this process's environments.
    """
    place = Path(config.run) / "failed"
    failed = Checkpoints(place)
    failed.save(iteration - 1, before, {"seed": config.seed, "iteration": iteration, "commit": commit()})
    failed.close()
    with whole(place / f"batch-{config.process}.npz") as temporary:
        parts: dict[str, Any] = {name: _own(name, x) for name, x in learner.batch(before).items()}
        np.savez_compressed(temporary, **parts)
    leaves = zip(names(before.env_state), jax.tree.leaves(before.env_state), strict=True)
    bad = [n for n, x in leaves if np.issubdtype(x.dtype, np.floating) and not bool(jnp.isfinite(x).all())]
    why = f"; not finite before it: {', '.join(bad[:4])}" if bad else ""
    saved = f"the state before it and its batch are in {place}"
    return f"update {iteration} (seed {config.seed}) isn't finite; {saved}{why}"


def _own(name: str, x: jax.Array) -> np.ndarray:
    """The part of a batch that lies on this process's devices."""
    if x.is_fully_addressable:
        return np.asarray(x)
    axis = 0 if name in ("carry", "last") else 1
    shards = sorted(x.addressable_shards, key=lambda shard: shard.index[axis].start)
    return np.concatenate([np.asarray(shard.data) for shard in shards], axis)


def initialise(state: TrainState, source: str, config: TrainConfig | None = None) -> TrainState:
    """Parameters and normaliser from another run's folder or from a policy file (which has nothing for the critic).

    config: of the run that starts; a policy that learnt with another range of residual angles is converted. Where the
      learning rate is steered it starts at the lowest: the usual one may be far too high for a policy whose actions
      have little spread, which loses then in one update what it has learnt. It rises within some iterations.
    """
    path, before = Path(source), None
    if path.is_dir():
        arrays = read_arrays(path / "checkpoints" if (path / "checkpoints").is_dir() else path)
        # What the run's policy.npz has, too.
        averaged = {n.removeprefix("average."): x for n, x in arrays.items() if n.startswith("average.")}
        arrays |= {f"params.policy.{name}": x for name, x in averaged.items()}
        if (path / "config.yaml").is_file():
            before = load_config(path / "config.yaml").env
    else:
        with np.load(path) as file:
            arrays = {k: file[k] for k in file.files}
        if "metadata" in arrays:
            before = training_env(json.loads(str(arrays["metadata"])))
    if config is not None and config.env is not None and before is not None:
        ratio = before.tg.residual_range / config.env.tg.residual_range
        if ratio != 1.0:
            arrays = rescale_residuals(arrays, ratio)
    if config is not None and config.init_spread != 1.0:
        arrays = rescale_spread(arrays, config.init_spread)
    parts = {"params": state.params, "normaliser": state.normaliser}
    owned = {
        n: x.shape for n, x in zip(names(parts), jax.tree.leaves(parts), strict=True) if ".footholds." in n
    }
    # A part for footholds as it was before learns anew; PPO doesn't train it.
    afresh = any(name not in arrays or arrays[name].shape != shape for name, shape in owned.items())
    taken = []

    def take(name: str, x: jax.Array) -> jax.Array:
        new = arrays.get(name)
        if afresh and name in owned:
            return x
        if new is None or new.shape != x.shape:
            if name.startswith("params.policy"):
                has = "missing" if new is None else f"of shape {new.shape}"
                raise ValueError(f"init={source} doesn't fit: {name} is {has}, not of shape {x.shape}")
            return x
        taken.append(name)
        return jax.device_put(new.astype(x.dtype), x.sharding)

    measured = "normaliser.mean.privileged_state"
    if measured in arrays and arrays[measured].shape != state.normaliser.mean["privileged_state"].shape:
        # The critic sees other things than it did: its normaliser is measured anew, see `measure_rest`.
        arrays = {k: v for k, v in arrays.items() if not k.startswith("normaliser.count")}
    flat = [take(n, x) for n, x in zip(names(parts), jax.tree.leaves(parts), strict=True)]
    if any(".footholds." in name for name in arrays) and "footholds" not in state.params.policy["params"]:
        needs = "terrain with pits, ppo.guide and policy.foothold_head"
        raise ValueError(f"init={source} doesn't fit: it has a part for footholds, which needs {needs}")
    parts = jax.tree.unflatten(jax.tree.structure(parts), flat)
    print(f"init: {len(taken)} of {len(flat)} arrays from {source}", flush=True)
    if afresh and owned and any(".footholds." in name for name in arrays):
        print(
            "init: its part for footholds is of another shape and learns anew; "
            "see policy.foothold_head, foothold_keep",
            flush=True,
        )
    rate = state.learning_rate
    if config is not None and config.ppo.kl_target > 0:
        rate = jax.device_put(np.float32(config.ppo.learning_rate_min), rate.sharding)
    return dataclasses.replace(
        state,
        params=parts["params"],
        average=parts["params"].policy,
        normaliser=parts["normaliser"],
        learning_rate=rate,
    )


def _spread_times(factor: float, raw: np.ndarray) -> np.ndarray:
    """Raw scales whose softplus is `factor` times that of `raw`; finite however large."""
    spread = factor * np.logaddexp(raw, 0.0)
    return spread + np.log(-np.expm1(-spread))


def rescale_residuals(arrays: dict[str, np.ndarray], ratio: float) -> dict[str, np.ndarray]:
    """A policy's parameters and normaliser with residual actions `ratio` times as large as they were.

    So it asks for the same angles where the range of residuals is 1/ratio times as wide: exactly where actions are
    small, somewhat more where they were near their limits.
    """
    arrays, residual = dict(arrays), RESIDUALS
    spread = slice(tg.ACTION_SIZE + RESIDUALS.start, 2 * tg.ACTION_SIZE)
    seen = tg.core.offset("actions") + np.arange(2 * tg.ACTION_SIZE).reshape(2, -1)[:, residual].reshape(-1)
    for name, x in arrays.items():
        x = np.array(x)
        if name.endswith("params.action.kernel"):
            x[:, residual] *= ratio
        elif name.endswith("params.action.bias"):
            x[residual] *= ratio
            x[spread] = _spread_times(ratio, x[spread])
        elif ".leg_action." in name:
            x *= ratio
        elif name.startswith(("normaliser.mean.", "normaliser.std.")):
            x[seen] *= ratio
        elif name.startswith("normaliser.summed_variance."):
            x[seen] *= ratio**2
        else:
            continue
        arrays[name] = x
    return arrays


def rescale_spread(arrays: dict[str, np.ndarray], factor: float) -> dict[str, np.ndarray]:
    """A policy's parameters with `factor` times the standard deviation of its actions before tanh, beyond the least.

    Where the policy's spread differs from state to state that holds as long as it is well below 1.
    """
    arrays, name = dict(arrays), "params.policy.params.action.bias"
    if name in arrays:
        x = np.array(arrays[name])
        x[tg.ACTION_SIZE :] = _spread_times(factor, x[tg.ACTION_SIZE :])
        arrays[name] = x
    return arrays


def measure_rest(learner: Learner, state: TrainState) -> TrainState:
    """Normaliser of a policy file completed by what one iteration, which only looks, measures for the critic.

    It then counts as if seen for a hundred iterations, so that the policy's part of it stays nearly what it was.
    """
    looked, _ = learner.step(state)
    given, measured = state.normaliser, looked.normaliser
    count = 100 * int(measured.count.lo)
    chosen = {k: given if k == "state" else measured for k in measured.mean}
    std = {k: n.std[k] for k, n in chosen.items()}
    normaliser = measured.replace(
        mean={k: n.mean[k] for k, n in chosen.items()},
        std=std,
        summed_variance={k: count * jnp.square(x) for k, x in std.items()},
        count=dataclasses.replace(
            measured.count, lo=jax.device_put(np.uint32(count), measured.count.lo.sharding)
        ),
    )
    return dataclasses.replace(looked, normaliser=normaliser, iteration=state.iteration)


def has_checkpoint(folder: Path) -> bool:
    """Whether a run has a checkpoint, be it damaged; what a killed process was writing is none."""
    names = [path.name for path in (folder / "checkpoints").glob("*")]
    return any(name.isdigit() or name.startswith("damaged-") for name in names)


def check_folder(config: TrainConfig) -> Path:
    """The run's folder; it must be new, or hold a run if `resume` is set."""
    folder = Path(config.run)
    if config.resume:
        if not (folder / "config.yaml").exists():
            raise ValueError(f"run={folder} holds no run to resume")
    elif folder.exists() and (
        not folder.is_dir() or any(not p.name.startswith(".") for p in folder.iterdir())
    ):
        raise ValueError(
            f"run={folder} exists already; add resume=true to go on with it, or choose another name"
        )
    if config.init and not Path(config.init).exists():
        raise ValueError(f"init={config.init}: no such run folder or policy file")
    return folder


@contextlib.contextmanager
def _stop_on_signals() -> Iterator[list[int]]:
    """A list that isn't empty once SIGINT or SIGTERM came; a second signal ends the process at once."""
    stop: list[int] = []

    def handle(number: int, frame: Any) -> None:
        stop.append(number)
        signal.signal(number, signal.SIG_DFL)
        print("stopping after this iteration", flush=True)

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _meet(name: str) -> None:
    """Waits until all processes have come here."""
    if jax.process_count() > 1:
        from jax.experimental import multihost_utils

        multihost_utils.sync_global_devices(name)


def _agree(flag: bool) -> bool:
    """What the first host decides, on all hosts."""
    if jax.process_count() == 1:
        return flag
    from jax.experimental import multihost_utils

    return bool(multihost_utils.broadcast_one_to_all(np.asarray(flag)))
