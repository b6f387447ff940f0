"""Recurrent PPO (arXiv 1707.06347) on Brax's parts: our own loop around them.

Letters: B environments, T = unroll steps, M minibatches. One call of `Learner.step` is one iteration: T steps of
every environment, then `epochs` passes over M minibatches. Environments are split over the devices of a mesh axis
'data'; gradients and statistics are averaged over it, everything but the environments is replicated.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import flax
import jax
import jax.numpy as jnp
import numpy as np
import optax
from brax.envs.base import Env, State
from brax.training.acme import running_statistics
from brax.training.agents.ppo.losses import PPONetworkParams
from jax.flatten_util import ravel_pytree
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from envs import Guidance, guide
from tlq.loss import foothold_loss, ppo_loss
from tlq.networks import Networks

AXIS = "data"
NORMALISED = ("state", "privileged_state")
STREAMS = 16
"""Groups of environments that are shuffled each by itself: a minibatch doesn't depend on the number of devices."""
STRIDE = 5
"""The guide that teaches the footholds is asked at every fifth step, or at the nearest below that divides the unroll:
the steps between say nearly the same."""


@dataclasses.dataclass(frozen=True)
class PPOConfig:
    """Settings of the update."""

    unroll: int = 40
    """Steps T of each environment per iteration; 40 steps are one gait cycle at 1.25 Hz."""
    epochs: int = 1
    """Passes over the data of an iteration. Two learn little more by steps, and take a sixth longer
    (docs/experiments.md)."""
    minibatches: int = 8
    """Gradient steps of a pass; each takes B / minibatches whole pieces of T steps."""
    discount: float = 0.99
    """Discount of a step."""
    gae_lambda: float = 0.9
    """Lambda of the advantage estimate."""
    clip: float = 0.2
    """Clipping range of the probability ratio."""
    learning_rate: float = 3e-4
    """Adam's learning rate at the start; a run with `init=` and a KL target starts at the lowest."""
    learning_rate_min: float = 1e-5
    """Lower bound of the adaptive learning rate."""
    learning_rate_max: float = 1e-3
    """Upper bound of the adaptive learning rate."""
    critic_rate: float = 0.0
    """Adam's learning rate of the critic; 0: the policy's. The KL target bounds how fast the policy may change, which
    says nothing of the critic: at so low a rate it lags behind, most of all one that begins anew (`init=` with a
    policy file). If set, the gradients of the two are scaled down each by its own norm."""
    kl_target: float = 0.015
    """KL(old, new) of an iteration that the learning rate is steered to; 0 keeps the learning rate."""
    kl_stop: float = 4.0
    """Gradient steps are left out while the KL of their minibatch is beyond so many times the target; 0: none is."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    value_loss: float = 0.5
    """Weight of the value loss (which has a factor 1/2 of its own)."""
    max_grad_norm: float = 1.0
    """The gradient is scaled down to this norm."""
    reward_scaling: float = 0.1
    """Factor on the reward."""
    guide: float = 4.0
    """0: the policy learns footholds by reward alone, without the scripted guide (envs/guide.py) that says what they
    cost where the terrain has pits. Otherwise the weight of that cost in PPO's loss, if the policy has no part of its
    own for them (`policy.foothold_head`), which the guide teaches apart."""
    guide_rate: float = 1e-3
    """Adam's learning rate of the part of the policy that leads feet to footholds."""
    guide_epochs: int = 5
    """Passes over what the guide says of an iteration, in which it teaches that part. It is asked at every fifth step
    (fourth, third, ... where five doesn't divide the unroll)."""
    train_footholds: bool = False
    """PPO trains that part, too, by what the footsteps led to; the guide goes on teaching it (`guide_rate`). For a
    policy that knows its footholds nearly as well as the guide can say."""
    average: float = 0.98
    """What an iteration keeps of the average of the policy's parameters, which is what `policy.npz` holds: the last 50
    iterations or so, without the noise of single updates. 0: the last parameters."""
    taken_over: float = 0.0
    """Weight in PPO's loss of the squares of the rest's residuals, before tanh, as far as that part takes them over.
    They have no effect then and drift off, to where there is much to make up for whenever the share changes. Whether
    0.03 or so helps isn't known yet (docs/experiments.md)."""


Constants = dict[str, list[jax.Array]]
"""What the environment's functions close over, by the function: 'reset', 'step', 'guide'."""


