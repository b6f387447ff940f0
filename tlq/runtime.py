"""Runs an exported policy on a robot, with NumPy and `tg` alone.

    controller = Controller("policy.npz")
    controller.reset()
    sensors = controller.example_sensors()
    points = controller.sample_points(sensors)            # where the terrain's height is wanted
    q_des = controller.step(sensors, heights, command)    # every `control_dt` seconds

Letters: L = 4 legs (LF, RF, LR, RR), J = 12 joints (leg by leg: abduction, hip, knee), P = 25 points a foot.
The heading frame has the trunk's yaw, but neither its roll nor its pitch.
"""

import dataclasses
import json
import math
import os
import zipfile
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

import tg
from tlq.graph import Graph, GraphError

FORMAT = "tlq-policy"
VERSION = 1
LARGEST = 1 << 28
"""Bytes a policy file may unpack to."""

Sensors = Mapping[str, np.ndarray]

_SHAPES = {"orientation": (4,), "angular_velocity": (3,), "joint_position": (12,), "joint_velocity": (12,)}
_START_PHASE = 0.5 * math.pi
"""Every foot is in the middle of its step there: fading in the stride pushes the robot neither way."""


class PolicyFileError(ValueError):
    """A file that holds no policy this version can run; the text says why."""


class NpzError(ValueError):
    """A file that isn't what it should be; the text says why."""


@dataclasses.dataclass(frozen=True, eq=False)
class Policy:
    """What a policy file holds."""

    metadata: dict[str, Any]
    """See `tlq.export.describe`."""
    arrays: dict[str, np.ndarray]
    """Initialisers of the graph, float32."""
    graph: Graph
    """The network: observation (S,) and memory (M,) to action (14,) and next memory."""
    core: tg.Core
    """Trajectory generator, observation, leg kinematics."""

    @property
    def memory_size(self) -> int:
        """M."""
        return self.metadata["memory"]["size"]


class Controller:
    """A policy, its memory and the trajectory generator of one robot."""

    def __init__(self, path: str | os.PathLike[str]):
        """Reads a policy file; raises PolicyFileError if it can't be run."""
        policy = load_policy(path)
        self.metadata = policy.metadata
        self.core = policy.core
        self.joint_names: tuple[str, ...] = tuple(policy.metadata["joint_names"])
        self.control_dt: float = policy.metadata["control_dt"]
        self.kp: float = policy.metadata["kp"]
        self.kd: float = policy.metadata["kd"]
        self.torque_limit = np.array(policy.metadata["torque_limit"])
        self._graph = policy.graph
        self._memory_size = policy.memory_size
        self.reset()

    def reset(self, phase: float = _START_PHASE) -> None:
        """Forgets everything; the robot is taken to stand. `phase` rad: where in its cycle the gait will start."""
        self.state = self.core.initial_state(np.asarray(phase, np.float32))
        self.memory = np.zeros(self._memory_size, np.float32)
        """(M,) the policy's memory."""
        self.action = np.zeros(tg.ACTION_SIZE, np.float32)
        """(14,) what the policy gave last, in (-1, 1)."""
        self.observation = np.zeros(self.core.observation_size, np.float32)
        """(S,) what the policy was shown last."""

    @property
    def damping(self) -> np.ndarray:
        """Derivative gains (12,) N m s/rad that go with the last desired joint angles: `kd`, in stance by a factor."""
        return self.kd * np.asarray(self.core.damping(self.state))

    def keep_heading(self) -> None:
        """Takes the present heading as the one to keep (at first that of `reset`), while everything else goes on."""
        self.state = self.state._replace(turn=0.0 * self.state.turn)

    def example_sensors(self) -> dict[str, np.ndarray]:
        """Sensors of a robot that stands level.

        orientation (4,) quaternion w x y z, world from trunk (its yaw isn't used); angular_velocity (3,) rad/s, trunk
        frame; joint_position (12,) rad and joint_velocity (12,) rad/s in the order of `joint_names`.
        """
        return {
            "orientation": np.array([1.0, 0.0, 0.0, 0.0]),
            "angular_velocity": np.zeros(3),
            "joint_position": np.array(self.core.default_pose, float),
            "joint_velocity": np.zeros(12),
        }

    def sample_points(self, sensors: Sensors) -> np.ndarray:
        """Points (L, P, 2) m at which `step` wants the terrain's height: heading frame, from the trunk's centre."""
        return self.core.sample_points(self.state, _sensors(sensors))

    def step(self, sensors: Sensors, heights: np.ndarray | None, command: np.ndarray) -> np.ndarray:
        """One control period.

        Args:
          sensors: as `example_sensors`.
          heights: (L, P) m, the terrain's at `sample_points(sensors)`, from the trunk's centre, up positive; a blind
            policy takes None.
          command: (2,) unit vector, direction in the heading frame; 0 to stand.

        Returns:
          Desired joint angles (12,) rad for a PD controller with the gains `kp` and `damping` (which damps the joint's
          speed).
        """
        measured = _sensors(sensors)
        direction = _array("command", command, (2,))
        length = math.hypot(*direction.tolist())
        if length > 1e-6 and abs(length - 1.0) > 0.01:
            raise ValueError(f"command has length {length:.3g}; give a unit vector, or 0, 0 to stand")
        seen = patch = None
        if self.core.heights:
            shape = (4, self.core.points)
            if heights is None:
                raise ValueError(f"heights is None; this policy needs an array of shape {shape}")
            seen, patch = np.split(_array("heights", heights, shape), [tg.samples.COUNT], axis=1)
        self.observation = self.core.observe(self.state, measured, seen, direction)
        self.action, self.memory = self._graph(self.observation, self.memory)
        self.state, desired = self.core.act(self.state, self.action, measured, direction, patch)
        return desired


