"""A LeRobot dataset as our episodes."""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image, UnidentifiedImageError

from .. import interface
from ..cli import Progress, claim
from ..episode import FLAGS, Episode, key_of
from ..interface import Interface
from . import form, names
from .form import DatasetError
from .video import VideoReader

# How far (s) a row's time may be off its place.
TIME_OFF_MAX = 1e-3


def to_npz(root: Path, robot: Interface, out: Path, renamed: Mapping[str, str] | None = None) -> dict[str, Any]:
    """Writes the episodes of a dataset as `out/episode-000000.npz` and on; those that are there are not done again.

    `renamed` says what names of the dataset are called by the robot. Returns the numbers of episodes, of new ones, of
    actions left out, and of episodes whose success only such an action led to. Raises `RcwmError`.
    """
    dataset = _Dataset(root, robot, renamed or {})
    info = hashlib.sha256((root / form.INFO).read_bytes()).hexdigest()
    claim(out, {"dataset": info, "interface": robot.hash, "map": dict(renamed or {})}, "dataset.json")
    result = {"episodes": len(dataset.rows), "new": 0, "actions_left_out": 0, "successes_left_out": 0}
    progress = Progress(len(dataset.rows), "episodes")
    try:
        for row in dataset.rows:
            path = out / f"episode-{int(row['episode_index']):06}.npz"
            if not path.exists():
                episode, lost = dataset.episode(row)
                episode.write(path)
                result["new"] += 1
                result["actions_left_out"] += lost is not None
                result["successes_left_out"] += bool(lost) and not episode.success.any()
            progress.add()
    finally:
        dataset.close()
    return result


