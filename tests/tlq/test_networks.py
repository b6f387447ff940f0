"""Memory, policy, distribution: a scan is the steps one by one, and an episode's end cuts it."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers.training import VmapWrapper
from brax.training.acme import running_statistics
from brax.training.distribution import NormalTanhDistribution
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.tlq.toy import ACTIONS, ToyEnv
from tlq import memory
from tlq.memory import Memory, RecurrentWrapper, linear_scan
from tlq.networks import CLIP, LAST, NetworkConfig, make_networks

T, B, W = 7, 3, 8
KEY = jax.random.PRNGKey(0)
SMALL = NetworkConfig(memory_width=W, encoder=16, foot_encoder=(8, 4), head=8, critic=(16,))


def random(*shape, seed=0):
    return jax.random.normal(jax.random.PRNGKey(seed), shape)


def slow_scan(a, b, h):
    out = []
    for t in range(len(a)):
        h = a[t] * h + b[t]
        out.append(h)
    return np.stack(out)


@pytest.fixture(params=["cpu", "gpu"])
def backend(request, monkeypatch):
    """Both ways of scanning: step by step, and with the associative scan."""
    monkeypatch.setattr(memory.jax, "default_backend", lambda: request.param)


def test_linear_scan_is_the_plain_loop(backend):
    a, b, h = jax.nn.sigmoid(random(T, B, W)), random(T, B, W, seed=1), random(B, W, seed=2)
    a = a.at[3].set(0.0)
    np.testing.assert_allclose(linear_scan(a, b, h), slow_scan(*map(np.asarray, (a, b, h))), atol=1e-6)


def test_linear_scan_has_the_gradient_of_the_plain_loop(backend):
    a, b, h, weight = (
        jax.nn.sigmoid(random(T, B, W)),
        random(T, B, W, seed=1),
        random(B, W, seed=2),
        random(T, B, W, seed=3),
    )

    def plain(a, b, h):
        total = 0.0
        for t in range(T):
            h = a[t] * h + b[t]
            total += jnp.sum(weight[t] * h)
        return total

    mine = jax.grad(lambda *x: jnp.sum(weight * linear_scan(*x)), argnums=(0, 1, 2))(a, b, h)
    for x, y in zip(mine, jax.grad(plain, argnums=(0, 1, 2))(a, b, h), strict=True):
        np.testing.assert_allclose(x, y, atol=1e-5)


@pytest.mark.parametrize("kind", memory.KINDS)
def test_scan_is_the_steps_one_by_one(kind):
    module = Memory(kind, layers=2, width=W)
    x, first = random(T, B, W), jnp.zeros((T, B, 1)).at[4, 1].set(1.0)
    carry = random(B, memory.carry_size(kind, 2, W), seed=1)
    params = module.init(KEY, carry, x[0], first[0])
    last, y = module.apply(params, carry, x, first)
    for t in range(T):
        carry, step = module.apply(params, carry, x[t], first[t])
        np.testing.assert_allclose(step, y[t], atol=2e-6)
    np.testing.assert_allclose(carry, last, atol=2e-6)


@pytest.mark.parametrize("kind", ["mingru", "gru"])
def test_an_episodes_start_cuts_memory_and_gradient(kind):
    module = Memory(kind, layers=2, width=W)
    x, carry = random(T, 2, W), random(2, 2 * W, seed=1)
    first = (
        jnp.zeros((T, 2, 1)).at[4, 1].set(1.0)
    )  # environment 1 starts anew at t = 4, environment 0 doesn't
    params = module.init(KEY, carry, x, first)
    grad = jax.grad(lambda x: jnp.sum(module.apply(params, carry, x, first)[1][-1] ** 2))(x)
    assert np.abs(grad[0, 0]).max() > 0
    assert (np.asarray(grad[:4, 1]) == 0).all()
    assert np.abs(grad[4, 1]).max() > 0


def test_mingru_starts_with_time_constants_from_2_to_100_steps():
    params = Memory("mingru", 1, 64).init(KEY, jnp.zeros((1, 64)), jnp.zeros((1, 64)), jnp.zeros((1, 1)))
    z = jax.nn.sigmoid(params["params"]["layer_0"]["gates"]["bias"][:64])
    tau = -1 / np.log(1 - np.asarray(z))
    np.testing.assert_allclose(tau[[0, -1]], [2, 100], rtol=1e-4)
    np.testing.assert_allclose(np.diff(np.log(tau)), np.log(50) / 63, rtol=1e-2)


@settings(max_examples=20, deadline=None)
@given(scale=st.floats(0.1, 1e4), seed=st.integers(0, 99))
def test_mingrus_memory_never_leaves_minus_one_to_one(scale, seed):
    module = Memory("mingru", 1, W)
    x = scale * random(T, B, W, seed=seed)
    params = module.init(KEY, jnp.zeros((B, W)), x, jnp.zeros((T, B, 1)))
    carry, _ = module.apply(params, jnp.sign(random(B, W, seed=seed)), x, jnp.zeros((T, B, 1)))
    assert np.abs(carry).max() <= 1 + 1e-6


def observation(networks_config=SMALL, heights=100, time=None):
    lead = (B,) if time is None else (time, B)
    size = memory.carry_size(
        networks_config.memory, networks_config.memory_layers, networks_config.memory_width
    )
    return {
        "state": random(*lead, 10 + heights),
        "privileged_state": random(*lead, 20),
        "carry": jnp.zeros((*lead, size)),
        "is_first": jnp.zeros((*lead, 1)),
    }


def statistics(obs, mean=0.0, std=1.0):
    nest = {k: jnp.zeros(obs[k].shape[-1]) for k in ("state", "privileged_state")}
    state = running_statistics.init_state(nest)
    return state.replace(
        mean=jax.tree.map(lambda x: x + mean, nest), std=jax.tree.map(lambda x: x + std, nest)
    )


@pytest.mark.parametrize("heights", [100, 0])
def test_an_untrained_policy_acts_little_and_explores_as_configured(heights):
    obs = observation(heights=heights)
    if heights:
        obs["state"] = obs["state"].at[..., LAST].set(0.0)  # nothing done before, either
    networks = make_networks(
        {"state": 10 + heights, "privileged_state": 20}, ACTIONS, config=SMALL, heights=heights
    )
    out = networks.policy_network.apply(statistics(obs), networks.policy_network.init(KEY), obs)
    distribution = networks.parametric_action_distribution.create_dist(out)
    assert np.abs(distribution.loc).max() < 0.05
    np.testing.assert_allclose(distribution.scale, SMALL.initial_std, rtol=0.05)
    # However small training makes the spread, some is left.
    networks = make_networks(
        {"state": 10 + heights, "privileged_state": 20},
        ACTIONS,
        config=dataclasses.replace(SMALL, min_std=0.05),
        heights=heights,
    )
    silent = dict(out, action=out["action"].at[:, ACTIONS:].set(-100.0))
    scale = networks.parametric_action_distribution.create_dist(silent).scale
    np.testing.assert_allclose(scale, 0.05, rtol=1e-6)
    value = networks.value_network.apply(statistics(obs), networks.value_network.init(KEY), obs)
    assert value.shape == (B,)


def test_proprioception_is_normalised_and_heights_are_not():
    obs = observation()
    networks = make_networks({"state": 110, "privileged_state": 20}, ACTIONS, config=SMALL)
    params = networks.policy_network.init(KEY)
    shifted = dict(obs, state=obs["state"].at[:, :10].multiply(3.0).at[:, :10].add(5.0))
    plain = networks.policy_network.apply(statistics(obs), params, obs)
    again = networks.policy_network.apply(statistics(obs, mean=5.0, std=3.0), params, shifted)
    np.testing.assert_allclose(plain["action"], again["action"], atol=1e-5)
    # What lies beyond +-CLIP is as good as on the bound.
    far = [dict(obs, state=obs["state"].at[:, 0].set(x)) for x in (CLIP, 1e6)]
    near, beyond = (networks.policy_network.apply(statistics(obs), params, o)["action"] for o in far)
    np.testing.assert_array_equal(near, beyond)


def test_footholds_take_over_a_share_of_the_residuals():
    obs = observation()
    networks = make_networks({"state": 110, "privileged_state": 20}, 14, config=SMALL)
    stats = statistics(obs, 0.3, 2.0)
    params = networks.policy_network.init(jax.random.PRNGKey(0))
    params = jax.tree.map(lambda x: x + 0.1 * random(*x.shape), params)
    own = params["params"]["footholds"]
    without = dataclasses.replace(SMALL, foothold_head=0)
    plain = make_networks({"state": 110, "privileged_state": 20}, 14, config=without)
    both = networks.policy_network.apply(stats, params, obs)
    rest = plain.policy_network.apply(stats, params, obs)["action"]
    found = both["footholds"]
    np.testing.assert_allclose(found["rest"], rest[..., 2:14], atol=1e-6)
    added = networks.footholds(stats, own, obs["state"], found["rest"])
    assert float(jnp.abs(added).max()) > 0.01
    expected = np.array(rest)
    expected[..., 2:14] += added  # after frequency and lift; then the raw scales
    np.testing.assert_allclose(both["action"], expected, atol=1e-6)
    # Of whatever the rest does more, a share is taken back: it is replaced, not added to.
    share = added - networks.footholds(stats, own, obs["state"], found["rest"] + 1.0)
    assert ((share > 0) & (share < 1)).all()
    np.testing.assert_allclose(found["share"], share, atol=1e-5)
    alone = dict(own, share=jax.tree.map(jnp.zeros_like, own["share"]) | {"bias": jnp.full(3, 100.0)})
    taken_over = [networks.footholds(stats, alone, obs["state"], r) + r for r in (found["rest"], 3.0)]
    np.testing.assert_allclose(*taken_over, atol=1e-5)
    np.testing.assert_allclose(added, share * (taken_over[0] - found["rest"]), atol=1e-5)
    # It goes on from the last action's residuals, as far as it keeps them.
    moved = dict(obs, state=obs["state"].at[..., LAST].add(0.5))
    fresh = jax.tree.map(jnp.zeros_like, own)
    change = [networks.footholds(stats, fresh, o["state"], 0.0) for o in (obs, moved)]
    np.testing.assert_allclose(change[1] - change[0], 0.5 * 0.5 * 0.5, atol=1e-6)  # both shares are a half
    # What they were in an earlier call replaces the network, whose parameters then don't matter.
    nothing = {"params": dict(params["params"], footholds=jax.tree.map(jnp.zeros_like, own))}
    again = networks.policy_network.apply(stats, nothing, dict(obs, footholds=found))
    np.testing.assert_allclose(again["action"], both["action"], atol=1e-6)


def test_only_the_action_enters_the_density():
    networks = make_networks({"state": 110, "privileged_state": 20}, ACTIONS, config=SMALL)
    mine, plain = (
        networks.parametric_action_distribution,
        NormalTanhDistribution(ACTIONS, min_std=SMALL.min_std),
    )
    logits, carry = random(B, 2 * ACTIONS), random(B, 2 * W, seed=1)
    parameters = {"action": logits, "carry": carry}
    raw = mine.sample_no_postprocessing(parameters, KEY)
    np.testing.assert_array_equal(raw["action"], plain.sample_no_postprocessing(logits, KEY))
    np.testing.assert_array_equal(mine.log_prob(parameters, raw), plain.log_prob(logits, raw["action"]))
    np.testing.assert_array_equal(mine.entropy(parameters, KEY), plain.entropy(logits, KEY))
    np.testing.assert_array_equal(mine.mode(parameters)["action"], plain.mode(logits))
    squashed = mine.postprocess(raw)
    np.testing.assert_allclose(squashed["action"], np.tanh(raw["action"]), rtol=1e-6)
    np.testing.assert_array_equal(squashed["carry"], carry)


def test_the_wrapper_carries_memory_until_an_episode_ends():
    env = RecurrentWrapper(VmapWrapper(ToyEnv(length=2)), size=W)
    state = jax.jit(env.reset)(jax.random.split(KEY, B))
    assert (state.obs["is_first"] == 1).all() and (state.obs["carry"] == 0).all()
    before = jax.tree.map(np.array, state)
    ones = {"action": jnp.zeros((B, ACTIONS)), "carry": jnp.ones((B, W))}
    for _ in range(4):
        state = jax.jit(env.step)(state, ones)
        np.testing.assert_array_equal(state.obs["is_first"][:, 0], state.done)
        np.testing.assert_array_equal(state.obs["carry"], np.repeat(1 - state.done[:, None], W, axis=1))
    first = jax.jit(env.reset)(jax.random.split(KEY, B))
    jax.tree.map(np.testing.assert_array_equal, before, first)


def test_an_unknown_memory_names_the_known_ones():
    with pytest.raises(ValueError, match="unknown memory 'lstm'; choose one of mingru, gru, none"):
        make_networks(
            {"state": 110, "privileged_state": 20}, 14, config=dataclasses.replace(SMALL, memory="lstm")
        )
