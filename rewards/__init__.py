"""Reward terms and their weighted total."""

from rewards.config import RewardConfig
from rewards.terms import across, along, energy, height, smooth, standing, terrain
from rewards.total import total

__all__ = ["RewardConfig", "across", "along", "energy", "height", "smooth", "standing", "terrain", "total"]