class _Dataset:
    def __init__(self, root: Path, robot: Interface, renamed: Mapping[str, str]):
        self.root, self.robot = root, robot
        self.info = _read_info(root)
        self.fps = self.info["fps"]
        if abs(self.fps - robot.rate_hz) > 1e-6 * robot.rate_hz:
            raise DatasetError(f"{root}: fps {self.fps}, and the robot's rate_hz is {robot.rate_hz:g}; both must agree")
        self.features: dict[str, dict[str, Any]] = self.info["features"]
        self.columns = names.find(self.features, robot, renamed)
        paths = sorted((root / "meta/episodes").glob("*/*.parquet"))
        if not paths:
            raise DatasetError(f"{root}: meta/episodes holds no parquet files")
        self.rows = [row for path in paths for row in _table(path, _is_place).to_pylist()]
        self.data: tuple[Path, pa.Table] | None = None
        self.videos: dict[str, VideoReader] = {}

    def episode(self, row: Mapping[str, Any]) -> tuple[Episode, bool | None]:
        """An episode, and whether an action that had to be left out led to success; None where none was left out."""
        index = int(_value(row, "episode_index"))
        rows = self._rows(row, index)
        count, robot = rows.num_rows, self.robot
        action = self._numbers(rows, self.columns.actions, index)
        after = {name: self._after(rows, key) for key, name in form.NEXT.items()}
        images = {name: self._images(rows, row, key, count) for name, key in self.columns.cameras.items()}
        proprio = self._numbers(rows, self.columns.states, index)
        beside = self._beside(index, count)
        lost: bool | None = None
        if beside is None:
            lost = bool(after["success"][-1])
            action, after = action[:-1], {name: values[:-1] for name, values in after.items()}
        else:
            proprio = np.concatenate([proprio, beside["proprio"]])
            for at, camera in enumerate(robot.cameras):
                images[camera.name] = np.concatenate([images[camera.name], beside[key_of("image", at)]])
        steps = len(action) + 1
        first = beside["first"] if beside else np.zeros(len(form.NEXT), np.float32)
        parts = {name: _shift(after[name], first[at]) for at, name in enumerate(form.NEXT.values())}
        parts |= {name: parts[name] > 0.5 for name in FLAGS if name in parts}
        parts["is_first"] = np.arange(steps) == 0
        parts["is_last"] = np.arange(steps) == steps - 1
        masks = {}
        for at, camera in enumerate(robot.cameras):
            if beside and key_of("robot_mask", at) in beside:
                masks[camera.name] = beside[key_of("robot_mask", at)][..., 0]
        led = np.concatenate([np.zeros((1, robot.action_numbers), np.float32), action])
        return Episode(robot, images, action=led, proprio=proprio, masks=masks, **parts), lost

    def _rows(self, row: Mapping[str, Any], index: int) -> pa.Table:
        path = self.root / self.info["data_path"].format(
            chunk_index=_value(row, "data/chunk_index"), file_index=_value(row, "data/file_index")
        )
        if self.data is None or self.data[0] != path:
            self.data = (path, _table(path))
        table = self.data[1]
        if "episode_index" not in table.column_names:
            raise DatasetError(f"{path}: column episode_index is missing; the dataset is damaged")
        rows = table.filter(pa.compute.equal(table["episode_index"], index))
        length = int(_value(row, "length"))
        if rows.num_rows != length or length < 1:
            raise DatasetError(f"{path}: episode {index} has {rows.num_rows} rows; meta/episodes says {length}")
        if "timestamp" in rows.column_names:
            times = rows["timestamp"].to_numpy()
            off = np.abs(times - times[0] - np.arange(length) / self.fps).max()
            if not off <= TIME_OFF_MAX:
                raise DatasetError(f"{path}: episode {index}: rows are not {1 / self.fps:g} s apart ({off:.3g} s off)")
        return rows

    def _numbers(self, rows: pa.Table, places: Iterable[tuple[str, int]], index: int) -> np.ndarray:
        """[rows, places] f32, finite."""
        columns: dict[str, np.ndarray] = {}
        picked = []
        for key, place in places:
            if key not in columns:
                columns[key] = self._column(rows, key)
            picked.append(columns[key][:, place])
        values = np.stack(picked, 1) if picked else np.zeros((rows.num_rows, 0), np.float32)
        if not np.isfinite(values).all():
            raise DatasetError(f"{self.root}: episode {index}: a number is not finite")
        return values

    def _column(self, rows: pa.Table, key: str) -> np.ndarray:
        """[rows, n] f32."""
        if key not in rows.column_names:
            raise DatasetError(f"{self.root}: column {key} is missing in data/; the dataset is damaged")
        width = int(np.prod(self.features[key]["shape"]))
        try:
            values = np.array(rows[key].to_pylist(), np.float32).reshape(rows.num_rows, -1)
        except (ValueError, TypeError) as error:
            raise DatasetError(f"{self.root}: column {key}: no numbers ({error})") from None
        if values.shape[1] != width:
            raise DatasetError(f"{self.root}: column {key}: {values.shape[1]} numbers a row; info.json says {width}")
        return values

    def _after(self, rows: pa.Table, key: str) -> np.ndarray:
        """[rows] f32: what an action led to; zeros where the dataset does not say."""
        if key not in self.features:
            return np.zeros(rows.num_rows, np.float32)
        values = self._column(rows, key)
        if values.shape[1] != 1 or not np.isfinite(values).all():
            raise DatasetError(f"{self.root}: column {key}: expected one finite number a row")
        return values[:, 0]

    def _images(self, rows: pa.Table, row: Mapping[str, Any], key: str, count: int) -> np.ndarray:
        """[rows, rows of a picture, columns, 3] u8."""
        if self.features[key]["dtype"] == "image":
            return self._stored_images(rows, key)
        path = self.root / self.info["video_path"].format(
            video_key=key,
            chunk_index=_value(row, f"videos/{key}/chunk_index"),
            file_index=_value(row, f"videos/{key}/file_index"),
        )
        if key not in self.videos or self.videos[key].path != path:
            if key in self.videos:
                self.videos.pop(key).close()
            self.videos[key] = VideoReader(path, self.fps)
        first = round(float(_value(row, f"videos/{key}/from_timestamp")) * self.fps)
        return self._checked(self.videos[key].read(first, count), key)

    def _stored_images(self, rows: pa.Table, key: str) -> np.ndarray:
        images = []
        for cell in rows[key].to_pylist() if key in rows.column_names else [{}]:
            stored = cell.get("bytes") if isinstance(cell, dict) else None
            try:
                if not stored:
                    stored = (self.root / cell["path"]).read_bytes()
                images.append(np.asarray(Image.open(io.BytesIO(stored)).convert("RGB")))
            except (UnidentifiedImageError, OSError, KeyError, TypeError) as error:
                raise DatasetError(f"{self.root}: column {key}: no picture ({error!r})") from None
        return self._checked(np.stack(images), key)

    def _checked(self, images: np.ndarray, key: str) -> np.ndarray:
        camera = next(name for name, other in self.columns.cameras.items() if other == key)
        shape = next(other.shape for other in self.robot.cameras if other.name == camera)
        if images.shape[1:] != shape:
            raise DatasetError(f"{self.root}: {key}: pictures of {list(images.shape[1:])}; expected {list(shape)}")
        return images

    def _beside(self, index: int, count: int) -> dict[str, np.ndarray] | None:
        path = self.root / form.BESIDE.format(index=index)
        if not path.exists():
            return None
        wanted = {"proprio": (1, self.robot.state_numbers), "first": (len(form.NEXT),)}
        for at, camera in enumerate(self.robot.cameras):
            wanted[key_of("image", at)] = (1, *camera.shape)
        try:
            with np.load(path, allow_pickle=False) as archive:
                found = {key: archive[key] for key in archive.files}
            own = interface.parse(str(found["interface"][0]))
        except Exception as error:  # numpy and zip raise many kinds for damaged files
            raise DatasetError(f"{path}: damaged ({error}); remove it to go without the last observation") from None
        lines = interface.differences(self.robot, own)
        wrong = [key for key, shape in wanted.items() if key not in found or found[key].shape != shape]
        wrong += [key for key in found if key.startswith("robot_mask") and len(found[key]) != count + 1]
        if lines or wrong:
            reason = "; ".join(lines) or f"{', '.join(wrong)} do not fit"
            raise DatasetError(f"{path}: {reason}; remove it to go without the last observation")
        return found

    def close(self) -> None:
        for video in self.videos.values():
            video.close()


