"""The PPO loss, from Brax's parts.

It is Brax's `compute_ppo_loss`, but that advantages are normalised over the batch of all devices and the entropy's
noise belongs to the environment: an update doesn't depend on how many devices share it, within rounding.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
from brax.training.agents.ppo.losses import PPONetworkParams, compute_gae

from envs import Guidance, guide
from tlq.networks import RESIDUALS, Networks

if TYPE_CHECKING:
    from tlq.ppo import PPOConfig, Rollout


def ppo_loss(
    params: PPONetworkParams,
    normaliser: Any,
    rollout: Rollout,
    carry: jax.Array,
    last: jax.Array,
    keys: jax.Array,
    *,
    networks: Networks,
    config: PPOConfig,
    axis: str,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Loss of B environments over T steps, on one device of the mesh axis `axis`; its mean over the axis is the loss.

    Args:
      params: of policy and critic.
      normaliser: of the observation.
      rollout: (T, B, ...).
      carry: (B, C) from before the first step.
      last: (B, V) 'privileged_state' after the last step.
      keys: (B, 2) uint32, for the entropy's noise.
      networks: policy, critic, distribution.
      config: weights.
      axis: name of the mesh axis.

    Returns:
      The loss (), and its parts.
    """
    distribution = networks.parametric_action_distribution
    observation: dict[str, Any] = dict(rollout.observation, carry=carry[None])
    if networks.footholds is not None and not config.train_footholds:
        # To PPO the footholds are part of the world: their parameters stay as they acted and get no gradient.
        observation["footholds"] = rollout.footholds
    parameters = networks.policy_network.apply(normaliser, params.policy, observation)
    values = networks.value_network.apply(normaliser, params.value, rollout.observation)
    last_value = networks.value_network.apply(normaliser, params.value, {"privileged_state": last})
    targets, advantages = compute_gae(
        truncation=rollout.truncation,
        termination=rollout.done * (1 - rollout.truncation),
        rewards=rollout.reward * config.reward_scaling,
        values=values,
        bootstrap_value=last_value,
        lambda_=config.gae_lambda,
        discount=config.discount,
    )
    mean = jax.lax.pmean(jnp.mean(advantages), axis)
    deviation = jnp.sqrt(jax.lax.pmean(jnp.mean(jnp.square(advantages - mean)), axis))
    advantages = (advantages - mean) / (deviation + 1e-8)

    ratio = jnp.exp(distribution.log_prob(parameters, {"action": rollout.action}) - rollout.log_prob)
    clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
    policy_loss = -jnp.mean(jnp.minimum(ratio * advantages, clipped * advantages))
    surrogate = -jnp.mean(ratio * advantages)  # without clipping, which alone makes `policy_loss` positive
    value_loss = 0.5 * config.value_loss * jnp.mean(jnp.square(targets - values))
    entropy_loss = jnp.float32(0)
    if config.entropy:  # its noise takes time
        by_env = jax.vmap(lambda p, key: distribution.entropy({"action": p}, key), in_axes=(1, 0), out_axes=1)
        entropy_loss = -config.entropy * jnp.mean(by_env(parameters["action"], keys))
    guide_loss = jnp.float32(0)
    if rollout.guide is not None and networks.footholds is None:
        mean = jnp.tanh(jnp.split(parameters["action"], 2, axis=-1)[0])
        guide_loss = jnp.mean(guide.cost(rollout.guide, mean))
    taken_over = jnp.float32(0)
    if networks.footholds is not None:
        squares = jnp.square(parameters["footholds"]["share"] * parameters["footholds"]["rest"])
        taken_over = jnp.mean(jnp.sum(squares, axis=-1))
    total = (
        policy_loss + value_loss + entropy_loss + config.guide * guide_loss + config.taken_over * taken_over
    )

    new = distribution.create_dist(parameters)
    kl = jnp.mean(new.kl_divergence(distribution.create_dist({"action": rollout.parameters})))
    return total, {
        "total": total,
        "policy": policy_loss,
        "surrogate": surrogate,
        "value": value_loss,
        "entropy": entropy_loss,
        "guide": guide_loss,
        "taken_over": taken_over,
        "kl": kl,
        "std": jnp.mean(new.scale),
        "std_max": jnp.max(new.scale),
    }


def foothold_loss(
    params: Any, normaliser: Any, seen: jax.Array, rest: jax.Array, guidance: Guidance, *, networks: Networks
) -> jax.Array:
    """What a guide says () of the footholds.

    Args:
      params: of `networks.footholds` alone.
      normaliser: of the observation.
      seen: 'state' (.., S).
      rest: (.., 12) the residuals' means before tanh without what the footholds add to them.
      guidance: (.., ...).
      networks: whose footholds are judged.
    """
    assert networks.footholds is not None
    added = networks.footholds(normaliser, params, seen, rest)
    before = [(0, 0)] * (added.ndim - 1)
    action = jnp.pad(jnp.tanh(rest + added), [*before, (RESIDUALS.start, 0)])  # only its residuals are judged
    return jnp.mean(guide.cost(guidance, action) + guide.idle(guidance, added))
