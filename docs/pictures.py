"""Draws the documents' pictures of how it works, from the code itself.

python -m docs.pictures                   # all of them, into docs/images/
python -m docs.pictures folder=pictures   # elsewhere
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import mujoco
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.patches import Circle, Rectangle

import envs
import terrains
import tg
from envs.env import make_core
from envs.robot import Robot, make_robot
from tlq import cli
from tlq.cli import option

ROOT = Path(__file__).resolve().parents[1]
SHOWN = 2.0
"""Terrains are drawn up to this far from the start (m)."""
COLOURS = ("C0", "C3", "C9", "C1")
"""Of LF, RF, LR, RR."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What a user may set."""

    folder: str = option(str(ROOT / "docs" / "images"), "where to write the pictures")


def robot() -> tuple[Robot, tg.Core]:
    """The default robot and its controller core, in NumPy."""
    config = envs.EnvConfig()
    found = make_robot(config.robot)
    core = make_core(config, found)
    names = ("base_foot", "default_pose", "lower", "upper")
    arrays: dict[str, Any] = {name: np.asarray(getattr(core, name)) for name in names}
    geometry = tg.LegGeometry(*(np.asarray(part) for part in core.geometry))
    return found, dataclasses.replace(core, geometry=geometry, **arrays)


# -- The trajectory generator ----------------------------------------------------------------------------------------


def foot_path() -> Any:
    """A foot's path under its hip, and its speed over the ground in a cycle, with retraction 0 and 1."""
    config = tg.TGConfig()
    figure, (side, speed) = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
    phase = np.linspace(-math.pi, math.pi, 2001)
    dots = np.linspace(-math.pi, math.pi, 32, endpoint=False)
    trunk = 2.0 * config.base_frequency * config.step_length
    for retraction, colour in ((0.0, "C1"), (1.0, "C0")):
        along = config.step_length * tg.path.stride(phase, retraction)
        side.plot(100 * along, 100 * config.lift * tg.path.height(phase), colour, lw=1)
        x = config.step_length * tg.path.stride(dots, retraction)
        side.plot(100 * x, 100 * config.lift * tg.path.height(dots), f"{colour}.", label=f"{retraction:g}")
        rate = np.gradient(along, phase / (2.0 * math.pi * config.base_frequency))
        speed.plot(phase / math.pi, trunk + rate, colour, label=f"{retraction:g}")
    side.set(xlabel="along the step, forward positive (cm)", ylabel="height (cm)", aspect="equal")
    side.set_title(f"path in the heading frame, a dot every 1/{len(dots)} of a cycle", fontsize=9)
    speed.axvline(0.0, color="0.7", lw=0.8)
    speed.axhline(0.0, color="0.7", lw=0.8)
    speed.set(xlabel="phase / π: stance, then swing", ylabel="speed over the ground (m/s)")
    speed.set_title(f"with the trunk at 2fL = {trunk:.2f} m/s", fontsize=9)
    speed.legend(title="retraction")
    return figure


# -- What the policy sees --------------------------------------------------------------------------------------------


def samples() -> Any:
    """The 100 sample points from above: round feet in stance, and round the ends of the steps of feet in swing."""
    found, core = robot()
    sensors = tg.Sensors(
        orientation=np.array([1.0, 0.0, 0.0, 0.0], np.float32),
        angular_velocity=np.zeros(3, np.float32),
        joint_position=core.default_pose,
        joint_velocity=np.zeros(12, np.float32),
    )
    forward = np.array([1.0, 0.0], np.float32)
    speed = 2.0 * core.config.base_frequency * core.config.step_length
    state = core.initial_state(np.asarray(0.25 * math.pi, np.float32))
    state = state._replace(gate=np.float32(1.0), stride=forward, velocity=np.array([speed, 0.0], np.float32))
    points, feet = core.sample_points(state, sensors), core.feet(sensors)
    swing = tg.path.leg_phases(state.phase) > 0

    figure, axis = plt.subplots(figsize=(7.5, 4.2), layout="constrained")
    hx, hy, _ = found.trunk_half_size
    axis.add_patch(Rectangle((-hx, -hy), 2 * hx, 2 * hy, color="0.9"))
    for leg, name in enumerate(("LF", "RF", "LR", "RR")):
        axis.plot(*points[leg].T, ".", color=COLOURS[leg], ms=4)
        axis.plot(*feet[leg, :2], "o", color=COLOURS[leg], mfc="none" if swing[leg] else COLOURS[leg])
        label = f"{name}, {'swing' if swing[leg] else 'stance'}"
        axis.text(feet[leg, 0] - 0.02, 1.85 * feet[leg, 1], label, fontsize=8, ha="right", va="center")
        if swing[leg]:
            axis.annotate("", points[leg, 0], feet[leg, :2], arrowprops={"arrowstyle": "->"})
    axis.annotate("", (hx + 0.12, 0.0), (hx, 0.0), arrowprops={"arrowstyle": "->", "color": "C2"})
    axis.text(hx + 0.13, 0.0, "command", color="C2", va="center", fontsize=8)
    axis.set(
        xlabel="x, heading frame (m)", ylabel="y (m)", aspect="equal", xlim=(-0.45, 0.55), ylim=(-0.33, 0.33)
    )
    return figure


