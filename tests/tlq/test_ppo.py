"""PPO: replayed probabilities are the stored ones, one compilation, and a task that needs the memory is learned."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.base import Wrapper
from brax.envs.wrappers.training import VmapWrapper
from jax.sharding import PartitionSpec as P

from envs import guide
from tests.tlq.toy import ACTIONS, ToyEnv
from tlq.memory import RecurrentWrapper, carry_size
from tlq.networks import NetworkConfig, make_networks
from tlq.ppo import AXIS, Learner, PPOConfig, make_mesh

NETWORKS = NetworkConfig(
    memory_width=16, memory_layers=1, encoder=32, foot_encoder=(8, 4), head=16, critic=(32,)
)
CONFIG = PPOConfig(unroll=12, epochs=1, minibatches=1, kl_target=0, reward_scaling=1.0)
B = 32
KEY = jax.random.PRNGKey(0)


def make_learner(memory="mingru", config=CONFIG, env=None, devices=1):
    c = dataclasses.replace(NETWORKS, memory=memory)
    env = env or ToyEnv(length=5)
    wrapped = RecurrentWrapper(VmapWrapper(env), carry_size(c.memory, c.memory_layers, c.memory_width))
    networks = make_networks(env.observation_size, ACTIONS, config=c)
    return Learner(wrapped, networks, config, B, make_mesh(devices))


@pytest.fixture(scope="module")
def learner():
    return make_learner()


@pytest.fixture(scope="module")
def trained(learner):
    """State after three iterations, so that the normaliser and the memory are at work."""
    state = learner.init(0)
    for _ in range(3):
        state, metrics = learner.step(state)
    return state, metrics


def rollout_of(learner, state):
    roll = jax.shard_map(
        learner._rollout,
        mesh=learner.mesh,
        in_specs=(P(), learner.specs, P()),
        out_specs=(P(AXIS), P(None, AXIS), P()),
        check_vma=False,
    )
    return jax.jit(roll)(learner._step_constants, state, jax.random.PRNGKey(5))


def test_replayed_probabilities_are_the_stored_ones(learner, trained):
    state, _ = trained
    _, rollout, _ = rollout_of(learner, state)
    carry = state.env_state.obs["carry"]
    starts = np.asarray(rollout.observation["is_first"])
    assert (
        np.abs(carry).max() > 0 and starts[1:].any()
    )  # the memory isn't empty, and episodes begin inside the piece
    observation = dict(rollout.observation, carry=carry[None])
    networks = learner.networks
    parameters = jax.jit(networks.policy_network.apply)(state.normaliser, state.params.policy, observation)
    log_prob = networks.parametric_action_distribution.log_prob(parameters, {"action": rollout.action})
    np.testing.assert_allclose(log_prob, rollout.log_prob, atol=2e-5)
    # And it does matter: without the memory they differ.
    forgetful = dict(observation, carry=0 * carry[None])
    parameters = networks.policy_network.apply(state.normaliser, state.params.policy, forgetful)
    other = networks.parametric_action_distribution.log_prob(parameters, {"action": rollout.action})
    assert np.abs(other - rollout.log_prob).max() > 1e-3


def test_the_first_gradient_step_sees_no_change_of_policy(trained):
    _, metrics = trained  # one gradient step an iteration
    assert abs(float(metrics["kl"])) < 2e-4  # Brax's own formula has 1e-5 in each of 14 logarithms


def test_an_iteration_compiles_once_and_its_figures_are_finite(learner, trained):
    compiled = []
    jax.monitoring.register_event_duration_secs_listener(
        lambda name, seconds, **_: compiled.append(name) if "backend_compile" in name else None
    )
    state, _ = learner.step(learner.init(3))
    compiled.clear()
    state, metrics = learner.step(state)
    learner.step(state)
    assert not compiled
    assert all(np.isfinite(float(x)) for x in metrics.values())
    assert float(metrics["reward"]) == pytest.approx(
        float(metrics["reward/match"] + metrics["reward/effort"]), abs=1e-6
    )


def test_the_first_iteration_only_looks(learner):
    before = learner.init(1)
    after, _ = learner.step(before)
    jax.tree.map(np.testing.assert_array_equal, before.params, after.params)
    jax.tree.map(np.testing.assert_array_equal, before.opt_state, after.opt_state)
    assert float(after.normaliser.mean["state"][1]) > 0.5  # steps since the episode's start
    assert int(after.iteration) == 1
    third, _ = learner.step(after)
    changed = jax.tree.map(lambda x, y: bool((x != y).any()), after.params, third.params)
    assert any(jax.tree.leaves(changed))


def test_the_same_seed_gives_the_same_run_and_another_one_another(learner, trained):
    state = learner.init(0)
    for _ in range(3):
        state, _ = learner.step(state)
    jax.tree.map(np.testing.assert_array_equal, state, trained[0])
    other = learner.init(1)
    assert (
        np.asarray(other.env_state.obs["state"]) != np.asarray(learner.init(0).env_state.obs["state"])
    ).any()


def test_the_batch_is_permuted_by_environments_and_nothing_is_lost(learner, trained):
    """Two passes with a learning rate of zero: every minibatch's loss averages to the loss of the whole."""
    state, _ = trained
    env_state, rollout, _ = rollout_of(learner, state)
    still = state.replace(learning_rate=jnp.float32(0.0))
    values = {}
    for minibatches in (1, 4):
        learner.config = dataclasses.replace(CONFIG, epochs=2, minibatches=minibatches)
        update = jax.shard_map(
            learner._update,
            mesh=learner.mesh,
            in_specs=(learner.specs, P(AXIS), P(None, AXIS), P(AXIS), P()),
            out_specs=P(),
            check_vma=False,
        )
        carry, last = state.env_state.obs["carry"], env_state.obs["privileged_state"]
        params, _, losses = jax.jit(update)(still, carry, rollout, last, jax.random.PRNGKey(0))
        jax.tree.map(np.testing.assert_array_equal, params, state.params)
        values[minibatches] = float(losses["loss/value"])
    learner.config = CONFIG
    assert values[4] == pytest.approx(values[1], rel=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize(("memory", "solves"), [("mingru", True), ("none", False)])
def test_a_task_that_needs_the_memory(memory, solves):
    """The target is shown on the first of five steps; without a memory four of five steps are a guess."""
    config = dataclasses.replace(CONFIG, epochs=4, learning_rate=3e-3)
    learner = make_learner(memory, config)
    state = learner.init(0)
    for _ in range(120):
        state, metrics = learner.step(state)
    reward = float(metrics["reward/match"])
    assert (reward > 0.6) == solves, reward


class Asking(Wrapper):
    """Says that there is more gap to one side of two feet, and that a third stands, whatever the state."""

    def _ask(self, state):
        slope = jnp.linspace(0.0, 1.0, guide.SIDE)
        guidance = guide.Guidance(
            lead=jnp.zeros((4, 2, 4)).at[:, 0, 0].set(0.1).at[:, 1, 1].set(0.1),
            legs=jnp.array([1, 2]),
            gaps=jnp.stack([jnp.tile(slope, (guide.SIDE, 1)), jnp.tile(1 - slope, (guide.SIDE, 1))]),
            ahead=jnp.zeros(2),
            across=jnp.array([0.0, 1.0]),
            weight=jnp.ones(2),
            held=jnp.array([[0.05, 0.0]] * 4),
            hold=jnp.array([1.0, 0.0, 0.0, 0.0]),
        )
        return state.replace(info=state.info | {"guide": guidance})

    def reset(self, key):
        return self._ask(self.env.reset(key))

    def step(self, state, action):
        return self._ask(self.env.step(state, action))


def test_a_policy_learns_where_its_guide_sees_ground():
    config = dataclasses.replace(CONFIG, guide=30.0, learning_rate=3e-3, epochs=4)
    learner = make_learner(config=config, env=Asking(ToyEnv(length=5)))
    state = learner.init(0)
    losses = []
    for _ in range(12):
        state, metrics = learner.step(state)
        losses.append(float(metrics["loss/guide"]))
    parameters = learner.networks.policy_network.apply(
        state.normaliser, state.params.policy, state.env_state.obs
    )
    residual = np.tanh(parameters["action"][:, :14])[:, 2:].reshape(-1, 4, 3).mean(axis=0)
    # One foot to the right, another to the left, so that the middle stays; the third where it was.
    assert residual[1, 1] < -0.5
    assert residual[2, 1] > 0.5
    np.testing.assert_allclose(residual[0, :2], [0.5, 0.0], atol=0.1)
    assert losses[-1] < 0.6 * losses[0]
