"""Tells from what a controller sees and does whether the robot is about to fall, and stops it; NumPy and `tg` alone.

    controller = Controller("policy.npz")
    monitor = Monitor("monitor.npz", "policy.npz")
    while True:                                           # every `control_dt` seconds
        q_des = controller.step(sensors, heights, 0 * command if monitor.standing else command)
        monitor.step(controller)

`python -m tlq.monitor_fit` makes the file. Letters: S observed values, M of memory, F = S + M + 14 features.
"""

import hashlib
import json
import os
from typing import Any, NamedTuple

import numpy as np

from tlq.calibration import sigmoid
from tlq.runtime import Controller, NpzError, read_npz

FORMAT = "tlq-monitor"
VERSION = 1
LARGEST = 1 << 24
"""Bytes a monitor's file may unpack to."""
GO = 0.5
"""The lower threshold, as a share of the one for alarms."""
CLIP = 5.0
"""Features are cut to ± this many standard deviations."""

Array = Any


class MonitorFileError(ValueError):
    """A file that holds no monitor for this policy that this version can run; the text says why."""


class Network(NamedTuple):
    """A multi-layer perceptron with ELU, features (F,) to a logit."""

    mean: Array
    """(F,) of the features."""
    std: Array
    """(F,) of the features."""
    kernels: tuple[Array, ...]
    """(F, n), (n, m), ..., (k, 1)."""
    biases: tuple[Array, ...]
    """(n,), (m,), ..., (1,)."""
    scale: Array
    """() of the calibrated logit, after `scale` x + `shift` (Platt)."""
    shift: Array
    """() see `scale`."""


def features(observation: Array, memory: Array, action: Array) -> Array:
    """What the monitor is shown of a control step (..., F): observation, the memory after it, the policy's action."""
    return observation.__array_namespace__().concatenate([observation, memory, action], axis=-1)


def logit(network: Network, x: Array) -> Array:
    """The calibrated logit (...) of a fall within the horizon, from features (..., F); NumPy or JAX."""
    xp = x.__array_namespace__()
    x = xp.clip((x - network.mean) / network.std, -CLIP, CLIP)
    for i, (kernel, bias) in enumerate(zip(network.kernels, network.biases, strict=True)):
        x = x @ kernel + bias
        if i + 1 < len(network.kernels):
            x = xp.maximum(x, 0.0) + xp.expm1(xp.minimum(x, 0.0))
    return network.scale * x[..., 0] + network.shift


def fingerprint(policy: str | os.PathLike[str]) -> str:
    """What tells a policy file from all others: the SHA-256 of its bytes, in hexadecimal."""
    with open(policy, "rb") as file:
        return hashlib.sha256(file.read()).hexdigest()


class Decision:
    """Probabilities to stopping and going on, with two thresholds, so that it doesn't do both in turns."""

    def __init__(self, stop: float, go: float, resume: float):
        """An alarm is a probability beyond `stop`.

        Args:
          stop: threshold.
          go: another, not larger.
          resume: for how long (s) probabilities must have been below `go` before the robot goes on; 0: it stands for
            good.
        """
        self.stop, self.go, self.resume = stop, go, resume
        self.reset()

    @classmethod
    def at(cls, stop: float, resume: float) -> "Decision":
        """The one of a threshold, with the lower one that belongs to it."""
        return cls(stop, GO * stop, resume)

    def reset(self) -> None:
        """Forgets all alarms."""
        self.standing = False
        """Whether the robot is to stand."""
        self.alarms = 0
        """How many there were."""
        self._calm = 0.0  # s

    def step(self, probability: float, dt: float) -> bool:
        """Whether to stand, `dt` seconds after the last decision. What isn't a number is an alarm."""
        if not self.standing:
            self.standing, self._calm = not probability <= self.stop, 0.0
            self.alarms += self.standing
            return self.standing
        self._calm = self._calm + dt if probability < self.go else 0.0
        if self.resume and self._calm >= self.resume - 1e-9:
            self.standing = False
        return self.standing


class Monitor:
    """Watches one controller, and says when the robot is to be told to stand."""

    def __init__(self, path: str | os.PathLike[str], policy: str | os.PathLike[str]):
        """Reads a monitor's file; raises MonitorFileError if it can't be used with the policy's file."""
        self.metadata, self.network = load_monitor(path)
        if self.metadata["policy_sha256"] != fingerprint(policy):
            raise MonitorFileError(
                f"{os.fspath(path)}: the monitor belongs to another policy than {os.fspath(policy)}; fit one to it "
                "with tlq.monitor_fit"
            )
        self.decision = Decision(*(self.metadata[name] for name in ("stop", "go", "resume")))
        self.reset()

    def reset(self) -> None:
        """Forgets all alarms; to be called with `Controller.reset`."""
        self.decision.reset()
        self.last = 0.0
        """The last probability."""
        self.standing = False
        """Whether the command is to be 0."""

    def probability(self, controller: Controller) -> float:
        """That the robot falls within `metadata["horizon"]` seconds by the command it has; after `controller.step`."""
        x = features(controller.observation, controller.memory, controller.action)
        return float(sigmoid(logit(self.network, x)))

    def step(self, controller: Controller) -> bool:
        """One control period, after `controller.step`: whether the robot is to stand in the next one."""
        self.last = self.probability(controller)
        self.standing = self.decision.step(self.last, controller.control_dt)
        return self.standing


