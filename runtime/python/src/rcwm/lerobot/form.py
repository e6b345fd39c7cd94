"""The form of a LeRobot dataset, v3.0: names of files, of features, and the errors of both directions."""

from __future__ import annotations

from typing import Any

import numpy as np

from .. import RcwmError
from ..interface import Interface

VERSION = "v3.0"
INFO, STATS, TASKS = "meta/info.json", "meta/stats.json", "meta/tasks.parquet"
FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
EPISODES, DATA, VIDEO = f"meta/episodes/{FILE}.parquet", f"data/{FILE}.parquet", "videos/{video_key}/" + FILE + ".mp4"
# Files in a folder, and bytes after which the next file begins.
FILES_MAX, DATA_MB, VIDEO_MB = 1000, 100, 200
# Ours: what LeRobot has no place for, one file an episode.
BESIDE = "rcwm/episode-{index:06d}.npz"

STATE, ACTION, IMAGES = "observation.state", "action", "observation.images."
# Our arrays [T] of what an action led to, as features of the row it was chosen in. `next.done` is LeRobot's is_last.
NEXT = {
    "next.reward": "reward",
    "next.done": "is_last",
    "next.success": "success",
    "next.terminal": "is_terminal",
    "next.pushed": "pushed",
}
QUANTILES = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}


class DatasetError(RcwmError):
    """A dataset that is damaged, or none of the expected robot."""


def whole_rate(robot: Interface) -> int:
    """The robot's rate as LeRobot's fps, a whole number. Raises `DatasetError`."""
    if robot.rate_hz != int(robot.rate_hz):
        raise DatasetError(f"rate_hz = {robot.rate_hz:g}: LeRobot's fps is a whole number; record at one")
    return int(robot.rate_hz)


def features(robot: Interface, videos: bool) -> dict[str, dict[str, Any]]:
    """`features` of info.json."""
    out: dict[str, dict[str, Any]] = {}
    if robot.state_numbers:
        out[STATE] = _vector(robot.state_names)
    for camera in robot.cameras:
        entry: dict[str, Any] = {"dtype": "video" if videos else "image", "shape": list(camera.shape)}
        out[IMAGES + camera.name] = {**entry, "names": ["height", "width", "channels"]}
    out[ACTION] = _vector(robot.action_names)
    for key in NEXT:
        out[key] = {"dtype": "float32" if key == "next.reward" else "bool", "shape": [1], "names": None}
    for key in ("timestamp", "frame_index", "episode_index", "index", "task_index"):
        out[key] = {"dtype": "float32" if key == "timestamp" else "int64", "shape": [1], "names": None}
    return out


def _vector(names: list[str]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": [len(names)], "names": names}


def statistics(values: np.ndarray, is_image: bool) -> dict[str, np.ndarray]:
    """Of one episode's rows: min, max, mean, std, count, quantiles; of images by channel, [3, 1, 1], white 1."""
    if is_image:
        # As LeRobot does, some frames stand for all.
        values = values[np.unique(np.linspace(0, len(values) - 1, min(len(values), 100)).astype(int))]
        count, rows = len(values), values.reshape(-1, 3) / 255.0
    else:
        count, rows = len(values), values.reshape(len(values), -1).astype(np.float64)
    out = {"min": rows.min(0), "max": rows.max(0), "mean": rows.mean(0), "std": rows.std(0)}
    out |= {key: np.quantile(rows, share, axis=0) for key, share in QUANTILES.items()}
    if is_image:
        out = {key: value.reshape(3, 1, 1) for key, value in out.items()}
    return {**out, "count": np.array([count])}


def together(parts: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Statistics of all episodes; quantiles, as LeRobot's, are means of the episodes'."""
    share = np.array([part["count"][0] for part in parts], np.float64)
    share /= share.sum()
    mean = {key: sum(w * part[key] for w, part in zip(share, parts, strict=True)) for key in ("mean", *QUANTILES)}
    spread = sum(
        w * (part["std"] ** 2 + (part["mean"] - mean["mean"]) ** 2) for w, part in zip(share, parts, strict=True)
    )
    lowest, highest = (np.stack([part[key] for part in parts]) for key in ("min", "max"))
    out = {"min": lowest.min(0), "max": highest.max(0), **mean, "std": np.sqrt(spread)}
    return {**out, "count": np.array([sum(int(part["count"][0]) for part in parts)])}
