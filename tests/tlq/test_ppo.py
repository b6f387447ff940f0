"""PPO: replayed probabilities are the stored ones, one compilation, and a task that needs the memory is learned."""

import dataclasses
import functools
import os
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from brax.envs.base import Wrapper
from brax.envs.wrappers.training import VmapWrapper
from brax.training.agents.ppo.losses import compute_ppo_loss
from brax.training.types import Transition
from jax.sharding import PartitionSpec as P

from envs import guide
from tests.tlq.toy import ACTIONS, ToyEnv
from tlq.loss import ppo_loss
from tlq.memory import RecurrentWrapper, carry_size
from tlq.networks import NetworkConfig, make_networks
from tlq.ppo import AXIS, Learner, PPOConfig, Rollout, adapt_learning_rate, hoist, make_mesh, summarise

NETWORKS = NetworkConfig(
    memory_width=16,
    memory_layers=1,
    encoder=32,
    foot_encoder=(8, 4),
    head=16,
    foothold_head=0,
    critic=(32,),
)
CONFIG = PPOConfig(unroll=12, epochs=1, minibatches=1, kl_target=0, reward_scaling=1.0)
B = 32
KEY = jax.random.PRNGKey(0)


def make_learner(memory="mingru", config=CONFIG, env=None, devices=1, **networks):
    c = dataclasses.replace(NETWORKS, memory=memory, **networks)
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
    return jax.jit(roll)(learner._constants, state, jax.random.PRNGKey(5))


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


def test_the_policys_parameters_are_averaged(learner):
    state = learner.init(1)
    jax.tree.map(np.testing.assert_array_equal, state.average, state.params.policy)
    for n in range(4):
        before, (state, _) = state, learner.step(state)
        # 1/10, 2/11, ... of the old average are kept at first, up to `average`.
        keep = min(learner.config.average, (1 + n) / (10 + n))
        expected = jax.tree.map(lambda a, p, k=keep: k * a + (1 - k) * p, before.average, state.params.policy)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), state.average, expected)


def test_the_same_seed_gives_the_same_run_and_another_one_another(learner, trained):
    state = learner.init(0)
    for _ in range(3):
        state, _ = learner.step(state)
    jax.tree.map(np.testing.assert_array_equal, state, trained[0])
    other = learner.init(1)
    assert (
        np.asarray(other.env_state.obs["state"]) != np.asarray(learner.init(0).env_state.obs["state"])
    ).any()


@pytest.mark.slow
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
        params, _, _, losses = jax.jit(update)(still, carry, rollout, last, jax.random.PRNGKey(0))
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

    def guidance(self, state):
        slope = jnp.linspace(0.0, 1.0, guide.SIDE)
        return guide.Guidance(
            lead=jnp.zeros((4, 2, 4)).at[:, 0, 0].set(0.1).at[:, 1, 1].set(0.1),
            legs=jnp.array([1, 2]),
            gaps=jnp.stack([jnp.tile(slope, (guide.SIDE, 1)), jnp.tile(1 - slope, (guide.SIDE, 1))]),
            ahead=jnp.zeros(2),
            across=jnp.array([0.0, 1.0]),
            weight=jnp.ones(2),
            held=jnp.array([[0.05, 0.0]] * 4),
            hold=jnp.array([1.0, 0.0, 0.0, 0.0]),
            last=jnp.array([[0.03, -0.09], [0.03, 0.09]]),
            error=jnp.zeros((2, 2)),
            known=jnp.ones(2),
            mirror=jnp.float32(1.0),
        )


class Telling(Asking):
    """Its guide repeats what is observed, so that it shows when it was asked."""

    def guidance(self, state):
        return super().guidance(state)._replace(ahead=state.obs["state"][:2])


