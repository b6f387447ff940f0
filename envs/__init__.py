"""The quadruped environment on MJX."""

import contextlib

with contextlib.redirect_stdout(None):  # MJX prints there that the optional warp isn't installed
    from mujoco import mjx as _  # noqa: F401

from envs.auto_reset import AutoReset
from envs.config import EVALUATION_ITERATIONS, METHODS, CurriculumConfig, EnvConfig, RandomisationConfig
from envs.env import GOAL, QuadrupedEnv
from envs.guide import Guidance, Guided
from envs.robot import ROBOTS, RobotConfig
from envs.types import Episode, Randomised


def make(config: EnvConfig) -> QuadrupedEnv:
    """The environment of a configuration; builds its bank of terrains."""
    return QuadrupedEnv(config)


__all__ = [
    "EVALUATION_ITERATIONS",
    "GOAL",
    "METHODS",
    "ROBOTS",
    "AutoReset",
    "CurriculumConfig",
    "EnvConfig",
    "Episode",
    "Guidance",
    "Guided",
    "QuadrupedEnv",
    "Randomised",
    "RandomisationConfig",
    "RobotConfig",
    "make",
]
