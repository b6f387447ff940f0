"""The weighted total of the reward terms."""

import jax

from rewards.config import RewardConfig


def total(config: RewardConfig, terms: dict[str, jax.Array]) -> tuple[jax.Array, dict[str, jax.Array]]:
    """Adds up the terms.

    Args:
      config: weights.
      terms: `along`, `across`, `smooth`, `energy`, `terrain`, `aim`, `height`, `yaw`, `heading`, `tilt`, and `heave`
        and `knee` if they are paid for, each () and unweighted.

    Returns:
      The reward (), and each term as it enters it.
    """
    weighted = {name: getattr(config, name) * value for name, value in terms.items()}
    if not config.literal:
        # The gentle terms are paid by the motion along the command: a robot that stands earns nothing by them.
        for name in ("across", "smooth"):
            weighted[name] = weighted[name] * terms["along"].clip(0.0, 1.0)
    return sum(weighted.values()), weighted
