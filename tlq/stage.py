"""The 3D part of the page of `tlq.viewer`: terrain, robot, and marks for what the policy sees and does.

World frame, metres. All of it hangs below one node that moves against the robot, so that a visitor's camera, which
stays where it is, keeps the robot in view and can still be turned by hand. Letters: L = 4 legs, P = 25 sample points.
"""

from typing import Any

import mujoco
import numpy as np

import tg
from envs.robots.look import LOOK_GROUP
from envs.scene import build_scene
from tlq import insight
from tlq.render import COMMAND_COLOUR, LEG_COLOURS
from tlq.simulation import Simulation

HIGH, LOW = np.array([250, 205, 60]), np.array([40, 50, 130])
"""Colours of a sample point as high as the highest of the P x L, and of one `tg.core.HEIGHT_CLIP` or more below it."""
MAP_HIGH, MAP_LOW = np.array([60, 220, 190]), np.array([110, 30, 130])
"""Likewise of a cell of the elevation map, against the highest that is drawn."""
MAP_REACH = 0.7
"""The map is drawn up to this far (m) from the robot: at most 3,850 cells of 2 cm."""
PATH_COLOUR, FOOT_COLOUR = (120, 120, 130), (255, 255, 255)
DIMMED = 0.62
"""Of the ground's colours, which are meant for MuJoCo's light and would be white in viser's."""
FOLLOWING = 0.15
"""Share of the way to the robot that the view makes with each picture."""
OUT_OF_SIGHT = np.array([0.0, 0.0, -100.0])
"""m."""
JUMP = 1.0
"""A robot that is this far (m) away has started anew: the view goes there at once."""
MARKS = ("sample points", "foot paths", "feet", "command", "elevation map")

_BOX, _CYLINDER = int(mujoco.mjtGeom.mjGEOM_BOX), int(mujoco.mjtGeom.mjGEOM_CYLINDER)


class Stage:
    """The scene of a viser server."""

    def __init__(self, server: Any):
        self.scene = server.scene
        self.follow = True
        self._focus = np.zeros(3)
        self.scene.set_up_direction("+z")
        self._world = self.scene.add_frame("/world", show_axes=False)
        self._built: list[Any] = []
        self._bodies: dict[int, Any] = {}
        self._marks = _add_marks(self.scene)
        server.initial_camera.position = (0.9, -1.2, 0.75)
        server.initial_camera.look_at = (0.0, 0.0, 0.25)

    def build(self, sim: Simulation) -> None:
        """Puts up another terrain and another robot."""
        for handle in (*self._built, *self._bodies.values()):
            handle.remove()
        model = build_scene(sim.config.robot, sim.terrain, look=True)
        self._built = _add_terrain(self.scene, model, sim.terrain.floor)
        self._bodies = _add_robot(self.scene, model)
        # The simulation's own model draws less, but has the same bodies and joints.
        assert (sim.model.nbody, sim.model.nq) == (model.nbody, model.nq)
        self._model, self._data = model, mujoco.MjData(model)
        self._focus = sim.data.qpos[:3].copy()

    def show(self, mark: str, visible: bool) -> None:
        """Shows or hides one of `MARKS`."""
        for handle in self._marks[mark]:
            handle.visible = visible

    def draw(self, sim: Simulation, direction: np.ndarray) -> None:
        """The present state; `direction` (2,) is the command."""
        # The simulation's own places of bodies are a timestep old, and those of nothing at the start.
        self._data.qpos[:] = sim.data.qpos
        mujoco.mj_kinematics(self._model, self._data)
        for body, handle in self._bodies.items():
            handle.position, handle.wxyz = self._data.xpos[body], self._data.xquat[body]
        self._move_view(sim.data.qpos[:3])
        self._draw_points(insight.sample_points(sim))
        self._draw_feet(insight.feet(sim), insight.desired_feet(sim))
        self._draw_paths(insight.foot_paths(sim))
        (arrow,) = self._marks["command"]
        start = sim.data.qpos[:3] + np.array([0.0, 0.0, 0.16])
        if not direction.any():  # an arrow out of sight: whether it is shown is the visitor's to say
            start = start + OUT_OF_SIGHT
        arrow.points = _f32([[start, start + 0.3 * np.append(direction, 0.0)]])

    def _move_view(self, trunk: np.ndarray) -> None:
        if not self.follow:
            return
        way = trunk - self._focus
        self._focus = self._focus + (1.0 if np.linalg.norm(way) > JUMP else FOLLOWING) * way
        self._world.position = -self._focus + np.array([0.0, 0.0, 0.3])

    def _draw_points(self, points: np.ndarray) -> None:
        (cloud,) = self._marks["sample points"]
        points = points.reshape(-1, 3)
        # A little above the ground, which would hide half of them.
        cloud.points = _f32(points + np.array([0.0, 0.0, 0.004]))
        cloud.colors = _shaded(points, HIGH, LOW)

    def draw_map(self, sim: Simulation) -> None:
        """What the elevation map holds near the robot; nothing without one. Costs too much for every picture."""
        (cloud,) = self._marks["elevation map"]
        cells = insight.measured_cells(sim, MAP_REACH)
        if len(cells) == 0:
            cells = OUT_OF_SIGHT[None]
        # Below the sample points, and a little above the ground.
        cloud.points = _f32(cells + np.array([0.0, 0.0, 0.002]))
        cloud.colors = _shaded(cells, MAP_HIGH, MAP_LOW)

    def _draw_feet(self, actual: np.ndarray, desired: np.ndarray) -> None:
        there, wanted, between = self._marks["feet"]
        there.batched_positions, wanted.batched_positions = _f32(actual), _f32(desired)
        between.points = _f32(np.stack([actual, desired], axis=1))

    def _draw_paths(self, paths: np.ndarray) -> None:
        (lines,) = self._marks["foot paths"]
        lines.points = _f32(np.stack([paths[:, :-1], paths[:, 1:]], axis=2).reshape(-1, 2, 3))


