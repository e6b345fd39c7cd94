"""The robot's end of a link to a controller, as far as the loop needs it. `rcwm.link` is the one over shared memory."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Protocol

import numpy as np

from ..messages import Answer, Header


class Link(Protocol):
    """The robot's end. Observations go out, answers come in; the newest wins."""

    @property
    def misfits(self) -> int:
        """Answers of another length than the interface's, which `wait_action` does not give."""

    def publish(
        self,
        header: Header,
        state: np.ndarray,
        executed: np.ndarray,
        images: Mapping[str, np.ndarray],
        masks: Mapping[str, np.ndarray],
    ) -> None:
        """Sends an observation: state [n] f32 and executed action [n] f32 in the interface's order and units; a picture
        [rows, columns, 3] u8 of each camera; a mask [rows, columns] u8, 255 where the robot is, of each that has one.
        """

    def wait_action(self, timeout_s: float) -> Answer | None:
        """The newest answer, or None when the time is up. What was published last is published again, with
        `Flags.REPEATED`, for a controller that connects meanwhile. Raises `PeerClosed` once when the controller leaves.
        """

    def close(self) -> None:
        """Tells the controller that no further observation will come."""


class Clock:
    """The time that the loop goes by; tests bring their own."""

    def now_ns(self) -> int:
        """CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def sleep_until(self, then_ns: int) -> None:
        """Returns at once where that is past."""
        left_ns = then_ns - self.now_ns()
        if left_ns > 0:
            time.sleep(left_ns / 1e9)
