"""The controller core: trajectory generator, leg kinematics, observation. Runs under JAX and under NumPy alike."""

from tg import footholds, frames, leg, path, samples
from tg.config import BEFORE, TGConfig
from tg.core import ACTION_SIZE, ControllerState, Core, Sensors
from tg.leg import LegGeometry

__all__ = [
    "ACTION_SIZE",
    "BEFORE",
    "ControllerState",
    "Core",
    "LegGeometry",
    "Sensors",
    "TGConfig",
    "footholds",
    "frames",
    "leg",
    "path",
    "samples",
]
