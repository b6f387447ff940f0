"""The paper's figures of single walks, in MuJoCo C on the true geometry, as a picture and as numbers.

    python -m tlq.figures figure=stairs picture=stairs.png   # foot paths and lift on stairs of 3, 7.5 and 12 cm
    python -m tlq.figures figure=gaps picture=gaps.png       # joint angles over two courses of gaps

Policies are given by method, as the paper compares them: ours=, fixed_height=, blind=, each a file, a run folder or the
name of a policy that comes with tlq; those left empty aren't drawn.
"""

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

import numpy as np

import envs
import terrains
from tlq import cli, judge
from tlq.cli import find_policy, option
from tlq.config import training_env
from tlq.evaluate import FIRST_SEED
from tlq.files import whole
from tlq.runtime import Controller
from tlq.simulation import Simulation

RISES = (0.03, 0.075, 0.12)
"""Stairs of the paper's figure (m)."""
SHIPPED = {
    "stairs": {"ours": "stairs_lift", "fixed_height": "mixed_fixed_height", "blind": "mixed_blind"},
    "gaps": {"ours": "stones"},
}
"""Policies that come with tlq, by figure and method."""
COURSES = ((0.085, 0.17, 0.255), (0.068, 0.204, 0.136))
"""Gaps of its two courses (m), in the order in which they are met."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What a user may set."""

    figure: str = option("stairs", "which", choices=lambda: ("stairs", "gaps"))
    ours: str = option("", "policy of the paper's method; if none is given at all, those that come with tlq")
    fixed_height: str = option("", "policy of that baseline")
    blind: str = option("", "policy of that baseline")
    picture: str = option("", "PNG file to write", required=True)
    json: str = option("", "file for the numbers")
    seed: int = option(0, "of the terrains (10,000 more than this)")


@dataclasses.dataclass(frozen=True)
class Trace:
    """A walk straight ahead, one row a control step; LF, RF, LR, RR."""

    feet: np.ndarray
    """(T, 4, 3) m, feet's centres, world."""
    lift: np.ndarray
    """(T, 4) m, H + δh."""
    swing: np.ndarray
    """(T, 4) bool."""
    desired: np.ndarray
    """(T, 12) rad, desired joint angles."""
    distance: float
    """m, along x."""
    energy: float
    """J/m."""
    fell: bool
    """Whether the walk ended with a fall."""


def walk(policy: str, terrain: terrains.Terrain, distance: float = judge.GOAL) -> Trace:
    """Walks along +x to a distance (m), a fall, or 60 s."""
    controller = Controller(find_policy(policy))
    sim = Simulation(controller, terrain, training_env(controller.metadata))
    sites = sim.robot.foot_site_ids
    rows: dict[str, list[np.ndarray]] = {"feet": [], "lift": [], "swing": [], "desired": []}
    reached, work, fell = 0.0, 0.0, False
    for _ in range(round(60.0 / controller.control_dt)):
        moment = sim.step(np.array([1.0, 0.0]))
        rows["feet"].append(sim.data.site_xpos[sites].copy())
        rows["lift"].append(np.array(controller.state.lift))
        rows["swing"].append(controller.core.phases(controller.state.phase) > 0)
        rows["desired"].append(np.array(controller.state.desired))
        reached, work = max(reached, float(moment.position[0])), work + float(moment.work)
        fell = bool(moment.fell)
        if fell or reached >= distance:
            break
    return Trace(
        **{name: np.array(values) for name, values in rows.items()},
        distance=reached,
        energy=work / max(reached, 1e-6),
        fell=fell,
    )


def chosen(options: Options) -> dict[str, str]:
    """Policies by method, those that were given."""
    return {m: getattr(options, m) for m in envs.METHODS if getattr(options, m)}


# -- stairs ----------------------------------------------------------------------------------------------------------


