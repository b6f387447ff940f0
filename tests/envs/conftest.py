import pytest

import tg
from tests.envs.subjects import Subject, config


@pytest.fixture(scope="session")
def exact():
    """An environment without randomisation; `step` doesn't reset."""
    return Subject(config(randomised=False))


@pytest.fixture(scope="session")
def noisy():
    """An environment as in training: randomised, and `step` resets. Legs in stance are damped twice as much."""
    return Subject(config(tg=tg.TGConfig(stance_damping=2.0)), auto_reset=True)
