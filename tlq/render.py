"""Pictures and videos of recorded motion, drawn off-screen by MuJoCo.

    frames = render(qpos, terrain=terrain, command=command)
    write_video("walk.mp4", frames)

Letters: T recorded steps, L = 4 legs (LF, RF, LR, RR). World frame, metres, radians.
"""

from __future__ import annotations

import functools
import importlib
import math
import os
import platform
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Self

import av
import mujoco
import numpy as np

from envs.robot import RobotConfig
from envs.robots.look import HIDDEN_GROUP, LOOK_GROUP
from envs.scene import HORIZON, SUN, ZENITH, build_scene
from terrains import Terrain, exact_height

BACKENDS = ("egl", "osmesa")
"""Ways to draw without a screen, the better one first."""
LEG_COLOURS = (
    (0.16, 0.50, 0.90, 0.9),
    (0.95, 0.30, 0.25, 0.9),
    (0.20, 0.75, 0.85, 0.9),
    (0.95, 0.60, 0.15, 0.9),
)
"""Foot targets' red, green, blue, alpha by leg."""
COMMAND_COLOUR = (0.20, 0.75, 0.35, 1.0)
LOOK_BELOW = np.array([0.0, 0.0, 0.1])
"""The camera looks at a point this far under the trunk, m."""
VIEW = math.radians(115.0)
"""The camera looks across the direction of travel and a little against it, rad."""
REACH = 3.0
"""Ground is drawn up to this far from the robot's path, m."""
SKY = (math.radians(-9.0), math.radians(14.0))
"""The sky's colour goes from HORIZON to ZENITH between these heights over the true horizon, rad."""
SHIN = 0.16
"""The terrain must not hide what lies this far under the point the camera looks at, m."""


def render(
    qpos: np.ndarray,
    *,
    robot: RobotConfig | None = None,
    terrain: Terrain | None = None,
    control_dt: float = 0.02,
    fps: float = 25.0,
    size: tuple[int, int] = (640, 360),
    command: np.ndarray | None = None,
    feet: np.ndarray | None = None,
    azimuth: float | None = None,
    elevation: float = math.radians(24.0),
    distance: float = 1.5,
) -> Iterator[np.ndarray]:
    """Draws recorded motion, one picture after another, with a camera that travels along.

    Args:
      qpos: (T, 19) trunk position, quaternion (w first), joint angles.
      robot: the robot that moved; none: the default one.
      terrain: where; none: a plane.
      control_dt: time between rows of `qpos`, s.
      fps: pictures per second; nearest rows are drawn.
      size: width and height, pixels.
      command: (2,) or (T, 2) commanded direction in the world, drawn as an arrow over the trunk unless 0.
      feet: (T, L, 3) foot targets, drawn as balls.
      azimuth: direction the camera looks in, rad; none: the robot walks across the picture, a
        little towards us, seen from its right or, where terrain is in the way, from its left.
      elevation: of the camera over the trunk, rad; more where the terrain would be in the way.
      distance: camera to trunk, m.

    Yields:
      (height, width, 3) uint8.
    """
    qpos = np.asarray(qpos, float)
    if qpos.ndim != 2 or qpos.shape[1] != 19 or len(qpos) == 0:
        raise ValueError(f"qpos has shape {qpos.shape}; expected (T, 19) with T > 0")
    model = build_scene(robot or RobotConfig(), terrain, look=True, path=qpos[:, :2], reach=REACH)
    rows = _rows(len(qpos), control_dt, fps)
    focus = _smooth(qpos[:, :3] - LOOK_BELOW, round(0.8 / control_dt))
    sides = [azimuth] if azimuth is not None else [_travel(qpos, command) + side * VIEW for side in (1, -1)]
    views = [
        _elevations(focus, terrain, side, elevation, distance, round(0.2 / control_dt)) for side in sides
    ]
    best = int(np.argmin([view.mean() for view in views]))
    azimuth, tilt = sides[best], views[best]
    with _Painter(model, size) as painter:
        painter.turn_sun(azimuth)
        for row in rows:
            marks = _marks(qpos[row], _at(command, row, 2), None if feet is None else feet[row])
            yield painter.draw(qpos[row], focus[row], azimuth, tilt[row], distance, marks)


