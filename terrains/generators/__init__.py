"""The generators, one file a kind; importing this package registers them in this order."""

from terrains.generators import flat, blocks, stairs, stepping_stones, poles, gaps  # noqa: F401, I001