def _array(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.asarray(value, np.float32)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be an array of {shape} numbers") from None
    if array.shape != shape:
        raise ValueError(f"{name} has shape {array.shape}; expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} holds values that are not finite")
    return array


def _sensors(sensors: Sensors) -> tg.Sensors:
    if not isinstance(sensors, Mapping) or set(sensors) != set(_SHAPES):
        raise ValueError(f"sensors must be a dict of {', '.join(_SHAPES)}")
    measured = tg.Sensors(
        **{name: _array(f"sensors['{name}']", sensors[name], _SHAPES[name]) for name in _SHAPES}
    )
    length = math.hypot(*measured.orientation.tolist())
    if abs(length - 1.0) > 0.01:
        raise ValueError(
            f"sensors['orientation'] has length {length:.3g}; expected a unit quaternion w, x, y, z"
        )
    return measured


# -- reading a file --------------------------------------------------------------------------------------------------


def load_policy(path: str | os.PathLike[str]) -> Policy:
    """Reads and checks a policy file; raises PolicyFileError, one line, where anything is wrong with it."""
    name = os.fspath(path)
    if not os.path.isfile(name):
        raise PolicyFileError(f"no policy file at {name}")
    try:
        arrays = read_npz(name, "policy", ("graph", "metadata"), LARGEST)
        metadata, nodes = (_json(key, arrays.pop(key)) for key in ("metadata", "graph"))
        _check_version(metadata)
        core = _core(metadata)
        _check_arrays(arrays)
        policy = Policy(metadata, arrays, Graph(nodes, arrays), core)
        _try(policy)
    except (PolicyFileError, NpzError) as error:
        raise PolicyFileError(f"{name}: {error}") from None
    except GraphError as error:
        raise PolicyFileError(f"{name}: its graph can't be run: {error}") from None
    return policy


def read_npz(name: str, what: str, needed: Sequence[str], largest: int) -> dict[str, np.ndarray]:
    """Arrays of an npz file, without pickle; raises NpzError where it isn't a `what` file, holding `needed` ones.

    largest: bytes that it may unpack to.
    """
    try:
        with zipfile.ZipFile(name) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > largest:
                raise NpzError(f"too large for a {what} file")
        with np.load(name, allow_pickle=False) as file:
            if not set(needed) <= set(file.files):
                raise NpzError(f"not a {what} file: it has no {' and '.join(needed)}")
            return {key: file[key] for key in file.files}
    except NpzError:
        raise
    except zipfile.BadZipFile as error:
        raise NpzError(f"damaged, or not a {what} file ({error})") from None
    except (
        Exception
    ) as error:  # NumPy reads the arrays' headers with Python's own parser, which raises many kinds
        raise NpzError(f"damaged ({' '.join(str(error).split())})") from None


def _json(key: str, array: np.ndarray) -> Any:
    try:
        found = json.loads(str(array[()]))
    except (ValueError, RecursionError):
        raise PolicyFileError(f"damaged: its {key} isn't JSON") from None
    if not isinstance(found, dict if key == "metadata" else list):
        raise PolicyFileError(f"damaged: its {key} is of the wrong type")
    return found


def _check_version(metadata: dict[str, Any]) -> None:
    if metadata.get("format") != FORMAT:
        raise PolicyFileError("not a policy file of this program")
    if metadata.get("version") != VERSION:
        raise PolicyFileError(
            f"format version {metadata.get('version')}; this program reads version {VERSION}"
        )


def _check_arrays(arrays: dict[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        if array.dtype != np.float32:
            raise PolicyFileError(f"{name} is of type {array.dtype}, not float32")
        if not np.isfinite(array).all():
            raise PolicyFileError(f"{name} holds values that are not finite")


def _core(metadata: dict[str, Any]) -> tg.Core:
    """The controller core a file describes."""

    def numbers(value: Any, what: str, *shape: int) -> np.ndarray:
        with np.errstate(over="ignore"):
            array = np.asarray(value, np.float32)
        if array.shape != shape or not np.isfinite(array).all():
            raise PolicyFileError(f"metadata: {what} must be {shape} finite numbers")
        return array

    try:
        shapes = {"hip_position": (4, 3), "offset": (4,), "thigh": (4,), "shank": (4,), "sign": (3,)}
        geometry = {
            name: numbers(metadata["leg"][name], f"leg.{name}", *shape) for name, shape in shapes.items()
        }
        settings = tg.TGConfig(**(tg.BEFORE | metadata["tg"]))
        kp, kd = (float(numbers(metadata[name], name)) for name in ("kp", "kd"))
        if kp <= 0.0:
            raise PolicyFileError("metadata: kp must be above 0")
        core = tg.Core(
            settings,
            tg.LegGeometry(**geometry),
            base_foot=numbers(metadata["base_foot"], "base_foot", 4, 3),
            default_pose=numbers(metadata["default_pose"], "default_pose", 12),
            lower=numbers(metadata["joint_lower"], "joint_lower", 12),
            upper=numbers(metadata["joint_upper"], "joint_upper", 12),
            dt=float(metadata["control_dt"]),
            sag=float(metadata["sag"]),
            slack=kd / kp,
            heights=metadata["observation"][-1]["name"] == "heights",
        )
        numbers(metadata["torque_limit"], "torque_limit", 12)
        for name in ("control_dt", "sag"):
            numbers(metadata[name], name)
        if settings.gait not in tg.path.GAITS:
            raise PolicyFileError(f"metadata: tg.gait must be one of {', '.join(tg.path.GAITS)}")
        for name, value in metadata["tg"].items():
            if name != "gait":
                numbers(value, f"tg.{name}")
        if not 0.0 < settings.swing_share <= tg.path.LONGEST_SWING[settings.gait]:
            raise PolicyFileError("metadata: tg.swing_share is out of range")
        if len(metadata["joint_names"]) != 12 or not all(isinstance(n, str) for n in metadata["joint_names"]):
            raise PolicyFileError("metadata: joint_names must be 12 names")
        size = metadata["memory"]["size"]
        if type(size) is not int or not 0 <= size <= 1 << 20:
            raise PolicyFileError("metadata: memory.size must be a whole number")
        layout = tuple((part["name"], part["size"]) for part in metadata["observation"])
    except PolicyFileError:
        raise
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError) as error:
        raise PolicyFileError(
            f"metadata: something is missing or wrong ({type(error).__name__}: {error})"
        ) from None
    if layout != core.layout:
        raise PolicyFileError("metadata: the observation has another layout than this program's")
    return core


def _try(policy: Policy) -> None:
    """Runs the graph once, so that shapes that don't fit show now."""
    memory = np.zeros(policy.memory_size, np.float32)
    try:
        with np.errstate(all="ignore"):
            action, after = policy.graph(np.zeros(policy.core.observation_size, np.float32), memory)
    except (ValueError, TypeError, IndexError, AttributeError) as error:
        raise PolicyFileError(f"its graph doesn't fit its arrays ({' '.join(str(error).split())})") from None
    for what, array, shape in (("action", action, (tg.ACTION_SIZE,)), ("memory_out", after, memory.shape)):
        if array.shape != shape or array.dtype != np.float32 or not np.isfinite(array).all():
            raise PolicyFileError(
                f"its graph gives {what} as {array.dtype} {array.shape}, not finite float32 {shape}"
            )
