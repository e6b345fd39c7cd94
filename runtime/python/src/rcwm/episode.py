"""Recorded episodes as `.npz` files, the form of Dreamer's and of the project's trainer.

| key | type | shape | meaning |
| --- | --- | --- | --- |
| `image`, `image_2`, ... | u8 | [T, rows, columns, 3] | the cameras in the interface's order, upright, RGB |
| `action` | f32 | [T, n] | the action that LED TO `image[t]`, in [-1, 1] from limit to limit; zeros at the first |
| `reward` | f32 | [T] | of that transition |
| `is_first`, `is_last`, `is_terminal`, `success` | bool | [T] | |
| `pushed` | bool | [T] | the action was a push off course and no example of what to do |
| `proprio` | f32 | [T, n] | all states in the interface's order, in its units; left out where there is none |
| `robot_mask`, `robot_mask_2`, ... | u8 | [T, rows, columns, 1] | optional; 1 where the robot is |
| `interface` | text | [1] | the interface's canonical text |

In an `Episode` actions are in the interface's units.
"""

from __future__ import annotations

import os
import re
import tempfile
import zipfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from . import RcwmError, interface
from .interface import Interface

STEPS_MAX = 100_000
# Of all arrays of a file together: more is not read.
BYTES_MAX = 4 << 30
# How far beyond a limit an action may be, as a share of half the range: it may have been rounded.
ROUNDING = 1e-3
FLAGS = ("is_first", "is_last", "is_terminal", "success", "pushed")
_KEYS = re.compile(rf"(image|robot_mask)(_\d)?|action|reward|proprio|interface|{'|'.join(FLAGS)}")


class EpisodeError(RcwmError):
    """A file that is no episode, or none of the expected robot."""


@dataclass
class Episode:
    """One episode of T observations; see the module for types and shapes. `images` and `masks` are by camera."""

    interface: Interface
    images: dict[str, np.ndarray]
    action: np.ndarray
    reward: np.ndarray
    proprio: np.ndarray
    is_first: np.ndarray
    is_last: np.ndarray
    is_terminal: np.ndarray
    success: np.ndarray
    pushed: np.ndarray
    masks: dict[str, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.reward)

    def arrays(self) -> dict[str, Any]:
        """What the file holds, by key."""
        out: dict[str, np.ndarray] = {}
        for index, camera in enumerate(self.interface.cameras):
            out[key_of("image", index)] = self.images[camera.name]
            if camera.name in self.masks:
                out[key_of("robot_mask", index)] = self.masks[camera.name][..., None]
        out |= {
            "action": _scaled(self.interface, self.action, self.is_first),
            "reward": self.reward,
        }
        if self.interface.state_numbers:
            out["proprio"] = self.proprio
        out |= {key: getattr(self, key) for key in FLAGS}
        out["interface"] = np.array([self.interface.canonical()])
        return out

    def write(self, path: Path) -> None:
        """Writes the file whole or not at all. Raises `EpisodeError`."""
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with tempfile.NamedTemporaryFile(dir=path.parent, prefix=f".{path.stem}", delete=False) as file:
                try:
                    np.savez_compressed(file, **self.arrays())
                    file.flush()
                    os.fsync(file.fileno())
                    Path(file.name).chmod(0o644)
                    Path(file.name).replace(path)
                except BaseException:
                    Path(file.name).unlink(missing_ok=True)
                    raise
        except OSError as error:
            raise EpisodeError(f"episode {path}: cannot be written ({error})") from None