def _shaded(points: np.ndarray, high: np.ndarray, low: np.ndarray) -> np.ndarray:
    """Colours (N, 3) uint8 of points (N, 3) m, by how far each lies below the highest."""
    depth = np.clip((points[:, 2].max() - points[:, 2:]) / tg.core.HEIGHT_CLIP, 0.0, 1.0)
    return (high + depth * (low - high)).astype(np.uint8)


def _f32(values: Any) -> np.ndarray:
    return np.asarray(values, np.float32)


def _add_marks(scene: Any) -> dict[str, tuple[Any, ...]]:
    """Marks by name, all at the origin."""
    colours = (255 * np.array(LEG_COLOURS)[:, :3]).astype(np.uint8)
    pair = np.zeros((4, 2, 3), np.float32)
    points = scene.add_point_cloud(
        "/world/points",
        np.zeros((100, 3)),
        np.zeros((100, 3), np.uint8),
        point_size=0.011,
        point_shape="circle",
        precision="float32",
        point_shading="flat",
    )
    paths = scene.add_line_segments("/world/paths", np.zeros((4, 2, 3)), PATH_COLOUR, thickness=0.004)
    between = scene.add_line_segments(
        "/world/errors", pair, np.repeat(colours[:, None], 2, axis=1), thickness=0.006
    )
    arrow = scene.add_arrows(
        "/world/command",
        np.zeros((1, 2, 3)),
        tuple(int(255 * c) for c in COMMAND_COLOUR[:3]),
        shaft_radius=0.01,
        head_radius=0.025,
        head_length=0.06,
    )
    there = _balls(scene, "/world/feet", 0.012, np.array(FOOT_COLOUR, np.uint8))
    wanted = _balls(scene, "/world/desired", 0.018, colours)
    cells = scene.add_point_cloud(
        "/world/map",
        OUT_OF_SIGHT[None],
        np.zeros((1, 3), np.uint8),
        point_size=0.014,
        point_shape="square",
        precision="float32",
        point_shading="flat",
    )
    groups = ((points,), (paths,), (there, wanted, between), (arrow,), (cells,))
    return dict(zip(MARKS, groups, strict=True))


