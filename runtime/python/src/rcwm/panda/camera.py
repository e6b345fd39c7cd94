"""Small pictures of a MuJoCo model, many a second on a processor without graphics hardware.

The physics keeps its model untouched. What is drawn is a copy of it: no shadows, reflections or multisampling, and
meshes with a tenth of their triangles.
"""

from __future__ import annotations

import copy
import os
import sys

from .. import RcwmError

if "mujoco" in sys.modules and "MUJOCO_GL" not in os.environ:
    raise RcwmError(
        "MuJoCo was imported before it was told how to draw: import rcwm.panda first, or set MUJOCO_GL=osmesa"
    )
# At this size a second thread costs more than it draws.
os.environ.setdefault("LP_NUM_THREADS", "0")
os.environ.setdefault("MUJOCO_GL", "osmesa")
os.environ.setdefault("PYOPENGL_PLATFORM", os.environ["MUJOCO_GL"])

import fast_simplification
import mujoco
import numpy as np

# Share of triangles that is kept, and the fewest that a mesh is thinned out to.
MESH_SHARE, TRIANGLES_MIN = 0.1, 300
# Geoms for collisions are in group 0, those to look at in group 1.
COLLISION_GROUP = 0


class Renderer:
    """Draws the fixed cameras of a model, upright, all of one size.

    `model` and `data` are MuJoCo's; `robot` [nbody] says which bodies are the robot. `plain` draws as MuJoCo does
    by default, for comparison. Several may be in use in one thread.
    """

    # Whose graphics context is current: drawing in another gives black pictures and no error, and making it current for
    # every picture takes a tenth of its time.
    current: Renderer | None = None

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, side: int, robot: np.ndarray, plain: bool = False):
        self.model, self.data, self.side, self.robot = model, data, side, robot
        drawn = copy.copy(model)
        drawn.vis.global_.offwidth = drawn.vis.global_.offheight = side
        if not plain:
            drawn.vis.quality.offsamples = drawn.vis.quality.shadowsize = 0
            is_mesh = (model.geom_type == mujoco.mjtGeom.mjGEOM_MESH) & (model.geom_group != COLLISION_GROUP)
            simplify_meshes(drawn, np.unique(model.geom_dataid[is_mesh]))
        self.gl = mujoco.GLContext(side, side)
        self._make_current()
        self.context = mujoco.MjrContext(drawn, mujoco.mjtFontScale.mjFONTSCALE_50)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)
        self.scene = mujoco.MjvScene(model, maxgeom=1000)
        if not plain:
            for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
                self.scene.flags[flag] = 0
        self.option = mujoco.MjvOption()
        self.option.geomgroup[COLLISION_GROUP] = 0
        self.option.sitegroup[:] = 0
        self.view = mujoco.MjvCamera()
        self.view.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self.perturb = mujoco.MjvPerturb()
        self.rectangle = mujoco.MjrRect(0, 0, side, side)
        self.pixels = np.zeros((side, side, 3), np.uint8)

    def draw(self, camera: str) -> np.ndarray:
        """[side, side, 3] u8, RGB."""
        self.view.fixedcamid = self.model.camera(camera).id
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(self.model, self.data, self.option, self.perturb, self.view, everything, self.scene)
        return self._render().copy()

    def segment(self) -> np.ndarray:
        """[side, side] u8: 1 where the picture drawn last shows the robot, else 0."""
        flags = (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR)
        for flag in flags:
            self.scene.flags[flag] = 1
        ids = self._render()
        for flag in flags:
            self.scene.flags[flag] = 0
        # A thing's colour is its segment number plus one; 0 is the background.
        colour = ids[..., 0] + 256 * ids[..., 1].astype(np.int32)
        robot = np.zeros(self.scene.ngeom + 1, np.uint8)
        for thing in self.scene.geoms[: self.scene.ngeom]:
            if thing.segid >= 0 and thing.objtype == mujoco.mjtObj.mjOBJ_GEOM:
                robot[thing.segid + 1] = self.robot[self.model.geom_bodyid[thing.objid]]
        mask: np.ndarray = robot[np.minimum(colour, self.scene.ngeom)]
        return mask

    def close(self) -> None:
        """Frees the graphics context."""
        self._make_current()
        self.context.free()
        self.gl.free()
        Renderer.current = None

    def _make_current(self) -> None:
        if Renderer.current is not self:
            self.gl.make_current()
            Renderer.current = self

    def _render(self) -> np.ndarray:
        self._make_current()
        mujoco.mjr_render(self.rectangle, self.scene, self.context)
        mujoco.mjr_readPixels(self.pixels, None, self.rectangle, self.context)
        return np.flipud(self.pixels)  # the library's first row is the lowest


