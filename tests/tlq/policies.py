"""Policy files with random weights, and the networks they were made from."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from brax.training.acme import running_statistics

import tlq.export
from tlq.config import TrainConfig, default_config, replace
from tlq.networks import make_networks


def put(value, index):
    """A change of an array: another value at an index."""

    def change(array):
        array = np.array(array, float)
        array[index] = value
        return array

    return change


@dataclasses.dataclass(frozen=True)
class Trained:
    """What a trainer hands to the export."""

    config: TrainConfig
    networks: object
    params: object
    normaliser: object

    def export(self, path, extra=None):
        tlq.export.export_policy(path, self.config, self.params, self.normaliser, extra)
        return path

    def step(self, observation, memory):
        """JAX's action (14,) and memory (M,), by the networks that are trained."""
        obs = {
            "state": jnp.asarray(observation)[None],
            "privileged_state": jnp.zeros((1, 3)),
            "carry": jnp.asarray(memory)[None],
            "is_first": jnp.zeros((1, 1)),
        }
        out = self._apply(self.normaliser, self.params, obs)
        mode = self.networks.parametric_action_distribution.mode(out)
        return np.asarray(mode["action"][0]), np.asarray(mode["carry"][0])

    @functools.cached_property
    def _apply(self):
        return jax.jit(self.networks.policy_network.apply)


def trained(method="ours", memory="mingru", seed=0, spread=0.05, **settings) -> Trained:
    """Random weights of the size that training leads to, and a normaliser that does something.

    With spread 0 it is the policy that training starts from: it leaves walking to the trajectory generator.
    """
    config = default_config()
    for key, value in {"env.method": method, "policy.memory": memory, **settings}.items():
        config = replace(config, key, value)
    size = sum(part["size"] for part in tlq.export.describe(config)["observation"])
    heights = 0 if method == "blind" else 100
    sizes = {"state": size, "privileged_state": 3}
    networks = make_networks(sizes, 14, config=config.policy, heights=heights)
    rng = np.random.default_rng(seed)
    params = networks.policy_network.init(jax.random.PRNGKey(seed))
    params = jax.tree.map(lambda x: x + spread * rng.standard_normal(x.shape).astype(np.float32), params)
    normaliser = running_statistics.init_state({k: jnp.zeros(n) for k, n in sizes.items()})
    mean = {k: jnp.asarray(rng.normal(0, 0.1, n), jnp.float32) for k, n in sizes.items()}
    std = {k: jnp.asarray(rng.uniform(0.3, 1.0, n), jnp.float32) for k, n in sizes.items()}
    return Trained(config, networks, params, normaliser.replace(mean=mean, std=std))
