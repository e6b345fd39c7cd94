"""What travels between a robot and its controller."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum, IntFlag

import numpy as np


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


class Source(IntEnum):
    """Where an action came from."""

    POLICY = 0
    IMAGINED = 1
    FALLBACK = 2


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
    source: int = Source.POLICY
