"""Room in shared memory: asked for before, and taken for good as soon as files are there.

iceoryx2 maps files of which no byte is there yet: where `/dev/shm` is full, the first write to such a page ends the
process.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .. import RcwmError

SHARED_MEMORY = Path("/dev/shm")
# Payloads that a publisher keeps room for, and some more; and the bytes of everything else.
PAYLOADS, OVERHEAD_BYTES = 28, 64 << 10


class SharedMemoryFull(RcwmError):
    """No room in `/dev/shm`."""


@contextmanager
def reserved(prefix: str, message_bytes: int) -> Iterator[None]:
    """Ports made meanwhile, with messages of so many bytes, have their room for good. Raises `SharedMemoryFull`."""
    _check(PAYLOADS * message_bytes + OVERHEAD_BYTES)
    before = _files(prefix)
    yield
    for path in _files(prefix) - before:
        _take(path)


def _check(needed: int) -> None:
    try:
        found = os.statvfs(SHARED_MEMORY)
    except OSError:  # where it cannot be told there may be room
        return
    if found.f_bavail * found.f_frsize < needed:
        raise _full(needed)


def _full(needed: int) -> SharedMemoryFull:
    found = os.statvfs(SHARED_MEMORY)
    free = found.f_bavail * found.f_frsize
    return SharedMemoryFull(
        f"shared memory is full: {SHARED_MEMORY} has {free >> 10} KiB free and {-(-needed >> 10)} are needed; remove "
        "files there, or give the container more (--shm-size)"
    )


def _files(prefix: str) -> set[str]:
    found: set[str] = set()
    try:
        entries = list(os.scandir(SHARED_MEMORY))
    except OSError:
        return found
    for entry in entries:
        try:
            status = entry.stat(follow_symlinks=False)
        except OSError:  # a peer has just removed its own
            continue
        if entry.name.startswith(prefix) and stat.S_ISREG(status.st_mode) and status.st_uid == os.geteuid():
            found.add(entry.path)
    return found


def _take(path: str) -> None:
    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError:  # a peer has removed its own
        return
    try:
        size = os.fstat(descriptor).st_size
        if size:
            os.posix_fallocate(descriptor, 0, size)
    except OSError as error:
        if error.errno == errno.ENOSPC:
            raise _full(size) from None
    finally:
        os.close(descriptor)
