"""Runs a policy as on a robot: the policy in a process of its own, the robot in another, UDP messages between them.

    python -m tlq.deploy policy=blocks terrain=blocks seconds=10 json=deploy.json   # both, in real time
    python -m tlq.deploy policy=blocks faults=0.2                                   # over a bad line
    python -m tlq.deploy policy=blocks terrain=blocks perception=depth              # heights by simulated sensors
    python -m tlq.deploy role=policy policy=blocks address=127.0.0.1:7777           # the policy alone, for your robot

The robot is MuJoCo C on the terrain's true geometry, its joints under PD control at 500 Hz. It sends its sensors every
control period; the policy's process, which needs NumPy alone, answers each message at once, and goes on by itself where
none comes (`tlq.supervisor`). The report, in JSON, holds jitter and latency: median, 99 %, worst.
"""

import collections
import dataclasses
import json
import math
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from tlq.cli import check_folders, find_monitor, find_policy, option, parse, run
from tlq.faults import BadLine
from tlq.judge import GOAL
from tlq.messages import LARGEST, MessageError, Sensing, Targets, unpack
from tlq.monitor import Monitor
from tlq.runtime import Controller
from tlq.senses import SensingOptions, check_use, described
from tlq.supervisor import Mode, Supervisor

ROLES = ("both", "policy")
PD_PERIOD = 0.002
"""Of the joints' controllers (s)."""
START_LIMIT, STOP_LIMIT = 60.0, 5.0
"""Time in which the policy's process must have started, and must have ended when told to (s)."""
_KEPT = 100_000  # measurements of each kind
_QUEUE = 64  # messages read at once: a flood of them doesn't stop the control


def _terrains() -> Sequence[str]:
    import terrains  # not at the top: it needs JAX, which the policy's process hasn't

    return terrains.kinds()


@dataclasses.dataclass(frozen=True)
class Options(SensingOptions):
    """What a user may set."""

    policy: str = option(
        "", "policy file, run folder, or name of a policy that comes with tlq", required=True
    )
    terrain: str = option("flat", "kind of terrain", choices=_terrains)
    difficulty: str = option("paper", "number in [0, 1], or paper")
    seconds: float = option(10.0, "length of the run; role=policy: 0 for no end")
    direction: float = option(0.0, "of the walk, in degrees from straight ahead, left positive")
    seed: int = option(
        0, "of the terrain (10,000 more than this), of the faults and of the perception's errors"
    )
    faults: float = option(0.0, "share of the sensor messages that are lost, late, torn or nonsense")
    monitor: str = option("none", "file of a safety monitor, or name of one that comes with tlq")
    json: str = option("", "file to write the report to")
    role: str = option("both", "both: policy and simulated robot; policy: that alone", choices=lambda: ROLES)
    address: str = option("127.0.0.1:0", "role=policy: where it listens, host:port; port 0: any free one")
    watch: bool = option(False, "role=policy: end when standard input is closed")


# -- the policy's process --------------------------------------------------------------------------------------------


