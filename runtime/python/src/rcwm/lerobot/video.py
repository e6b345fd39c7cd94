"""Pictures as video, one file for many episodes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

import av
import numpy as np

from .form import DatasetError

# A key frame every second picture, as LeRobot's, so that any picture is quickly found; a lower crf loses less.
KEY_FRAME_EVERY, CRF = 2, 15


class VideoWriter:
    """Appends pictures to an mp4 (H.264)."""

    def __init__(self, path: Path, fps: int, rows: int, columns: int):
        """Raises `DatasetError` where the pictures cannot be stored so."""
        if rows % 2 or columns % 2:
            raise DatasetError(f"video of {rows} x {columns}: both must be even; store images instead (--images)")
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path, self.count = path, 0
        self.container = av.open(str(path), "w")
        options = {"g": str(KEY_FRAME_EVERY), "crf": str(CRF), "preset": "medium", "threads": "1"}
        self.stream: Any = self.container.add_stream("libx264", fps, options=options)
        self.stream.width, self.stream.height, self.stream.pix_fmt = columns, rows, "yuv420p"

    def add(self, images: np.ndarray) -> None:
        """[n, rows, columns, 3] u8."""
        for image in images:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
            self.container.mux(self.stream.encode(frame))
            self.count += 1

    def close(self) -> None:
        """Writes what is left."""
        self.container.mux(self.stream.encode())
        self.container.close()


class VideoReader:
    """Reads pictures of a file onwards; going back opens it again."""

    def __init__(self, path: Path, fps: int):
        self.path, self.fps, self.next = path, fps, 0
        self._open()

    def __enter__(self) -> VideoReader:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    def read(self, first: int, count: int) -> np.ndarray:
        """[count, rows, columns, 3] u8: pictures number `first` and on. Raises `DatasetError` where there are fewer."""
        if first < self.next:
            self.close()
            self._open()
        images = []
        try:
            for number, frame in self.frames:
                self.next = number + 1
                if number >= first:
                    images.append(frame.to_ndarray(format="rgb24"))
                if self.next >= first + count:
                    break
        except (av.FFmpegError, OSError) as error:
            raise DatasetError(f"{self.path}: damaged video ({error})") from None
        if len(images) != count:
            raise DatasetError(f"{self.path}: {len(images)} of {count} pictures from number {first} on")
        return np.stack(images)

    def close(self) -> None:
        """Closes the file."""
        self.container.close()

    def _open(self) -> None:
        try:
            self.container = av.open(str(self.path))
            stream = self.container.streams.video[0]
        except (av.FFmpegError, OSError, IndexError) as error:
            raise DatasetError(f"{self.path}: no video can be read ({error})") from None
        rate = stream.average_rate
        if rate is not None and abs(float(rate) - self.fps) > 0.01:
            raise DatasetError(f"{self.path}: {float(rate):g} pictures a second; expected {self.fps}")
        self.frames: Iterator[tuple[int, Any]] = iter(self._numbered(stream))
        self.next = 0

    def _numbered(self, stream: Any) -> Iterator[tuple[int, Any]]:
        start = stream.start_time or 0
        for frame in self.container.decode(stream):
            yield round(float((frame.pts - start) * stream.time_base) * self.fps), frame
