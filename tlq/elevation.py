"""An elevation map that travels with the robot, in NumPy alone: from points that range sensors see to heights anywhere.

    ground = ElevationMap(ElevationConfig())
    ground.reset(position, height)            # the robot stands on ground it knows
    ground.move(position)                     # whenever the pose estimate has changed
    ground.fuse(origin, points, variance)     # whenever a scan has come
    heights = ground.read(places)

All in one level frame that the pose estimate lives in (odometry), z up, m; only differences within it matter. The grid
is fixed to that frame and rolls under the robot: cell (i, j) of the frame is kept at (i mod N, j mod N), so moving
copies nothing. N: cells along a side, M: points of a scan.

A cell holds a height, its variance, and whether the height was *measured* or is a *bound*: where rays pass over a cell
and hit nothing in it, the ground lies below them. That is how a gap between poles shows, whose bottom is hardly ever
seen. After Fankhauser et al., Robot-Centric Elevation Mapping with Uncertainty Estimates (CLAWAR 2014), whose map has
no bounds.

A pose estimate slips, and edges with it. So each scan is also laid on the map: moved and turned a little, as far as the
estimate may have slipped, to where its rays end, and go on, as earlier ones did (scan matching on an occupancy grid).

Where an edge is, single points don't tell: a range that is off by 2 cm puts a point beside it. So a cell counts the
rays that meet its surface: those that end there, and those that go on deeper. Where a ray meets a surface doesn't
depend on its range, only whether it ends there does.
"""

import dataclasses

import numpy as np


@dataclasses.dataclass(frozen=True)
class ElevationConfig:
    """Sizes and thresholds of an elevation map."""

    cell: float = 0.02
    """Side of a cell (m)."""
    cells: int = 128
    """N, cells along a side, even: with 2 cm the map reaches 1.28 m to every side."""
    least_deviation: float = 0.004
    """Standard deviation (m) below which no height is trusted, however often it was measured."""
    gate: float = 3.0
    """A measurement agrees with a cell when it is within so many standard deviations of both together..."""
    least_gate: float = 0.02
    """...or within this (m). One that doesn't takes the cell's place if it is higher: with a pose that drifts, what was
    seen last is nearest to the truth..."""
    doubt: float = 0.018
    """...but one that is lower may be the side of a step in the same cell: it adds the square of this (m) to the cell's
    variance..."""
    forget: float = 0.03
    """...and takes its place when the standard deviation would go beyond this (m): the third in a row."""
    bound_deviation: float = 0.02
    """Standard deviation (m) of a bound by one scan."""
    drift: float = 0.01
    """Standard deviation (m) that heights gain while the robot walks a metre; grows with the root of the way."""
    follow: float = 0.5
    """Share of a scan's median deviation in height by which the whole map is moved: z of the pose estimate drifts, and
    what counts is the ground's height against the present estimate."""
    passes: int = 14
    """Cells before a ray's end over which it is taken to pass."""
    rings: tuple[int, ...] = (1, 2, 3, 5, 8)
    """Half widths (cells) of the squares in which a cell that isn't measured looks for cells that tell of the
    ground."""
    beside: int = 4
    """Half width (cells) of the square whose highest cell a hole is compared with."""
    step: float = 0.04
    """A cell is a hole if it lies at least so far below that (m)..."""
    floor: float = 1 / 3
    """...and isn't floor: no more than this share of it and its neighbours, those that are measured, lie at its
    height."""
    stop: float = 1.75
    """A ray ends on a surface if its end lies within so many standard deviations above or below..."""
    least_stop: float = 0.01
    """...or within this (m)."""
    reach: int = 1
    """Where a cell isn't measured its surface, if it has one, is the highest within so many cells."""
    solid: float = 0.6
    """A cell is ground if at least this share of the rays that meet its surface end there. More than a half: a ray that
    meets a gap near its far side ends on the wall, hardly below the edge..."""
    trust: float = 0.5
    """...and it is to begin with: so many rays are taken to have ended there."""
    memory: float = 0.3
    """Rays count for 1 / e after the robot has walked so far (m): the pose estimate drifts, and edges with it."""
    slip: float = 0.02
    """Error that the pose estimate is taken to gain while the robot walks a metre, standard deviation in x and in y
    (m); grows with the root of the way. Scans are laid on the map as far as that allows; 0: only turned."""
    slip_turn: float = 0.01
    """The same of the heading (rad); 0: only moved."""
    weight: float = 0.3
    """A scan's likelihood counts for so much: its rays tell less than if each erred by itself, and the map isn't the
    truth."""
    hole: float = 0.3
    """Depth (m) of a hole whose floor isn't seen. Deeper than what the policy tells apart, 0.25 m."""


