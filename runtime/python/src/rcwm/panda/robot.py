"""robosuite's Panda that lifts a cube, with the calls of a Gymnasium environment."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.resources import files
from typing import Any

from .. import RcwmError, interface

try:
    from .camera import Renderer, descendants  # first: it chooses how MuJoCo draws
except ImportError as error:
    raise RcwmError(
        f"robosuite cannot be used ({error}); install rcwm[robosuite] and the system's libosmesa6"
    ) from None
import mujoco
import numpy as np

SIDES = (64, 128)
# Our names of robosuite's cameras.
CAMERAS = {"front": "agentview", "wrist": "robot0_eye_in_hand"}
# Where the front camera stands (m), what it looks at (m), and its angle from top to bottom (degrees). Nearer than
# robosuite's, or the cube would be 3 pixels wide.
FRONT_AT, FRONT_LOOKS_AT, FRONT_ANGLE = (0.46, -0.18, 1.13), (-0.04, 0.0, 0.9), 42.0
# Sets of layouts that never meet, whatever seeds and numbers are given.
LAYOUTS = ("learning", "choosing", "reporting")
# Numbers that keep apart the random streams of one episode.
STREAM_LAYOUT, STREAM_PUSHES = 0, 1
HORIZON = 100


def panda_lift(side: int = 64, cameras: Sequence[str] = tuple(CAMERAS), masks: bool = False) -> interface.Interface:
    """The robot's interface with pictures of `side` x `side`. Raises `RcwmError` for what it does not have."""
    if side not in SIDES:
        raise RcwmError(f"pictures of {side} x {side}: expected a side of {' or '.join(map(str, SIDES))}")
    robot = interface.parse(files(__package__).joinpath("panda-lift.toml").read_text("utf-8"))
    known = {camera.name: camera for camera in robot.cameras}
    unknown = [name for name in cameras if name not in known]
    if unknown or not cameras or len(set(cameras)) != len(cameras):
        raise RcwmError(f"cameras {', '.join(cameras) or 'none'}: expected each once, some of {', '.join(known)}")
    mask = "robot" if masks else None
    return interface.with_cameras(robot, [replace(known[c], shape=(side, side, 3), mask=mask) for c in cameras])


def random_stream(layouts: str, seed: int, layout: int, stream: int) -> np.random.Generator:
    """Every argument has words of its own: numbers of different lengths would run into each other."""
    words = [word for number in (seed, layout) for word in (number & 0xFFFFFFFF, number >> 32)]
    return np.random.default_rng([1 + LAYOUTS.index(layouts), stream, *words])


