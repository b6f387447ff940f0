"""A run and its folder: what it leaves behind, and that it goes on where it stopped."""

import csv
import dataclasses
import math
import os
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme.running_statistics import init_state
from brax.training.agents.ppo.losses import PPONetworkParams

from tests.tlq.toy import ToyEnv
from tlq import training
from tlq.checkpoint import names, read_arrays
from tlq.config import TrainConfig, load_config
from tlq.logger import Logger, read_csv, text_line
from tlq.networks import NetworkConfig, make_networks
from tlq.ppo import PPOConfig, TrainState
from tlq.training import (
    TrainingFailed,
    initialise,
    make_learner,
    measure_rest,
    rescale_residuals,
    rescale_spread,
    train,
)

ROOT = Path(__file__).parents[2]
NETWORKS = NetworkConfig(
    memory_width=8, memory_layers=1, encoder=16, foot_encoder=(8, 4), head=8, critic=(16,)
)
CONFIG = TrainConfig(
    policy=NETWORKS, ppo=PPOConfig(unroll=6, minibatches=2), num_envs=8, log_every=0.0, checkpoint_every=1e9
)
STEPS = 8 * 6  # of an iteration


@pytest.fixture(scope="module")
def learner():
    return make_learner(CONFIG, ToyEnv(length=5), heights=100)


@pytest.fixture
def run(learner, monkeypatch, tmp_path):
    """Trains for some iterations in tmp_path / name, with one compiled learner for all tests."""
    monkeypatch.setattr(training, "make_learner", lambda *_: learner)
    monkeypatch.setattr(training, "export", lambda *_: None)

    def call(iterations, name="run", **changes):
        config = dataclasses.replace(CONFIG, steps=iterations * STEPS, run=str(tmp_path / name), **changes)
        return train(config)

    return call


def table(path, drop=("steps_per_second",)):
    with path.open() as file:
        return [{k: v for k, v in row.items() if k not in drop} for row in csv.DictReader(file)]


def test_what_a_run_leaves_behind(run, tmp_path, capsys):
    figures = run(3)
    folder = tmp_path / "run"
    assert figures["iteration"] == 3 and figures["env_steps"] == 3 * STEPS
    assert load_config(folder / "config.yaml").ppo == CONFIG.ppo
    rows = read_csv(folder / "metrics.csv")
    assert [row["env_steps"] for row in rows] == [STEPS, 2 * STEPS, 3 * STEPS]
    expected = {
        "reward",
        "reward/match",
        "episode/distance",
        "episode/fell",
        "episode/length",
        "episodes",
        "level",
    }
    expected |= {
        "loss/policy",
        "loss/surrogate",
        "loss/value",
        "kl",
        "std",
        "learning_rate",
        "steps_per_second",
    }
    assert expected <= set(rows[0])
    assert list(folder.glob("events.*")) and (folder / "curve.png").stat().st_size > 1000
    assert [p.name for p in (folder / "checkpoints").iterdir() if p.is_dir()] == ["3"]
    lines = [line for line in capsys.readouterr().out.splitlines() if "steps " in line]
    assert len(lines) == 3 and "kl" in lines[0] and "distance" in lines[0]


def test_a_resumed_run_is_the_uninterrupted_one(run, tmp_path):
    run(5, "whole")
    run(2, "parts")
    run(5, "parts", resume=True)
    whole, parts = (read_arrays(tmp_path / name / "checkpoints") for name in ("whole", "parts"))
    assert whole.keys() == parts.keys() and len(whole) > 30
    for name, x in whole.items():
        np.testing.assert_array_equal(x, parts[name], err_msg=name)
    assert table(tmp_path / "whole/metrics.csv") == table(tmp_path / "parts/metrics.csv")


def test_a_run_that_is_complete_says_so(run, capsys):
    run(2)
    assert run(2, resume=True) == {}
    assert f"has its {2 * STEPS} steps already" in capsys.readouterr().out


