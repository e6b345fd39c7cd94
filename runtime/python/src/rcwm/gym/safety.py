"""What a robot may execute: answers that are finite, within limits and no faster than `rate_max`; or what is safe."""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum

import numpy as np

from ..interface import Action, Interface

# What rounding to f32 may add to a limit.
ROUNDING = 1e-6


class Refused(Enum):
    """Why an answer is not executed."""

    NOT_FINITE = "not finite"
    OUT_OF_LIMITS = "out of limits"
    LENGTH = "of another length"


class Safety:
    """Holds what was executed last. All actions are [action numbers] f32 in the interface's units."""

    def __init__(self, robot: Interface):
        self.robot = robot
        self.low, self.high = robot.low, robot.high
        most = [np.inf if part.rate_max is None else part.rate_max for part in robot.actions for _ in part.elements]
        self.most = np.array(most, np.float32)
        # NaN where it is not known: a position that is not measured, before the first command.
        self.last = np.zeros(robot.action_numbers, np.float32)
        self.commanded = False

    def begin(self, state: np.ndarray) -> np.ndarray:
        """Begins an episode: what counts as executed before it.

        Zeros, or of an absolute action where its state is; all zeros where that is not measured, which says that
        nothing was executed.
        """
        self.commanded = False
        self.last = np.clip(np.zeros(self.robot.action_numbers, np.float32), self.low, self.high)
        for part, place in self._parts():
            if part.mode == "absolute":
                measured = self._measured(part.measured, state)
                self.last[place] = np.nan if measured is None else np.clip(measured, self.low[place], self.high[place])
        return np.zeros_like(self.last) if np.isnan(self.last).any() else self.last.copy()

    def accept(self, action: np.ndarray) -> np.ndarray | Refused:
        """What is executed of an answer: itself, with changes beyond `rate_max` cut off; or why nothing is."""
        values = np.asarray(action, np.float32).reshape(-1)
        if values.shape != self.low.shape:
            return Refused.LENGTH
        if not np.isfinite(values).all():
            return Refused.NOT_FINITE
        room = ROUNDING * (self.high - self.low)
        if (values < self.low - room).any() or (values > self.high + room).any():
            return Refused.OUT_OF_LIMITS
        values = np.clip(values, self.low, self.high)
        known = np.isfinite(self.last)
        nearest = np.clip(values, self.last - self.most, self.last + self.most)
        self.last, self.commanded = np.where(known, nearest, values).astype(np.float32), True
        return self.last

    def rest(self, state: np.ndarray) -> np.ndarray | None:
        """The interface's safe action for a measured state; None where it is to hold a command and there was none."""
        rest = np.zeros(self.robot.action_numbers, np.float32)
        for part, place in self._parts():
            if isinstance(part.fallback, tuple):
                rest[place] = part.fallback
            elif part.fallback == "hold-measured" or (part.fallback == "hold" and not self.commanded):
                measured = self._measured(part.measured, state)
                if measured is None:
                    return None
                rest[place] = measured
            elif part.fallback == "hold":
                rest[place] = self.last[place]
        self.last, self.commanded = np.clip(rest, self.low, self.high), True
        return self.last

    def _parts(self) -> Iterator[tuple[Action, slice]]:
        at = 0
        for part in self.robot.actions:
            yield part, slice(at, at + len(part.elements))
            at += len(part.elements)

    def _measured(self, name: str | None, state: np.ndarray) -> np.ndarray | None:
        at = 0
        for part in self.robot.states:
            if part.name == name:
                return state[at : at + len(part.elements)]
            at += len(part.elements)
        return None
