"""Reward terms and their weighted total."""

from rewards.config import RewardConfig
from rewards.step import Step, step_terms
from rewards.terms import across, along, energy, height, knee, smooth, standing, terrain
from rewards.total import total

__all__ = [
    "RewardConfig",
    "Step",
    "across",
    "along",
    "energy",
    "height",
    "knee",
    "smooth",
    "standing",
    "step_terms",
    "terrain",
    "total",
]