def test_rows_after_the_checkpoint_are_dropped_on_resume(tmp_path):
    log = Logger(tmp_path, 100)
    for i in range(1, 5):
        log.write({"iteration": i, "env_steps": 10 * i, "steps_per_second": 1.0, "reward": i})
    log.close()
    log = Logger(tmp_path, 100, iteration=2)
    log.write({"iteration": 3, "env_steps": 30, "steps_per_second": 1.0, "reward": 9.0})
    log.close()
    assert [row["reward"] for row in read_csv(tmp_path / "metrics.csv")] == [1, 2, 9]


def test_a_signal_ends_the_run_with_a_checkpoint(run, tmp_path, monkeypatch, capsys):
    write = Logger.write

    def interrupt(self, figures):
        write(self, figures)
        if figures["iteration"] == 2:
            os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(Logger, "write", interrupt)
    run(9)
    out = capsys.readouterr().out
    assert f"stopped at {2 * STEPS} steps; go on with run={tmp_path / 'run'} resume=true" in out
    assert (tmp_path / "run/checkpoints/2").is_dir()
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL
    assert run(3, resume=True)["iteration"] == 3


def test_a_failed_update_leaves_the_state_before_it(run, learner, tmp_path, monkeypatch):
    step = learner.step

    def poisoned(state):
        if int(state.iteration) == 2:
            obs = dict(
                state.env_state.obs, privileged_state=state.env_state.obs["privileged_state"] * jnp.nan
            )
            state = state.replace(env_state=state.env_state.replace(obs=obs))
        return step(state)

    monkeypatch.setattr(learner, "step", poisoned)
    with pytest.raises(
        TrainingFailed,
        match=f"update 3 .seed 0. isn't finite; the state before it and its batch are in {tmp_path}",
    ):
        run(5)
    saved = read_arrays(tmp_path / "run/failed")
    assert saved["iteration"] == 2
    assert all(np.isfinite(x).all() for n, x in saved.items() if n.startswith("params"))
    with np.load(tmp_path / "run/failed/batch-0.npz") as batch:
        shapes = {name: x.shape for name, x in batch.items()}
        # The next update's, from the state that was saved.
        np.testing.assert_array_equal(batch["carry"], saved["env_state.obs.carry"])
        np.testing.assert_array_equal(batch["state"][0], saved["env_state.obs.state"])
    unroll, envs = learner.config.unroll, learner.num_envs
    assert shapes["reward"] == shapes["done"] == shapes["log_prob"] == (unroll, envs)
    assert shapes["action"] == (unroll, envs, 14) and shapes["last"][0] == envs


def test_folders_are_never_overwritten(run, tmp_path):
    run(1)
    with pytest.raises(ValueError, match="exists already; add resume=true to go on with it"):
        run(1)
    with pytest.raises(ValueError, match="holds no run to resume"):
        run(1, "another", resume=True)
    with pytest.raises(ValueError, match="no such run folder or policy file"):
        run(1, "another", init=str(tmp_path / "nothing"))
    assert not (tmp_path / "another").exists()


def test_a_run_can_start_from_another_ones_parameters(run, learner, tmp_path):
    run(3)
    arrays = read_arrays(tmp_path / "run/checkpoints")
    state = initialise(learner.init(7), str(tmp_path / "run"))
    for name, x in zip(names(state), jax.tree.leaves(state), strict=True):
        if name.startswith(("params", "normaliser", "average")):
            # The policy's parameters are the averaged ones, as in the run's policy file.
            taken = name.replace("params.policy", "average") if name.startswith("params") else name
            np.testing.assert_array_equal(x, arrays[taken], err_msg=name)
    changed = [n for n in arrays if n.startswith("params.policy")]
    assert any((arrays[n] != arrays[n.replace("params.policy", "average")]).any() for n in changed)
    assert int(state.iteration) == 0
    # Where the KL steers the learning rate it starts low, else as it is set.
    for target, rate in ((0.01, 2e-5), (0.0, 1e-3)):
        ppo = PPOConfig(kl_target=target, learning_rate=1e-3, learning_rate_min=2e-5)
        fresh = dataclasses.replace(learner.init(7), learning_rate=jnp.float32(ppo.learning_rate))
        begun = initialise(fresh, str(tmp_path / "run"), TrainConfig(ppo=ppo))
        assert float(begun.learning_rate) == pytest.approx(rate)


