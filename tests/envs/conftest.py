import pytest

from tests.envs.subjects import Subject, config


@pytest.fixture(scope="session")
def exact():
    """An environment without randomisation; `step` doesn't reset."""
    return Subject(config(randomised=False))


@pytest.fixture(scope="session")
def noisy():
    """An environment as in training: randomised, and `step` resets."""
    return Subject(config(), auto_reset=True)