class PolicyServer:
    """Answers a robot's sensor messages, at the rate of the control periods."""

    def __init__(
        self, path: str, address: tuple[str, int], watch: bool = False, monitor: Monitor | None = None
    ):
        """Loads a policy and listens; with `watch` it ends when standard input is closed."""
        self.supervisor = Supervisor(Controller(path), monitor=monitor)
        self.dt = self.supervisor.controller.control_dt
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.bind(address)
        self.socket.setblocking(False)
        self.watched = [sys.stdin] if watch else []
        self.robot: Any = None
        """Address of the sender of the newest message that was well formed: it gets the answers."""
        self.modes: collections.Counter[str] = collections.Counter()
        self.malformed = self.ticks = 0
        self.periods, self.ages, self.works = (collections.deque[float](maxlen=_KEPT) for _ in range(3))

    def run(self, seconds: float) -> None:
        """Serves for a time (s), or until told to stop; 0: without end."""
        end = time.monotonic() + (seconds or math.inf)
        last, heard = time.monotonic(), False
        while time.monotonic() < end:
            message, closed = self._wait(last, heard)
            if closed:
                return
            now = time.monotonic()
            if self.ticks and heard and message:
                self.periods.append(now - last)
            last, heard = now, message is not None
            self._tick(message, now)

    def report(self) -> dict[str, Any]:
        """Measurements and counts."""
        return {
            "steps": self.ticks,
            "period_ms": spread(self.periods),
            "age_of_sensors_ms": spread(self.ages),
            "step_ms": spread(self.works),
            "modes": dict(self.modes),
            "faults": dict(self.supervisor.faults) | {"malformed": self.malformed},
            "stops_by_monitor": self.supervisor.stops,
        }

    def _tick(self, message: Sensing | None, now: float) -> None:
        desired = self.supervisor.step(message, now)
        self.ticks += 1
        self.modes[self.supervisor.mode.name.lower()] += 1
        last = self.supervisor.last
        if desired is None or last is None or self.robot is None:
            return
        sent = time.monotonic_ns()
        mode = int(self.supervisor.mode)
        damping, centres = self.supervisor.controller.damping, self.supervisor.centres()
        answer = Targets(self.ticks, sent, last.sequence, last.time, mode, desired, damping, centres)
        try:
            self.socket.sendto(answer.pack(), self.robot)
        except OSError:
            self.supervisor.faults["send"] += 1
        if last is message:
            self.works.append(1e-9 * sent - now)
            self.ages.append(now - 1e-9 * last.time)

    def _wait(self, last: float, heard: bool) -> tuple[Sensing | None, bool]:
        """The next control period's message, None if there is none, and whether to stop.

        The periods follow the robot's messages: one that comes between half a period and one and a half after the last
        step is acted on at once. Two steps are never closer than half a period, however many messages come.
        """
        earliest, latest = last + 0.5 * self.dt, last + (1.5 if heard else 1.0) * self.dt
        if _readable(self.watched, earliest - time.monotonic()):
            return None, True
        while True:
            ready = _readable([self.socket, *self.watched], latest - time.monotonic())
            if set(ready) & set(self.watched):
                return None, True
            message = self._newest() if ready else None
            if message is not None or time.monotonic() >= latest:
                return message, False

    def _newest(self) -> Sensing | None:
        found: Sensing | None = None
        for _ in range(_QUEUE):
            try:
                data, sender = self.socket.recvfrom(LARGEST)
            except OSError:  # nothing more; or the robot's port was closed
                break
            message = _unpacked(data, Sensing)
            if message is None:
                self.malformed += 1
                continue
            self.robot = sender
            if found is None or message.sequence > found.sequence:
                found = message
        return found


def serve(options: Options) -> None:
    """The policy's process: one line of JSON with its address at the start, one with its report at the end."""
    path, address = find_policy(options.policy), _address(options.address)
    server = PolicyServer(str(path), address, options.watch, _monitor(options))
    print(json.dumps({"address": server.socket.getsockname()}), flush=True)
    try:
        server.run(options.seconds)
    except KeyboardInterrupt:
        pass
    print(json.dumps(server.report()), flush=True)


def _monitor(options: Options) -> Monitor | None:
    file = find_monitor(options.monitor)
    return None if file is None else Monitor(file, find_policy(options.policy))


# -- the robot's process ---------------------------------------------------------------------------------------------