class Recorder:
    """Collects observations into an `Episode`: `begin`, `add` after every step, `finish`."""

    def __init__(self, robot: Interface):
        self.interface = robot
        self.rows: dict[str, list[Any]] = {}

    def begin(self, observation: dict[str, np.ndarray]) -> None:
        """The first observation, which no action led to."""
        self.rows = {}
        self.add(observation, np.zeros(self.interface.action_numbers, np.float32), 0.0, False, False)

    def add(
        self, observation: dict[str, np.ndarray], action: np.ndarray, reward: float, success: bool, pushed: bool
    ) -> None:
        """An observation, and the action that led to it. Raises `InterfaceError` where a state is missing."""
        row: dict[str, Any] = {"action": action, "reward": reward, "success": success, "pushed": pushed}
        row["proprio"] = self.interface.pack(observation)
        for camera in self.interface.cameras:
            row[f"image {camera.name}"] = observation[camera.name]
            if camera.mask:
                row[f"mask {camera.name}"] = observation[f"{camera.name}_mask"]
        for key, value in row.items():
            self.rows.setdefault(key, []).append(value)

    def finish(self, terminal: bool = False) -> Episode:
        """The episode; `terminal` where it ended because of its state and not because its time was up."""
        steps = len(self.rows["reward"])
        at = np.arange(steps)
        cameras = [camera.name for camera in self.interface.cameras]
        masked = [camera.name for camera in self.interface.cameras if camera.mask]
        return Episode(
            interface=self.interface,
            images={name: np.stack(self.rows[f"image {name}"]) for name in cameras},
            masks={name: np.stack(self.rows[f"mask {name}"]).astype(np.uint8) for name in masked},
            action=np.stack(self.rows["action"]).astype(np.float32),
            reward=np.array(self.rows["reward"], np.float32),
            proprio=np.stack(self.rows["proprio"]),
            is_first=at == 0,
            is_last=at == steps - 1,
            is_terminal=(at == steps - 1) & terminal,
            success=np.array(self.rows["success"], bool),
            pushed=np.array(self.rows["pushed"], bool),
        )


def key_of(name: str, index: int) -> str:
    """The key of camera number `index`: the first one's has no number."""
    return name if index == 0 else f"{name}_{index + 1}"


def read(path: Path, expected: Interface | None = None) -> Episode:
    """Reads a file. Without `expected` the file must carry its interface; with it, the two must fit.

    Raises `EpisodeError` for a damaged file, a missing array, a wrong shape or type, numbers that are not finite,
    actions that stand at the image they were chosen on, and another robot.
    """
    try:
        with np.load(path, allow_pickle=False) as archive:
            _check_size(path, archive.zip)
            arrays = {key: archive[key] for key in archive.files if _KEYS.fullmatch(key)}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, zipfile.error, KeyError, AttributeError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise EpisodeError(f"episode {path}: no whole archive of arrays ({reason}); record it again") from None
    robot = _interface(path, arrays, expected)
    steps = len(_get(path, arrays, "reward").reshape(-1))
    if not 1 <= steps <= STEPS_MAX:
        raise EpisodeError(f"episode {path}: {steps} steps; expected 1 to {STEPS_MAX}")
    if not robot.state_numbers:
        arrays["proprio"] = np.zeros((steps, 0), np.float32)
    numbers = {
        "action": (steps, robot.action_numbers),
        "proprio": (steps, robot.state_numbers),
        "reward": (steps,),
    }
    parts: dict[str, Any] = {key: _numbers(path, arrays, key, shape) for key, shape in numbers.items()}
    for key in FLAGS:
        parts[key] = _flags(path, arrays, key, steps)
    images, masks = {}, {}
    for index, camera in enumerate(robot.cameras):
        images[camera.name] = _bytes(path, arrays, key_of("image", index), (steps, *camera.shape))
        mask = key_of("robot_mask", index)
        if mask in arrays:
            shape = (steps, *camera.shape[:2], 1)
            masks[camera.name] = _bytes(path, arrays, mask, shape)[..., 0]
    if (np.abs(parts["action"]) > 1 + ROUNDING).any():
        raise EpisodeError(
            f"episode {path}: actions beyond [-1, 1]; expected them from limit to limit, not in the interface's units"
        )
    if parts["action"][parts["is_first"]].any():
        raise EpisodeError(
            f"episode {path}: the first action is not zero, so actions stand where they were chosen; "
            "expected those that led to it: a[1:] = a[:-1]; a[0] = 0"
        )
    middle, half = _range(robot)
    in_units = middle + half * np.clip(parts["action"].astype(np.float64), -1, 1)
    parts["action"] = np.where(parts["is_first"][:, None], 0.0, in_units).astype(np.float32)
    episode = Episode(interface=robot, images=images, masks=masks, **parts)
    return episode if expected is None else _as_expected(episode, expected)


