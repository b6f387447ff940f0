"""A robot that is told where to walk, pushed, paused and given newer policies while it walks.

session = Session("poles", "poles", "paper")
session.walk(angle=0.0)
session.advance(seconds)  # every few milliseconds of the clock
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

import terrains
from envs.config import EnvConfig
from envs.robot import RobotConfig
from terrains import Terrain
from tlq import render
from tlq.cli import find_policy
from tlq.config import training_env
from tlq.evaluate import FIRST_SEED
from tlq.insight import RewardMeter
from tlq.runtime import Controller, PolicyFileError
from tlq.senses import PerceptionConfig, check_use
from tlq.simulation import Simulation

LATE = 0.1
"""A simulation that falls behind the clock by more than this (s) is slower than it, instead of running after it."""
EDGE = 0.15
"""The robot starts anew this far (m) before the end of the map."""
LONGEST_CLIP = 120.0
"""A recording ends by itself after so long (s, simulated)."""
FASTEST_PUSH = 3.0
"""m/s."""
_ROBOT = ("joint_names", "leg", "base_foot", "default_pose", "joint_lower", "joint_upper", "kp", "kd")
_CONTROL = (*_ROBOT, "torque_limit", "tg", "control_dt", "sag")
"""What two policies must have in common for one to go on where the other was."""


@dataclasses.dataclass(frozen=True)
class Clip:
    """A recorded walk, one row a control step."""

    qpos: np.ndarray
    """(T, 19), see `mujoco.MjData.qpos`."""
    command: np.ndarray
    """(T, 2) unit vectors in the world, or 0."""
    robot: RobotConfig
    terrain: Terrain
    control_dt: float
    """s."""

    def write(self, path: str | Path) -> Path:
        """Renders the clip as an MP4; takes about as long as the walk, or longer."""
        frames = render.render(
            self.qpos,
            robot=self.robot,
            terrain=self.terrain,
            control_dt=self.control_dt,
            command=self.command,
        )
        return render.write_video(clip_path(path), frames)


def clip_path(name: str | Path) -> Path:
    """The path of a clip; raises ValueError where none can be written."""
    path = Path(name)
    if path.suffix != ".mp4":
        raise ValueError(f"clip {name!s}: the name must end in .mp4")
    if not path.absolute().parent.is_dir():
        raise ValueError(f"clip {name}: there is no folder {path.absolute().parent}")
    return path


class Session:
    """One robot on one terrain. Not for several threads at once. World frame, SI units."""

    def __init__(
        self,
        policy: str,
        kind: str,
        difficulty: float | str = "paper",
        seed: int = 0,
        perception: PerceptionConfig | None = None,
    ):
        """Puts the robot on the terrain's start platform, told to stand.

        Args:
          policy: file, run folder, or name of a policy that comes with tlq.
          kind: of the terrain.
          difficulty: in [0, 1], or "paper".
          seed: of the terrain; evaluation's with the same number.
          perception: range sensors and elevation map that give the heights; none: the terrain itself does.
        """
        self.path = find_policy(policy)
        self._stamp = _stamp(self.path)
        self.direction = np.zeros(2)
        """(2,) where the robot is told to walk: a unit vector in the world, or 0 to stand."""
        self.paused = False
        self.speed = 1.0
        """Simulated seconds per second of the clock."""
        self.falls = 0
        self.news = ""
        """One line on what happened last."""
        self.kind, self.seed = kind, seed
        """What was asked for; `mixed` is one of the others in `sim.terrain`."""
        self.perception = perception
        """What senses the ground; None: heights are the terrain's."""
        self._owed = 0.0
        self._rows: list[tuple[np.ndarray, np.ndarray]] | None = None
        controller, config = read(self.path)
        check_use(perception, controller, self.path)
        self._begin(controller, make_terrain(kind, difficulty, seed), config)

    # -- commands

    def walk(self, angle: float) -> None:
        """Towards an angle (rad) in the world, left of the x axis positive."""
        self.direction = np.array([math.cos(angle), math.sin(angle)])

    def stand(self) -> None:
        """Stops."""
        self.direction = np.zeros(2)

    def push(self, angle: float, speed: float) -> None:
        """Changes the trunk's velocity at once, by `speed` (m/s) towards an angle (rad) in the world."""
        if not 0.0 <= speed <= FASTEST_PUSH:
            raise ValueError(f"push of {speed} m/s must be in [0, {FASTEST_PUSH}]")
        self.sim.data.qvel[:2] += speed * np.array([math.cos(angle), math.sin(angle)])

    def restart(self) -> None:
        """Back on the start platform; the command stays."""
        self.sim.reset()
        self._meter.reset(self.sim)
        self._start_counting()

    def build(self, kind: str, difficulty: float | str, seed: int) -> None:
        """Another terrain; the robot starts anew."""
        self._check_not_recording()
        terrain = make_terrain(kind, difficulty, seed)
        self._begin(self.sim.controller, terrain, self.sim.config)
        self.kind, self.seed = kind, seed
        self.news = f"on {terrain.kind}, difficulty {terrain.difficulty:g}, seed {seed}"

    def sense(self, perception: PerceptionConfig | None) -> None:
        """Heights from other sensors, or from the terrain itself; the robot starts anew."""
        if perception is not None:
            perception.check()
        check_use(perception, self.sim.controller, self.path)
        self._check_not_recording()
        self.perception = perception
        self._begin(self.sim.controller, self.sim.terrain, self.sim.config)
        self.news = "heights from the map" if perception is None else f"heights from {perception.kind}"

    # -- time

    def advance(self, seconds: float) -> int:
        """Runs the control steps that have become due in so much time of the clock (s); returns their number."""
        if self.paused:
            self._owed = 0.0
            return 0
        dt = self.sim.controller.control_dt
        self._owed = min(self._owed + seconds * self.speed, max(LATE, dt))
        count = math.floor(self._owed / dt + 1e-6)
        self._owed -= count * dt
        for _ in range(count):
            self.step()
        return count

    def step(self) -> None:
        """One control period; after a fall and at the edge of the map the robot starts anew."""
        before = self.sim.data.qpos[:2].copy()
        moment = self.sim.step(self.direction)
        self.time += self.sim.controller.control_dt
        self.work += float(moment.work)
        self.distance += float((moment.position - before) @ self.direction)
        self.terms = self._meter(self.sim, self.direction, float(moment.work))
        self._record_row()
        if moment.fell:
            self.falls += 1
            self._start_anew("fell")
        elif np.abs(moment.position).max() > self.sim.terrain.half_extent - EDGE:
            self._start_anew("came to the edge of the map")

    # -- readings

    @property
    def energy_per_metre(self) -> float:
        """Sum of |torque x speed| dt since the start, per distance (J/m); NaN in the first 10 cm."""
        return self.work / self.distance if self.distance > 0.1 else math.nan

    @property
    def frequency_change(self) -> float:
        """δf (Hz)."""
        core = self.sim.controller.core
        return float(self.sim.controller.state.frequency) - core.config.base_frequency

    @property
    def lift_change(self) -> np.ndarray:
        """δh (4,) m, of each leg, held from lift-off to touch-down."""
        return self.sim.controller.state.lift - self.sim.controller.core.config.lift

    # -- policies

    def load(self, policy: str) -> None:
        """Goes on with another policy; raises ValueError, and keeps the present one, where that can't be run."""
        path = find_policy(policy)
        stamp = _stamp(path)
        self._take_over(path, *read(path))
        self.path, self._stamp = path, stamp
        self.news = f"took over {path}"

    def refresh(self) -> bool:
        """Takes over the policy's file if it has changed, and says whether; a file that is gone hasn't.

        Raises ValueError where the new file can't be run; it is not tried again before it changes again.
        """
        stamp = _stamp(self.path)
        if stamp is None or stamp == self._stamp:
            return False
        self._stamp = stamp
        self._take_over(self.path, *read(self.path))
        self.news = f"took over a newer {self.path}"
        return True

    # -- clips

    @property
    def recorded(self) -> float | None:
        """Length (s, simulated) of the clip that is being recorded; None: none is."""
        return None if self._rows is None else (len(self._rows) - 1) * self.sim.controller.control_dt

    def record(self) -> None:
        """Begins a clip."""
        self._check_not_recording()
        self._rows = []
        self._record_row()

    def take_clip(self) -> Clip:
        """Ends the clip."""
        if self._rows is None:
            raise ValueError("nothing is being recorded")
        qpos, command = (np.array(column) for column in zip(*self._rows, strict=True))
        self._rows = None
        return Clip(qpos, command, self.sim.config.robot, self.sim.terrain, self.sim.controller.control_dt)

    # -- inside

    def _begin(self, controller: Controller, terrain: Terrain, config: EnvConfig) -> None:
        seed = terrain.seed  # as evaluation's first episode
        self.sim = Simulation(controller, terrain, config, perception=self.perception, seed=seed)
        self._meter = RewardMeter(self.sim)
        self._start_counting()

    def _start_counting(self) -> None:
        self.time = 0.0
        """s, simulated, since the start; as `work` (J) and `distance` (m), the progress along the commands."""
        self.work = self.distance = 0.0
        self.terms = {}
        """Reward terms of the last step, weighted, and their `total`."""

    def _start_anew(self, what: str) -> None:
        self.news = f"{what} after {self.distance:.2f} m, {self.time:.1f} s; started anew"
        self.restart()

    def _take_over(self, path: Path, controller: Controller, config: EnvConfig) -> None:
        check_use(self.perception, controller, path)
        old = self.sim.controller
        same = all(controller.metadata.get(key) == old.metadata.get(key) for key in _CONTROL)
        if same and config.robot == self.sim.config.robot:
            # The gait goes on where it was; the memory is the new policy's own and starts empty.
            controller.state = old.state
            self.sim.controller, self.sim.config = controller, config
            return
        self._check_not_recording()
        try:
            self._begin(controller, self.sim.terrain, config)
        except KeyError as error:
            raise PolicyFileError(f"the policy's robot can't be built: {error}") from None

    def _record_row(self) -> None:
        if self._rows is not None and len(self._rows) * self.sim.controller.control_dt <= LONGEST_CLIP:
            self._rows.append((self.sim.data.qpos.copy(), self.direction.copy()))

    def _check_not_recording(self) -> None:
        if self._rows is not None:
            raise ValueError("a clip is being recorded; save it first")


def make_terrain(kind: str, difficulty: float | str, seed: int) -> Terrain:
    """The terrain that evaluation has under this seed; raises ValueError on what there isn't."""
    if seed < 0:
        raise ValueError(f"seed={seed} must be 0 or more")
    return terrains.make_terrain(kind, terrains.parse_difficulty(difficulty), FIRST_SEED + seed)


def read(path: Path) -> tuple[Controller, EnvConfig]:
    """A policy, and what it was trained in; raises PolicyFileError where the file can't be run."""
    controller = Controller(path)
    try:
        return controller, training_env(controller.metadata)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise PolicyFileError(f"{path}: its training's configuration can't be read ({error})") from None


def _stamp(path: Path) -> Any:
    """Changes whenever the file does; None if there is none."""
    try:
        status = path.stat()
    except OSError:
        return None
    return status.st_mtime_ns, status.st_size, status.st_ino