# -- Frames ----------------------------------------------------------------------------------------------------------


def frames() -> Any:
    """World, heading and trunk frame of a robot that is turned and tilted, seen obliquely."""
    found, _ = robot()
    turned = np.zeros(4)
    mujoco.mju_euler2Quat(turned, np.radians([20.0, -20.0, 15.0]), "XYZ")  # roll, pitch, yaw
    trunk = tg.frames.rotation(turned)
    heading = trunk @ tg.frames.heading_from_trunk(tg.frames.up_in_trunk(turned)).T
    centre = np.array([0.5, 0.35, 0.15])
    azimuth, elevation = np.radians([-55.0, 25.0])  # of the camera, far away
    right = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    up = np.cross(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ],
        right,
    )
    view = np.stack([right, up], axis=1)

    figure, axis = plt.subplots(figsize=(6.5, 3.6), layout="constrained")
    corners = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    box = (centre + (corners * found.trunk_half_size) @ trunk.T) @ view
    edges = [(a, b) for a in range(8) for b in range(a) if (corners[a] != corners[b]).sum() == 1]
    for a, b in edges:
        axis.plot(*box[[a, b]].T, color="0.75", lw=1)
    for name, origin, axes, colour in (
        ("world", np.zeros(3), np.eye(3), "0.2"),
        ("heading", centre, heading, "C2"),
        ("trunk", centre, trunk, "C3"),
    ):
        for direction, letter in zip(axes.T, "xyz", strict=True):
            start, tip, text = (view.T @ (origin + r * direction) for r in (0.0, 0.25, 0.3))
            axis.annotate("", tip, start, arrowprops={"arrowstyle": "->", "color": colour, "shrinkA": 0})
            axis.text(
                text[0], text[1], f"{letter} {name}", color=colour, fontsize=8, ha="center", va="center"
            )
    axis.set(aspect="equal", xlim=(-0.1, 1.0), ylim=(-0.15, 0.5))
    axis.set_axis_off()
    return figure


# -- Terrains --------------------------------------------------------------------------------------------------------


def kinds() -> Any:
    """Every kind of terrain at the paper's level: from above, and in section along x."""
    names = [kind for kind in terrains.kinds() if kind != "mixed"]
    figure, axes = plt.subplots(
        2,
        len(names),
        figsize=(2.2 * len(names), 3.4),
        layout="constrained",
        height_ratios=(3, 1),
        sharex="col",
    )
    for kind, (above, section) in zip(names, axes.T, strict=True):
        terrain = terrains.make_terrain(kind, "paper", seed=0)
        draw(terrain, above, section)
        above.set_title(kind, fontsize=9)
        section.set_xlabel("x (m)")
    for axis in axes[:, 1:].flat:
        axis.set_yticklabels([])
    axes[0, 0].set_ylabel("y (m)")
    axes[1, 0].set_ylabel("z (m)")
    return figure


def draw(terrain: terrains.Terrain, above: Any, section: Any) -> None:
    """One terrain: heights from above, dark is low, and the profile on the dashed line under the left feet."""
    x = np.arange(-SHOWN, SHOWN, 0.01) + 0.005
    xy = np.stack(np.meshgrid(x, x, indexing="ij"), axis=-1)
    heights = np.clip(terrains.exact_height(terrain, xy), -0.5, 0.8)
    above.imshow(heights.T, origin="lower", extent=(-SHOWN, SHOWN) * 2, cmap="Greys_r", vmin=-0.5, vmax=0.8)
    hx, hy, _ = terrain.platform
    above.add_patch(Rectangle((-hx, -hy), 2 * hx, 2 * hy, ec="C2", fc="none"))
    above.add_patch(Circle((0, 0), 0.03, color="C2"))
    line = 0.15
    above.axhline(line, color="C0", lw=0.6, ls="--")
    section.fill_between(x, heights[:, np.searchsorted(x, line)], -0.55, color="0.75", step="mid")
    section.set_ylim(-0.55, 0.85)


PICTURES: dict[str, Callable[[], Any]] = {
    "foot_path": foot_path,
    "samples": samples,
    "frames": frames,
    "terrains": kinds,
}
"""What draws each picture, by its file's name without .png."""


def main(arguments: Sequence[str]) -> None:
    """The command line."""
    options = cli.parse(Options, arguments, __doc__ or "")
    folder = Path(options.folder)
    folder.mkdir(parents=True, exist_ok=True)
    matplotlib.use("Agg")
    for name, make in PICTURES.items():
        figure = make()
        # Without the version of Matplotlib in it, a picture that shows the same is the same file.
        figure.savefig(folder / f"{name}.png", dpi=90, metadata={"Software": None})
        plt.close(figure)
        print(folder / f"{name}.png")


if __name__ == "__main__":
    cli.run(main)