def turned(angle: float, places: np.ndarray) -> np.ndarray:
    """Vectors (..., 2) turned to the left (rad)."""
    cos, sin = np.cos(angle), np.sin(angle)
    return places @ np.array([[cos, sin], [-sin, cos]])


class ElevationMap:
    """The map of one robot."""

    def __init__(self, config: ElevationConfig | None = None):
        """An empty map round the origin."""
        self.config = ElevationConfig() if config is None else config
        c = self.config
        if c.cells < 2 or c.cells % 2 or c.cell <= 0:
            raise ValueError(
                f"cells={c.cells}, cell={c.cell}; choose an even number of cells of more than 0 m"
            )
        size = c.cells * c.cells
        self.height = np.zeros(size)
        """(N·N,) m, see `index`; means nothing where the variance is infinite."""
        self.variance = np.full(size, np.inf)
        """(N·N,) m², infinite where nothing is known."""
        self.bound = np.zeros(size, bool)
        """(N·N,) whether the height is only an upper bound."""
        self.stopped = np.zeros(size)
        """(N·N,) number of rays, old ones counted for less, that met the cell's surface and ended there..."""
        self.went_on = np.zeros(size)
        """(N·N,) ...and of those that ended deeper."""
        self.ground = 0.0
        """Height (m) where nothing is known near and far."""
        self.position = np.zeros(2)
        """(2,) m, the robot's last one."""
        self.shift, self.turn = np.zeros(2), 0.0
        """(2,) m and rad: what is told in the pose estimate's frame is turned, then moved, onto the map."""
        self.slipped = np.zeros((3, 3))
        """Covariance of the robot's x, y (m) and heading (rad) on the map."""
        self.centre = np.zeros(2, int)
        """(2,) the cell under the robot; the map holds those from `centre` - N / 2 to `centre` + N / 2 - 1."""

    # -- where

    def onto(self, places: np.ndarray) -> np.ndarray:
        """Places (..., 2 or 3) m of the pose estimate's frame, laid on the map; z stays."""
        level = turned(self.turn, places[..., :2]) + self.shift
        return np.concatenate([level, places[..., 2:]], axis=-1)

    def back(self, places: np.ndarray) -> np.ndarray:
        """`onto` the other way."""
        level = turned(-self.turn, places[..., :2] - self.shift)
        return np.concatenate([level, places[..., 2:]], axis=-1)

    def cells_of(self, places: np.ndarray) -> np.ndarray:
        """Cells (..., 2) of the frame in which places (..., 2 or more) m lie."""
        return np.floor(places[..., :2] * (1.0 / self.config.cell)).astype(int)

    def inside(self, cells: np.ndarray) -> np.ndarray:
        """Whether cells (..., 2) lie on the map: (...)."""
        half = self.config.cells // 2
        away = cells - self.centre
        return np.all((away >= -half) & (away < half), axis=-1)

    def index(self, cells: np.ndarray) -> np.ndarray:
        """Where cells (..., 2) are kept: (...) into `height`."""
        n = self.config.cells
        return cells[..., 0] % n * n + cells[..., 1] % n

    # -- what is done to the map

    def reset(self, position: np.ndarray, ground: float, half_size: tuple[float, float] = (0.0, 0.0)) -> None:
        """Forgets everything but a rectangle of ground on which the robot stands.

        Args:
          position: (2,) m, of the robot.
          ground: height of the ground there (m); also taken where nothing is ever seen.
          half_size: half the rectangle's sides along x and y (m); 0: none.
        """
        self.variance[:] = np.inf
        self.bound[:] = False
        self.stopped[:] = self.went_on[:] = 0.0
        self.ground = ground
        self.shift, self.turn = np.zeros(2), 0.0
        self.slipped[:] = 0.0
        self.position = np.array(position[:2], float)
        self.centre = self.cells_of(self.position)
        if min(half_size) > 0:
            low, high = (self.cells_of(self.position + s * np.array(half_size)) for s in (-1, 1))
            i, j = (np.arange(a, b + 1) for a, b in zip(low, high, strict=True))
            cells = np.stack(np.meshgrid(i, j, indexing="ij"), axis=-1).reshape(-1, 2)
            where = self.index(cells[self.inside(cells)])
            self.height[where], self.variance[where] = ground, self.config.bound_deviation**2

    def move(self, position: np.ndarray) -> None:
        """Rolls the map to a new position (2,) m of the robot; what comes in anew is unknown, heights lose
        certainty.
        """
        position = self.onto(np.asarray(position[:2], float))
        n, centre = self.config.cells, self.cells_of(position)
        way = float(np.hypot(*(position[:2] - self.position)))
        shift = centre - self.centre
        kept = ((self.variance, np.inf), (self.bound, False), (self.stopped, 0.0), (self.went_on, 0.0))
        for axis in range(2):
            count = min(abs(int(shift[axis])), n)
            first = self.centre[axis] + n // 2 if shift[axis] > 0 else centre[axis] - n // 2
            new = np.arange(first, first + count) % n
            for values, unknown in kept:
                np.moveaxis(values.reshape(n, n), axis, 0)[new] = unknown
        self.centre, self.position = centre, np.array(position[:2], float)
        self.variance += way * self.config.drift**2
        slip, turn = self.config.slip**2, self.config.slip_turn**2
        self.slipped += way * np.diag([slip, slip, turn])
        self.stopped *= np.exp(-way / self.config.memory)
        self.went_on *= np.exp(-way / self.config.memory)

    def raise_by(self, change: float) -> None:
        """Moves everything up (m)."""
        self.height += change
        self.ground += change

    def fuse(self, origin: np.ndarray, points: np.ndarray, variance: np.ndarray) -> None:
        """Takes in a scan.

        Args:
          origin: (3,) m, of the sensor; or (M, 3).
          points: (M, 3) m, where rays ended on the ground.
          variance: (M,) m², of the points' heights.
        """
        if not len(points):
            return
        origin, points = self.onto(np.broadcast_to(origin, points.shape)), self.onto(points)
        odds = self._odds()
        where, measured, _ = self._tops(points, variance)
        self._follow(where, measured)
        surface = self._surface()
        tolerance = np.maximum(self.config.stop * np.sqrt(variance), self.config.least_stop)
        ended = self._stop(origin, points, surface, tolerance)
        low, went_on = self._passes(origin, points, surface, tolerance)
        self._align(odds, ended, went_on)
        solid = self.solid()
        where, measured, spread = self._tops(points, variance)
        seen = solid[where] | self._floor(where, measured, surface[where])
        where = where[seen]
        low[where] = np.inf  # what is seen in a cell counts for more than rays that miss it
        self._measure(where, measured[seen], spread[seen])
        passed = np.flatnonzero(low < np.inf)
        upper = self.height[passed] > surface[passed] - self.config.step
        self._pass(passed, low[passed], upper & ~solid[passed], ~upper)

    def solid(self) -> np.ndarray:
        """Whether cells (N·N,) are ground, by the rays that met their surface."""
        stopped = self.stopped + self.config.trust
        return stopped >= self.config.solid * (stopped + self.went_on)

    def read(self, places: np.ndarray) -> np.ndarray:
        """Heights (...) m at places (..., 2) m: of the cell and those beside it that agree, or filled in from around
        it.

        A cell that isn't measured is taken to be as low as the lowest that is known in the smallest square round it in
        which anything is: what is hidden is hidden by something higher. A hole is taken to be deep.
        """
        cells = self._nearest(self.onto(np.asarray(places, float)).reshape(-1, 2))
        found, missing = self._seen(cells)
        for ring in self.config.rings:
            if not len(missing):
                break
            lowest, done = self._lowest(cells[missing], ring)
            found[missing[done]] = self._seen(lowest[done])[0]
            missing = missing[~done]
        found[missing] = self.ground
        return found.reshape(places.shape[:-1])

    def measured(self, reach: float) -> np.ndarray:
        """Centres and heights (C, 3) m of the cells within `reach` (m) of the robot in which something was seen."""
        n = self.config.cells
        line = np.arange(n) - n // 2
        cells = self.centre + np.stack(np.meshgrid(line, line, indexing="ij"), axis=-1).reshape(-1, 2)
        centres = (cells + 0.5) * self.config.cell
        where = self.index(cells)
        known = self._measured()[where] & (np.hypot(*(centres - self.position).T) <= reach)
        return self.back(np.column_stack([centres, self.height[where]])[known])

    # -- parts of it

    def _measured(self) -> np.ndarray:
        """Whether something was seen in cells (N·N,)."""
        return np.isfinite(self.variance) & ~self.bound

    def _nearest(self, places: np.ndarray) -> np.ndarray:
        """The cells (K, 2) that tell of places (K, 2) m: those in which they lie, but where some of the four round a
        place are ground and some aren't, the nearest that is what the place is by the four together.
        """
        c = self.config
        own = self.cells_of(places)
        at = places / c.cell - 0.5
        low = np.floor(at).astype(int)
        corners = low[:, None] + np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
        where = self.index(corners)
        apart = at[:, None] - corners
        weight = np.prod(1.0 - np.abs(apart), axis=-1)
        stopped = self.stopped[where] + c.trust
        share = stopped / (stopped + self.went_on[where])
        ground = share >= c.solid
        mixed = np.isfinite(self.variance[where]).all(axis=1) & ground.any(axis=1) & ~ground.all(axis=1)
        mixed &= self.inside(corners).all(axis=1)
        here = (weight * share).sum(axis=1) >= c.solid
        away = np.where(ground == here[:, None], (apart**2).sum(axis=-1), np.inf)
        best = corners[np.arange(len(places)), away.argmin(axis=1)]
        return np.where(mixed[:, None], best, own)

    def _seen(self, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Heights (C,) m of cells (C, 2), and the numbers of those that were not seen and are no holes.

        From the side only a hole's upper part is seen: its walls, or rays that pass into it. How far down depends on
        where the robot looks from, not on the ground.
        """
        c, own = self.config, self.index(cells)
        where, inside = self._around(cells, c.beside)
        height, variance = self.height[where], self.variance[where]
        measured = inside & np.isfinite(variance) & ~self.bound[where]
        error = np.sqrt(np.where(measured, variance, 0.0))
        here, known = self.height[own], self.inside(cells) & np.isfinite(self.variance[own])
        doubt = np.sqrt(np.where(known, self.variance[own], 0.0))

        steps = np.arange(-c.beside, c.beside + 1)
        near = np.flatnonzero(np.maximum(np.abs(steps)[:, None], np.abs(steps)) <= 1)
        level = np.abs(height[:, near] - here[:, None]) <= np.maximum(
            np.hypot(error[:, near], doubt[:, None]), c.least_gate
        )
        level &= measured[:, near]
        surely = np.where(measured, height - error, -np.inf).max(axis=1)
        surface = known & ~self.bound[own]
        floor = surface & (level.sum(axis=1) > c.floor * measured[:, near].sum(axis=1))
        hole = known & ~floor & (here < surely - c.step)

        weight = np.where(level, 1.0 / np.where(level, variance[:, near], 1.0), 0.0)
        mean = (weight * height[:, near]).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9)
        found = np.where(hole, np.minimum(here, surely - c.hole), np.where(surface, mean, here))
        return found, np.flatnonzero(~surface & ~hole)

    def _lowest(self, cells: np.ndarray, ring: int) -> tuple[np.ndarray, np.ndarray]:
        """The lowest known cell (C, 2) within `ring` cells of cells (C, 2), and whether any is measured there (C,)."""
        where, inside = self._around(cells, ring)
        known = inside & np.isfinite(self.variance[where])
        lowest = np.where(known, self.height[where], np.inf).argmin(axis=1)
        # Bounds alone don't tell of the ground: a ray may pass high over all of them.
        step = np.stack(np.divmod(lowest, 2 * ring + 1), axis=-1) - ring
        return cells + step, (known & ~self.bound[where]).any(axis=1)

    def _around(self, cells: np.ndarray, half: int) -> tuple[np.ndarray, np.ndarray]:
        """The cells of squares round cells (C, 2): where they are kept (C, W), row by row, and whether on the map."""
        n, steps = self.config.cells, np.arange(-half, half + 1)
        line = cells[:, :, None] + steps
        away = line - self.centre[:, None]
        on = (away >= -(n // 2)) & (away < n // 2)
        kept = line % n
        where = kept[:, 0, :, None] * n + kept[:, 1, None, :]
        inside = on[:, 0, :, None] & on[:, 1, None, :]
        square = (len(cells), (2 * half + 1) ** 2)
        return where.reshape(square), inside.reshape(square)

    def _tops(self, points: np.ndarray, variance: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What a scan says of the cells it hit: their place (C,), height (C,) m and variance (C,) m².

        Where it hit both the top and the side of a step, the top counts.
        """
        c, size = self.config, len(self.height)
        cells = self.cells_of(points)
        keep = self.inside(cells)
        where, z, var = self.index(cells[keep]), points[keep, 2], variance[keep]
        top = np.full(size, -np.inf)
        np.maximum.at(top, where, z)
        near = z >= top[where] - np.maximum(c.gate * np.sqrt(var), c.least_gate)
        weight = np.bincount(where[near], 1.0 / var[near], size)
        total = np.bincount(where[near], z[near] / var[near], size)
        hit = np.flatnonzero(weight)
        return hit, total[hit] / weight[hit], np.maximum(1.0 / weight[hit], c.least_deviation**2)

    def _follow(self, where: np.ndarray, measured: np.ndarray) -> None:
        """Moves the map up or down towards what a scan says of cells that are known well."""
        deviation = measured - self.height[where]
        near = np.abs(deviation) < 2.0 * self.config.least_gate
        known = near & ~self.bound[where] & (self.variance[where] < self.config.least_gate**2)
        if known.sum() >= 20:
            self.raise_by(self.config.follow * float(np.median(deviation[known])))

    def _surface(self) -> np.ndarray:
        """Heights (N·N,) m at which cells are ground or not: the highest beside them, or their own if it is hardly
        lower; -inf far from any.
        """
        measured = self._measured()
        error = np.sqrt(np.where(measured, self.variance, 0.0))
        surely = self._highest(np.where(measured, self.height - error, -np.inf), self.config.reach)
        return np.where(measured & (self.height > surely - self.config.step), self.height, surely)

    def _floor(self, where: np.ndarray, measured: np.ndarray, surface: np.ndarray) -> np.ndarray:
        """Whether heights (C,) m measured in cells (C,) are of a floor below their surface (C,) m, rather than of a
        wall: a little further from the edge something lies as low.
        """
        lowest = -self._highest(np.where(self._measured(), -self.height, -np.inf), self.config.reach + 1)[
            where
        ]
        return (measured <= surface - self.config.step) & (
            np.abs(measured - lowest) <= self.config.least_gate
        )

    def _highest(self, heights: np.ndarray, reach: int) -> np.ndarray:
        """Of heights (N·N,) the highest in the square that reaches so many cells to every side of each."""
        n = self.config.cells
        best = heights.reshape(n, n)
        for axis in range(2):
            best = np.max([np.roll(best, k, axis) for k in range(-reach, reach + 1)], axis=0)
        return best.ravel()

    def _stop(
        self, origin: np.ndarray, points: np.ndarray, surface: np.ndarray, tolerance: np.ndarray
    ) -> np.ndarray:
        """Counts in `stopped` the rays that end within a tolerance (M,) m of a surface, in the cells where they meet
        it; returns where, (K, 2) m.
        """
        away = surface[self.index(self.cells_of(points))] - points[:, 2]
        near = self.inside(self.cells_of(points)) & (np.abs(away) <= tolerance)
        back = (origin - points)[near]
        share = away[near] / np.maximum(back[:, 2], tolerance[near])
        places = points[near, :2] + share[:, None] * back[:, :2]
        cells = self.cells_of(places)
        inside = self.inside(cells)
        self.stopped += np.bincount(self.index(cells[inside]), minlength=len(self.stopped))
        return places[inside]

    def _passes(
        self, origin: np.ndarray, points: np.ndarray, surface: np.ndarray, tolerance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Heights (N·N,) m of the lowest ray over each cell, infinite where none passes, near the rays' ends only.

        Counts in `went_on` the rays that meet a cell's surface and end more than a tolerance (M,) m below it; also
        returns where in each such cell they are, (K, 2) m.
        """
        c = self.config
        back = origin - points
        level = np.maximum(np.hypot(back[:, 0], back[:, 1]), 1e-9)
        steps = np.arange(c.passes + 1) * c.cell
        share = steps / level[:, None]
        on = points[:, None] + share[..., None] * back[:, None]
        cells = self.cells_of(on)
        keep, where = (share < 1.0) & self.inside(cells), self.index(cells)
        top, z = surface[where], on[..., 2]
        half = 0.5 * c.cell * (back[:, 2] / level)[:, None]  # by how much rays sink over half a cell
        before = (cells != cells[:, :1]).any(axis=-1)  # the cell of its end may be ground beyond it
        meets = keep & (z - half < top) & (before | (top <= z + half))
        meets &= points[:, 2, None] < top - tolerance[:, None]
        self.went_on += np.bincount(where[meets], minlength=len(self.went_on))
        keep &= before
        low = np.full(len(self.height), np.inf)
        np.minimum.at(low, where[keep], z[keep])
        return low, on[meets, :2]

    def _odds(self) -> np.ndarray:
        """Logarithm of the odds (N, N) that a ray which meets a cell's surface ends there, smoothed over 3 x 3."""
        n, trust = self.config.cells, self.config.trust
        odds = np.log((self.stopped + trust) / (self.went_on + trust)).reshape(n, n)
        for axis in range(2):
            odds = 0.5 * odds + 0.25 * (np.roll(odds, 1, axis) + np.roll(odds, -1, axis))
        return odds

    def _align(self, odds: np.ndarray, ended: np.ndarray, went_on: np.ndarray) -> None:
        """Moves and turns what comes next onto the map, so that rays end, and go on, where earlier ones did.

        A Kalman update: how far the estimate may have slipped is the prior, and the likelihood is that of these rays at
        the odds that the map gives each, to the second order (Fisher's information).

        Args:
          odds: (N, N), before this scan.
          ended: (K, 2) m, on the map, where rays met a surface and ended.
          went_on: (K', 2) m, where they were below one.
        """
        c, n = self.config, self.config.cells
        if not self.slipped.any():
            return
        places = np.concatenate([ended, went_on])
        outcome = np.concatenate([np.ones(len(ended)), np.zeros(len(went_on))])
        at = places / c.cell - 0.5  # in cells, centres at whole numbers
        low = np.floor(at).astype(int)
        x, y = (at - low).T
        (i, j), (i2, j2) = (low % n).T, ((low + 1) % n).T
        h00, h10, h01, h11 = odds[i, j], odds[i2, j], odds[i, j2], odds[i2, j2]
        value = (1 - x) * ((1 - y) * h00 + y * h01) + x * ((1 - y) * h10 + y * h11)
        slope_x = ((1 - y) * (h10 - h00) + y * (h11 - h01)) / c.cell
        slope_y = ((1 - x) * (h01 - h00) + x * (h11 - h10)) / c.cell
        away = places - self.position
        slopes = np.stack([slope_x, slope_y, away[:, 0] * slope_y - away[:, 1] * slope_x])
        chance = 1.0 / (1.0 + np.exp(-value))
        pull = c.weight * slopes @ (outcome - chance)
        information = c.weight * (slopes * (chance * (1.0 - chance))) @ slopes.T
        self.slipped = np.linalg.solve(np.eye(3) + self.slipped @ information, self.slipped)
        change = self.slipped @ pull
        # The robot is moved by the first two, and turned about where it is.
        self.shift = self.position + change[:2] + turned(float(change[2]), self.shift - self.position)
        self.turn += float(change[2])

    def _measure(self, where: np.ndarray, measured: np.ndarray, spread: np.ndarray) -> None:
        """Kalman updates of cells (C,) by heights (C,) m with variances (C,) m²."""
        c = self.config
        height, variance = self.height[where], self.variance[where]
        known = np.isfinite(variance) & ~self.bound[where]
        prior = np.where(known, variance, 1.0)
        agree = known & (
            np.abs(measured - height) <= np.maximum(c.gate * np.sqrt(prior + spread), c.least_gate)
        )
        doubted = prior + c.doubt**2
        keep = known & ~agree & (measured < height) & (doubted < c.forget**2)
        gain = np.where(agree, prior / (prior + spread), 1.0)
        new = np.where(agree, height + gain * (measured - height), measured)
        left = np.maximum(np.where(agree, (1.0 - gain) * prior, spread), c.least_deviation**2)
        self.height[where] = np.where(keep, height, new)
        self.variance[where] = np.where(keep, doubted, left)
        self.bound[where] = False

    def _pass(self, where: np.ndarray, low: np.ndarray, edge: np.ndarray, lower: np.ndarray) -> None:
        """Cells (C,) over which rays passed at heights (C,) m, and in which nothing was seen.

        edge: whether they turned out not to be ground at the height at which they lie; lower: whether they lie lower
        than their surface.
        """
        c = self.config
        height, variance, bound = self.height[where], self.variance[where], self.bound[where]
        new = np.isinf(variance)
        gate = np.maximum(c.gate * np.sqrt(np.where(new, 0.0, variance)), c.least_gate)
        taken = new | np.where(bound, low < height, edge | lower & (height - low > gate))
        self.height[where] = np.where(taken, low, height)
        self.variance[where] = np.where(taken | bound, c.bound_deviation**2, variance)
        self.bound[where] = bound | taken
