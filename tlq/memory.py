"""The policy's memory: a stack of recurrent layers, and the wrapper that keeps its carry in the observation.

Letters: B environments, T time, W width of a layer, C size of the carry.
One code path: a step is a scan over T = 1.
"""

from typing import Any

import jax
import jax.numpy as jnp
from brax.envs.base import Env, State, Wrapper
from flax import linen as nn

KINDS = ("mingru", "gru", "none")


def carry_size(kind: str, layers: int, width: int) -> int:
    """Number of floats C an episode carries from step to step."""
    if kind not in KINDS:
        raise ValueError(f"unknown memory '{kind}'; choose one of {', '.join(KINDS)}")
    return 0 if kind == "none" else layers * width


class Dense(nn.Dense):
    """`nn.Dense` that sees one leading axis: with (T, B) the gradient of its weights takes twice as long on a CPU."""

    def __call__(self, inputs: jax.Array) -> jax.Array:
        """(.., inputs) -> (.., features)."""
        flat = inputs.reshape(-1, inputs.shape[-1])
        return super().__call__(flat).reshape(*inputs.shape[:-1], self.features)


@jax.custom_vjp
def linear_scan(a: jax.Array, b: jax.Array, h0: jax.Array) -> jax.Array:
    """h_t = a_t h_{t-1} + b_t with h_{-1} = h0; a, b (T, B, W), h0 (B, W) -> h (T, B, W).

    The operator is (a1, b1) o (a2, b2) = (a1 a2, a2 b1 + b2). A reset is a_t = 0: the scan needs no flag.
    """
    return _scan(a, b, h0)


def _scan(a: jax.Array, b: jax.Array, h0: jax.Array, reverse: bool = False) -> jax.Array:
    # Measured on a CPU at T = 40: plain steps beat the log2(T) passes of the associative scan.
    if jax.default_backend() == "cpu" or a.shape[0] == 1:

        def step(h, ab):
            h = ab[0] * h + ab[1]
            return h, h

        return jax.lax.scan(step, h0, (a, b), reverse=reverse)[1]
    first = -1 if reverse else 0
    b = b.at[first].add(a[first] * h0)
    operator = lambda x, y: (x[0] * y[0], y[0] * x[1] + y[1])  # noqa: E731
    return jax.lax.associative_scan(operator, (a, b), reverse=reverse)[1]


def _linear_scan_forward(a, b, h0):
    h = _scan(a, b, h0)
    return h, (a, h, h0)


def _linear_scan_backward(residuals, dh):
    # g_t = dh_t + a_{t+1} g_{t+1} is the same recurrence run backwards; then da_t = g_t h_{t-1}, db_t = g_t.
    a, h, h0 = residuals
    a_next = jnp.concatenate([a[1:], jnp.zeros_like(a[:1])])
    g = _scan(a_next, dh, jnp.zeros_like(h0), reverse=True)
    h_before = jnp.concatenate([h0[None], h[:-1]])
    return g * h_before, g, g[0] * a[0]


linear_scan.defvjp(_linear_scan_forward, _linear_scan_backward)


def _gate_bias(key: jax.Array, shape: tuple[int, ...], dtype: Any = jnp.float32) -> jax.Array:
    """Bias of [z | c | g]: z starts with time constants tau log-uniform over 2 to 100 steps, 1 - z = exp(-1/tau)."""
    width = shape[0] // 3
    keep = jnp.exp(-1.0 / jnp.geomspace(2.0, 100.0, width))
    return jnp.concatenate([jnp.log((1 - keep) / keep), jnp.zeros(2 * width)]).astype(dtype)


