"""Our episodes as a LeRobot dataset."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from .. import episode as episodes
from ..cli import Progress
from ..episode import Episode
from ..interface import Interface
from . import form
from .form import DatasetError
from .video import VideoWriter


def from_npz(
    folder: Path, robot: Interface, out: Path, task: str | None = None, images: bool = False, limits: Sequence[int] = ()
) -> dict[str, Any]:
    """Writes the episodes `folder/*.npz` as the dataset `out`, which must not exist; `images` stores them without loss.

    `limits` are megabytes of a data and of a video file, LeRobot's where not given. The dataset appears whole or not at
    all. Returns the numbers of episodes, rows and pushed actions. Raises `RcwmError`.
    """
    paths = sorted(path for path in folder.glob("*.npz") if not path.name.startswith("."))
    if not paths:
        raise DatasetError(f"{folder}: holds no .npz episodes")
    if out.exists():
        raise DatasetError(f"{out}: exists already; choose another --out or remove it")
    beside = out.with_name(f".{out.name}.new")
    shutil.rmtree(beside, ignore_errors=True)
    writer = _Writer(beside, robot, task or robot.name, images, *(limits or (form.DATA_MB, form.VIDEO_MB)))
    progress = Progress(len(paths), "episodes")
    try:
        for path in paths:
            writer.add(episodes.read(path, robot), path)
            progress.add()
        result = writer.finish()
        beside.replace(out)
    except OSError as error:
        raise DatasetError(f"{out}: cannot be written ({error})") from None
    finally:
        writer.close()
        shutil.rmtree(beside, ignore_errors=True)
    return result


class _Writer:
    def __init__(self, root: Path, robot: Interface, task: str, images: bool, data_mb: int, video_mb: int):
        self.root, self.robot, self.task, self.images = root, robot, task, images
        self.limits = (data_mb << 20, video_mb << 20)
        self.fps = form.whole_rate(robot)
        self.features = form.features(robot, not images)
        self.schema = pa.schema([(key, self._type(entry)) for key, entry in self.features.items() if self._type(entry)])
        self.rows: list[dict[str, Any]] = []
        self.statistics: list[dict[str, dict[str, np.ndarray]]] = []
        self.frames = self.pushed = 0
        self.data_place = self.video_place = -1
        self.data_bytes = 0
        self.data: pq.ParquetWriter | None = None
        self.videos: dict[str, VideoWriter] = {}

    def _type(self, entry: dict[str, Any]) -> Any:
        if entry["dtype"] == "video":
            return None
        if entry["dtype"] == "image":
            return pa.struct([("bytes", pa.binary()), ("path", pa.string())])
        one = {"float32": pa.float32(), "int64": pa.int64(), "bool": pa.bool_()}[entry["dtype"]]
        return one if entry["shape"] == [1] and entry["names"] is None else pa.list_(one, entry["shape"][0])

    def add(self, episode: Episode, path: Path) -> None:
        """Appends the T - 1 rows of an episode."""
        index, rows = len(self.rows), len(episode) - 1
        if rows < 1:
            raise DatasetError(f"episode {path}: one observation and no action; LeRobot has no row for it")
        if episode.is_first[1:].any():
            raise DatasetError(f"episode {path}: begins again in its middle; expected one episode a file")
        columns = self._columns(episode, index, rows)
        row = {"episode_index": index, "tasks": [self.task], "length": rows}
        row |= self._store_data(columns)
        row |= self._store_videos(episode, rows)
        row |= {"dataset_from_index": self.frames, "dataset_to_index": self.frames + rows}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        self.rows.append(row)
        self._measure(episode, columns, rows)
        self._store_beside(episode, index)
        self.frames += rows
        self.pushed += int(episode.pushed.sum())

    def _columns(self, episode: Episode, index: int, rows: int) -> dict[str, np.ndarray]:
        at = np.arange(rows)
        columns: dict[str, np.ndarray] = {}
        if self.robot.state_numbers:
            columns[form.STATE] = episode.proprio[:-1]
        columns[form.ACTION] = episode.action[1:]
        columns |= {key: getattr(episode, name)[1:] for key, name in form.NEXT.items()}
        columns |= {"timestamp": (at / self.fps).astype(np.float32), "frame_index": at, "index": self.frames + at}
        columns |= {"episode_index": np.full(rows, index), "task_index": np.zeros(rows, np.int64)}
        if self.images:
            columns |= {form.IMAGES + name: images[:-1] for name, images in episode.images.items()}
        return columns

    def _store_data(self, columns: dict[str, np.ndarray]) -> dict[str, int]:
        arrays = [self._array(columns[column.name], column.type) for column in self.schema]
        table = pa.Table.from_arrays(arrays, schema=self.schema)
        if self.data is None or self.data_bytes + table.nbytes > self.limits[0]:
            if self.data is not None:
                self.data.close()
            self.data_place, self.data_bytes = self.data_place + 1, 0
            self.data = pq.ParquetWriter(self._path(form.DATA, self.data_place), self.schema, compression="snappy")
        self.data.write_table(table)
        self.data_bytes += table.nbytes
        return _place("data", self.data_place)

    @staticmethod
    def _array(values: np.ndarray, kind: Any) -> Any:
        if pa.types.is_struct(kind):
            return pa.array([{"bytes": _png(image), "path": None} for image in values], kind)
        if pa.types.is_fixed_size_list(kind):
            return pa.FixedSizeListArray.from_arrays(pa.array(values.reshape(-1), kind.value_type), kind.list_size)
        return pa.array(values, kind)

    def _store_videos(self, episode: Episode, rows: int) -> dict[str, Any]:
        if self.images:
            return {}
        full = any(video.path.stat().st_size > self.limits[1] for video in self.videos.values() if video.path.exists())
        if not self.videos or full:
            self._close_videos()
            self.video_place += 1
            for camera in self.robot.cameras:
                key = form.IMAGES + camera.name
                path = self._path(form.VIDEO, self.video_place, video_key=key)
                self.videos[key] = VideoWriter(path, self.fps, *camera.shape[:2])
        found: dict[str, Any] = {}
        for camera in self.robot.cameras:
            key = form.IMAGES + camera.name
            video = self.videos[key]
            found |= _place(f"videos/{key}", self.video_place)
            found[f"videos/{key}/from_timestamp"] = video.count / self.fps
            video.add(episode.images[camera.name][:rows])
            found[f"videos/{key}/to_timestamp"] = video.count / self.fps
        return found

    def _measure(self, episode: Episode, columns: dict[str, np.ndarray], rows: int) -> None:
        pictures = {form.IMAGES + name: images[:rows] for name, images in episode.images.items()}
        one = {key: form.statistics(values, True) for key, values in pictures.items()}
        one |= {key: form.statistics(values, False) for key, values in columns.items() if key not in pictures}
        self.statistics.append(one)

    def _store_beside(self, episode: Episode, index: int) -> None:
        path = self.root / form.BESIDE.format(index=index)
        path.parent.mkdir(parents=True, exist_ok=True)
        arrays: dict[str, Any] = {key: value[-1:] for key, value in episode.arrays().items() if key.startswith("image")}
        arrays |= {key: value for key, value in episode.arrays().items() if key.startswith("robot_mask")}
        arrays |= {"first": np.array([getattr(episode, key)[0] for key in form.NEXT.values()], np.float32)}
        arrays |= {"proprio": episode.proprio[-1:], "interface": np.array([episode.interface.canonical()])}
        np.savez_compressed(path, **arrays)

    def finish(self) -> dict[str, Any]:
        """Writes `meta/`."""
        self.close()
        total, count = len(self.rows), self.frames
        info = {
            "codebase_version": form.VERSION,
            "robot_type": self.robot.name,
            "total_episodes": total,
            "total_frames": count,
            "total_tasks": 1,
            "chunks_size": form.FILES_MAX,
            "data_files_size_in_mb": self.limits[0] >> 20,
            "video_files_size_in_mb": self.limits[1] >> 20,
            "fps": self.fps,
            "splits": {"train": f"0:{total}"},
            "data_path": form.DATA,
            "video_path": None if self.images else form.VIDEO,
            "features": self.features,
        }
        every = {key: form.together([one[key] for one in self.statistics]) for key in self.statistics[0]}
        _json(self.root / form.INFO, info)
        _json(self.root / form.STATS, {k: {n: v.tolist() for n, v in stats.items()} for k, stats in every.items()})
        (self.root / "meta/interface.toml").write_text(self.robot.canonical(), encoding="utf-8")
        _write_tasks(self.root / form.TASKS, [self.task])
        rows = []
        for row, one in zip(self.rows, self.statistics, strict=True):
            flat = {f"stats/{key}/{name}": v.tolist() for key, stats in one.items() for name, v in stats.items()}
            rows.append({**row, **flat})
        pq.write_table(pa.Table.from_pylist(rows), self._path(form.EPISODES, 0), compression="snappy")
        return {"episodes": total, "rows": count, "pushed_actions": self.pushed}

    def close(self) -> None:
        """Closes what is open."""
        if self.data is not None:
            self.data.close()
            self.data = None
        self._close_videos()

    def _close_videos(self) -> None:
        for video in self.videos.values():
            video.close()
        self.videos = {}

    def _path(self, form_of_path: str, place: int, **names: str) -> Path:
        chunk, file = divmod(place, form.FILES_MAX)
        path = self.root / form_of_path.format(chunk_index=chunk, file_index=file, **names)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


def _place(prefix: str, place: int) -> dict[str, int]:
    chunk, file = divmod(place, form.FILES_MAX)
    return {f"{prefix}/chunk_index": chunk, f"{prefix}/file_index": file}


def _png(image: np.ndarray) -> bytes:
    out = io.BytesIO()
    Image.fromarray(image).save(out, "PNG")
    return out.getvalue()


def _json(path: Path, value: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(value, indent=4) + "\n", encoding="utf-8")


def _write_tasks(path: Path, tasks: list[str]) -> None:
    """A table that pandas reads with the tasks as its index, as LeRobot expects."""
    place = {
        "name": None,
        "field_name": "__index_level_0__",
        "pandas_type": "unicode",
        "numpy_type": "object",
        "metadata": None,
    }
    number = {
        "name": "task_index",
        "field_name": "task_index",
        "pandas_type": "int64",
        "numpy_type": "int64",
        "metadata": None,
    }
    about = {
        "index_columns": ["__index_level_0__"],
        "column_indexes": [],
        "columns": [number, place],
        "pandas_version": "2.0.0",
    }
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "__index_level_0__": pa.array(tasks)})
    pq.write_table(table.replace_schema_metadata({"pandas": json.dumps(about)}), path)