@flax.struct.dataclass
class TrainState:
    """All that an iteration reads and changes."""

    params: PPONetworkParams
    average: Any  # of the policy's parameters over the last iterations (`PPOConfig.average`)
    opt_state: Any  # of PPO
    guide_opt_state: Any  # of the footholds that the guide teaches; () without
    learning_rate: jax.Array  # ()
    normaliser: running_statistics.RunningStatisticsState  # of 'state' (S,) and 'privileged_state' (V,)
    env_state: State  # every leaf (B, ...)
    key: jax.Array  # (2,) uint32
    iteration: jax.Array  # () int32


@flax.struct.dataclass
class Rollout:
    """What the loss reads of T steps of B environments."""

    observation: dict[str, jax.Array]  # 'state' (T, B, S), 'privileged_state' (T, B, V), 'is_first' (T, B, 1)
    action: jax.Array  # (T, B, A) before tanh
    log_prob: jax.Array  # (T, B)
    parameters: jax.Array  # (T, B, 2 A) of the distribution that drew the action
    reward: jax.Array  # (T, B)
    done: jax.Array  # (T, B)
    truncation: jax.Array  # (T, B)
    guide: Guidance | None  # (T / stride, B, ...) what a guide to footholds says, if there is one
    footholds: dict[str, jax.Array] | None  # (T, B, 12) each, see `Policy`, if there is a part for them


def make_mesh(num_devices: int = 0) -> Mesh:
    """Mesh over the first `num_devices` devices (0: all of them), with the axis 'data'."""
    devices = jax.devices()
    return Mesh(np.array(devices[: num_devices or len(devices)]), (AXIS,))


def hoist(function: Callable[..., Any], *example: Any) -> tuple[list[Any], Callable[..., Any]]:
    """(constants, f) such that f(constants, *arguments) = function(*arguments), for arguments shaped like the example.

    A bank of terrains that a jitted function closes over becomes part of the program: it is compiled anew for every
    bank and fills the compilation cache. As an argument it does neither.
    """
    closed, shape = jax.make_jaxpr(function, return_shape=True)(*example)
    structure = jax.tree.structure(shape)

    def pure(constants: list[Any], *arguments: Any) -> Any:
        results = jax.core.eval_jaxpr(closed.jaxpr, constants, *jax.tree.leaves(arguments))
        return jax.tree.unflatten(structure, results)

    return closed.consts, pure


def adapt_learning_rate(rate: jax.Array, kl: jax.Array, config: PPOConfig) -> jax.Array:
    """Halves the rate above twice the target KL, raises it by 1.5 below half of it, within its bounds."""
    if config.kl_target <= 0:
        return rate
    factor = jnp.where(kl > 2 * config.kl_target, 0.5, jnp.where(kl < config.kl_target / 2, 1.5, 1.0))
    return jnp.clip(rate * factor, config.learning_rate_min, config.learning_rate_max)