class Landing(Asking):
    """Its feet come down one after the other, and miss their places by their number and the episode's steps."""

    def followed(self, state):
        clock = state.info["clock"]
        missed = jnp.arange(4.0)[:, None] + jnp.stack([jnp.float32(clock), 0.0])
        landings = guide.Landings(
            jnp.zeros((4, 2)), jnp.zeros(4, jnp.int32), jnp.arange(4) == clock % 6, missed
        )
        return state.replace(info=state.info | {"landings": landings})

    def reset(self, key):
        state = self.env.reset(key)
        return self.followed(state.replace(info=state.info | {"clock": jnp.int32(0)}))

    def step(self, state, action):
        after = self.env.step(state, action)
        return self.followed(after.replace(info=after.info | {"clock": state.info["clock"] + 1}))


def test_the_guide_knows_afterwards_how_feet_came_down():
    learner = make_learner(env=Landing(ToyEnv(length=1000)), foothold_head=16)
    parts = learner.batch(learner.init(0))
    unroll, stride = len(parts["reward"]), learner.stride
    whole = ~np.asarray(parts["done"]).any(axis=0)
    assert whole.any()
    for i, leg in ((i, leg) for i in range(unroll // stride) for leg in (1, 2)):
        # The step from clock c leads to c + 1.
        clock = next((c for c in range(stride * i + 1, unroll + 1) if c % 6 == leg), None)
        assert np.all(parts["guide_known"][i, whole, leg - 1] == (clock is not None))
        if clock is not None:
            assert np.all(parts["guide_error"][i, whole, leg - 1] == np.array([leg + clock, leg]))


@pytest.mark.parametrize(("head", "unroll", "every"), [(16, 10, 5), (16, 12, 4), (16, 7, 1), (0, 10, 1)])
def test_the_guide_is_asked_at_every_fifth_step(head, unroll, every):
    """Or the nearest below that divides the unroll; where it is part of PPO's own loss, at every step."""
    config = dataclasses.replace(CONFIG, unroll=unroll)
    learner = make_learner(config=config, env=Telling(ToyEnv(length=5)), foothold_head=head)
    parts = jax.eval_shape(learner.batch, jax.eval_shape(learner.init, 0))
    assert parts["guide_ahead"].shape == (unroll // every, B, 2)
    if every > 1:
        parts = learner.batch(learner.init(0))
        np.testing.assert_array_equal(parts["guide_ahead"], parts["state"][::every, :, :2])
        assert (np.asarray(parts["state"][1]) != parts["state"][0]).any()


@pytest.mark.slow
@pytest.mark.parametrize("head", [0, 16])
def test_a_policy_learns_where_its_guide_sees_ground(head):
    config = dataclasses.replace(CONFIG, guide=30.0, learning_rate=3e-3, epochs=4)
    config = dataclasses.replace(config, guide_rate=3e-3, guide_epochs=20)
    learner = make_learner(config=config, env=Asking(ToyEnv(length=5)), foothold_head=head)
    state = learner.init(0)

    def means(state):
        networks, obs = learner.networks, state.env_state.obs
        parameters = networks.policy_network.apply(state.normaliser, state.params.policy, obs)
        return jnp.tanh(parameters["action"][:, :ACTIONS])

    said = jax.vmap(learner.env.guidance)(state.env_state)
    before = float(jnp.mean(guide.cost(said, means(state))))
    for _ in range(12):
        state, metrics = learner.step(state)
    after = float(jnp.mean(guide.cost(said, means(state))))
    residual = np.asarray(means(state))[:, 2:].reshape(-1, 4, 3).mean(axis=0)
    # One foot to the right, another to the left, so that the middle stays, and both forwards, where they were led
    # before: there (0.1 x - 0.03)^2 / 0.06^2 + |(0.1 x, 0.1 y)| is least. The first stays where it was.
    assert residual[1, 1] < -0.5
    assert residual[2, 1] > 0.5
    np.testing.assert_allclose(residual[0, :2], [0.5, 0.0], atol=0.1)
    np.testing.assert_allclose(residual[1:3, 0], 0.3, atol=0.1)
    assert after < 0.6 * before
    assert float(metrics["loss/guide"]) < 0.7 * before  # with what it costs to move legs at all
    # What a failed update would leave.
    batch = learner.batch(state)
    asked = 12 // learner.stride
    assert batch["guide_lead"].shape == (asked, B, 4, 2, 4) and batch["guide_hold"].shape == (asked, B, 4)


@pytest.mark.slow
def test_the_guide_teaches_the_footholds_and_reward_the_rest():
    """Each at its own rate, and neither touches what the other learns, unless PPO is to train both."""
    env = Asking(ToyEnv(length=5))

    def changed(**rates):
        """By how much each part of the policy is changed by an iteration that learns."""
        learner = make_learner(config=dataclasses.replace(CONFIG, **rates), env=env, foothold_head=16)
        looked, _ = learner.step(learner.init(0))
        after, _ = learner.step(looked)
        before, after = (x.params.policy["params"] for x in (looked, after))

        def largest(name):
            pairs = zip(*map(jax.tree.leaves, (before[name], after[name])), strict=True)
            return max(float(jnp.abs(a - b).max()) for a, b in pairs)

        return {name: largest(name) for name in after}

    by_reward = changed(learning_rate=1e-3, guide_rate=0.0)
    assert by_reward.pop("footholds") == 0 and min(by_reward.values()) > 0
    by_guide = changed(learning_rate=0.0, guide_rate=1e-3)
    assert by_guide.pop("footholds") > 5e-4 and max(by_guide.values()) == 0
    both = changed(learning_rate=1e-3, guide_rate=0.0, train_footholds=True)
    assert min(both.values()) > 0


@pytest.mark.slow
def test_the_critic_may_learn_at_a_rate_of_its_own():
    """Adam's first step is as long as the rate, in every parameter: of the policy one, of the critic the other."""

    def changed(**rates):
        learner = make_learner(
            config=dataclasses.replace(CONFIG, minibatches=1, epochs=1, kl_target=0.0, **rates)
        )
        before, _ = learner.step(learner.init(0))  # which only measures
        after, _ = learner.step(before)
        return [
            max(float(jnp.abs(a - b).max()) for a, b in zip(*map(jax.tree.leaves, (new, old)), strict=True))
            for new, old in (
                (after.params.policy, before.params.policy),
                (after.params.value, before.params.value),
            )
        ]

    assert changed(learning_rate=1e-3) == pytest.approx([1e-3, 1e-3], rel=0.05)
    assert changed(learning_rate=1e-3, critic_rate=5e-3) == pytest.approx([1e-3, 5e-3], rel=0.05)
    policy, critic = changed(learning_rate=0.0, critic_rate=5e-3)
    assert policy == 0 and critic == pytest.approx(5e-3, rel=0.05)


@pytest.mark.slow
def test_residuals_that_footholds_take_over_cost_their_squares():
    """The loss with the weight less that without: the squares of the rest's residuals times the shares, by hand."""
    learner = make_learner(env=Asking(ToyEnv(length=5)), foothold_head=16)
    state = learner.init(0)
    params = jax.tree.map(lambda x: x + 0.1, state.params)
    state = state.replace(params=params)
    parts = learner.batch(state)
    carry, last = parts["carry"], parts["last"]
    observation = {name: parts[name] for name in ("state", "privileged_state", "is_first")}
    names = ("action", "log_prob", "parameters", "reward", "done", "truncation")
    out = learner.networks.policy_network.apply(
        state.normaliser, params.policy, dict(observation, carry=carry[None])
    )
    rollout = Rollout(
        observation=observation,
        guide=None,
        footholds=out["footholds"],
        **{name: parts[name] for name in names},
    )
    keys = jax.random.split(jax.random.PRNGKey(0), B)

    def loss(params, weight):
        config = dataclasses.replace(CONFIG, taken_over=weight)
        whole = functools.partial(ppo_loss, networks=learner.networks, config=config, axis=AXIS)
        apart = jax.shard_map(whole, mesh=make_mesh(1), in_specs=P(), out_specs=P(), check_vma=False)
        return apart(params, state.normaliser, rollout, carry, last, keys)[0]

    share, rest = (np.array(out["footholds"][name]) for name in ("share", "rest"))
    expected = np.mean(np.sum(np.square(share * rest), axis=-1))
    assert expected > 1e-3
    both = jax.jit(jax.value_and_grad(loss))
    (paid, grads), (free, _) = both(params, jnp.float32(2.0)), both(params, jnp.float32(0.0))
    assert float(paid - free) == pytest.approx(2.0 * expected, rel=1e-3)
    # It teaches the rest, never the share.
    assert all(not leaf.any() for leaf in jax.tree.leaves(grads.policy["params"]["footholds"]))


def test_footholds_that_nobody_teaches_are_refused():
    with pytest.raises(ValueError, match="nobody teaches the footholds"):
        make_learner(foothold_head=16)


def test_constants_become_arguments():
    table = jnp.arange(1000.0)
    constants, pure = hoist(lambda x: {"y": table[x["i"]] + 1}, {"i": jax.ShapeDtypeStruct((), jnp.int32)})
    assert any(x is table for x in constants)
    assert float(pure(constants, {"i": jnp.int32(3)})["y"]) == 4.0
    assert float(pure([x + 10 if x is table else x for x in constants], {"i": jnp.int32(3)})["y"]) == 14.0


def test_the_learning_rate_follows_the_kl():
    config = PPOConfig(kl_target=0.01, learning_rate_min=1e-5, learning_rate_max=1e-3)
    rate = functools.partial(adapt_learning_rate, config=config)
    assert float(rate(jnp.float32(4e-4), 0.021)) == pytest.approx(2e-4)  # above twice the target: half
    assert float(rate(jnp.float32(4e-4), 0.0049)) == pytest.approx(6e-4)  # below half of it: 1.5 times
    assert float(rate(jnp.float32(4e-4), 0.01)) == pytest.approx(4e-4)
    assert float(rate(jnp.float32(9e-4), 0.001)) == pytest.approx(1e-3)
    assert float(rate(jnp.float32(1e-5), 1.0)) == pytest.approx(1e-5)
    assert adapt_learning_rate(3e-4, 1.0, dataclasses.replace(config, kl_target=0)) == 3e-4


def test_no_step_follows_one_that_went_too_far():
    """At a rate of 1 the first of four gradient steps changes the policy altogether; the others are left out."""
    far = dataclasses.replace(
        CONFIG, epochs=2, minibatches=2, kl_target=0.01, kl_stop=4.0, learning_rate=1.0, learning_rate_max=1.0
    )
    ends = {}
    for name, config in {"stops": far, "goes on": dataclasses.replace(far, kl_stop=0.0)}.items():
        learner = make_learner(config=config)
        before, _ = learner.step(learner.init(0))  # only looks
        after, figures = learner.step(dataclasses.replace(before, learning_rate=jnp.float32(1.0)))
        ends[name] = before, after, figures
    before, after, figures = ends["stops"]
    assert float(figures["skipped"]) == 3 / 4 and "skipped" not in ends["goes on"][2]
    # Adam's first step is the rate times the gradient's sign, or less where the gradient is about as small as eps.
    moved = jax.tree.map(lambda a, b: jnp.abs(b - a).max(), before.params.policy, after.params.policy)
    assert 0.9 < max(jax.tree.leaves(moved)) <= 1.0 + 1e-5
    assert int(optax.tree_utils.tree_get(after.opt_state, "count")) == 1
    assert int(optax.tree_utils.tree_get(ends["goes on"][1].opt_state, "count")) == 4


def test_figures_of_episodes_are_means_over_episodes():
    # 2 of 8 steps end an episode, at 3 m and 5 m, one of them by a fall.
    means = {"episode/ended": 2 / 8, "episode/distance": 8 / 8, "episode/fell": 1 / 8, "reward": 0.5}
    # A quarter of the environments has stairs, at levels whose mean is 0.4.
    means |= {"share/stairs": 1 / 4, "level/stairs": 0.1}
    figures = summarise(jax.tree.map(jnp.float32, means), 8)
    assert {k: float(v) for k, v in figures.items()} == pytest.approx({
        "episode/distance": 4.0, "episode/fell": 0.5, "reward": 0.5, "episodes": 2.0,
        "share/stairs": 0.25, "level/stairs": 0.4,
    })  # fmt: skip


def test_environments_that_cannot_be_split_evenly_are_refused():
    with pytest.raises(ValueError, match="num_envs=32 must be a multiple of devices x minibatches = 1 x 5"):
        make_learner(config=dataclasses.replace(CONFIG, minibatches=5))


COMPARED = """
import sys, numpy as np, jax
from tests.tlq.test_ppo import SHARED, Asking, ToyEnv, make_learner
learner = make_learner(config=SHARED, devices=0, env=Asking(ToyEnv(length=5)), foothold_head=16)
state = learner.init(0)
for _ in range(3):
    state, metrics = learner.step(state)
    metrics = jax.device_get(metrics)
learnt = state.params, state.opt_state, state.guide_opt_state, state.normaliser, state.learning_rate
parts = jax.tree.leaves(learnt)
if jax.process_index() == 0:
    np.savez(sys.argv[1], *map(np.asarray, parts), reward=metrics["reward"], kl=metrics["kl"])
assert state.env_state.reward.addressable_shards[0].data.shape == (32 // jax.device_count(),)
"""
SHARED = dataclasses.replace(CONFIG, epochs=2, minibatches=2, entropy=1e-2, kl_target=0.02)
JOIN = """
from tlq.cores import join
join(sys.argv[2], 2, int(sys.argv[3]))
"""


def run_python(code, *arguments):
    return subprocess.Popen(
        [sys.executable, "-c", code, *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"XLA_FLAGS": "", "PJRT_NPROC": "8"},
    )


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Parameters, optimiser, normaliser and figures after three iterations on one device."""
    path = tmp_path_factory.mktemp("alone") / "one.npz"
    process = run_python(COMPARED, path)
    out, _ = process.communicate(timeout=600)
    assert process.returncode == 0, out
    return dict(np.load(path))


def assert_the_same_update(path, alone):
    with np.load(path) as found:
        assert set(found.files) == set(alone)
        for name, x in alone.items():
            np.testing.assert_allclose(found[name], x, rtol=2e-3, atol=2e-5, err_msg=name)


@pytest.mark.slow
def test_two_devices_make_the_update_of_one(alone, tmp_path):
    two = 'import jax; jax.config.update("jax_num_cpu_devices", 2)\n'
    process = run_python(two + COMPARED, tmp_path / "two.npz")
    out, _ = process.communicate(timeout=600)
    assert process.returncode == 0, out
    assert_the_same_update(tmp_path / "two.npz", alone)


@pytest.mark.slow
def test_two_processes_make_the_update_of_one(alone, tmp_path):
    """Over loopback, as on two hosts."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{probe.getsockname()[1]}"
    code = COMPARED.replace("from tests", JOIN + "from tests", 1)
    processes = [run_python(code, tmp_path / "two.npz", address, i) for i in (0, 1)]
    outputs = [process.communicate(timeout=600)[0] for process in processes]
    for process, out in zip(processes, outputs, strict=True):
        assert process.returncode == 0, out
    assert_the_same_update(tmp_path / "two.npz", alone)


@pytest.mark.slow
def test_the_loss_is_braxs(learner, trained):
    """Value and gradient, without the entropy, whose noise is drawn in another way."""
    state, _ = trained
    env_state, rollout, _ = rollout_of(learner, state)
    carry, last = state.env_state.obs["carry"], env_state.obs["privileged_state"]
    params = jax.tree.map(lambda x: x + 0.01 * jax.random.normal(KEY, x.shape), state.params)
    settings = PPOConfig(
        entropy=0.0, discount=0.97, gae_lambda=0.9, clip=0.1, value_loss=0.7, reward_scaling=0.3
    )

    def mine(params):
        keys = jnp.zeros((B, 2), jnp.uint32)
        return ppo_loss(
            params, state.normaliser, rollout, carry, last, keys,
            networks=learner.networks, config=settings, axis=AXIS,
        )  # fmt: skip

    def braxs(params):
        swapped = lambda x: jnp.swapaxes(x, 0, 1)  # noqa: E731
        data = Transition(
            observation=jax.tree.map(swapped, dict(rollout.observation, carry=carry[None])),
            action=(),
            reward=swapped(rollout.reward),
            discount=swapped(1 - rollout.done),
            next_observation={"privileged_state": last[:, None]},
            extras={
                "state_extras": {"truncation": swapped(rollout.truncation)},
                "policy_extras": {
                    "raw_action": {"action": swapped(rollout.action)},
                    "log_prob": swapped(rollout.log_prob),
                    "distribution_params": {"action": swapped(rollout.parameters)},
                },
            },
        )
        return compute_ppo_loss(
            params, state.normaliser, data, KEY, learner.networks, entropy_cost=0.0, discounting=0.97,
            reward_scaling=0.3, gae_lambda=0.9, clipping_epsilon=0.1, vf_coefficient=0.7,
        )  # fmt: skip

    shard = jax.shard_map(
        jax.value_and_grad(mine, has_aux=True),
        mesh=learner.mesh,
        in_specs=P(),
        out_specs=P(),
        check_vma=False,
    )
    (loss, parts), grads = jax.jit(shard)(params)
    (expected, other), expected_grads = jax.jit(jax.value_and_grad(braxs, has_aux=True))(params)
    assert np.asarray(rollout.truncation).any() and np.asarray(rollout.done - rollout.truncation).any()
    assert float(loss) == pytest.approx(float(expected), rel=1e-5)
    for name, brax_name in [("policy", "policy_loss"), ("value", "v_loss"), ("kl", "kl_mean")]:
        assert float(parts[name]) == pytest.approx(float(other[brax_name]), rel=1e-4, abs=1e-6)
    assert float(parts["surrogate"]) < float(parts["policy"])  # clipping only ever takes away
    for x, y in zip(jax.tree.leaves(grads), jax.tree.leaves(expected_grads), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-3, atol=1e-5)


class ForBrax(Wrapper):
    """What Brax's own loop expects beside: metrics of the episode in `info`."""

    def reset(self, rng):
        state = self.env.reset(rng)
        return self._with_metrics(state)

    def step(self, state, action):
        return self._with_metrics(self.env.step(state, action))

    def _with_metrics(self, state):
        metrics = {"sum_reward": state.reward, "length": state.reward}
        extra = {"episode_metrics": metrics, "episode_done": state.done, "steps": state.reward}
        return state.replace(info=state.info | extra)


@pytest.mark.slow
def test_brax_trains_the_same_environment_and_networks(monkeypatch):
    from brax.training.agents.ppo import train as brax_ppo

    # Gone from newer JAX; Brax 0.14.2 still calls it.
    replicate = lambda x, devices: jax.tree.map(lambda y: jnp.stack([y] * len(devices)), x)  # noqa: E731
    monkeypatch.setattr(jax, "device_put_replicated", replicate, raising=False)
    env = ForBrax(RecurrentWrapper(VmapWrapper(ToyEnv(length=5)), NETWORKS.memory_width))
    seen = []
    make_policy, params, _ = brax_ppo.train(
        environment=env,
        wrap_env=False,
        num_timesteps=B * 12 * 4,
        num_envs=B,
        unroll_length=12,
        batch_size=B // 2,
        num_minibatches=2,
        normalize_observations=True,
        network_factory=functools.partial(make_networks, config=NETWORKS),
        episode_length=5,
        num_eval_envs=4,
        log_training_metrics=True,
        training_metrics_steps=1,
        progress_fn=lambda step, metrics: seen.append(metrics),
        use_pmap_on_reset=True,
    )
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(params))
    obs = jax.jit(env.reset)(jax.random.split(jax.random.PRNGKey(0), B)).obs
    action, _ = make_policy(params, deterministic=True)(obs, jax.random.PRNGKey(0))
    assert action["action"].shape == (B, ACTIONS) and action["carry"].shape == (B, 16)