class MinGRU(nn.Module):
    """Residual block around a minGRU (arXiv 2410.01201), in linear space so that a reset is exact.

    With u = LayerNorm(x), z = sigmoid(Wz u + bz), c = tanh(Wc u + bc), a = (1 - is_first)(1 - z):
    h_t = a_t h_{t-1} + z_t c_t and y = x + Wo [h silu(Wg u + bg)]. |h| <= 1 always.
    """

    width: int

    @nn.compact
    def __call__(self, carry: jax.Array, x: jax.Array, is_first: jax.Array) -> tuple[jax.Array, jax.Array]:
        """carry (B, W), x (T, B, W), is_first (T, B, 1) -> (carry after the last step (B, W), y (T, B, W))."""
        gates = Dense(3 * self.width, bias_init=_gate_bias, name="gates")(nn.LayerNorm(name="norm")(x))
        z, c, g = jnp.split(gates, 3, axis=-1)
        z = nn.sigmoid(z)
        h = linear_scan((1 - is_first) * (1 - z), z * jnp.tanh(c), carry)
        return h[-1], x + Dense(x.shape[-1], name="out")(h * nn.silu(g))


class GRU(nn.Module):
    """Residual block around a GRU, scanned step by step. Same arguments as `MinGRU`."""

    width: int

    @nn.compact
    def __call__(self, carry: jax.Array, x: jax.Array, is_first: jax.Array) -> tuple[jax.Array, jax.Array]:
        """carry (B, W), x (T, B, W), is_first (T, B, 1) -> (carry after the last step (B, W), y (T, B, W))."""

        def step(cell, h, inputs):
            u, first = inputs
            return cell((1 - first) * h, u)

        scan = nn.scan(step, variable_broadcast="params", split_rngs={"params": False})
        carry, h = scan(nn.GRUCell(self.width, name="cell"), carry, (nn.LayerNorm(name="norm")(x), is_first))
        return carry, x + Dense(x.shape[-1], name="out")(h)


class Memory(nn.Module):
    """A stack of recurrent blocks; `kind` is one of `KINDS`."""

    kind: str = "mingru"
    layers: int = 2
    width: int = 64

    @nn.compact
    def __call__(self, carry: jax.Array, x: jax.Array, is_first: jax.Array) -> tuple[jax.Array, jax.Array]:
        """One step at rank 2, a scan over T at rank 3.

        carry (B, C) from before the first step; x (B, W) or (T, B, W); is_first (B, 1) or (T, B, 1), 1 where an
        episode starts. Returns (carry after the last step (B, C), y like x).
        """
        if self.kind == "none":
            return carry, x
        step = x.ndim == 2
        if step:
            x, is_first = x[None], is_first[None]
        block: Any = {"mingru": MinGRU, "gru": GRU}[self.kind]
        carries = []
        for i, h in enumerate(jnp.split(carry, self.layers, axis=-1)):
            h, x = block(self.width, name=f"layer_{i}")(h, x, is_first)
            carries.append(h)
        return jnp.concatenate(carries, axis=-1), x[0] if step else x


class RecurrentWrapper(Wrapper):
    """Outermost wrapper of a batched environment: the memory travels in the observation.

    obs = {..., 'carry': (B, C) from before the step, 'is_first': (B, 1)}; action = {'action': (B, A),
    'carry': (B, C)}. Where an episode ends, the next carry is zero and is_first is 1.
    """

    def __init__(self, env: Env, size: int):
        super().__init__(env)
        self.size = size

    def reset(self, rng: jax.Array) -> State:
        """rng (B, 2) keys -> batched state."""
        state = self.env.reset(rng)
        batch = state.done.shape
        return state.replace(
            obs=dict(state.obs, carry=jnp.zeros((*batch, self.size)), is_first=jnp.ones((*batch, 1)))
        )

    def step(self, state: State, action: dict[str, jax.Array]) -> State:
        """Batched state and {'action', 'carry'} -> batched state."""
        inner = {k: v for k, v in state.obs.items() if k not in ("carry", "is_first")}
        state = self.env.step(state.replace(obs=inner), action["action"])
        done = state.done[..., None]
        return state.replace(
            obs=dict(state.obs, carry=jnp.where(done > 0, 0.0, action["carry"]), is_first=done)
        )
