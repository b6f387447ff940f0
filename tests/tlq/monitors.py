"""Monitor files for tests."""

import numpy as np

from tlq import monitor
from tlq.runtime import load_policy


def network(policy, *, seed=0, bias=0.0, spread=0.05):
    """A random network for a policy's file; with spread 0 it always gives the logit `bias`."""
    found, random = load_policy(policy), np.random.default_rng(seed)
    sizes = [found.core.observation_size + found.memory_size + 14, 8, 1]

    def draw(*shape):
        return (spread * random.normal(size=shape)).astype(np.float32)

    return monitor.Network(
        mean=draw(sizes[0]),
        std=np.ones(sizes[0], np.float32),
        kernels=(draw(sizes[0], sizes[1]), draw(sizes[1], 1)),
        biases=(draw(sizes[1]), draw(1) + np.float32(bias)),
        scale=np.float32(1.0),
        shift=np.float32(0.0),
    )


def made(path, policy, *, bias=0.0, spread=0.0, **metadata):
    """Writes a monitor for a policy's file, and returns the path."""
    about = {"policy_sha256": monitor.fingerprint(policy), "stop": 0.5, "go": 0.25, "resume": 0.0}
    about |= {"horizon": 0.8, **metadata}
    monitor.save_monitor(path, about, network(policy, bias=bias, spread=spread))
    return path