def write_video(path: str | Path, frames: Iterable[np.ndarray], fps: float = 25.0) -> Path:
    """Encodes pictures (height, width, 3) uint8 with even sides as H.264; the folder is made if need be."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    stream = None
    with av.open(str(path), mode="w") as container:
        for picture in frames:
            if stream is None:
                stream = container.add_stream(
                    "libx264", rate=round(fps), options={"crf": "23", "preset": "fast"}
                )
                stream.height, stream.width = picture.shape[:2]
                stream.pix_fmt = "yuv420p"
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        if stream is None:
            raise ValueError("no frames to write; render at least one")
        container.mux(stream.encode())
    return path


def strip(frames: Sequence[np.ndarray], count: int, columns: int | None = None) -> np.ndarray:
    """Pictures evenly spaced in time, first and last included, side by side: (rows * H, columns * W, 3)
    uint8.

    `columns` (all in one row by default) breaks the strip into rows; places left over stay white.
    """
    frames = list(frames)
    if not frames:
        raise ValueError("no frames for a strip; render at least one")
    count = min(count, len(frames))
    columns = min(columns or count, count)
    picked = [frames[i] for i in np.linspace(0, len(frames) - 1, count).round().astype(int)]
    picked += [np.full_like(picked[0], 255)] * (-count % columns)
    return np.concatenate(
        [np.concatenate(picked[i : i + columns], axis=1) for i in range(0, len(picked), columns)]
    )


def write_png(path: str | Path, picture: np.ndarray) -> Path:
    """Writes (H, W, 3) uint8 as a PNG; the folder is made if need be."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), mode="w", format="image2", options={"update": "1"}) as container:
        stream = container.add_stream("png", rate=1)
        stream.height, stream.width = picture.shape[:2]
        stream.pix_fmt = "rgb24"
        container.mux(
            stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24"))
        )
        container.mux(stream.encode())
    return path


# Path and camera --------------------------------------------------------------------------------------------


def _rows(steps: int, control_dt: float, fps: float) -> np.ndarray:
    """Rows of the recording to draw, (N,)."""
    times = np.arange(0.0, (steps - 1) * control_dt + 1e-9, 1.0 / fps)
    return np.minimum(np.round(times / control_dt).astype(int), steps - 1)