def _shift(values: np.ndarray, first: float) -> np.ndarray:
    """From what each action led to, [n], to what each observation came with, [n + 1]."""
    return np.concatenate([[first], values]).astype(np.float32)


def _is_place(column: str) -> bool:
    return not column.startswith("stats/")


def _value(row: Mapping[str, Any], key: str) -> Any:
    if row.get(key) is None:
        raise DatasetError(f"meta/episodes: column {key} is missing; the dataset is damaged")
    return row[key]


def _table(path: Path, wanted: Any = None) -> pa.Table:
    try:
        columns = [name for name in pq.read_schema(path).names if wanted(name)] if wanted else None
        return pq.read_table(path, columns=columns)
    except (pa.ArrowException, OSError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise DatasetError(f"{path}: no parquet file that can be read ({reason}); fetch the dataset again") from None


def _read_info(root: Path) -> dict[str, Any]:
    path = root / form.INFO
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        version, _, features = str(info["codebase_version"]), info["fps"] + 0, dict(info["features"])
        info["data_path"].format(chunk_index=0, file_index=0)
        for key, entry in features.items():
            if not isinstance(entry["dtype"], str) or not all(isinstance(side, int) for side in entry["shape"]):
                raise ValueError(f"feature {key} has no dtype and shape")
        if any(entry["dtype"] == "video" for entry in features.values()):
            info["video_path"].format(video_key="a", chunk_index=0, file_index=0)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DatasetError(f"{path}: no dataset of LeRobot ({type(error).__name__}: {error})") from None
    if not version.startswith("v3."):
        raise DatasetError(
            f"{root}: a dataset of {version}; expected {form.VERSION}: convert it with LeRobot's own script"
        )
    if form.ACTION not in features:
        raise DatasetError(f"{root}: has no feature {form.ACTION!r}; it has {', '.join(features)}")
    return dict(info)