def _check_size(path: Path, archive: zipfile.ZipFile) -> None:
    size = sum(entry.file_size for entry in archive.infolist() if _KEYS.fullmatch(entry.filename.removesuffix(".npy")))
    if size > BYTES_MAX:
        raise EpisodeError(f"episode {path}: arrays of {size} bytes; expected at most {BYTES_MAX}")


def _range(robot: Interface) -> tuple[np.ndarray, np.ndarray]:
    """Middle and half width of each number of an action, f64, in units."""
    low, high = robot.low.astype(np.float64), robot.high.astype(np.float64)
    return (low + high) / 2, (high - low) / 2


def _scaled(robot: Interface, action: np.ndarray, is_first: np.ndarray) -> np.ndarray:
    """[T, n] f32 in [-1, 1] of actions in units. Raises `EpisodeError` where one is not within the limits."""
    middle, half = _range(robot)
    scaled = (action.astype(np.float64) - middle) / half
    led = scaled[~is_first]
    if not np.isfinite(led).all() or (np.abs(led) > 1 + ROUNDING).any():
        raise EpisodeError(
            "an executed action is not within the interface's limits; clip what is executed, and record that"
        )
    return np.where(is_first[:, None], 0.0, np.clip(scaled, -1, 1)).astype(np.float32)


def _as_expected(episode: Episode, robot: Interface) -> Episode:
    """The states and cameras that `robot` has, in its order."""
    places, at = {}, 0
    for state in episode.interface.states:
        places[state.name] = list(range(at, at + len(state.elements)))
        at += len(state.elements)
    names = [camera.name for camera in robot.cameras]
    return replace(
        episode,
        interface=robot,
        images={name: episode.images[name] for name in names},
        masks={name: episode.masks[name] for name in names if name in episode.masks},
        proprio=episode.proprio[:, [place for state in robot.states for place in places[state.name]]],
    )


def _interface(path: Path, arrays: dict[str, np.ndarray], expected: Interface | None) -> Interface:
    if "interface" not in arrays:
        if expected is None:
            raise EpisodeError(f"episode {path}: carries no interface; give its robot's (--interface)")
        return expected
    if arrays["interface"].size != 1:
        raise EpisodeError(f"episode {path}: array 'interface' has {arrays['interface'].size} texts; expected one")
    own = interface.parse(str(arrays["interface"].reshape(-1)[0]))
    lines = interface.differences(expected, own) if expected else []
    if lines:
        raise EpisodeError(f"episode {path}: of another robot: {'; '.join(lines)}")
    return own


def _get(path: Path, arrays: dict[str, np.ndarray], key: str) -> np.ndarray:
    if key not in arrays:
        raise EpisodeError(f"episode {path}: array {key!r} is missing; there are {', '.join(arrays)}")
    return arrays[key]


def _shaped(path: Path, arrays: dict[str, np.ndarray], key: str, shape: tuple[int, ...]) -> np.ndarray:
    array = _get(path, arrays, key)
    # As many numbers in axes that differ only by ones: [T, 1] for [T].
    if [size for size in array.shape if size != 1] != [size for size in shape if size != 1]:
        raise EpisodeError(f"episode {path}: array {key!r} has the shape {list(array.shape)}; expected {list(shape)}")
    return array.reshape(shape)


def _numbers(path: Path, arrays: dict[str, np.ndarray], key: str, shape: tuple[int, ...]) -> np.ndarray:
    array = _shaped(path, arrays, key, shape)
    if array.dtype.kind not in "fiub" or not np.isfinite(array).all():
        raise EpisodeError(f"episode {path}: array {key!r} is not of finite numbers")
    return array.astype(np.float32)


def _flags(path: Path, arrays: dict[str, np.ndarray], key: str, steps: int) -> np.ndarray:
    if key not in arrays and key != "is_first":
        return np.zeros(steps, bool)
    return np.asarray(_numbers(path, arrays, key, (steps,)) > 0.5)


def _bytes(path: Path, arrays: dict[str, np.ndarray], key: str, shape: tuple[int, ...]) -> np.ndarray:
    array = _shaped(path, arrays, key, shape)
    if array.dtype != np.uint8:
        raise EpisodeError(f"episode {path}: array {key!r} is {array.dtype}; expected uint8")
    return array
