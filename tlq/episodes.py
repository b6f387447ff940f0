"""Walks of a policy in MuJoCo C, written down step by step for `tlq.monitor_fit`.

The robot walks as in `tlq.evaluate`, with training's errors of sensors and map, on terrains of training's seeds (below
10,000). In half of the episodes it is told once, at a random time, to stand for a while, so that what is written down
holds standing, too. Letters: T control steps, F features of `tlq.monitor`.
"""

import dataclasses
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import terrains
from tlq import judge
from tlq.config import training_env
from tlq.evaluate import FIRST_SEED, direction, start_phase
from tlq.files import whole
from tlq.monitor import features, fingerprint
from tlq.runtime import Controller
from tlq.simulation import Simulation

STOP_SHARE = 0.5
"""Share of the episodes in which the robot is told to stand once."""
STOP_FROM, STOP_FOR = (1.0, 8.0), (1.0, 2.0)
"""When, and for how long (s): drawn evenly."""


@dataclasses.dataclass(frozen=True)
class Setting:
    """What decides an episode, besides its number."""

    policy: str
    """File."""
    terrain: str
    """Kind."""
    difficulty: float
    """Middle of the range in [0, 1]."""
    spread: float
    """The difficulty of an episode is drawn evenly within ± this."""
    seed: int
    """Of the terrains and of the noise, below `FIRST_SEED`."""


@dataclasses.dataclass(frozen=True, eq=False)
class Episode:
    """One walk."""

    features: np.ndarray
    """(T, F) float16, see `tlq.monitor.features`."""
    standing: np.ndarray
    """(T,) bool, whether the robot was told to stand."""
    progress: np.ndarray
    """(T,) float32, m, after the step."""
    fell: bool
    """Whether the last step ended in a fall."""


def level(setting: Setting, k: int) -> float:
    """Difficulty of episode k."""
    drawn = np.random.default_rng([setting.seed, k]).uniform(-1.0, 1.0)
    return float(np.clip(setting.difficulty + setting.spread * drawn, 0.0, 1.0))


def stop(setting: Setting, k: int) -> tuple[float, float]:
    """From when until when (s) the robot of episode k is told to stand; infinite where it isn't."""
    random = np.random.default_rng([setting.seed, k, 1])
    if random.uniform() >= STOP_SHARE:
        return np.inf, np.inf
    start = random.uniform(*STOP_FROM)
    return start, start + random.uniform(*STOP_FOR)


def walk(setting: Setting, k: int) -> Episode:
    """Episode k."""
    controller = Controller(setting.policy)
    config = training_env(controller.metadata)
    terrain = terrains.make_terrain(setting.terrain, level(setting, k), setting.seed, index=k)
    # Another seed of the noise for every episode of every setting.
    seed = int(np.random.default_rng([setting.seed, k, 2]).integers(1 << 31))
    sim = Simulation(controller, terrain, config, noise=config.randomisation, seed=seed)
    sim.reset(start_phase(k))
    moment = sim.moment()
    tally, origin, dt = judge.begin(moment), moment.position, controller.control_dt
    start, end = stop(setting, k)
    rows: list[tuple[Any, ...]] = []
    while tally.ended == judge.RUNNING:
        standing = start <= len(rows) * dt < end
        moment = sim.step((0.0 if standing else 1.0) * direction(k))
        tally = judge.update(tally, moment, origin, direction(k), dt)
        shown = features(controller.observation, controller.memory, controller.action)
        rows.append((shown, standing, tally.progress))
    shown, stood, progress = zip(*rows, strict=True)
    return Episode(
        np.array(shown, np.float16),
        np.array(stood, bool),
        np.array(progress, np.float32),
        bool(tally.ended == judge.FELL),
    )


def record(
    setting: Setting,
    count: int,
    file: str | os.PathLike[str] = "",
    report: Callable[[str], None] = print,
    *,
    every: int = 10,
) -> list[Episode]:
    """Walks episodes 0..count - 1.

    Args:
      setting: what they are.
      count: how many.
      file: npz in which they are kept, written after `every` ones; those it holds already aren't walked again.
      report: takes lines of text on the progress.
      every: see `file`.
    """
    if not 0 <= setting.seed < FIRST_SEED:
        raise ValueError(
            f"seed={setting.seed} must be in [0, {FIRST_SEED - 1}]: those above are for evaluation"
        )
    episodes = load(file, setting) if file and Path(file).is_file() else []
    for k in range(len(episodes), count):
        episodes.append(walk(setting, k))
        last = episodes[-1]
        end = "fell" if last.fell else "ended"
        report(f"episode {k}: {end} after {last.progress[-1]:.2f} m, difficulty {level(setting, k):.2f}")
        if file and (k % every == every - 1 or k == count - 1):
            save(file, setting, episodes)
    return episodes[:count]


def save(file: str | os.PathLike[str], setting: Setting, episodes: Sequence[Episode]) -> None:
    """Writes a recording, whole or not at all."""
    joined = {
        name: np.concatenate([getattr(e, name) for e in episodes])
        for name in ("features", "standing", "progress")
    }
    lengths, fell = [len(e.standing) for e in episodes], [e.fell for e in episodes]
    with whole(file) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, key=_key(setting), lengths=lengths, fell=fell, **joined)


def load(file: str | os.PathLike[str], setting: Setting) -> list[Episode]:
    """Reads a recording; raises ValueError where it is none, or one of another setting."""
    try:
        with np.load(file, allow_pickle=False) as stored:
            arrays = {name: stored[name] for name in stored.files}
        ends = np.cumsum(arrays["lengths"])
        parts = zip(
            *(np.split(arrays[n], ends[:-1]) for n in ("features", "standing", "progress")), strict=True
        )
        key, fell = arrays["key"], arrays["fell"]
    except Exception as error:
        raise ValueError(f"recording={file} is damaged, or no recording ({error})") from None
    if not np.array_equal(key, _key(setting)):
        raise ValueError(
            f"recording={file} is of another policy, terrain, difficulty or seed; choose another file"
        )
    return [Episode(a, b, c, bool(f)) for (a, b, c), f in zip(parts, fell, strict=True)]


def _key(setting: Setting) -> np.ndarray:
    numbers = f"{setting.difficulty!r} {setting.spread!r} {setting.seed}"
    return np.array(f"{fingerprint(setting.policy)} {setting.terrain} {numbers}")
