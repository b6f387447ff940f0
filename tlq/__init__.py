"""tlq: terrain-aware legged locomotion for quadrupeds, trained with JAX, MuJoCo MJX and PPO."""

from typing import Any


def __getattr__(name: str) -> Any:
    # Lazy, so that `tlq.runtime` can be used where there is neither JAX nor MuJoCo.
    if name == "make":
        from tlq.config import make

        return make
    raise AttributeError(f"module 'tlq' has no attribute '{name}'")