def descendants(model: mujoco.MjModel, roots: list[str]) -> np.ndarray:
    """[nbody] bool: whether each body is one of `roots` or hangs on one."""
    inside = np.zeros(model.nbody, bool)
    inside[[model.body(root).id for root in roots]] = True
    for body in range(1, model.nbody):  # parents come before their children
        inside[body] |= inside[model.body_parentid[body]]
    return inside


def simplify_meshes(model: mujoco.MjModel, meshes: np.ndarray) -> None:
    """Thins out meshes in place. For a model that is only drawn: hulls for collisions are dropped."""
    for mesh in meshes:
        if model.mesh_facenum[mesh] <= TRIANGLES_MIN or _is_textured(model, mesh):
            continue
        points, corners = _triangles(model, mesh)
        share = max(MESH_SHARE, TRIANGLES_MIN / len(corners))
        points, corners = fast_simplification.simplify(points, corners, 1 - share)
        _replace(model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum, mesh, points)
        _replace(model.mesh_normal, model.mesh_normaladr, model.mesh_normalnum, mesh, _normals(points, corners))
        _replace(model.mesh_face, model.mesh_faceadr, model.mesh_facenum, mesh, corners)
        first = model.mesh_faceadr[mesh]
        model.mesh_facenormal[first : first + len(corners)] = corners
        model.mesh_graphadr[mesh] = model.mesh_texcoordadr[mesh] = -1
        model.mesh_texcoordnum[mesh] = 0


def _is_textured(model: mujoco.MjModel, mesh: int) -> bool:
    materials = model.geom_matid[(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH) & (model.geom_dataid == mesh)]
    return bool((model.mat_texid[materials[materials >= 0]] >= 0).any())


def _triangles(model: mujoco.MjModel, mesh: int) -> tuple[np.ndarray, np.ndarray]:
    vertex, face = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
    vertices = model.mesh_vert[vertex : vertex + model.mesh_vertnum[mesh]]
    faces = model.mesh_face[face : face + model.mesh_facenum[mesh]]
    # Points that lie in one place become one, or cracks open between the patches of a surface.
    points, place = np.unique(vertices, axis=0, return_inverse=True)
    return points, place.reshape(-1)[faces].astype(np.int32)


def _replace(rows: np.ndarray, first_row: np.ndarray, row_count: np.ndarray, mesh: int, values: np.ndarray) -> None:
    """Puts fewer rows than before in the place of one mesh in a shared table."""
    if len(values) > row_count[mesh]:
        raise ValueError(f"mesh {mesh}: {len(values)} rows do not fit into {row_count[mesh]}")
    rows[first_row[mesh] : first_row[mesh] + len(values)] = values
    row_count[mesh] = len(values)


def _normals(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """[points, 3]: the mean of the adjacent faces' normals, weighted by area."""
    a, b, c = (points[corners[:, i]] for i in range(3))
    faces = np.cross(b - a, c - a)
    normals = np.zeros_like(points)
    for i in range(3):
        np.add.at(normals, corners[:, i], faces)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))