# -- the file --------------------------------------------------------------------------------------------------------


def load_monitor(path: str | os.PathLike[str]) -> tuple[dict[str, Any], Network]:
    """Metadata and network of a file; raises MonitorFileError, one line, where anything is wrong with it."""
    name = os.fspath(path)
    if not os.path.isfile(name):
        raise MonitorFileError(f"no monitor file at {name}")
    try:
        arrays = read_npz(name, "monitor", ("metadata",), LARGEST)
        metadata = _metadata(arrays.pop("metadata"))
        return metadata, _network(metadata, arrays)
    except (MonitorFileError, NpzError) as error:
        raise MonitorFileError(f"{name}: {error}") from None


def _metadata(array: np.ndarray) -> dict[str, Any]:
    try:
        found = json.loads(str(array[()]))
    except (ValueError, RecursionError):
        raise MonitorFileError("damaged: its metadata isn't JSON") from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise MonitorFileError("not a monitor's file of this program")
    if found.get("version") != VERSION:
        raise MonitorFileError(f"format version {found.get('version')}; this program reads version {VERSION}")
    for name, most in (("stop", 1.0), ("go", 1.0), ("resume", 60.0), ("horizon", 60.0)):
        value: Any = found.get(name)
        if type(value) not in (int, float) or not 0.0 <= value <= most:
            raise MonitorFileError(f"metadata: {name} must be a number in [0, {most:g}]")
    if found["go"] > found["stop"]:
        raise MonitorFileError("metadata: go must not be larger than stop")
    if not isinstance(found.get("policy_sha256"), str):
        raise MonitorFileError("metadata: policy_sha256 is missing")
    return found


def _network(metadata: dict[str, Any], arrays: dict[str, np.ndarray]) -> Network:
    sizes = metadata.get("layers")
    if not isinstance(sizes, list) or len(sizes) < 2 or not all(type(n) is int and n > 0 for n in sizes):
        raise MonitorFileError("metadata: layers must be a list of sizes")
    if sizes[-1] != 1:
        raise MonitorFileError("metadata: the last layer must have size 1")
    shapes: dict[str, tuple[int, ...]] = {"mean": (sizes[0],), "std": (sizes[0],), "platt": (2,)}
    for i, (n, m) in enumerate(zip(sizes[:-1], sizes[1:], strict=True)):
        shapes |= {f"kernel_{i}": (n, m), f"bias_{i}": (m,)}
    for name, shape in shapes.items():
        array = arrays.get(name)
        if array is None or array.shape != shape or array.dtype != np.float32:
            raise MonitorFileError(f"damaged: {name} must be float32 {shape}")
        if not np.isfinite(array).all():
            raise MonitorFileError(f"damaged: {name} holds values that are not finite")
    if not (arrays["std"] > 0).all():
        raise MonitorFileError("damaged: std must be positive")
    layers = range(len(sizes) - 1)
    return Network(
        mean=arrays["mean"],
        std=arrays["std"],
        kernels=tuple(arrays[f"kernel_{i}"] for i in layers),
        biases=tuple(arrays[f"bias_{i}"] for i in layers),
        scale=arrays["platt"][0],
        shift=arrays["platt"][1],
    )


def save_monitor(path: str | os.PathLike[str], metadata: dict[str, Any], network: Network) -> None:
    """Writes a monitor's file, whole or not at all; the metadata's format, version and layers are filled in."""
    from tlq.files import whole

    arrays: dict[str, Any] = {"mean": network.mean, "std": network.std}
    arrays["platt"] = np.array([network.scale, network.shift])
    for i, (kernel, bias) in enumerate(zip(network.kernels, network.biases, strict=True)):
        arrays |= {f"kernel_{i}": kernel, f"bias_{i}": bias}
    layers = [int(len(network.mean)), *(int(kernel.shape[1]) for kernel in network.kernels)]
    text = json.dumps({"format": FORMAT, "version": VERSION, **metadata, "layers": layers})
    arrays = {name: np.asarray(array, np.float32) for name, array in arrays.items()}
    with whole(path) as temporary, temporary.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, metadata=np.array(text), **arrays)
