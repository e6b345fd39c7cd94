"""Meta-World for the simulator: environment, camera, robot mask, scripted expert, disturbances.

The program that embeds this file reads the arrays `image`, `mask`, `facts` and `expert_action` of an `Environment` in
place; they are made once and never replaced.
"""

import copy
import ctypes
import ctypes.util
import os
import threading
import warnings

import numpy as np

SIZE = 64
ACTION_REPEAT = 2
CAMERA = "corner2"
CAMERA_POSITION = (0.75, 0.075, 0.7)
JOINTS = tuple(f"right_j{i}" for i in range(7)) + ("r_close", "l_close")
# Share of the robot's triangles that the fast picture keeps; at a twentieth the arm has visible holes.
MESH_SHARE = 0.2
# The library keeps one mesh for the whole process, and lets other threads run meanwhile.
SIMPLIFYING = threading.Lock()
# Tasks whose expert is told where the fingers meet in place of where the hand is. Meta-World's brings the hand to the goal, and so stops
# with the fingers 4.5 cm off it, where the task counts as solved up to 5 cm.
AIMS_WITH_FINGERS = ("reach",)
# Numbers that keep apart the random streams of one episode.
STREAM_LAYOUT, STREAM_LOOK = 0, 1
# Sets of layouts that never meet, whatever seeds and numbers of episodes are given.
LAYOUTS = ("learning", "choosing", "reporting")


class MissingLibrary(Exception):
    """A shared library that rendering needs cannot be loaded; the argument is its name."""


def load_library(name):
    """Fails with `MissingLibrary` where the dynamic linker does not find `name`."""
    try:
        ctypes.CDLL(ctypes.util.find_library(name) or f"lib{name}.so")
    except OSError as error:
        raise MissingLibrary(name) from error


def choose_renderer():
    """Software rendering off-screen, unless the user asks for EGL (a GPU) by MUJOCO_GL=egl."""
    # At this size a second thread costs more than it draws.
    os.environ.setdefault("LP_NUM_THREADS", "0")
    backend = "egl" if os.environ.get("MUJOCO_GL", "").lower() == "egl" else "osmesa"
    os.environ["MUJOCO_GL"] = os.environ["PYOPENGL_PLATFORM"] = backend
    load_library("EGL" if backend == "egl" else "OSMesa")


# This interpreter does not heed them, but a package (glfw) starts another one as a child.
for variable in ("PYTHONHOME", "PYTHONPATH"):
    os.environ.pop(variable, None)
choose_renderer()
import fast_simplification  # noqa: E402  the renderer must be chosen before MuJoCo is imported
import metaworld  # noqa: E402
import mujoco  # noqa: E402
from metaworld.policies import ENV_POLICY_MAP  # noqa: E402
from metaworld_look import Look  # noqa: E402  embedded beside this file

# The experts ask for more than the action range by design; MuJoCo would write its warnings to a file in this folder.
warnings.filterwarnings("ignore", message="Constant.* may be too high")
mujoco.set_mju_user_warning(lambda text: warnings.warn(str(text), stacklevel=1))

FLAG = mujoco.mjtRndFlag
OBJECT = mujoco.mjtObj


def task_names():
    """Names of all tasks, without the version."""
    return sorted(name.removesuffix("-v3") for name in metaworld.ALL_V3_ENVIRONMENTS)


def random_stream(layouts, seed, episode, stream):
    """Every argument has words of its own: numbers of different lengths would run into each other."""
    words = [word for number in (seed, episode) for word in (number & 0xFFFFFFFF, number >> 32)]
    return np.random.default_rng([1 + LAYOUTS.index(layouts), stream, *words])


