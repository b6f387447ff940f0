"""Shows a policy walking in MuJoCo C, on the terrain's true geometry.

    python -m tlq.play policy=poles terrain=poles                 # a page in the browser; needs pip install 'tlq[play]'
    python -m tlq.play policy=poles terrain=poles viewer=native   # MuJoCo's viewer; needs a display
    python -m tlq.play policy=poles terrain=poles video=walk.mp4  # a video; needs EGL or OSMesa
    python -m tlq.play policy=poles terrain=poles picture=walk.png  # a strip of moments
    python -m tlq.play policy=poles terrain=poles perception=depth  # heights from simulated sensors

The same kind, difficulty and seed give the same terrain as in `tlq.evaluate`.
"""

import dataclasses
import math
import os
import sys
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

import terrains
from tlq import render, viewer
from tlq.cli import check_folders, find_policy, option, parse, run
from tlq.config import training_env
from tlq.evaluate import FIRST_SEED
from tlq.judge import GOAL
from tlq.runtime import Controller, load_policy
from tlq.senses import SensingOptions, check_use
from tlq.session import Session
from tlq.simulation import Simulation

VIEWERS = ("browser", "native")


@dataclasses.dataclass(frozen=True)
class Options(SensingOptions):
    """What a user may set."""

    policy: str = option(
        "", "policy file, run folder, or name of a policy that comes with tlq", required=True
    )
    terrain: str = option("poles", "kind of terrain", choices=terrains.kinds)
    difficulty: str = option("paper", "number in [0, 1], or paper")
    direction: float = option(0.0, "of the walk, in degrees from straight ahead, left positive")
    seed: int = option(0, "of the terrain (10,000 more than this) and of the perception's errors")
    seconds: float = option(12.0, "longest walk")
    video: str = option("", "MP4 file to write")
    picture: str = option("", "PNG file to write: a strip of moments")
    moments: int = option(6, "pictures in the strip")
    viewer: str = option("browser", "a page, or MuJoCo's window", choices=lambda: VIEWERS)
    port: int = option(8080, "of the page")


@dataclasses.dataclass(frozen=True)
class Walk:
    """A recorded walk, one row a control step."""

    qpos: np.ndarray
    """(T, 19), see `mujoco.MjData.qpos`."""
    command: np.ndarray
    """(2,) unit vector in the world."""
    distance: float
    """Largest progress along the command (m)."""
    fell: bool
    """Whether the walk ended with a fall."""


def simulation(options: Options) -> Simulation:
    """The robot on its terrain, ready to walk."""
    controller = Controller(find_policy(options.policy))
    config = training_env(controller.metadata)
    level, seed = terrains.parse_difficulty(options.difficulty), FIRST_SEED + options.seed
    terrain = terrains.make_terrain(options.terrain, level, seed)
    return Simulation(controller, terrain, config, perception=options.sensing(), seed=seed)


def walk(sim: Simulation, direction: float, seconds: float) -> Walk:
    """Walks towards a direction (rad, world) until 5 m, a fall or `seconds` have passed."""
    command = np.array([math.cos(direction), math.sin(direction)])
    start = sim.data.qpos[:2].copy()
    rows, distance, fell = [sim.data.qpos.copy()], 0.0, False
    for _ in range(round(seconds / sim.controller.control_dt)):
        moment = sim.step(command)
        rows.append(sim.data.qpos.copy())
        distance = max(distance, float((moment.position - start) @ command))
        fell = bool(moment.fell)
        if fell or distance >= GOAL:
            break
    return Walk(np.array(rows), command, distance, fell)


def watch(sim: Simulation, direction: float) -> None:
    """Shows the robot in MuJoCo's viewer, in real time, until the window is closed; it starts anew after a fall."""
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise ValueError("there is no display; write a file instead: video=FILE.mp4 or picture=FILE.png")
    import mujoco.viewer

    command = np.array([math.cos(direction), math.sin(direction)])
    with mujoco.viewer.launch_passive(sim.model, sim.data) as window:
        while window.is_running():
            began = time.monotonic()
            if sim.step(command).fell or np.abs(sim.data.qpos[:2]).max() > GOAL:
                sim.reset()
            window.sync()
            time.sleep(max(sim.controller.control_dt - (time.monotonic() - began), 0.0))


def browse(options: Options) -> None:
    """Serves a page on which the robot can be led about, until it is interrupted."""
    where = (options.terrain, options.difficulty, options.seed)
    session = Session(options.policy, *where, perception=options.sensing())
    session.walk(math.radians(options.direction))
    viewer.serve(session, options.port)


def shown(options: Options) -> bool:
    """Whether the walk is shown rather than written to files."""
    return not options.video and not options.picture


def main(arguments: Sequence[str]) -> None:
    """The command line."""
    options = parse(Options, arguments, __doc__ or "")
    check(options)
    direction = math.radians(options.direction)
    if shown(options) and options.viewer == "browser":
        browse(options)
        return
    sim = simulation(options)
    if shown(options):
        watch(sim, direction)
        return
    record = walk(sim, direction, options.seconds)
    seconds = sim.controller.control_dt * (len(record.qpos) - 1)
    print(f"walked {record.distance:.2f} m in {seconds:.1f} s, {'fell' if record.fell else 'did not fall'}")
    settings: dict[str, Any] = {
        "robot": sim.config.robot,
        "terrain": sim.terrain,
        "control_dt": sim.controller.control_dt,
        "command": record.command,
    }
    if options.video:
        render.write_video(options.video, render.render(record.qpos, **settings))
        print(f"wrote {options.video}")
    if options.picture:
        # Only the moments of the strip are drawn.
        rate = 1.0 / (
            sim.controller.control_dt * max((len(record.qpos) - 1) // max(options.moments - 1, 1), 1)
        )
        frames = list(render.render(record.qpos, fps=rate, **settings))
        render.write_png(options.picture, render.strip(frames, options.moments, columns=3))
        print(f"wrote {options.picture}")


def check(options: Options) -> None:
    """Raises ValueError on options out of range, before anything takes long."""
    terrains.parse_difficulty(options.difficulty)
    if options.seed < 0:
        raise ValueError(f"seed={options.seed} must be 0 or more")
    if not 0 < options.seconds <= 3600:
        raise ValueError(f"seconds={options.seconds} must be in (0, 3600]")
    if options.moments < 1:
        raise ValueError(f"moments={options.moments} must be at least 1")
    for name, ending in (("video", ".mp4"), ("picture", ".png")):
        value = getattr(options, name)
        if value and not value.endswith(ending):
            raise ValueError(f"{name}={value} must end in {ending}")
    check_folders(options, "video", "picture")
    check_use(options.sensing(), load_policy(find_policy(options.policy)), options.policy)
    if shown(options) and options.viewer == "browser":
        viewer.load_viser()
        viewer.check_port(options.port)


if __name__ == "__main__":
    run(main)
