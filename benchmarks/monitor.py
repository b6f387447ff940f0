"""What a safety monitor is worth: the same walks without it and with it, at several thresholds, stopping for good and
going on after a while.

    python -m benchmarks.monitor policy=poles terrain=poles monitor=poles episodes=36 json=FILE picture=FILE

MuJoCo C, as `tlq.evaluate`, on its terrains (seeds from 10,000 on). A fall is prevented if the robot, having been
stopped before it, walks on to the end or stands for three seconds without falling. The threshold in the monitor's file
was chosen before, on other episodes, and is among those that are tried.
"""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import envs  # noqa: F401  (before Brax: its import of MJX prints on stdout)
import terrains
from benchmarks import timing
from tlq import cli, evaluate, judge
from tlq.cli import find_monitor, find_policy, option
from tlq.evaluate import Walk
from tlq.files import whole
from tlq.monitor import Decision, Monitor


@dataclasses.dataclass(frozen=True)
class Options:
    """What a user may set."""

    policy: str = option("poles", "policy file, run folder, or name of a policy that comes with tlq")
    terrain: str = option("poles", "kind of terrain", choices=terrains.kinds)
    difficulty: str = option("paper", "number in [0, 1], or paper")
    monitor: str = option("poles", "file of a monitor, or name of one that comes with tlq")
    episodes: int = option(36, "number of episodes")
    seed: int = option(0, "of the terrains (10,000 more than this) and of the noise")
    noise: bool = option(True, "errors of sensors and map as in training")
    stops: str = option("0.2,0.4,0.6,0.8", "thresholds, besides that of the monitor's file")
    resumes: str = option("0,1", "times (s) without danger after which the robot goes on; 0: it doesn't")
    json: str = option("", "file for the figures")
    picture: str = option("", "PNG file for the curve")


def numbers(name: str, text: str, most: float) -> list[float]:
    """Numbers between commas, each in [0, most]."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"{name}={text} must be numbers with commas between them") from None
    if not all(0 <= number <= most for number in found):
        raise ValueError(f"{name}={text} must be numbers in [0, {most:g}]")
    return found


def measure(options: Options, report: Callable[[str], None] = print) -> dict[str, Any]:
    """All walks; what the JSON file holds."""
    path, file = find_policy(options.policy), find_monitor(options.monitor)
    assert file is not None  # see `check`
    asked = evaluate.Options(
        policy=str(path),
        terrain=options.terrain,
        engine="mujoco",
        difficulty=options.difficulty,
        episodes=options.episodes,
        seed=options.seed,
        noise=options.noise,
        monitor=str(file),
    )
    stops, resumes = numbers("stops", options.stops, 1.0), numbers("resumes", options.resumes, 60.0)
    own = Monitor(file, path).decision.stop
    base = [walk(asked, path, k, Decision.at(1.0, 0.0), report) for k in range(options.episodes)]
    rows = []
    for resume in resumes:
        for stop in sorted({*stops, own}, reverse=True):
            # A walk in which no probability went beyond the threshold is the same again.
            watched = [
                walk(asked, path, k, Decision.at(stop, resume), report) if w.highest > stop else w
                for k, w in enumerate(base)
            ]
            rows.append(
                {"stop": stop, "resume": resume, "of_the_file": stop == own, **compare(base, watched)}
            )
            report(str(rows[-1]))
    return {"rows": rows}


def check(options: Options) -> None:
    """Raises ValueError on options out of range, before anything takes long."""
    terrains.parse_difficulty(options.difficulty)
    if options.episodes < 1:
        raise ValueError(f"episodes={options.episodes} must be at least 1")
    if options.seed < 0:
        raise ValueError(f"seed={options.seed} must be 0 or more")
    if find_monitor(options.monitor) is None:
        raise ValueError("monitor=none measures nothing; choose a monitor")
    cli.check_folders(options, "json", "picture")


def walk(
    asked: evaluate.Options, path: Path, k: int, decision: Decision, report: Callable[[str], None]
) -> Walk:
    """Episode k with a decision in place of the file's."""

    def change(monitor: Monitor) -> None:
        monitor.decision = decision

    found = evaluate.mujoco_walk(asked, path, k, change=change)
    said = f"stop {decision.stop:g}, resume {decision.resume:g}, episode {k}: {found.alarms} alarms"
    report(f"{said}, {judge.ENDS[int(found.tally.ended)]} after {float(found.tally.progress):.2f} m")
    return found


def compare(base: Sequence[Walk], watched: Sequence[Walk]) -> dict[str, Any]:
    """What the monitor did to walks, pair by pair."""
    fell = np.array([w.tally.ended == judge.FELL for w in base])
    falls = np.array([w.tally.ended == judge.FELL for w in watched])
    way, kept = (
        float(sum(min(float(w.tally.progress), judge.GOAL) for w in walks)) for walks in (base, watched)
    )
    alarmed = np.array([w.alarms > 0 for w in watched])
    return {
        "episodes": len(base),
        "falls_without": int(fell.sum()),
        "falls_with": int(falls.sum()),
        "prevented": int((fell & ~falls).sum()),
        "caused": int((~fell & falls).sum()),
        "falls_without_alarm": int((falls & ~alarmed).sum()),
        "distance_without_m": way,
        "distance_with_m": kept,
        "distance_lost": 1.0 - kept / way if way > 0 else 0.0,
        "falls_per_10_m_without": 10.0 * int(fell.sum()) / way if way > 0 else None,
        "falls_per_10_m_with": 10.0 * int(falls.sum()) / kept if kept > 0 else None,
        "alarms": sum(w.alarms for w in watched),
        "stood_s": sum(w.stood for w in watched),
        "reached_without": sum(int(w.tally.ended == judge.REACHED) for w in base),
        "reached_with": sum(int(w.tally.ended == judge.REACHED) for w in watched),
    }


def draw(figures: dict[str, Any], path: str) -> None:
    """Share of the falls prevented against share of the distance lost."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axis = plt.subplots(figsize=(6, 4), constrained_layout=True)
    for number, resume in enumerate(dict.fromkeys(row["resume"] for row in figures["rows"])):
        rows = [row for row in figures["rows"] if row["resume"] == resume]
        falls = max(rows[0]["falls_without"], 1)
        x = [row["distance_lost"] for row in rows]
        y = [1.0 - row["falls_with"] / falls for row in rows]
        label = f"goes on after {resume:g} s without danger" if resume else "stops for good"
        axis.plot(x, y, f"C{number}.-", label=label)
        for row, a, b in zip(rows, x, y, strict=True):
            text = f"{row['stop']:g}" + (" (the file's)" if row["of_the_file"] else "")
            axis.annotate(text, (a, b), (4, -9), textcoords="offset points", fontsize=7)
    axis.set_xlabel("share of the distance lost")
    axis.set_ylabel(f"share by which {falls} falls become fewer")
    axis.legend(fontsize=8)
    with whole(path) as temporary:
        figure.savefig(temporary, dpi=90, format="png")
    plt.close(figure)


def main(arguments: Sequence[str]) -> None:
    """The command line."""
    options = cli.parse(Options, arguments, __doc__ or "")
    check(options)
    figures = measure(options, lambda line: print(line, file=sys.stderr, flush=True))
    timing.put_out(figures, dataclasses.asdict(options), options.json)
    if options.picture:
        draw(figures, options.picture)


if __name__ == "__main__":
    cli.run(main)
