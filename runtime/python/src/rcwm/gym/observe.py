"""What of a Gymnasium environment's observation is which state, camera and mask of the interface."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from .. import RcwmError
from ..interface import Interface

# From an environment's observation to a dictionary by the interface's names; masks are called `<camera>_mask`.
Observe = Callable[[Any], Mapping[str, Any]]


class UnfitEnvironment(RcwmError):
    """An environment that is not the robot of the interface."""


@dataclass(frozen=True)
class Seen:
    """State [n] f32; pictures [rows, columns, 3] u8 and masks [rows, columns] u8 (255: robot) by camera."""

    state: np.ndarray
    images: dict[str, np.ndarray]
    masks: dict[str, np.ndarray]


def see(env: Any, robot: Interface, observation: Any, observe: Observe | None) -> Seen:
    """Takes an observation apart. Without `observe` it is a dictionary by the interface's names, or the one state's
    vector; a single camera that is not in it is what the environment renders. Raises `UnfitEnvironment`.
    """
    if observe is not None:
        parts = dict(observe(observation))
    elif isinstance(observation, Mapping):
        parts = dict(observation)
    elif len(robot.states) == 1:
        parts = {robot.states[0].name: observation}
    else:
        count = len(robot.states)
        raise UnfitEnvironment(f"the observation is no dictionary, and the robot has {count} states: give observe=")
    missing = [camera for camera in robot.cameras if camera.name not in parts]
    if len(missing) == 1 and getattr(env, "render_mode", None) == "rgb_array":
        parts[missing[0].name] = env.render()
    elif missing:
        raise UnfitEnvironment(
            f"no picture of camera {missing[0].name}; the observation has {', '.join(map(str, parts))}"
        )
    state = robot.pack(parts)
    if not np.isfinite(state).all():
        name = robot.state_names[int(np.argmin(np.isfinite(state)))]
        raise UnfitEnvironment(f"the environment's {name} is not finite")
    images, masks = {}, {}
    for camera in robot.cameras:
        images[camera.name] = _pixels(camera.name, parts[camera.name], camera.shape)
        mask = parts.get(f"{camera.name}_mask")
        if camera.mask and mask is not None:
            flat = _pixels(f"{camera.name}_mask", np.asarray(mask, np.uint8), camera.shape[:2])
            masks[camera.name] = np.where(flat > 0, np.uint8(255), np.uint8(0))
    return Seen(state, images, masks)


def check_action_space(env: Any, robot: Interface) -> None:
    """The environment must take every action that the interface allows. Raises `UnfitEnvironment`."""
    space = getattr(env, "action_space", None)
    if space is None:
        return
    shape, low, high = (getattr(space, key, None) for key in ("shape", "low", "high"))
    if low is None or high is None or shape is None:
        raise UnfitEnvironment(f"the environment's actions are {space}; expected a Box, continuous numbers")
    if int(np.prod(shape)) != robot.action_numbers:
        raise UnfitEnvironment(f"the environment takes {list(shape)} numbers; the interface has {robot.action_numbers}")
    out = (robot.low < np.ravel(low) - 1e-6) | (robot.high > np.ravel(high) + 1e-6)
    if out.any():
        at = int(np.argmax(out))
        limits = f"{robot.low[at]:g} to {robot.high[at]:g}"
        takes = f"{np.ravel(low)[at]:g} to {np.ravel(high)[at]:g}"
        raise UnfitEnvironment(
            f"action {robot.action_names[at]}: the interface allows {limits}, the environment {takes}"
        )


def _pixels(name: str, image: Any, shape: tuple[int, ...]) -> np.ndarray:
    array = np.asarray(image)
    if array.dtype != np.uint8 or array.shape != shape:
        raise UnfitEnvironment(f"camera {name}: {array.dtype} {list(array.shape)}; expected uint8 {list(shape)}")
    return array