class Environment:
    """One task, seen by the moved camera; `step` repeats its action twice."""

    def __init__(self, task, layouts, seed, faithful, masks, disturb):
        make = metaworld.ALL_V3_ENVIRONMENTS_GOAL_OBSERVABLE[f"{task}-v3-goal-observable"]
        self.task, self.layouts, self.seed, self.masks = task, layouts, seed, masks
        # The class takes 32 bits; layouts are drawn from our own streams.
        self.env = make(seed=seed % 2**32)
        self.env._freeze_rand_vec = False
        self.env.seeded_rand_vec = True
        self.model, self.data = self.env.model, self.env.data
        self.model.cam_pos[self.model.camera(CAMERA).id] = CAMERA_POSITION
        self.expert = ENV_POLICY_MAP[f"{task}-v3"]()
        self.observation = None

        joints = [self.model.joint(name) for name in JOINTS]
        self.position_at = np.array([joint.qposadr[0] for joint in joints])
        self.velocity_at = np.array([joint.dofadr[0] for joint in joints])
        low, high = np.array([joint.range for joint in joints]).T
        self.position_middle, self.position_half_range = (low + high) / 2, (high - low) / 2

        # What tasks write into the model while they reset, so that no episode depends on the one before.
        self.pristine = {name: getattr(self.model, name).copy() for name in ("body_pos", "body_quat", "site_pos")}
        self.camera = Camera(self.model, self.data, faithful)
        self.look = Look(self.model, self.camera, disturb) if disturb != "none" else None

        self.image = self.camera.image
        self.mask = np.zeros((SIZE, SIZE), np.uint8)
        # Reward, success (0 or 1), 9 joint positions scaled so that -1 and 1 are the joint's limits, 9 joint velocities
        # (rad/s; m/s for the two fingers).
        self.facts = np.zeros(2 + 2 * len(JOINTS), np.float32)
        self.expert_action = np.zeros(4, np.float32)

    def reset(self, episode):
        """Starts an episode; its layout depends on task, set of layouts, seed and `episode` alone."""
        self.env.np_random = random_stream(self.layouts, self.seed, episode, STREAM_LAYOUT)
        self.look_random = random_stream(self.layouts, self.seed, episode, STREAM_LOOK)
        for name, values in self.pristine.items():
            getattr(self.model, name)[:] = values
        mujoco.mj_resetData(self.model, self.data)
        mujoco.mj_forward(self.model, self.data)
        self.observation, _ = self.env.reset()
        # Tasks move their goal last: without this the first picture shows it in another place.
        mujoco.mj_forward(self.model, self.data)
        if self.look is not None:
            self.look.change(self.look_random)
        self._observe(0.0, False)

    def step(self, *action):
        """Executes one action, four numbers in [-1, 1]; rewards add up, success is that of either of the repeats."""
        action = np.array(action, np.float32)
        reward, success = 0.0, False
        for _ in range(ACTION_REPEAT):
            self.observation, one_reward, _, _, info = self.env.step(action)
            reward += float(one_reward)
            success = success or info["success"] > 0
        self._observe(reward, success)

    def close(self):
        """Frees the graphics context."""
        self.camera.close()

    def ask_expert(self):
        """Puts the scripted expert's action for the present state into `expert_action`."""
        observation = self.observation
        if self.task in AIMS_WITH_FINGERS:
            observation = observation.copy()
            observation[:3] = self.env.tcp_center
        self.expert_action[:] = np.clip(self.expert.get_action(observation), -1, 1)

    def _observe(self, reward, success):
        positions, velocities = self.data.qpos[self.position_at], self.data.qvel[self.velocity_at]
        self.facts[:2] = reward, success
        self.facts[2:11] = (positions - self.position_middle) / self.position_half_range
        self.facts[11:] = velocities
        self.camera.shoot()
        noisy = self.look is not None and self.look.noise
        if self.masks or noisy:
            is_robot, is_background = self.camera.segment()
            np.multiply(is_robot, 255, out=self.mask, dtype=np.uint8, casting="unsafe")
            if noisy:
                noise = self.look_random.integers(0, 256, self.image.shape, np.uint8)
                np.copyto(self.image, noise, where=is_background[..., None])