class Robot:
    """A simulated robot that knows its policy by messages alone."""

    def __init__(self, simulation: Any, address: Sequence[Any], direction: float, line: BadLine):
        """Puts a `Simulation` at the other end of the line; direction in rad, in the world."""
        self.sim, self.line = simulation, line
        self.direction = np.array([math.cos(direction), math.sin(direction)])
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(tuple(address))
        self.socket.setblocking(False)
        self.desired = np.array(simulation.controller.core.standing_target, float)
        self.damping = simulation.controller.damping
        self.centres = np.full((4, 2), np.nan)
        self.sent = self.received = self.refused = self.newest = 0
        self.distance, self.fell = 0.0, False
        self.periods, self.late, self.trips, self.waits, self.looks = (
            collections.deque[float](maxlen=_KEPT) for _ in range(5)
        )

    def run(self, seconds: float, check: Callable[[], None]) -> None:
        """Lives for a time (s) or until it falls; `check` is called at every control period, and may raise."""
        start, before, heard = time.monotonic(), time.monotonic(), time.monotonic()
        for tick in range(round(seconds / PD_PERIOD)):
            due = start + tick * PD_PERIOD
            time.sleep(max(due - time.monotonic(), 0.0))
            now = time.monotonic()
            if tick:
                self.periods.append(now - before)
            before = now
            self.late.append(now - due)
            if tick % self.sim.substeps == 0:
                check()
                self._sense()
                if self.fell:
                    return
            if self._receive():
                self.waits.append(time.monotonic() - heard)
                heard = time.monotonic()
            self.sim.substep(self.desired, self.damping)

    def report(self) -> dict[str, Any]:
        """Measurements and counts."""
        return {
            "distance_m": round(self.distance, 3),
            "fell": self.fell,
            "seconds": round(float(self.sim.data.time), 3),
            "pd_period_ms": spread(self.periods),
            "pd_late_ms": spread(self.late),
            "round_trip_ms": spread(self.trips),
            "targets_period_ms": spread(self.waits),
            "sensing_ms": spread(self.looks),
            "messages": {
                "sent": self.sent,
                "targets": self.received,
                "targets_refused": self.refused,
                "faults_made": self.line.met,
            },
        }

    def _sense(self) -> None:
        sim, now = self.sim, time.monotonic_ns()
        sim.look(self.centres)
        self.looks.append(1e-9 * (time.monotonic_ns() - now))
        position = sim.data.qpos[:2] @ self.direction
        self.distance, self.fell = max(self.distance, float(position)), sim.fell()
        command = self.direction if self.distance < GOAL else 0.0 * self.direction
        cos, sin = math.cos(sim.yaw), math.sin(sim.yaw)  # from the world into the heading frame
        command = np.array([cos * command[0] + sin * command[1], cos * command[1] - sin * command[0]])
        self.sent += 1
        message = Sensing(self.sent, now, command=command, heights=sim.heights, **sim.sensors)
        for data in self.line.send(message, 1e-9 * now):
            try:
                self.socket.send(data)
            except OSError:  # the policy's process isn't there; `check` says so
                pass

    def _receive(self) -> bool:
        """Takes the newest desired joint angles that came; whether there were any."""
        came = False
        for _ in range(_QUEUE):
            try:
                message = _unpacked(self.socket.recv(LARGEST), Targets)
            except OSError:
                break
            whole = message is not None and np.isfinite([message.desired, message.damping]).all()
            if message is None or message.sequence <= self.newest or not whole:
                self.refused += 1
                continue
            came, self.newest, self.desired = True, message.sequence, message.desired
            self.damping, self.centres = message.damping, message.centres
            self.received += 1
            if message.mode == Mode.WALK:
                self.trips.append(time.monotonic() - 1e-9 * message.answers_time)
        return came


def _simulation(options: Options) -> Any:
    import terrains
    from tlq.config import training_env
    from tlq.evaluate import FIRST_SEED
    from tlq.simulation import Simulation

    controller, sensing = Controller(find_policy(options.policy)), options.sensing()
    check_use(sensing, controller, options.policy)
    config = training_env(controller.metadata)
    level, seed = terrains.parse_difficulty(options.difficulty), FIRST_SEED + options.seed
    terrain = terrains.make_terrain(options.terrain, level, seed)
    return Simulation(controller, terrain, config, timestep=PD_PERIOD, perception=sensing, seed=seed)


# -- both ------------------------------------------------------------------------------------------------------------


