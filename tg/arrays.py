"""What the array API can do, but NumPy does slowly."""

from collections.abc import Sequence
from typing import Any

Array = Any


def stack(parts: Sequence[Array], axis: int = -1) -> Array:
    """Arrays (...) side by side along a new last (-1) or last but one (-2) axis."""
    xp = parts[0].__array_namespace__()
    if xp.__name__ == "numpy" and parts[0].ndim < 2:
        # The same in 1 µs instead of 5 to 13; a control step stacks some thirty times.
        rows = xp.asarray(parts)
        return rows.T if axis == -1 else rows
    return xp.stack(parts, axis=axis)
