"""The robot's end of a link to a controller, as far as the loop needs it. `rcwm.link` is the one over shared memory."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntFlag
from typing import Protocol

import numpy as np

from .. import RcwmError


class Flags(IntFlag):
    """Facts about an observation, as bits on the wire."""

    FIRST = 1
    LAST = 2
    TERMINAL = 4
    SUCCESS = 8
    MASK_VALID = 16
    ACTION_HELD = 32
    REPEATED = 64
    PUSHED = 128


class PeerClosed(RcwmError):
    """The controller has said that it sends no further action: the robot must come to rest."""


@dataclass(frozen=True)
class Header:
    """What stands before an observation's numbers; times are CLOCK_MONOTONIC in ns, `period_ns` 0 in lock-step."""

    sequence: int
    episode: int
    step: int
    flags: Flags
    reward: float
    captured_ns: int
    scheduled_ns: int
    period_ns: int

    def with_flag(self, flag: Flags) -> Header:
        """The same with one flag more."""
        return replace(self, flags=self.flags | flag)


@dataclass(frozen=True)
class Answer:
    """A controller's answer to the observation of the sequence `answers`: [action numbers] f32, of any value."""

    answers: int
    action: np.ndarray


class Link(Protocol):
    """The robot's end. Observations go out, answers come in; the newest wins."""

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
