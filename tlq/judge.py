"""What an evaluated episode comes to: when it ends, and the figures of its walk.

Written against the array API, one episode at a time: NumPy calls it beside MuJoCo, JAX maps it over a batch in MJX.
Letters: L = 4 legs (LF, RF, LR, RR), P = 25 sample points a foot. World frame, SI units.
"""

from typing import Any, NamedTuple

import tg

Array = Any

GOAL = 5.0
"""Distance (m) at which the paper stops counting."""
PATIENCE = 10.0
"""An episode ends after so long (s) without progress."""
PROGRESS = 0.01
"""Progress is a new largest distance, by this much (m)."""
GAP = 0.25
"""A foothold is unsafe if the ground within 3 cm of it lies this far (m) below the highest within 10 cm."""

RUNNING, REACHED, FELL, STUCK = range(4)
ENDS = ("running", "reached", "fell", "stuck")
"""Names of what `Tally.ended` says."""

_NEAR = tg.samples.within(tg.samples.INNER)


class Moment(NamedTuple):
    """What a control step has led to."""

    position: Array
    """(2,) m, trunk."""
    yaw: Array
    """() rad, trunk."""
    phases: Array
    """(L,) rad of the trajectory generator; swing is > 0."""
    feet: Array
    """(L,) m, height of the feet's centres."""
    ground: Array
    """(L, P) m, height of the terrain at the sample points."""
    work: Array
    """() J, sum of |torque x speed| over joints and the step."""
    fell: Array
    """() whether trunk or a knee hit the terrain, or the trunk tilted too far."""


class Tally(NamedTuple):
    """One episode so far."""

    ended: Array
    """() int, RUNNING, REACHED, FELL or STUCK."""
    steps: Array
    """() control steps."""
    progress: Array
    """() m, largest distance along the direction."""
    mark: Array
    """() m, progress when it last counted as such."""
    idle: Array
    """() control steps since then."""
    work: Array
    """() J."""
    yaw: Array
    """() rad, last."""
    turned: Array
    """() rad, heading since the start, without wrapping."""
    swinging: Array
    """(L,) whether the leg was in swing."""
    lift_off: Array
    """(L,) m, height of the foot when it last stood."""
    peak: Array
    """(L,) m, largest height over that in this swing."""
    swings: Array
    """() number of finished swings."""
    lift: Array
    """() m, sum of their peaks."""
    unsafe: Array
    """() number of swings that ended on an unsafe foothold."""


def begin(moment: Moment) -> Tally:
    """The tally of an episode that begins in a moment."""
    zero = 0.0 * moment.yaw
    return Tally(
        ended=zero,
        steps=zero,
        progress=zero,
        mark=zero,
        idle=zero,
        work=zero,
        yaw=moment.yaw,
        turned=zero,
        swinging=moment.phases > 0,
        lift_off=moment.feet,
        peak=0.0 * moment.feet,
        swings=zero,
        lift=zero,
        unsafe=zero,
    )


def update(tally: Tally, moment: Moment, origin: Array, direction: Array, dt: float) -> Tally:
    """The tally after one more control step.

    Args:
      tally: of a running episode.
      moment: after the step.
      origin: (2,) m, where the episode began.
      direction: (2,) unit vector, commanded.
      dt: control period (s).
    """
    xp = moment.feet.__array_namespace__()
    progress = xp.maximum(tally.progress, (moment.position - origin) @ direction)
    counts = progress > tally.mark + PROGRESS
    idle = xp.where(counts, 0.0, tally.idle + 1.0)
    ended = xp.where(idle * dt >= PATIENCE, 1.0 * STUCK, 1.0 * RUNNING)
    ended = xp.where(progress >= GOAL, 1.0 * REACHED, ended)

    swinging = moment.phases > 0
    touch_down = 1.0 * (tally.swinging & ~swinging)
    # A leg that touches down may still be a little higher than it was.
    peak = xp.maximum(tally.peak, moment.feet - tally.lift_off)
    unsafe = xp.max(moment.ground, axis=1) - xp.min(moment.ground[:, _NEAR], axis=1) > GAP
    new = tally._replace(
        ended=ended,
        progress=progress,
        mark=xp.where(counts, progress, tally.mark),
        idle=idle,
        work=tally.work + moment.work,
        yaw=moment.yaw,
        turned=tally.turned + tg.path.wrap(moment.yaw - tally.yaw),
        swinging=swinging,
        lift_off=xp.where(swinging, tally.lift_off, moment.feet),
        peak=xp.where(swinging, peak, 0.0),
        swings=tally.swings + xp.sum(touch_down),
        lift=tally.lift + xp.sum(touch_down * peak),
        unsafe=tally.unsafe + xp.sum(touch_down * unsafe),
    )
    # Nothing of a step that ends in a fall counts: its numbers may not even be finite.
    fallen = tally._replace(ended=0.0 * tally.ended + FELL)
    result = Tally(*(xp.where(moment.fell, a, b) for a, b in zip(fallen, new, strict=True)))
    return result._replace(steps=tally.steps + 1.0)