class Learner:
    """PPO of one environment and one pair of networks.

    env: batched, with the carry in its observation (`RecurrentWrapper`). num_envs: B over all devices.
    """

    def __init__(
        self, env: Env, networks: Networks, config: PPOConfig, num_envs: int, mesh: Mesh | None = None
    ):
        self.env, self.networks, self.config, self.num_envs = env, networks, config, num_envs
        self.mesh = mesh or make_mesh()
        self.devices = self.mesh.devices.size
        if num_envs % (self.devices * config.minibatches):
            raise ValueError(
                f"num_envs={num_envs} must be a multiple of devices x minibatches = "
                f"{self.devices} x {config.minibatches}"
            )
        self.steps_per_iteration = num_envs * config.unroll
        self.guided = hasattr(env, "guidance")
        # In PPO's own loss the guide has a say at every step.
        strides = [s for s in range(1, STRIDE + 1) if config.unroll % s == 0]
        self.stride = 1 if networks.footholds is None else strides[-1]
        self._clip = optax.clip_by_global_norm(config.max_grad_norm)
        # The gradient is scaled down before, by parts. `identity` stands where that was done, for checkpoints' sake.
        self._optimiser = optax.chain(optax.identity(), optax.scale_by_adam(eps=1e-5))
        self._loss = functools.partial(ppo_loss, networks=networks, config=config, axis=AXIS)
        self._foothold_loss = functools.partial(foothold_loss, networks=networks)
        split = {"env_state": P(AXIS)}  # and nothing else
        fields = dataclasses.fields(TrainState)
        self.specs = TrainState(**{f.name: split.get(f.name, P()) for f in fields})  # type: ignore[arg-type]
        self._hoist()
        # Nothing is donated: the state before an update stays whole, so that a failed one can be saved and replayed.
        # That costs one env_state; the rollout, which is ten times larger, lives inside the call.
        self._jitted = jax.jit(
            jax.shard_map(
                self._iteration,
                mesh=self.mesh,
                in_specs=(P(), self.specs),
                out_specs=(self.specs, P()),
                check_vma=False,
            )
        )

    @property
    def streams(self) -> int:
        """Streams over all devices."""
        streams = math.gcd(STREAMS, self.num_envs // self.config.minibatches)
        return streams if streams % self.devices == 0 else self.devices

    def step(self, state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
        """One iteration: the next state, and the figures () of this one."""
        return self._jitted(self._constants, state)

    def batch(self, state: TrainState) -> dict[str, jax.Array]:
        """What `step` would learn from: each part of the rollout by name (T, B, ...), `carry` and `last` (B, ...)."""

        def roll(constants: Constants, state: TrainState):
            _, key, _ = jax.random.split(state.key, 3)
            env_state, rollout, _ = self._rollout(constants, state, key)
            return rollout, state.env_state.obs["carry"], env_state.obs["privileged_state"]

        specs = (P(), self.specs), (P(None, AXIS), P(AXIS), P(AXIS))
        shared = jax.shard_map(roll, mesh=self.mesh, in_specs=specs[0], out_specs=specs[1], check_vma=False)
        rollout, carry, last = jax.jit(shared)(self._constants, state)
        parts = {f.name: getattr(rollout, f.name) for f in dataclasses.fields(rollout)}
        parts = {name: part for name, part in parts.items() if part is not None}
        observation, guidance = parts.pop("observation"), parts.pop("guide", None)
        guidance = {f"guide_{k}": x for k, x in guidance._asdict().items()} if guidance else {}
        footholds = {f"footholds_{k}": x for k, x in parts.pop("footholds", {}).items()}
        return parts | observation | guidance | footholds | {"carry": carry, "last": last}

    # -- state ---------------------------------------------------------------------------------------------------------

    def init(self, seed: int) -> TrainState:
        """State before the first iteration, placed on the mesh."""
        init = jax.jit(self._init, out_shardings=self.shardings())
        return init(self._constants, jax.random.PRNGKey(seed))

    def shardings(self) -> TrainState:
        """Sharding of every part of the state."""
        return jax.tree.map(
            lambda spec: NamedSharding(self.mesh, spec), self.specs, is_leaf=lambda x: isinstance(x, P)
        )

    def _hoist(self) -> None:
        """Splits the environment into functions and the arrays they close over, which are put on every device."""
        keys = jax.eval_shape(lambda: jax.random.split(jax.random.PRNGKey(0), self.num_envs))
        env_state = jax.eval_shape(self.env.reset, keys)
        if self.networks.footholds is not None and not self.guided:
            raise ValueError(
                "nobody teaches the footholds: set foothold_head=0 or wrap the environment in Guided"
            )
        here = self.num_envs // self.devices
        env_state = jax.tree.map(lambda x: jax.ShapeDtypeStruct((here, *x.shape[1:]), x.dtype), env_state)
        action = {
            "action": jax.ShapeDtypeStruct((here, self.env.action_size), jnp.float32),
            "carry": env_state.obs["carry"],
        }
        ask = jax.vmap(self.env.guidance) if self.guided else lambda state: None
        reset_constants, self._env_reset = hoist(self.env.reset, keys)
        step_constants, self._env_step = hoist(self.env.step, env_state, action)
        guide_constants, self._ask_guide = hoist(ask, env_state)
        # One copy of what several need.
        everywhere = NamedSharding(self.mesh, P())
        constants = {"reset": reset_constants, "step": step_constants, "guide": guide_constants}
        placed = {id(x): jax.device_put(x, everywhere) for part in constants.values() for x in part}
        self._constants = {name: [placed[id(x)] for x in part] for name, part in constants.items()}

    def _init(self, constants: Constants, key: jax.Array) -> TrainState:
        key, key_env, key_policy, key_value = jax.random.split(key, 4)
        env_state = self._env_reset(constants["reset"], jax.random.split(key_env, self.num_envs))
        params = PPONetworkParams(
            policy=self.networks.policy_network.init(key_policy),
            value=self.networks.value_network.init(key_value),
        )
        # std_eps: an observation that hardly varies isn't blown up (least standard deviation 0.01).
        seen = {name: jnp.zeros(env_state.obs[name].shape[1:]) for name in NORMALISED}
        state = TrainState(
            params=params,
            average=params.policy,
            opt_state=self._optimiser.init(params),
            guide_opt_state=()
            if self.networks.footholds is None
            else self._optimiser.init(params.policy["params"]["footholds"]),
            learning_rate=jnp.float32(self.config.learning_rate),
            normaliser=running_statistics.init_state(seen, std_eps=1e-4),
            env_state=env_state,
            key=key,
            iteration=jnp.int32(0),
        )
        # Strong types throughout: with a weak one in the environment's state the second call would compile again.
        return jax.tree.map(lambda x: jax.lax.convert_element_type(x, jnp.asarray(x).dtype), state)

    # -- one iteration, on each device ---------------------------------------------------------------------------------

    def _iteration(self, constants: Constants, state: TrainState) -> tuple[TrainState, dict[str, jax.Array]]:
        key, key_rollout, key_update = jax.random.split(state.key, 3)
        carry = state.env_state.obs["carry"]
        env_state, rollout, env_metrics = self._rollout(constants, state, key_rollout)
        *learnt, losses = self._update(state, carry, rollout, env_state.obs["privileged_state"], key_update)
        # Statistics move after the gradient steps, so that the first ratio of new to old probability is 1.
        # A quarter of the steps says the same at a quarter of the cost.
        normaliser = running_statistics.update(
            state.normaliser, {k: rollout.observation[k][::4] for k in NORMALISED}, pmap_axis_name=AXIS
        )
        # The very first iteration only looks: a policy isn't trained on observations that aren't normalised yet.
        looking = (state.normaliser.count.hi == 0) & (state.normaliser.count.lo == 0)
        params, opt_state, guide_opt_state = jax.tree.map(
            lambda old, new: jnp.where(looking, old, new),
            [state.params, state.opt_state, state.guide_opt_state],
            learnt,
        )
        kl = jnp.where(looking, self.config.kl_target, losses["kl_last"])
        new_state = TrainState(
            params=params,
            average=self._averaged(state, params.policy),
            opt_state=opt_state,
            guide_opt_state=guide_opt_state,
            learning_rate=adapt_learning_rate(state.learning_rate, kl, self.config),
            normaliser=normaliser,
            env_state=env_state,
            key=key,
            iteration=state.iteration + 1,
        )
        return new_state, {**env_metrics, **losses, "learning_rate": state.learning_rate}

    def _averaged(self, state: TrainState, policy: Any) -> Any:
        """The next average of the policy's parameters."""
        # At the start it follows fast: an average from before a policy has learnt anything is of no use.
        n = state.iteration.astype(jnp.float32)
        keep = jnp.minimum(self.config.average, (1.0 + n) / (10.0 + n))
        return jax.tree.map(lambda old, new: keep * old + (1.0 - keep) * new, state.average, policy)

    def _rollout(
        self, constants: Constants, state: TrainState, key: jax.Array
    ) -> tuple[State, Rollout, dict[str, jax.Array]]:
        """T steps with sampled actions; metrics are means over T and B, see `summarise`."""
        policy, distribution = self.networks.policy_network, self.networks.parametric_action_distribution
        numbers = self._numbers()

        def step(env_state: State, key: jax.Array):
            obs = env_state.obs
            parameters = policy.apply(state.normaliser, state.params.policy, obs)
            raw = jax.vmap(distribution.sample_no_postprocessing)(parameters, _keys(key, numbers))
            after = self._env_step(constants["step"], env_state, distribution.postprocess(raw))
            rollout = Rollout(
                observation={k: obs[k] for k in (*NORMALISED, "is_first")},
                action=raw["action"],
                log_prob=distribution.log_prob(parameters, raw),
                parameters=parameters["action"],
                reward=after.reward,
                done=after.done,
                truncation=after.info["truncation"],
                guide=None,
                footholds=parameters.get("footholds"),
            )
            metrics = {k: jnp.mean(v) for k, v in after.metrics.items()}
            return after, (rollout, after.info.get("landings"), dict(metrics, reward=jnp.mean(after.reward)))

        def piece(env_state: State, keys: jax.Array):
            guidance = self._ask_guide(constants["guide"], env_state)
            env_state, results = jax.lax.scan(step, env_state, keys)
            return env_state, (guidance, results)

        keys = jax.random.split(key, self.config.unroll)
        env_state, (guidance, results) = jax.lax.scan(
            piece, state.env_state, keys.reshape(-1, self.stride, *keys.shape[1:])
        )
        rollout, landings, metrics = jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:]), results)
        if guidance is not None and landings is not None:
            errors = guide.next_errors(landings.missed, landings.landed, rollout.done)
            errors = jax.tree.map(lambda x: x[:: self.stride], errors)
            guidance = jax.vmap(jax.vmap(guide.with_errors))(guidance, *errors)
        rollout = rollout.replace(guide=guidance)
        metrics = _over_devices(jax.tree.map(lambda x: jnp.mean(x, axis=0), metrics))
        return env_state, rollout, summarise(metrics, self.steps_per_iteration)

    def _numbers(self) -> jax.Array:
        """Numbers (B,) of this device's environments among those of all devices."""
        here = self.num_envs // self.devices
        return jax.lax.axis_index(AXIS) * here + jnp.arange(here)

    def _minibatches(self, key: jax.Array, passes: int) -> jax.Array:
        """This device's environments (passes x M, B / M), shuffled stream by stream anew in each pass."""
        minibatches, here = self.config.minibatches, self.streams // self.devices
        size = self.num_envs // self.streams

        def order(stream: jax.Array) -> jax.Array:
            keys = jax.random.split(jax.random.fold_in(key, jax.lax.axis_index(AXIS) * here + stream), passes)
            return stream * size + jax.vmap(lambda k: jax.random.permutation(k, size))(keys)

        orders = jax.vmap(order)(jnp.arange(here)).reshape(here, passes, minibatches, -1)
        return jnp.moveaxis(orders, 0, 2).reshape(passes * minibatches, -1)

    def _clipped(self, grads: Any) -> Any:
        """A gradient, scaled down to `max_grad_norm`."""
        return self._clip.update(grads, optax.EmptyState())[0]

    def _descend(self, params: Any, opt_state: Any, grads: Any, rate: jax.Array | float) -> tuple[Any, Any]:
        """Parameters and optimiser's state after a gradient step."""
        updates, opt_state = self._optimiser.update(self._clipped(grads), opt_state)
        return optax.apply_updates(params, jax.tree.map(lambda u: -rate * u, updates)), opt_state

    def _improve(
        self, params: PPONetworkParams, opt_state: Any, grads: PPONetworkParams, rate: jax.Array
    ) -> tuple[PPONetworkParams, Any]:
        """The same of policy and critic, which may have a rate of its own."""
        if not self.config.critic_rate:
            return self._descend(params, opt_state, grads, rate)
        clipped = PPONetworkParams(policy=self._clipped(grads.policy), value=self._clipped(grads.value))
        updates, opt_state = self._optimiser.update(clipped, opt_state)
        updates = PPONetworkParams(
            policy=jax.tree.map(lambda u: -rate * u, updates.policy),
            value=jax.tree.map(lambda u: -self.config.critic_rate * u, updates.value),
        )
        return optax.apply_updates(params, updates), opt_state

    def _update(
        self, state: TrainState, carry: jax.Array, rollout: Rollout, last: jax.Array, key: jax.Array
    ) -> tuple[PPONetworkParams, Any, Any, dict[str, jax.Array]]:
        """`epochs` passes of gradient steps; then, if there are footholds to teach, the guide's.

        carry: (B, C) from before the first step; last: (B, V) 'privileged_state' after the last. Returns parameters,
        both optimisers' states, and figures.
        """
        c = self.config
        key_order, key_loss = jax.random.split(key)
        chosen, numbers = self._minibatches(key_order, c.epochs), self._numbers()

        def gradient_step(carried, inputs):
            params, opt_state = carried
            index, key = inputs
            batch = jax.tree.map(lambda x: x[:, index], rollout)
            (_, losses), grads = jax.value_and_grad(self._loss, has_aux=True)(
                params, state.normaliser, batch, carry[index], last[index], _keys(key, numbers[index])
            )
            grads, losses = _over_devices((grads, losses))
            stepped = self._improve(params, opt_state, grads, state.learning_rate)
            figures = dict(losses, grad_norm=optax.global_norm(grads))
            if c.kl_target > 0 and c.kl_stop > 0:
                # A step too far is seen by the next minibatch. A policy with little spread needs few to be lost.
                far = losses["kl"] > c.kl_stop * c.kl_target
                stepped = jax.tree.map(lambda old, new: jnp.where(far, old, new), carried, stepped)
                figures["skipped"] = 1.0 * far
            return stepped, figures

        (params, opt_state), losses = jax.lax.scan(
            gradient_step,
            (state.params, state.opt_state),
            (chosen, jax.random.split(key_loss, c.epochs * c.minibatches)),
        )
        figures, guide_opt_state = _loss_metrics(losses, c.minibatches), state.guide_opt_state
        if self.networks.footholds is not None:
            # 2: the two keys above are those folded with 0 and 1.
            footholds, guide_opt_state, cost = self._teach(
                state, params.policy["params"]["footholds"], rollout, jax.random.fold_in(key, 2)
            )
            params = params.replace(policy={"params": dict(params.policy["params"], footholds=footholds)})
            figures["loss/guide"] = cost
        return params, opt_state, guide_opt_state, figures

    def _teach(
        self, state: TrainState, footholds: Any, rollout: Rollout, key: jax.Array
    ) -> tuple[Any, Any, jax.Array]:
        """`guide_epochs` passes by which the footholds cost less, with the rest of the policy as it acted.

        footholds: their parameters. Returns the next ones, their optimiser's state, and the mean cost () in the last
        pass.
        """
        c = self.config
        assert rollout.footholds is not None
        asked = jax.tree.map(
            lambda x: x[:: self.stride], (rollout.observation["state"], rollout.footholds["rest"])
        )
        data = *asked, rollout.guide

        def gradient_step(carried, index):
            footholds, opt_state = carried
            batch = jax.tree.map(lambda x: x[:, index], data)
            cost, grads = jax.value_and_grad(self._foothold_loss)(footholds, state.normaliser, *batch)
            cost, grads = _over_devices((cost, grads))
            return self._descend(footholds, opt_state, grads, c.guide_rate), cost

        (footholds, opt_state), costs = jax.lax.scan(
            gradient_step, (footholds, state.guide_opt_state), self._minibatches(key, c.guide_epochs)
        )
        return footholds, opt_state, jnp.mean(costs[-c.minibatches :])