def test_a_run_can_start_from_a_policy_file(run, learner, tmp_path):
    """It has neither critic nor the normaliser's part for it; what the policy sees stays as it was."""
    run(3)
    arrays = read_arrays(tmp_path / "run/checkpoints")
    kept = {
        n: x
        for n, x in arrays.items()
        if n.startswith("params.policy") or n.endswith(("mean.state", "std.state"))
    }
    np.savez(tmp_path / "policy.npz", **kept)
    fresh = learner.init(7)
    state = measure_rest(learner, initialise(fresh, str(tmp_path / "policy.npz")))
    for name, x, y in zip(names(state), jax.tree.leaves(state), jax.tree.leaves(fresh), strict=True):
        if name.startswith("params"):
            np.testing.assert_array_equal(x, arrays[name] if name in kept else y, err_msg=name)
    np.testing.assert_array_equal(state.normaliser.mean["state"], arrays["normaliser.mean.state"])
    assert int(state.iteration) == 0
    after, _ = learner.step(state)
    assert any(
        (x != y).any() for x, y in zip(*map(jax.tree.leaves, (state.params, after.params)), strict=True)
    )
    np.testing.assert_allclose(
        after.normaliser.std["state"], arrays["normaliser.std.state"], rtol=0.05, atol=0.02
    )
    np.testing.assert_allclose(after.normaliser.mean["privileged_state"][0], 0.0, atol=1.0)


@pytest.mark.parametrize("factor", [0.5, 100.0])
def test_a_policy_is_started_with_less_exploration(factor):
    raw, bias = np.linspace(-3, 3, 14, dtype=np.float32), "params.policy.params.action.bias"
    before = {bias: np.concatenate([np.ones(14, np.float32), raw]), "another": np.ones(3)}
    after = rescale_spread(before, factor)
    np.testing.assert_array_equal(after["another"], np.ones(3))
    np.testing.assert_array_equal(after[bias][:14], np.ones(14))
    np.testing.assert_allclose(
        jax.nn.softplus(after[bias][14:]), factor * jax.nn.softplus(raw), rtol=1e-5, atol=1e-6
    )


def started(head, file):
    """Parameters of a policy for footholds or not, from a file."""
    config = dataclasses.replace(NETWORKS, foothold_head=head)
    networks = make_networks(ToyEnv().observation_size, 14, config=config)
    params = PPONetworkParams(networks.policy_network.init(jax.random.PRNGKey(1)), {})
    normaliser = init_state({name: jnp.zeros(n) for name, n in ToyEnv().observation_size.items()})
    state = TrainState(params, params.policy, (), (), 0.0, normaliser, None, None, 0)
    return params.policy["params"], initialise(state, str(file)).params.policy["params"]


@pytest.mark.parametrize("some", [False, True])
def test_footholds_are_new_to_a_policy_from_before(some, learner, tmp_path, capsys):
    """They begin as untrained ones do, all of them if some are new; the rest is the old policy's."""
    state = learner.init(0)
    arrays = dict(zip(names(state), map(np.asarray, jax.tree.leaves(state)), strict=True))
    arrays |= {"params.policy.params.footholds.leg.bias": np.ones(8)} if some else {}
    np.savez(tmp_path / "policy.npz", **{n: x for n, x in arrays.items() if n.startswith("params.policy")})
    fresh, taken = started(8, tmp_path / "policy.npz")
    assert ("learns anew" in capsys.readouterr().out) == some
    jax.tree.map(np.testing.assert_array_equal, taken["footholds"], fresh["footholds"])
    jax.tree.map(np.testing.assert_array_equal, taken["mix"], state.params.policy["params"]["mix"])
    assert (taken["mix"]["kernel"] != fresh["mix"]["kernel"]).any()


