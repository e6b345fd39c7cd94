"""What the package's command lines share: one line for an error, progress, results as JSON."""

from __future__ import annotations

import argparse
import json
import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from . import RcwmError


class Parser(argparse.ArgumentParser):
    """Shows examples as they are written, and bad options in one line."""

    def __init__(self, **options: Any):
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, allow_abbrev=False, **options)

    def error(self, message: str) -> Any:
        """Ends with one line and status 2."""
        self.exit(2, f"{self.prog}: {message}; {self.prog} --help shows examples\n")


def run(main: Callable[[], None]) -> None:
    """Runs a program: what a user can put right is one line and status 1; Ctrl-C and a closed pipe end it cleanly."""
    # A stop by a service manager, or a connection that ends, ends a program as Ctrl-C does: the peer is told.
    # A shell's background jobs have Ctrl-C ignored, but may be sent it by name; what nohup ignores stays so.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)
    try:
        main()
        sys.stdout.flush()
    except RcwmError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit(130)
    except BrokenPipeError:
        # What is still in the buffer has nowhere to go.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)


def write_json(path: Path | None, result: dict[str, Any]) -> None:
    """Writes a result whole or not at all, before anything is printed. Raises `RcwmError`."""
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_name(f".{path.name}.new")
        beside.write_text(json.dumps(result, indent=2) + "\n", encoding="utf-8")
        beside.replace(path)
    except OSError as error:
        raise RcwmError(f"{path}: cannot be written ({error})") from None


def claim(folder: Path, settings: dict[str, Any], name: str) -> None:
    """Makes a folder one of episodes of these settings, which `name` in it says.

    Raises `RcwmError` for one that holds others: they would be taken for those that were asked for.
    """
    path = folder / name
    if path.exists():
        try:
            before = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise RcwmError(f"{path}: cannot be read ({error}); remove the folder or choose another --out") from None
        differ = [key for key in settings if not isinstance(before, dict) or before.get(key) != settings[key]]
        if differ:
            raise RcwmError(f"{folder}: holds episodes of another {', '.join(differ)}; choose another --out")
        return
    if folder.exists() and (not folder.is_dir() or any(folder.glob("*.npz"))):
        raise RcwmError(f"{folder}: is no folder of ours ({name} is missing); choose another --out")
    write_json(path, settings)


def check_writable(path: Path | None) -> None:
    """Raises `RcwmError` where a result could not be written; before the work, not after it."""
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        beside = path.with_name(f".{path.name}.new")
        beside.touch()
        beside.unlink()
    except OSError as error:
        raise RcwmError(f"{path}: cannot be written ({error})") from None
    if path.is_dir():
        raise RcwmError(f"{path}: is a folder; expected a file")


def count(text: str) -> int:
    """A number of things, at least 1, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: expected at least 1")
    return value


class Progress:
    """A line on stderr with rate and time left: twice a second on a terminal, every ten seconds elsewhere."""

    def __init__(self, total: int, unit: str):
        self.total, self.unit, self.done = total, unit, 0
        self.begun = self.shown = time.monotonic()
        self.live = sys.stderr.isatty()

    def add(self, text: str = "") -> None:
        """One more is done."""
        self.done += 1
        now = time.monotonic()
        last = self.done == self.total
        if now - self.shown < (0.5 if self.live else 10.0) and not last:
            return
        self.shown = now
        rate = self.done / max(now - self.begun, 1e-9)
        left = (self.total - self.done) / rate
        line = f"{self.done}/{self.total} {self.unit}  {rate:.2f}/s  {_clock(left)} left  {text}".rstrip()
        print(f"\r{line}\x1b[K" if self.live else line, end="\n" if last or not self.live else "", file=sys.stderr)


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02}"