def stairs(options: Options) -> tuple[Any, dict[str, Any]]:
    """Figure and numbers: LF's path over the stairs, and the commanded lift of its swings along the way."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(len(RISES), 2, figsize=(13, 8), constrained_layout=True)
    numbers: dict[str, Any] = {}
    for (path_axis, lift_axis), rise in zip(axes, RISES, strict=True):
        sizes = dataclasses.replace(terrains.StairsConfig(), fixed_rise=rise)
        config = dataclasses.replace(terrains.TerrainConfig(), kind="stairs", stairs=sizes)
        terrain = terrains.make_terrain("stairs", "paper", FIRST_SEED + options.seed, config)
        x = np.arange(-0.3, 5.5, 0.01)
        ground = terrains.exact_height(terrain, np.stack([x, 0.15 + 0.0 * x], axis=-1))
        path_axis.fill_between(x, ground, ground.min() - 0.1, color="0.85")
        for colour, (method, policy) in enumerate(chosen(options).items()):
            trace = walk(policy, terrain)
            path_axis.plot(trace.feet[:, 0, 0], trace.feet[:, 0, 2], f"C{colour}", lw=0.8, label=method)
            starts = np.flatnonzero(np.diff(trace.swing[:, 0].astype(int)) == 1) + 1
            lift_axis.plot(trace.feet[starts, 0, 0], trace.lift[starts, 0], f"C{colour}.-", lw=0.8)
            numbers[f"{method}/{rise:g}"] = {
                "lift_median_m": float(np.median(trace.lift[trace.swing])) if trace.swing.any() else None,
                "energy_j_per_m": trace.energy,
                "distance_m": min(trace.distance, judge.GOAL),
                "fell": trace.fell,
            }
        path_axis.set_ylabel(f"{100 * rise:g} cm stairs: z (m)")
        lift_axis.set_ylabel("H + δh (m)")
    axes[0, 0].legend(fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("x of the left front foot (m)")
    return figure, numbers


# -- gaps ------------------------------------------------------------------------------------------------------------


def gaps(options: Options) -> tuple[Any, dict[str, Any]]:
    """Figure and numbers: desired angles of the front legs, and the hip's amplitude while a foot crosses each gap."""
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(
        len(COURSES), 3, figsize=(14, 6), width_ratios=(2, 2, 1), constrained_layout=True
    )
    numbers: dict[str, Any] = {}
    for row, course in zip(axes, COURSES, strict=True):
        sizes = dataclasses.replace(terrains.GapsConfig(), widths=course)
        config = dataclasses.replace(terrains.TerrainConfig(), kind="gaps", gaps=sizes)
        terrain = terrains.make_terrain("gaps", "paper", FIRST_SEED + options.seed, config)
        edges = gap_edges(terrain)
        trace = walk(options.ours, terrain, min(judge.GOAL, edges[-1][1] + 0.8))
        time = 0.02 * np.arange(len(trace.desired))
        *legs, hips = row
        for leg, axis in enumerate(legs):
            for joint, name in enumerate(("abduction", "hip", "knee")):
                axis.plot(time, trace.desired[:, 3 * leg + joint], lw=0.9, label=name)
            for start, end in edges:
                inside = (trace.feet[:, leg, 0] > start - 0.05) & (trace.feet[:, leg, 0] < end + 0.05)
                if inside.any():
                    axis.axvspan(time[inside][0], time[inside][-1], color="0.9")
            axis.set_title(
                f"{('left', 'right')[leg]} front leg, gaps {[round(100 * g, 1) for g in course]} cm"
            )
            axis.set_ylabel("desired angle (rad)")
        amplitudes = [amplitude(trace, start, end) for start, end in edges]
        order = np.argsort(course)
        # None, where no swing crossed a gap, becomes nan, which isn't drawn.
        hips.plot(100 * np.array(course)[order], np.array(amplitudes, float)[order], "C1.-")
        hips.set_ylabel("hip's amplitude (rad)")
        hips.set_ylim(bottom=0.0)
        numbers[str(list(course))] = {
            "distance_m": trace.distance,
            "fell": trace.fell,
            "hip_amplitude_rad": amplitudes,
        }
    axes[0, 0].legend(fontsize=8, ncols=3, loc="center left")
    for axis, label in zip(axes[-1], ("time (s)", "time (s)", "gap's width (cm)"), strict=True):
        axis.set_xlabel(label)
    return figure, numbers


def gap_edges(terrain: terrains.Terrain) -> list[tuple[float, float]]:
    """Start and end (m) of the gaps along +x, by the true geometry, to the millimetre."""
    x = np.arange(0.0, terrain.half_extent - 0.1, 0.001)
    low = terrains.exact_height(terrain, np.stack([x, 0.0 * x], axis=-1)) < terrain.floor + 0.1
    change = np.flatnonzero(np.diff(low.astype(int)))
    return [(float(x[a]), float(x[b])) for a, b in zip(change[::2], change[1::2], strict=False)]


def amplitude(trace: Trace, start: float, end: float) -> float | None:
    """Half the range (rad) of the front hips' desired angles in the swings that cross a gap; None if none did."""
    ranges = []
    for leg in (0, 1):
        x, swing = trace.feet[:, leg, 0], trace.swing[:, leg]
        bounds = np.flatnonzero(np.diff(swing.astype(int), prepend=0, append=0))
        for a, b in zip(bounds[::2], bounds[1::2], strict=False):
            if x[a] <= start + 0.02 and x[b - 1] >= end - 0.02:
                hip = trace.desired[a:b, 3 * leg + 1]
                ranges.append(0.5 * float(hip.max() - hip.min()))
    return float(np.mean(ranges)) if ranges else None


def main(arguments: Sequence[str]) -> None:
    """The command line."""
    options = cli.parse(Options, arguments, __doc__ or "")
    cli.check_folders(options, "picture", "json")
    if not chosen(options):
        options = dataclasses.replace(options, **SHIPPED[options.figure])
    if options.figure == "gaps" and not options.ours:
        raise ValueError("the figure of gaps is of the paper's method: set ours=")
    if options.seed < 0:
        raise ValueError(f"seed={options.seed} must be 0 or more")
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, numbers = {"stairs": stairs, "gaps": gaps}[options.figure](options)
    with whole(options.picture) as temporary:
        figure.savefig(temporary, dpi=90, format="png")
    plt.close(figure)
    text = json.dumps(numbers, indent=1)
    print(text)
    if options.json:
        with whole(options.json) as temporary:
            temporary.write_text(text + "\n")


if __name__ == "__main__":
    cli.run(main)