def _keys(key: jax.Array, numbers: jax.Array) -> jax.Array:
    """A key for each environment, by its number."""
    return jax.vmap(jax.random.fold_in, in_axes=(None, 0))(key, numbers)


def _over_devices(parts: Any) -> Any:
    """Means over the devices, taken together: on a CPU they wait for each other at every array."""
    flat, restored = ravel_pytree(parts)
    return restored(jax.lax.pmean(flat, AXIS))


def summarise(means: dict[str, jax.Array], steps: int) -> dict[str, jax.Array]:
    """Figures of an iteration from the means over its `steps` steps of the environment's metrics.

    What an environment reports as 'episode/<x>' is zero but at an episode's end, so a mean over episodes is a ratio
    of two means over steps. Without an episode's end the ratios are nan. Likewise 'level/<kind of terrain>' is zero
    where an environment is of another kind, and 'share/<kind>' 1 where it isn't.
    """
    ended = means.get("episode/ended", jnp.float32(0))
    figures = {k: v for k, v in means.items() if not k.startswith("episode/")}
    for key, value in means.items():
        if key.startswith("episode/") and key != "episode/ended":
            figures[key] = value / ended
        if key.startswith("level/"):
            figures[key] = value / means[key.replace("level", "share", 1)]
    return dict(figures, episodes=ended * steps)


def _loss_metrics(losses: dict[str, jax.Array], minibatches: int) -> dict[str, jax.Array]:
    """Means over the gradient steps (each (epochs x minibatches,)); `kl_last` over the last pass."""
    figures = {
        f"loss/{n}": jnp.mean(losses[n])
        for n in ("policy", "surrogate", "value", "entropy", "guide", "taken_over", "total", "grad_norm")
    }
    figures |= {n: jnp.mean(losses[n]) for n in ("std", "std_max", "skipped") if n in losses}
    finite = jnp.isfinite(losses["total"]) & jnp.isfinite(losses["grad_norm"])
    kl = losses["kl"]
    return dict(figures, kl=jnp.mean(kl), kl_last=jnp.mean(kl[-minibatches:]), finite=jnp.all(finite))