def deploy(options: Options) -> dict[str, Any]:
    """Starts the policy's process, is the robot, and ends the other process whatever happens."""
    _monitor(options)  # refuses a bad file before anything is started
    sim = _simulation(options)
    arguments = ["role=policy", f"policy={find_policy(options.policy)}", "watch=true"]
    monitor = find_monitor(options.monitor)
    arguments.append(f"monitor={monitor.absolute() if monitor else 'none'}")
    arguments.append(f"seconds={options.seconds + START_LIMIT}")
    child = subprocess.Popen(
        [sys.executable, "-m", "tlq.deploy", *arguments],
        stdin=subprocess.PIPE,  # closed by the system if this process dies in any way; then the other one ends
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,  # Ctrl-C comes here alone
        cwd=Path(__file__).resolve().parents[1],
    )
    try:
        assert child.stdout is not None
        if not _readable([child.stdout], START_LIMIT):
            raise TimeoutError(f"the policy's process didn't start within {START_LIMIT:.0f} s")
        line = BadLine(options.faults, options.seed)
        robot = Robot(sim, _line(child, child.stdout.readline()), math.radians(options.direction), line)
        robot.run(options.seconds, lambda: _alive(child))
        out, _ = child.communicate(timeout=STOP_LIMIT)
        return {**_asked(options), "robot": robot.report(), "policy_process": json.loads(out)}
    finally:
        _end(child)


def _alive(child: "subprocess.Popen[str]") -> None:
    if child.poll() is not None:
        raise OSError(f"the policy's process ended with exit code {child.returncode}")


def _line(child: "subprocess.Popen[str]", text: str) -> Sequence[Any]:
    if not text:
        child.wait(STOP_LIMIT)
        _alive(child)
    return json.loads(text)["address"]


def _end(child: "subprocess.Popen[str]") -> None:
    for stop in (child.terminate, child.kill):
        if child.poll() is None:
            stop()
            try:
                child.wait(STOP_LIMIT)
            except subprocess.TimeoutExpired:
                continue
    for pipe in (child.stdin, child.stdout):
        if pipe is not None:
            pipe.close()


def _asked(options: Options) -> dict[str, Any]:
    names = ("policy", "terrain", "difficulty", "direction", "seed", "faults", "monitor")
    return {name: getattr(options, name) for name in names} | {"perception": described(options.sensing())}


# -- small things ----------------------------------------------------------------------------------------------------


def spread(seconds: Iterable[float]) -> dict[str, float] | None:
    """Median, 99 % and largest of times (s), in ms; None of none."""
    values = 1e3 * np.array(list(seconds))
    if not values.size:
        return None
    found = {"median": np.median(values), "p99": np.percentile(values, 99), "worst": values.max()}
    return {name: round(float(value), 3) for name, value in found.items()}


def _readable(files: Sequence[Any], seconds: float) -> list[Any]:
    """Which of the files can be read, as soon as one can, or after the time (s)."""
    return select.select(files, [], [], max(seconds, 0.0))[0]


def _unpacked(data: bytes, kind: Any) -> Any:
    """The message of a kind that the bytes hold, or None."""
    try:
        message = unpack(data)
    except MessageError:
        return None
    return message if isinstance(message, kind) else None


def _address(text: str) -> tuple[str, int]:
    host, colon, port = text.rpartition(":")
    if not colon or not port.isdigit() or int(port) > 65535:
        raise ValueError(f"address={text} isn't of the form host:port")
    return host, int(port)


def check(options: Options) -> None:
    """Raises ValueError on options out of range, before anything takes long."""
    shortest = 0 if options.role == "policy" else 0.1
    if not shortest <= options.seconds <= 3600:
        raise ValueError(f"seconds={options.seconds} must be in [{shortest}, 3600]")
    if not 0 <= options.faults <= 1:
        raise ValueError(f"faults={options.faults} must be in [0, 1]")
    if not math.isfinite(options.direction):
        raise ValueError(f"direction={options.direction} must be a finite number of degrees")
    if options.seed < 0:
        raise ValueError(f"seed={options.seed} must be 0 or more")
    if options.sensing() is not None and options.role == "policy":
        raise ValueError(f"perception={options.perception} needs role=both; role=policy has no robot")
    check_folders(options, "json")


def _stop(*_: Any) -> NoReturn:
    raise KeyboardInterrupt


def main(arguments: Sequence[str]) -> None:
    """The command line."""
    options = parse(Options, arguments, __doc__ or "")
    check(options)
    if options.role == "policy":
        serve(options)
        return
    report = json.dumps(deploy(options), indent=1)
    print(report)
    if options.json:
        from tlq.files import whole

        with whole(options.json) as path:
            path.write_text(report + "\n")


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, _stop)  # ends both processes, as Ctrl-C does
    run(main)
