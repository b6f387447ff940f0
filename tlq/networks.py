"""Policy and critic (Flax linen), the action distribution, and the factory that Brax's PPO loss expects.

Letters: B environments, T time, A = 14 actions, C size of the carry, S and V sizes of 'state' and
'privileged_state'. 'state' is [proprioception | heights of 4 feet x 25 points], the heights already scaled.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import flax
import jax
import jax.numpy as jnp
import numpy as np
from brax.training.acme.running_statistics import NestedMeanStd
from brax.training.acme.running_statistics import normalize as normalise
from brax.training.agents.ppo.networks import PPONetworks
from brax.training.distribution import NormalTanhDistribution
from brax.training.networks import FeedForwardNetwork
from flax import linen as nn

import tg
from tlq.memory import Dense, Memory, carry_size

CLIP = 10.0  # normalised observations are clipped to +-CLIP standard deviations

SAME_SIDE = np.array(
    [
        leg * tg.samples.COUNT + point
        for leg in range(4)
        for point in (tg.samples.mirrored_points() if leg % 2 else range(tg.samples.COUNT))
    ]
)
"""Order of the 100 heights in which the right legs' (RF, RR) are those of left legs in the mirror."""
RESIDUALS = slice(2, tg.ACTION_SIZE)
"""Of an action [δf, δh, 12 residuals]."""


LAST = slice(tg.core.offset("actions") + RESIDUALS.start, tg.core.offset("actions") + RESIDUALS.stop)
"""Of the quadruped's 'state', the residuals of the last action, in [-1, 1]."""
LEG_SIGN = np.array([[1, 1, 1], [-1, 1, 1]] * 2, np.float32)
"""(4, 3) turns a left leg's residuals (abduction, hip, knee) into the same leg's."""


BEFORE = {"foothold_head": 0, "foothold_keep": False}
"""Settings that older runs don't name, as they were."""


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Sizes of policy and critic."""

    memory: str = "mingru"
    """Memory cell: mingru, gru or none."""
    memory_layers: int = 2
    """Recurrent layers."""
    memory_width: int = 64
    """Width of a recurrent layer."""
    encoder: int = 128
    """Width of the proprioceptive encoder and of the layer that mixes it with the feet."""
    foot_encoder: tuple[int, int] = (64, 32)
    """Widths of the encoder of one foot's heights; its weights are shared by the four feet."""
    head: int = 64
    """Width of the layer before the action."""
    leg_head: int = 64
    """Width of the layer that turns what one foot sees into that leg's residuals, its weights shared by the four legs:
    what one leg learns about an edge, all of them know. 0: none."""
    leg_context: int = 16
    """Width of what the rest of the network tells each leg's head."""
    critic: tuple[int, ...] = (128, 128)
    """Hidden widths of the critic."""
    initial_std: float = 0.3
    """Standard deviation of the action, before tanh, of an untrained policy."""
    min_std: float = 0.001
    """Lower bound of that deviation, so that a policy goes on exploring: poles27 ended at 0.03 and stood still. Whether
    0.05 or so helps isn't known yet (docs/experiments.md)."""
    foothold_head: int = 64
    """Width of the layers of a network of its own that takes over the residuals where feet must be led to footholds.
    There is one where the terrain has pits and a scripted guide teaches it (`ppo.guide`). 0: none."""
    foothold_keep: bool = True
    """That network says by how much to change the last action's residuals, a share of which it keeps; false: it says
    all of them anew."""
    feet: int = 4
    """Feet whose heights stand at the end of the observation."""