def test_footholds_are_not_left_out_silently(learner, tmp_path):
    state = learner.init(0)
    arrays = dict(zip(names(state), map(np.asarray, jax.tree.leaves(state)), strict=True))
    np.savez(tmp_path / "policy.npz", **arrays, **{"params.policy.params.footholds.leg.bias": np.zeros(8)})
    with pytest.raises(ValueError, match="it has a part for footholds, which needs terrain with pits"):
        initialise(state, str(tmp_path / "policy.npz"))


def test_parameters_of_other_sizes_are_refused(learner, tmp_path):
    np.savez(tmp_path / "policy.npz", x=np.zeros(3))
    with pytest.raises(ValueError, match="doesn't fit: params.policy.params.action.bias is missing"):
        initialise(learner.init(0), str(tmp_path / "policy.npz"))


def test_a_policy_is_converted_to_another_range_of_residuals(tmp_path):
    """The same small angles from the same observations, in which its own last actions are smaller, too."""
    networks = make_networks({"state": (188,), "privileged_state": (232,)}, 14, config=NetworkConfig())
    policy = networks.policy_network.init(jax.random.PRNGKey(0))
    random = np.random.default_rng(0)
    mean, std = random.normal(size=188), random.uniform(0.5, 2.0, 188)
    leaves = zip(names({"params": {"policy": policy}}), jax.tree.leaves(policy), strict=True)
    arrays = {name: np.asarray(x) for name, x in leaves}
    arrays |= {"normaliser.mean.state": mean, "normaliser.std.state": std}
    converted = rescale_residuals(arrays, 0.6)
    changed = jax.tree.unflatten(
        jax.tree.structure(policy), [converted[n] for n in arrays if n.startswith("params")]
    )

    def parameters(policy, arrays, state):
        state = jnp.asarray(state, jnp.float32)[None]
        seen = SimpleNamespace(
            mean={"state": jnp.asarray(arrays["normaliser.mean.state"], jnp.float32)},
            std={"state": jnp.asarray(arrays["normaliser.std.state"], jnp.float32)},
        )
        obs = {"state": state, "carry": jnp.zeros((1, 128)), "is_first": jnp.zeros((1, 1))}
        return np.asarray(networks.policy_network.apply(seen, policy, obs)["action"][0])

    state = random.normal(size=188)
    smaller = state.copy()
    for first in (35, 49):
        smaller[first + 2 : first + 14] *= 0.6
    before, after = parameters(policy, arrays, state), parameters(changed, converted, smaller)
    np.testing.assert_allclose(after[:2], before[:2], atol=1e-5)
    np.testing.assert_allclose(after[2:14], 0.6 * before[2:14], atol=1e-5)
    spread = np.logaddexp(before[14:], 0)
    np.testing.assert_allclose(np.logaddexp(after[14:16], 0), spread[:2], rtol=1e-4)
    np.testing.assert_allclose(np.logaddexp(after[16:], 0), 0.6 * spread[2:], rtol=0.02)


def test_the_line_of_text():
    figures = {"env_steps": 1.5e6, "steps_per_second": 10_000.0, "reward": 0.25, "episode/distance": 2.0}
    figures |= {"episode/fell": 0.5, "kl": math.nan}
    line = text_line(figures, 10_000_000)
    assert line == "1.50M/10M steps  10.0k/s  0:14:10 left  reward 0.250  distance 2.00 m  falls 50%"


@pytest.mark.slow
def test_train_py_from_the_command_line(tmp_path):
    """The real environment: a run, its policy file, and the same run resumed by another process."""
    small = [
        "terrain=flat",
        "env.terrain.num_terrains=12",
        "num_envs=8",
        "ppo.unroll=4",
        "ppo.minibatches=2",
        f"run={tmp_path / 'run'}",
    ]
    for arguments in (["steps=64", *small], [f"run={tmp_path / 'run'}", "resume=true", "steps=96"]):
        command = [sys.executable, str(ROOT / "train.py"), *arguments]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=1200)
        assert done.returncode == 0, done.stderr
    assert [p.name for p in tmp_path.iterdir()] == ["run"]  # nothing else is written
    assert [row["env_steps"] for row in read_csv(tmp_path / "run/metrics.csv")] == [32, 64, 96]
    with np.load(tmp_path / "run/policy.npz") as file:
        assert "graph" in file.files
