"""Figures of a run: metrics.csv, TensorBoard events, curve.png and a line of text now and then."""

import csv
import math
import time
from pathlib import Path

from tensorboardX import SummaryWriter

from tlq.files import whole

# name in the text line, name of the figure, format
LINE = (
    ("reward", "reward", ".3f"),
    ("distance", "episode/distance", ".2f m"),
    ("falls", "episode/fell", ".0%"),
    ("level", "level", ".2f"),
    ("kl", "kl", ".4f"),
    ("std", "std", ".2f"),
    ("lr", "learning_rate", ".1e"),
)
CURVES = ("reward", "episode/distance", "episode/fell", "level", "kl", "std")


class Logger:
    """Writes the figures of each iteration. On resume, rows from after the checkpoint are dropped."""

    def __init__(self, folder: Path, total_steps: int, iteration: int = 0, every: float = 10.0):
        self.folder, self.total_steps, self.every = folder, total_steps, every
        self._path = folder / "metrics.csv"
        self._columns: list[str] = []
        if iteration:
            self._drop_after(iteration)
        self._events = SummaryWriter(str(folder), purge_step=iteration or None, flush_secs=30)
        self._spoken = -math.inf
        self._rate, self._written = 0.0, 0  # steps per second, smoothed; rows of this process

    def write(self, figures: dict[str, float]) -> None:
        """figures: 'iteration', 'env_steps', 'steps_per_second' and whatever else was measured."""
        new = not self._columns
        if new:
            self._columns = list(figures)
        with self._path.open("a", newline="") as file:
            writer = csv.DictWriter(file, self._columns, restval="nan", extrasaction="ignore")
            if new:
                writer.writeheader()
            writer.writerow(figures)
        for name, value in figures.items():
            if math.isfinite(value):
                self._events.add_scalar(name, value, int(figures["env_steps"]))
        # The first iteration compiles: its rate says nothing about the next ones.
        rate = figures["steps_per_second"]
        self._rate = rate if self._written < 2 else 0.9 * self._rate + 0.1 * rate
        self._written += 1
        if time.monotonic() - self._spoken >= self.every:
            self._spoken = time.monotonic()
            print(text_line(figures | {"steps_per_second": self._rate}, self.total_steps), flush=True)

    def _drop_after(self, iteration: int) -> None:
        if not self._path.exists():
            return
        with self._path.open(newline="") as file:
            reader = csv.DictReader(file)
            # A row that a killed process left unfinished has no value in its last columns.
            rows = [row for row in reader if all(row.values()) and float(row["iteration"]) <= iteration]
            self._columns = list(reader.fieldnames or [])
        with whole(self._path) as temporary, temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, self._columns)
            writer.writeheader()
            writer.writerows(rows)

    def draw(self) -> None:
        """Refreshes curve.png from metrics.csv."""
        import matplotlib

        matplotlib.use("Agg")
        from matplotlib import pyplot as plt

        rows = read_csv(self._path)
        if not rows:
            return
        figure, axes = plt.subplots(2, 3, figsize=(12, 6), sharex=True, constrained_layout=True)
        for axis, name in zip(axes.flat, CURVES, strict=True):
            axis.plot(
                [row["env_steps"] / 1e6 for row in rows], [row.get(name, math.nan) for row in rows], lw=1
            )
            axis.set_title(name, fontsize=10)
            axis.grid(alpha=0.3)
        for axis in axes[-1]:
            axis.set_xlabel("million steps")
        with whole(self.folder / "curve.png") as temporary:
            figure.savefig(temporary, dpi=80)
        plt.close(figure)

    def close(self) -> None:
        """Ends the events file."""
        self._events.close()


def text_line(figures: dict[str, float], total_steps: int) -> str:
    """One line for people, e.g. '1.23M/10M steps  13.9k/s  0:10:31 left  reward 0.31  distance 2.10 m ...'."""
    steps, rate = figures["env_steps"], figures["steps_per_second"]
    left = int(max(total_steps - steps, 0) / max(rate, 1e-9))
    clock = f"{left // 3600}:{left % 3600 // 60:02d}:{left % 60:02d}"
    parts = [f"{steps / 1e6:.2f}M/{total_steps / 1e6:g}M steps", f"{rate / 1e3:.1f}k/s", f"{clock} left"]
    for label, name, form in LINE:
        value = figures.get(name, math.nan)
        if math.isfinite(value):
            number, _, unit = form.partition(" ")
            parts.append(f"{label} {value:{number}}{' ' + unit if unit else ''}")
    if figures.get("episode/exploded", 0) > 0:
        parts.append(f"EXPLODED {figures['episode/exploded']:.2%}")
    return "  ".join(parts)


def read_csv(path: Path) -> list[dict[str, float]]:
    """Rows of a metrics.csv, oldest first."""
    with path.open(newline="") as file:
        return [{k: float(v) for k, v in row.items() if v} for row in csv.DictReader(file)]