class RecurrentNormalTanh(NormalTanhDistribution):
    """Squashed normal over 'action' whose samples also hand the memory on: {'action': (.., A), 'carry': (B, C)}.

    Parameters are {'action': (.., 2 A) means and raw scales, 'carry': (B, C)}. Only 'action' enters the density.
    """

    def create_dist(self, parameters: dict[str, jax.Array]) -> Any:
        """Distribution of the action before tanh."""
        return super().create_dist(parameters["action"])

    def sample_no_postprocessing(
        self, parameters: dict[str, jax.Array], seed: jax.Array
    ) -> dict[str, jax.Array]:
        """A draw before tanh; the carry goes along."""
        return {"action": self.create_dist(parameters).sample(seed), "carry": parameters["carry"]}

    def mode(self, parameters: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """The mean, squashed; the carry goes along."""
        return self.postprocess({"action": self.create_dist(parameters).mode(), "carry": parameters["carry"]})

    def postprocess(self, event: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """tanh of the action."""
        return dict(event, action=super().postprocess(event["action"]))

    def inverse_postprocess(self, event: dict[str, jax.Array]) -> dict[str, jax.Array]:
        """arctanh of the action."""
        return dict(event, action=super().inverse_postprocess(event["action"]))

    def log_prob(self, parameters: dict[str, jax.Array], actions: dict[str, jax.Array]) -> jax.Array:
        """Log-density (..) of the squashed action, given the action before tanh."""
        return super().log_prob(parameters, actions["action"])


def _head_bias(initial_std: float, min_std: float) -> Callable[..., jax.Array]:
    """Bias of [mean | raw scale]: mean 0 and softplus(raw) + min_std = initial_std."""

    def init(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
        half = shape[0] // 2
        raw = jnp.log(jnp.expm1(initial_std - min_std))
        return jnp.concatenate([jnp.zeros(half), jnp.full(half, raw)]).astype(dtype)

    return init


SMALL = nn.initializers.variance_scaling(0.01**2, "fan_in", "truncated_normal")
"""Of layers that give actions."""
KEPT = 1.0
"""Logit of the share of the last residuals that it keeps."""
UNLED = -2.0
"""Logit of the share that an untrained part for footholds has in the residuals."""


def _elu(x: jax.Array) -> jax.Array:
    """ELU (arXiv 1511.07289) to within rounding; on a CPU `expm1`, which `nn.elu` calls, takes longer than `exp`."""
    return jnp.maximum(x, 0.0) + jnp.exp(jnp.minimum(x, 0.0)) - 1.0


def _feet(c: NetworkConfig, heights: jax.Array) -> jax.Array:
    """Layers of the module that calls it: heights (.., 100) to what each foot sees (.., 4, F), weights shared."""
    foot = heights[..., SAME_SIDE].reshape(*heights.shape[:-1], c.feet, heights.shape[-1] // c.feet)
    for i, width in enumerate(c.foot_encoder):
        foot = _elu(Dense(width, name=f"foot_{i}")(foot))
    return foot


def _legs(c: NetworkConfig, width: int, foot: jax.Array, context: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Layers of the module that calls it: what each foot sees (.., 4, F) and a context (.., X) of all legs to the
    residuals (.., 12), and the layer (.., 4, W) before them; weights shared by the legs.
    """
    context = Dense(c.feet * c.leg_context, name="to_legs")(context)
    context = context.reshape(*foot.shape[:-1], c.leg_context)
    leg = _elu(Dense(width, name="leg")(jnp.concatenate([foot, context], axis=-1)))
    residuals = Dense(3, kernel_init=SMALL, name="leg_action")(leg) * LEG_SIGN
    return residuals.reshape(*leg.shape[:-2], 3 * c.feet), leg


class Footholds(nn.Module):
    """What leads feet to footholds, in place of the rest of the policy where it knows better.

    It has no memory and shares nothing with the rest of the policy, so that it can be taught apart and faster. Each
    joint's residual is (1 - g) times the rest's and g times its own: where feet have to be led somewhere, what the rest
    would do with them is no disturbance that it had to guess.
    """

    config: NetworkConfig

    @nn.compact
    def __call__(
        self, proprio: jax.Array, heights: jax.Array, last: jax.Array | None
    ) -> tuple[jax.Array, jax.Array]:
        """Normalised proprio (.., S - 100), heights (.., 100), residuals (.., 12) of the last action, if it is to start
        from them -> its own residual actions (.., 12) before tanh, and the shares g (.., 12).
        """
        c = self.config
        foot = _feet(c, heights)
        # A trot swings a leg together with the one across.
        pair = jnp.concatenate([foot, foot[..., ::-1, :]], axis=-1)
        context = _elu(Dense(c.foothold_head, name="proprio")(proprio))
        own, leg = _legs(c, c.foothold_head, pair, context)
        share = Dense(3, kernel_init=SMALL, bias_init=nn.initializers.constant(UNLED), name="share")(leg)
        share = nn.sigmoid(share.reshape(own.shape))
        if last is not None:
            keep = Dense(3, kernel_init=SMALL, bias_init=nn.initializers.constant(KEPT), name="keep")(leg)
            own = own + nn.sigmoid(keep.reshape(own.shape)) * last
        return own, share


def _added(own: jax.Array, share: jax.Array, rest: jax.Array) -> jax.Array:
    """What `Footholds` add to the rest's residual actions before tanh; all (.., 12)."""
    return share * (own - rest)


class Policy(nn.Module):
    """Encoders, memory, head: normalised proprioception and heights -> parameters of the action distribution."""

    config: NetworkConfig
    action_size: int

    @nn.compact
    def __call__(
        self,
        proprio: jax.Array,
        heights: jax.Array | None,
        carry: jax.Array,
        is_first: jax.Array,
        footholds: dict[str, jax.Array] | None = None,
        last: jax.Array | None = None,
    ) -> dict[str, Any]:
        """proprio (.., S - 100), heights (.., 100) or None, carry (B, C) from before the first step, is_first (.., 1),
        last: residuals (.., 12) of the last action or None; .. is (B,) for a step, (T, B) for a scan.

        Returns {'action': (.., 2 A), 'carry': (B, C) after the last step}, and with a part for footholds 'footholds':
        'rest' (.., 12), the residuals' means without it, 'own' (.., 12), its own, and 'share' (.., 12), how much of
        them it takes over. With `footholds` of an earlier call 'own' and 'share' are taken from there.
        """
        c = self.config
        x = _elu(Dense(c.encoder, name="proprio")(proprio))
        foot = None
        if heights is not None:
            foot = _feet(c, heights)
            # The feet are told apart here: each has its own place in the input of `mix`.
            x = jnp.concatenate([x, foot.reshape(*x.shape[:-1], -1)], axis=-1)
        x = _elu(Dense(c.encoder, name="mix")(x))
        y = Dense(c.memory_width, name="to_memory")(x)
        carry, y = Memory(c.memory, c.memory_layers, c.memory_width, name="memory")(carry, y, is_first)
        # x skips the memory, so that reflexes don't have to pass through it.
        y = _elu(Dense(c.head, name="head")(jnp.concatenate([x, y], axis=-1)))
        out = Dense(
            2 * self.action_size,
            kernel_init=SMALL,
            bias_init=_head_bias(c.initial_std, c.min_std),
            name="action",
        )
        action = out(y)
        if foot is not None and c.leg_head:
            action = action.at[..., RESIDUALS].add(_legs(c, c.leg_head, foot, y)[0])
        if heights is None or not c.foothold_head:
            return {"action": action, "carry": carry}
        rest = action[..., RESIDUALS]
        if footholds is None:
            own, share = Footholds(c, name="footholds")(proprio, heights, last)
        else:
            own, share = footholds["own"], footholds["share"]
        return {
            "action": action.at[..., RESIDUALS].add(_added(own, share, rest)),
            "carry": carry,
            "footholds": {"rest": rest, "own": own, "share": share},
        }


class Critic(nn.Module):
    """Value of the normalised 'privileged_state' (.., V) -> (..)."""

    widths: tuple[int, ...]

    @nn.compact
    def __call__(self, privileged_state: jax.Array) -> jax.Array:
        """(.., V) -> (..)."""
        x = privileged_state
        for i, width in enumerate(self.widths):
            x = _elu(Dense(width, name=f"hidden_{i}")(x))
        return Dense(1, name="value")(x)[..., 0]


@flax.struct.dataclass
class Networks(PPONetworks):
    """Brax's, and the part of the policy that leads feet to footholds, by itself."""

    footholds: Callable[..., jax.Array] | None = None
    """(normaliser, its parameters, 'state' (.., S), the rest's residuals (.., 12) before tanh) -> (.., 12) what it adds
    to them; None without.

    The policy network takes an observation that has, as 'footholds', what they were in an earlier call.
    """


def _size(shape: Any) -> int:
    return shape if isinstance(shape, int) else shape[-1]


def _normalised(
    preprocess: Callable[..., Any], statistics: Any, obs: dict[str, jax.Array], key: str
) -> jax.Array:
    if preprocess is not normalise:  # Brax's identity takes whatever it is given
        return preprocess(obs, statistics)[key]
    part = NestedMeanStd(mean={key: statistics.mean[key]}, std={key: statistics.std[key]})
    return preprocess({key: obs[key]}, part, max_abs_value=CLIP)[key]


def make_networks(
    observation_size: dict[str, Any],
    action_size: int,
    preprocess_observations_fn: Callable[..., Any] = normalise,
    *,
    config: NetworkConfig = NetworkConfig(),
    heights: int = 100,
) -> Networks:
    """Network factory with Brax's signature.

    observation_size: {'state': S, 'privileged_state': V, ...}, each a number or a shape. `heights`: how many of the
    last entries of 'state' are terrain heights (0 for the blind policy); they are not normalised.
    """
    state_size, value_size = _size(observation_size["state"]), _size(observation_size["privileged_state"])
    size = carry_size(config.memory, config.memory_layers, config.memory_width)
    keeps = config.foothold_head > 0 and config.foothold_keep and heights > 0
    policy, critic = Policy(config, action_size), Critic(config.critic)

    def split(state: jax.Array) -> tuple[jax.Array, jax.Array | None]:
        proprio = state_size - heights
        return state[..., :proprio], state[..., proprio:] if heights else None

    def last(state: jax.Array) -> jax.Array | None:
        return state[..., LAST] if keeps else None

    def policy_init(key: jax.Array) -> Any:
        state = jnp.zeros((1, state_size))
        return policy.init(key, *split(state), jnp.zeros((1, size)), jnp.zeros((1, 1)), None, last(state))

    def policy_apply(statistics: Any, params: Any, obs: dict[str, jax.Array]) -> dict[str, jax.Array]:
        proprio, _ = split(_normalised(preprocess_observations_fn, statistics, obs, "state"))
        carry = obs["carry"] if proprio.ndim == 2 else obs["carry"][0]
        heights = split(obs["state"])[1]
        given = obs.get("footholds")
        return policy.apply(params, proprio, heights, carry, obs["is_first"], given, last(obs["state"]))

    def value_apply(statistics: Any, params: Any, obs: dict[str, jax.Array]) -> jax.Array:
        return critic.apply(
            params, _normalised(preprocess_observations_fn, statistics, obs, "privileged_state")
        )

    def footholds_apply(statistics: Any, params: Any, state: jax.Array, rest: jax.Array) -> jax.Array:
        proprio, _ = split(_normalised(preprocess_observations_fn, statistics, {"state": state}, "state"))
        own, share = Footholds(config).apply({"params": params}, proprio, split(state)[1], last(state))
        return _added(own, share, rest)

    return Networks(
        footholds=footholds_apply if heights and config.foothold_head else None,
        policy_network=FeedForwardNetwork(init=policy_init, apply=policy_apply),
        value_network=FeedForwardNetwork(
            init=lambda key: critic.init(key, jnp.zeros((1, value_size))), apply=value_apply
        ),
        parametric_action_distribution=RecurrentNormalTanh(event_size=action_size, min_std=config.min_std),
    )