class Camera:
    """Renders the task's camera, 64 x 64, upright.

    The physics keeps the model untouched. The fast picture draws a copy of it: no shadows, reflections or
    multisampling, and the robot's meshes with a fifth of their triangles.
    """

    # The camera whose graphics context is current in a thread: drawing into another gives black pictures and no error.
    # Making it current for every picture would cost a tenth of it.
    current = threading.local()

    def __init__(self, model, data, faithful):
        self.model, self.data = model, data
        # The drawn model: textures are changed here and sent to the graphics library, never in the simulated one.
        self.drawn = copy.copy(model)
        self.drawn.vis.global_.offwidth = self.drawn.vis.global_.offheight = SIZE
        self.robot_bodies = descendants(model, model.body("base").id)
        if not faithful:
            self.drawn.vis.quality.offsamples = self.drawn.vis.quality.shadowsize = 0
            simplify_meshes(self.drawn, self._robot_meshes())
        self.gl = mujoco.GLContext(SIZE, SIZE)
        self.make_current()
        self.context = mujoco.MjrContext(self.drawn, mujoco.mjtFontScale.mjFONTSCALE_50)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self.context)

        self.scene = mujoco.MjvScene(model, maxgeom=1000)
        if not faithful:
            self.scene.flags[FLAG.mjRND_SHADOW] = self.scene.flags[FLAG.mjRND_REFLECTION] = 0
        self.option, self.perturb = mujoco.MjvOption(), mujoco.MjvPerturb()
        self.view = mujoco.MjvCamera()
        self.view.type, self.view.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, model.camera(CAMERA).id
        self.rectangle = mujoco.MjrRect(0, 0, SIZE, SIZE)
        self.image = np.zeros((SIZE, SIZE, 3), np.uint8)
        self.ids = np.zeros((SIZE, SIZE, 3), np.uint8)

    def _robot_meshes(self):
        is_mesh = self.model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
        is_robot = self.robot_bodies[self.model.geom_bodyid]
        return np.unique(self.model.geom_dataid[is_mesh & is_robot])

    def shoot(self):
        """Fills `image`."""
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        mujoco.mjv_updateScene(
            self.model, self.data, self.option, self.perturb, self.view, everything, self.scene
        )
        self._draw(self.image)

    def segment(self):
        """Which pixels of the last image show the robot, and which the background: sky and floor. Two [64, 64] bool."""
        flags = self.scene.flags
        flags[FLAG.mjRND_SEGMENT] = flags[FLAG.mjRND_IDCOLOR] = 1
        self._draw(self.ids)
        flags[FLAG.mjRND_SEGMENT] = flags[FLAG.mjRND_IDCOLOR] = 0
        # A thing's colour is its segment id plus one; 0 is the sky.
        colour = self.ids[..., 0] + 256 * self.ids[..., 1].astype(np.int32)
        robot, background = np.zeros((2, self.scene.ngeom + 1), bool)
        background[0] = True
        for thing in self.scene.geoms[: self.scene.ngeom]:
            if thing.segid >= 0:
                body = self._body_of(thing)
                robot[thing.segid + 1] = body > 0 and self.robot_bodies[body]
                background[thing.segid + 1] = body == 0
        return robot[colour], background[colour]

    def upload(self, texture):
        """Sends a texture of `drawn` to the graphics library."""
        self.make_current()
        mujoco.mjr_uploadTexture(self.drawn, self.context, texture)

    def place(self):
        """Takes over where the model's camera and lights are now."""
        mujoco.mj_camlight(self.model, self.data)

    def _body_of(self, thing):
        """The body that carries a drawn geom or site, or -1."""
        if thing.objtype == OBJECT.mjOBJ_GEOM:
            return self.model.geom_bodyid[thing.objid]
        if thing.objtype == OBJECT.mjOBJ_SITE:
            return self.model.site_bodyid[thing.objid]
        return -1

    def close(self):
        """Frees the graphics context; without it another camera's may be freed in its place."""
        self.make_current()
        self.context.free()
        self.gl.free()
        Camera.current.camera = None

    def make_current(self):
        if getattr(Camera.current, "camera", None) is not self:
            self.gl.make_current()
            Camera.current.camera = self

    def _draw(self, pixels):
        self.make_current()
        # The rows that the library reads are upright for this camera, which is mounted upside down.
        mujoco.mjr_render(self.rectangle, self.scene, self.context)
        mujoco.mjr_readPixels(pixels, None, self.rectangle, self.context)


def descendants(model, root):
    """Whether each body is `root` or hangs on it. [nbody] bool."""
    inside = np.zeros(model.nbody, bool)
    inside[root] = True
    for body in range(root + 1, model.nbody):  # parents come before their children
        inside[body] = inside[model.body_parentid[body]]
    return inside


def simplify_meshes(model, meshes):
    """Thins out meshes in place. Only for drawing: the convex hulls of collisions are dropped."""
    for mesh in meshes:
        vertices = slice(model.mesh_vertadr[mesh], model.mesh_vertadr[mesh] + model.mesh_vertnum[mesh])
        faces = slice(model.mesh_faceadr[mesh], model.mesh_faceadr[mesh] + model.mesh_facenum[mesh])
        # Points that lie in one place become one, or cracks open between the patches of a surface.
        points, place = np.unique(model.mesh_vert[vertices], axis=0, return_inverse=True)
        corners = place[model.mesh_face[faces]].astype(np.int32)
        with SIMPLIFYING:
            points, corners = fast_simplification.simplify(points, corners, 1 - MESH_SHARE)
        normals = vertex_normals(points, corners)
        write(model.mesh_vert, model.mesh_vertadr, model.mesh_vertnum, mesh, points)
        write(model.mesh_normal, model.mesh_normaladr, model.mesh_normalnum, mesh, normals)
        write(model.mesh_face, model.mesh_faceadr, model.mesh_facenum, mesh, corners)
        first = model.mesh_faceadr[mesh]
        model.mesh_facenormal[first : first + len(corners)] = corners
        model.mesh_graphadr[mesh] = -1


def write(rows, first_row, row_count, index, values):
    """Puts fewer rows than before into the place of part `index` of a shared table."""
    if len(values) > row_count[index]:
        raise ValueError(f"mesh {index}: {len(values)} rows do not fit into {row_count[index]}")
    rows[first_row[index] : first_row[index] + len(values)] = values
    row_count[index] = len(values)


def vertex_normals(points, corners):
    """Mean of the adjacent faces' normals, weighted by area. [n, 3]."""
    a, b, c = (points[corners[:, i]] for i in range(3))
    face_normals = np.cross(b - a, c - a)
    normals = np.zeros_like(points)
    for i in range(3):
        np.add.at(normals, corners[:, i], face_normals)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)

