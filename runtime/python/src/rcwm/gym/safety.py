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
    """Holds what was executed last. All actions are [action numbers] f32 in the interface's units.

    What is chosen by `accept` and `rest` counts only once it was `executed`.
    """

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
        # Limits come last: a robot may have been moved beyond them.
        inside: np.ndarray = np.clip(self._near(values), self.low, self.high)
        return inside

    def rest(self, state: np.ndarray) -> np.ndarray | None:
        """The interface's safe action for a measured state; None where it is to hold a command and there was none.

        A place to drive to is driven to no faster than `rate_max`; what holds a change or a velocity stands still.
        """
        rest = np.zeros(self.robot.action_numbers, np.float32)
        near = np.zeros(self.robot.action_numbers, bool)
        for part, place in self._parts():
            if isinstance(part.fallback, tuple):
                rest[place], near[place] = part.fallback, True
            elif part.fallback == "zero" or part.mode != "absolute":
                near[place] = True
            elif part.fallback == "hold-measured" or not self.commanded:
                measured = self._measured(part.measured, state)
                # What was executed last is the next best.
                known = measured is not None and np.isfinite(measured).all()
                if not known and not self.commanded:
                    return None
                rest[place] = measured if known else self.last[place]
            else:
                rest[place] = self.last[place]
        return np.clip(np.where(near, self._near(rest), rest), self.low, self.high).astype(np.float32)

    def executed(self, action: np.ndarray) -> None:
        """What was executed, for what comes next."""
        self.last, self.commanded = np.array(action, np.float32), True

    def still_moves(self, action: np.ndarray) -> bool:
        """Whether a robot that has executed this still moves by it: a change or a velocity on its way to rest."""
        for part, place in self._parts():
            safe = part.fallback if isinstance(part.fallback, tuple) else 0.0
            if part.mode != "absolute" and (action[place] != np.clip(safe, self.low[place], self.high[place])).any():
                return True
        return False

    def _near(self, wanted: np.ndarray) -> np.ndarray:
        """No farther from what was executed last than may be."""
        nearest = np.clip(wanted, self.last - self.most, self.last + self.most)
        return np.where(np.isfinite(self.last), nearest, wanted).astype(np.float32)

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