def _smooth(values: np.ndarray, width: int) -> np.ndarray:
    """Twice a running mean over `width` rows, (T, N) -> (T, N): a camera without jolts."""
    half = max(width // 2, 1)
    kernel = np.ones(2 * half + 1) / (2 * half + 1)
    for _ in range(2):
        padded = np.pad(values, ((half, half), (0, 0)), mode="edge")
        values = np.stack([np.convolve(column, kernel, mode="valid") for column in padded.T], axis=1)
    return values


def _travel(qpos: np.ndarray, command: np.ndarray | None) -> float:
    """Direction of travel, rad: the way made, or what was commanded, or where the robot faces."""
    way = qpos[-1, :2] - qpos[0, :2]
    if np.linalg.norm(way) < 0.3:
        ordered = None if command is None else np.reshape(command, (-1, 2)).mean(axis=0)
        w, x, y, z = qpos[0, 3:7]
        facing = np.array([1 - 2 * (y * y + z * z), 2 * (x * y + w * z)])
        way = facing if ordered is None or np.linalg.norm(ordered) < 1e-6 else ordered
    return float(np.arctan2(way[1], way[0]))


def _elevations(
    focus: np.ndarray, terrain: Terrain | None, azimuth: float, lowest: float, distance: float, every: int
) -> np.ndarray:
    """Camera elevations (T,), rad: the lowest from which the terrain leaves the view of the robot free."""
    if terrain is None:
        return np.full(len(focus), lowest)
    tried = np.arange(lowest, np.radians(75.0), np.radians(4.0))
    reach = np.linspace(0.2, 1.0, 16) * distance
    rows = np.arange(0, len(focus), max(every, 1))
    # Points of all lines of sight: (N, E, S).
    flat = np.cos(tried)[:, None] * reach
    spots = focus[rows, None, None, :2] - flat[..., None] * np.array([np.cos(azimuth), np.sin(azimuth)])
    ground = exact_height(terrain, spots.reshape(-1, 2)).reshape(spots.shape[:-1])
    line = focus[rows, None, None, 2] - SHIN + np.sin(tried)[:, None] * reach
    clear = np.all(line > ground, axis=-1)
    first = np.where(clear.any(axis=1), clear.argmax(axis=1), len(tried) - 1)
    return _smooth(np.interp(np.arange(len(focus)), rows, tried[first])[:, None], 5 * every)[:, 0]


# Marks ------------------------------------------------------------------------------------------------------

Mark = tuple[str, np.ndarray, np.ndarray, Sequence[float]]
"""Kind ("ball" or "arrow"), from (3,), to (3,) m, colour."""


def _at(values: np.ndarray | None, row: int, width: int) -> np.ndarray | None:
    if values is None:
        return None
    values = np.asarray(values, float)
    return values if values.shape == (width,) else values[row]


def _marks(qpos: np.ndarray, command: np.ndarray | None, feet: np.ndarray | None) -> list[Mark]:
    marks: list[Mark] = []
    if command is not None and np.linalg.norm(command) > 1e-6:
        start = qpos[:3] + np.array([0.0, 0.0, 0.16])
        way = np.append(command / np.linalg.norm(command), 0.0)
        marks.append(("arrow", start, start + 0.3 * way, COMMAND_COLOUR))
    for foot, colour in zip(() if feet is None else feet, LEG_COLOURS, strict=feet is not None):
        marks.append(("ball", foot, foot, colour))
    return marks


# Drawing ----------------------------------------------------------------------------------------------------


class _Painter:
    """A model's pictures of one size; frees the graphics memory on leaving."""

    def __init__(self, model: mujoco.MjModel, size: tuple[int, int]):
        self.model, self.data = model, mujoco.MjData(model)
        self.context = gl_context()(*size)
        self.context.make_current()
        self.scene = mujoco.MjvScene(model, maxgeom=model.ngeom + 100)
        self.scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = True
        self.option, self.camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self.option.geomgroup[:] = [1, 0, 1, 0, 0, 0]
        self.mjr = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.mjr)
        self.mjr.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZERONEAR
        self.rect = mujoco.MjrRect(0, 0, *size)
        self.aspect = size[0] / size[1]
        planes = model.geom_type == mujoco.mjtGeom.mjGEOM_PLANE
        self.ground = np.flatnonzero((model.geom_bodyid == 0) & ~planes & (model.geom_group == LOOK_GROUP))
        self.depth = np.empty((size[1], size[0]), np.float32)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_) -> None:
        self.mjr.free()
        self.context.free()

    def turn_sun(self, azimuth: float) -> None:
        """Light from over the camera's left shoulder, whichever way it looks."""
        cos, sin = np.cos(azimuth - np.pi / 2), np.sin(azimuth - np.pi / 2)
        sun = np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]]) @ SUN
        light = self.model.light("sun").id
        self.model.light_dir[light] = sun / np.linalg.norm(sun)
        self.model.light_pos[light] = -4.0 * sun

    def draw(
        self, qpos, focus, azimuth: float, elevation: float, distance: float, marks: list[Mark]
    ) -> np.ndarray:
        """One picture (height, width, 3) uint8."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        camera = self.camera
        camera.lookat[:], camera.distance = focus, distance
        camera.azimuth, camera.elevation = np.degrees(azimuth), -np.degrees(elevation)
        self._hide_unseen(np.asarray(focus), azimuth, elevation, distance)
        mujoco.mjv_updateScene(
            self.model, self.data, self.option, None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, self.scene
        )
        for mark in marks:
            _add_mark(self.scene, *mark)
        mujoco.mjr_render(self.rect, self.scene, self.mjr)
        picture = np.empty((self.rect.height, self.rect.width, 3), np.uint8)
        mujoco.mjr_readPixels(picture, self.depth, self.rect, self.mjr)
        self._paint_sky(picture, elevation)
        return picture[::-1].copy()

    def _paint_sky(self, picture: np.ndarray, elevation: float) -> None:
        """MuJoCo's fog hides its sky: painted here over all that lies beyond the fog."""
        vis, height = self.model.vis, len(self.depth)
        tangent = np.tan(np.radians(vis.global_.fovy) / 2)
        angle = np.arctan(np.linspace(-tangent, tangent, height)) - elevation
        blue = np.clip((angle - SKY[0]) / (SKY[1] - SKY[0]), 0.0, 1.0)[:, None]
        sky = (255 * ((1 - blue) * np.array(HORIZON) + blue * np.array(ZENITH))).astype(np.uint8)
        # The depth buffer holds 1 at zfar, 0 at znear; lengths are metres as the model's extent is 1.
        near, far, fog = vis.map.znear, vis.map.zfar, vis.map.fogend
        beyond = self.depth >= far * (fog - near) / (fog * (far - near))
        picture[beyond] = np.broadcast_to(sky[:, None], picture.shape)[beyond]

    def _hide_unseen(self, focus: np.ndarray, azimuth: float, elevation: float, distance: float) -> None:
        """Ground outside the picture would cost as much as inside it."""
        cos, sin = np.cos(elevation), np.sin(elevation)
        forward = np.array([cos * np.cos(azimuth), cos * np.sin(azimuth), -sin])
        right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
        place = self.model.geom_pos[self.ground] - focus + distance * forward
        size = self.model.geom_rbound[self.ground]
        depth, across = place @ forward, np.abs(place @ right)
        wide = np.tan(np.radians(self.model.vis.global_.fovy) / 2) * self.aspect
        seen = (depth > -size) & (across < wide * np.maximum(depth, 0) + 1.4 * size + 0.2)
        self.model.geom_group[self.ground] = np.where(seen, LOOK_GROUP, HIDDEN_GROUP)