class PandaLift:
    """The robot. Observations are dictionaries by the interface's names.

    | name | type | shape | |
    | --- | --- | --- | --- |
    | `front`, `wrist` | u8 | [side, side, 3] | upright, RGB |
    | `front_mask`, `wrist_mask` | u8 | [side, side] | 1 where the robot is; with `masks` alone |
    | `joint_pos`, `joint_vel` | f32 | [7] | rad, rad/s |
    | `gripper` | f32 | [2] | fingers' positions, m |

    `info["success"]` is robosuite's: the cube is 4 cm above the table. It counts for the episode if it ever was so.
    A layout (where cube and arm begin) depends on the set of layouts, the seed and the layout's number alone.
    """

    def __init__(
        self,
        seed: int = 0,
        layouts: str = "learning",
        side: int = 64,
        cameras: Sequence[str] = tuple(CAMERAS),
        masks: bool = False,
        horizon: int = HORIZON,
        plain: bool = False,
    ):
        """`horizon` is in steps; `plain` draws as MuJoCo does by default, slowly. Raises `RcwmError`."""
        if layouts not in LAYOUTS:
            raise RcwmError(f"layouts {layouts!r}: expected {', '.join(LAYOUTS)}")
        if not 0 <= seed < 2**64 or horizon < 1:
            raise RcwmError(f"seed {seed}, horizon {horizon}: expected a seed of 0 to 2^64 - 1 and at least one step")
        self.interface = panda_lift(side, cameras, masks)
        self.seed, self.layouts, self.masks, self.horizon = seed, layouts, masks, horizon
        self.layout, self.steps, self.succeeded = -1, 0, False
        with _quietly():
            self.env = _make()
        self.model, self.data = self.env.sim.model._model, self.env.sim.data._data
        self._place_front_camera()
        self.is_robot = descendants(self.model, ["robot0_base", "fixed_mount0_base"])
        self.renderer: Renderer | None = Renderer(self.model, self.data, side, self.is_robot, plain)
        self._positions = [self.model.joint(f"robot0_joint{i}").qposadr[0] for i in range(1, 8)]
        self._velocities = [self.model.joint(f"robot0_joint{i}").dofadr[0] for i in range(1, 8)]
        self._fingers = [self.model.joint(f"gripper0_right_finger_joint{i}").qposadr[0] for i in (1, 2)]
        self._hand = self.model.site("gripper0_right_grip_site").id
        self._cube = self.model.body("cube_main").id

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Begins the next layout, that of `options["layout"]`, or with a new seed the first one."""
        if seed is not None:
            self.seed, self.layout = seed, -1
        self.layout = int((options or {}).get("layout", self.layout + 1))
        self.steps, self.succeeded = 0, False
        # The generator is shared by robosuite's parts: its state is replaced, not itself.
        stream = random_stream(self.layouts, self.seed, self.layout, STREAM_LAYOUT)
        self.env.rng.bit_generator.state = stream.bit_generator.state
        with _quietly():
            self.env.reset()
        return self._observe(), {"success": False, "layout": self.layout}

    def step(
        self, action: Sequence[float] | np.ndarray
    ) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Executes seven numbers in [-1, 1] for 50 ms: observation, reward, terminated (never), truncated, info.

        Raises `ValueError`, and executes nothing, for an action of another length, not finite or not in limits.
        """
        values = np.asarray(action, np.float64)
        if values.shape != (self.interface.action_numbers,) or not (np.abs(values) <= 1).all():
            raise ValueError(f"action {values.tolist()}: expected {self.interface.action_numbers} numbers in [-1, 1]")
        _, reward, _, _ = self.env.step(values)
        self.steps += 1
        success = bool(self.env._check_success())
        self.succeeded |= success
        info = {"success": success, "layout": self.layout}
        return self._observe(), float(reward), False, self.steps >= self.horizon, info

    def close(self) -> None:
        """Frees the graphics context and robosuite's environment."""
        if self.renderer is not None:
            self.renderer.close()
            self.renderer = None
            self.env.close()

    @property
    def hand(self) -> tuple[np.ndarray, np.ndarray]:
        """Where the fingers meet, [3] m, and its axes as columns, [3, 3]; fingers close along y and point along z."""
        return self.data.site_xpos[self._hand].copy(), self.data.site_xmat[self._hand].reshape(3, 3).copy()

    @property
    def cube(self) -> tuple[np.ndarray, np.ndarray]:
        """The cube's middle, [3] m, and its axes as columns, [3, 3]."""
        return self.data.xpos[self._cube].copy(), self.data.xmat[self._cube].reshape(3, 3).copy()

    @property
    def is_grasped(self) -> bool:
        """Whether both fingers touch the cube."""
        return bool(self.env._check_grasp(gripper=self.env.robots[0].gripper, object_geoms=self.env.cube))

    def _observe(self) -> dict[str, np.ndarray]:
        if self.renderer is None:
            raise RuntimeError("the robot was closed")
        observation = {
            "joint_pos": self.data.qpos[self._positions].astype(np.float32),
            "joint_vel": self.data.qvel[self._velocities].astype(np.float32),
            "gripper": self.data.qpos[self._fingers].astype(np.float32),
        }
        for camera in self.interface.cameras:
            observation[camera.name] = self.renderer.draw(CAMERAS[camera.name])
            if self.masks:
                observation[f"{camera.name}_mask"] = self.renderer.segment()
        return observation

    def _place_front_camera(self) -> None:
        back = np.subtract(FRONT_AT, FRONT_LOOKS_AT)
        back /= np.linalg.norm(back)
        right = np.cross((0, 0, 1), back)
        right /= np.linalg.norm(right)
        camera, turn = self.model.camera(CAMERAS["front"]).id, np.zeros(4)
        mujoco.mju_mat2Quat(turn, np.stack([right, np.cross(back, right), back], 1).ravel())
        self.model.cam_pos[camera], self.model.cam_quat[camera] = FRONT_AT, turn
        self.model.cam_fovy[camera] = FRONT_ANGLE


def _make() -> Any:
    import robosuite

    env = robosuite.make(
        "Lift",
        robots="Panda",
        control_freq=20,
        reward_shaping=True,
        horizon=2**31,
        ignore_done=True,
        hard_reset=False,  # builds the model once; the cube keeps its size
        seed=0,
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        use_object_obs=False,
    )
    for observable in env._observables.values():
        observable.set_enabled(False)  # measured by ourselves, once a step and not at every one of the physics
    return env


@contextmanager
def _quietly() -> Iterator[None]:
    """robosuite tells of macro files and optional packages on every start."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