def _balls(scene: Any, name: str, radius: float, colours: np.ndarray) -> Any:
    """Four balls, coloured (3,) or (4, 3) uint8."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return scene.add_batched_meshes_simple(
        name,
        ball.vertices,
        ball.faces,
        np.tile([1.0, 0.0, 0.0, 0.0], (4, 1)),
        np.zeros((4, 3)),
        batched_colors=colours,
        lod="off",
        cast_shadow=False,
    )


def _add_terrain(scene: Any, model: mujoco.MjModel, floor: float) -> list[Any]:
    """Boxes and cylinders of the world, each kind as one batch, and a plane at the floor."""
    import trimesh

    drawn = (model.geom_bodyid == 0) & (model.geom_group == LOOK_GROUP)
    unit = {_BOX: trimesh.creation.box((2, 2, 2)), _CYLINDER: trimesh.creation.cylinder(1, 2, sections=20)}
    handles = [_add_floor(scene, floor)]
    for kind, mesh in unit.items():
        rows = np.flatnonzero(drawn & (model.geom_type == kind))
        if len(rows) == 0:
            continue
        sizes = model.geom_size[rows]
        scales = sizes if kind == _BOX else sizes[:, [0, 0, 1]]
        handles.append(
            scene.add_batched_meshes_simple(
                f"/world/terrain_{kind}",
                mesh.vertices,
                mesh.faces,
                model.geom_quat[rows],
                model.geom_pos[rows],
                batched_scales=scales,
                batched_colors=(255 * DIMMED * model.geom_rgba[rows, :3]).astype(np.uint8),
                lod="off",
                flat_shading=True,
                # Shadows of thousands of poles would cost more than all the rest.
                cast_shadow=False,
            )
        )
    return handles


def _add_floor(scene: Any, floor: float) -> Any:
    pit = floor < -0.05
    return scene.add_grid(
        "/world/floor",
        width=40.0,
        height=40.0,
        # Below the tops of boxes that are as high as the floor, which would flicker.
        position=(0.0, 0.0, floor - 0.002),
        cell_color=(64, 70, 82) if pit else (130, 122, 110),
        section_color=(60, 66, 78) if pit else (115, 108, 96),
        plane_color=(52, 58, 70) if pit else (150, 142, 128),
        plane_opacity=1.0,
    )


def _add_robot(scene: Any, model: mujoco.MjModel) -> dict[int, Any]:
    """A node for each body, by its number, with the meshes of what viewers draw of it by default."""
    bodies = {
        body: scene.add_frame(f"/world/robot_{body}", show_axes=False) for body in range(1, model.nbody)
    }
    shown = (model.geom_bodyid > 0) & (model.geom_group <= LOOK_GROUP)
    for geom in np.flatnonzero(shown).tolist():
        vertices, faces = _mesh(model, geom)
        rgba = _rgba(model, geom)
        scene.add_mesh_simple(
            f"/world/robot_{model.geom_bodyid[geom]}/geom_{geom}",
            vertices,
            faces,
            color=tuple(int(255 * c) for c in rgba[:3]),
            opacity=None if rgba[3] == 1.0 else float(rgba[3]),
            flat_shading=model.geom_type[geom] == _BOX,
            position=model.geom_pos[geom],
            wxyz=model.geom_quat[geom],
        )
    return bodies


def _rgba(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """As MuJoCo has it: a geom's own colour, unless it has only a material's."""
    material = model.geom_matid[geom]
    own = model.geom_rgba[geom]
    plain = np.array_equal(own, np.array([0.5, 0.5, 0.5, 1.0], np.float32))
    return model.mat_rgba[material] if material >= 0 and plain else own


def _mesh(model: mujoco.MjModel, geom: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (N, 3) m in the geom's frame, faces (M, 3)."""
    import trimesh

    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
    make = trimesh.creation
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        v, f = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        vertices = model.mesh_vert[v : v + model.mesh_vertnum[mesh]]
        return vertices.copy(), model.mesh_face[f : f + model.mesh_facenum[mesh]].copy()
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        shape = make.box(2 * size)
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        shape = make.cylinder(size[0], 2 * size[1], sections=24)
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        shape = make.capsule(2 * size[1], size[0], count=(16, 16))
    else:  # a sphere or an ellipsoid
        shape = make.icosphere(subdivisions=2)
        radii = size if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else np.full(3, size[0])
        shape.apply_scale(radii)
    return shape.vertices, shape.faces