def _add_mark(
    scene: mujoco.MjvScene, kind: str, start: np.ndarray, end: np.ndarray, colour: Sequence[float]
) -> None:
    geom = scene.geoms[scene.ngeom]
    shape = mujoco.mjtGeom.mjGEOM_SPHERE if kind == "ball" else mujoco.mjtGeom.mjGEOM_ARROW
    size, rgba = np.full(3, 0.022), np.asarray(colour, np.float32)
    mujoco.mjv_initGeom(geom, shape, size, np.asarray(start, float), np.eye(3).reshape(-1), rgba)
    if kind == "arrow":
        mujoco.mjv_connector(geom, shape, 0.012, np.asarray(start, float), np.asarray(end, float))
    geom.emission, geom.specular, geom.shininess = 0.2, 0.0, 0.0
    scene.ngeom += 1


class RenderError(OSError):
    """This machine can't render; the text says what to install."""


@functools.cache
def gl_context() -> Callable:
    """The class of off-screen OpenGL contexts that works here: MUJOCO_GL's, else the first of `BACKENDS`."""
    chosen = os.environ.get("MUJOCO_GL", "").lower()
    if chosen in BACKENDS:
        return _load(chosen)
    if chosen not in ("", "glfw", "on", "enable", "enabled", "true", "1"):
        raise ValueError(
            f"unknown MUJOCO_GL='{chosen}' for rendering; choose one of {', '.join(BACKENDS)}, glfw"
        )
    if chosen or platform.system() != "Linux":
        return mujoco.GLContext
    for backend in BACKENDS:
        if _works(backend):
            return _load(backend)
    raise RenderError(
        "no OpenGL to render with: install EGL (Debian: apt-get install libegl1 libgl1-mesa-dri) "
        "or OSMesa (apt-get install libosmesa6), or choose MUJOCO_GL=egl, osmesa or glfw"
    )


def _works(backend: str) -> bool:
    """Tried in a process of its own: one that has loaded an OpenGL library is stuck with it."""
    code = f"from mujoco.{backend} import GLContext; c = GLContext(8, 8); c.make_current(); c.free()"
    environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"} | {"MUJOCO_GL": backend}
    run = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=False)
    return run.returncode == 0


def _load(backend: str) -> Callable:
    try:
        return importlib.import_module(f"mujoco.{backend}").GLContext
    except (ImportError, AttributeError, OSError) as error:
        package = {"egl": "libegl1 libgl1-mesa-dri", "osmesa": "libosmesa6"}[backend]
        raise RenderError(
            f"MUJOCO_GL={backend} doesn't work here (Debian: apt-get install {package})"
        ) from error
