"""The parts of an interface, its one text and its hash."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..errors import InterfaceError

GROUPS_MAX, ELEMENTS_MAX, SIDE_MAX, NAME_MAX = 64, 1024, 4096, 64
ACTION_NUMBERS_MAX, CAMERAS_MAX, OBSERVATION_BYTES_MAX = 64, 8, 256 << 20
MODES = ("absolute", "delta", "velocity")
RULES = ("hold", "hold-measured", "zero")


@dataclass(frozen=True)
class State:
    """A measured vector of f32."""

    name: str
    kind: str
    elements: tuple[str, ...]
    unit: str


@dataclass(frozen=True)
class Camera:
    """Pictures of rows x columns x 3 bytes, RGB; `mask` is `"robot"` where a mask of the robot travels beside them."""

    name: str
    shape: tuple[int, int, int]
    encoding: str = "rgb8"
    mask: str | None = None


@dataclass(frozen=True)
class Action:
    """A commanded vector of f32, `low` to `high` in `unit`."""

    name: str
    kind: str
    mode: str
    elements: tuple[str, ...]
    unit: str
    low: tuple[float, ...]
    high: tuple[float, ...]
    fallback: str | tuple[float, ...]
    rate_max: float | None = None
    measured: str | None = None


@dataclass(frozen=True)
class Interface:
    """Everything that goes between a robot and its controller; the orders are those of the wire."""

    name: str
    rate_hz: float
    states: tuple[State, ...]
    cameras: tuple[Camera, ...]
    actions: tuple[Action, ...]

    def canonical(self) -> str:
        """The text in its one form; `parse` reads it again."""
        lines = ["[interface]", f"name = {_quoted(self.name)}", f"rate_hz = {_decimal(self.rate_hz)}"]
        for state in self.states:
            lines += ["", "[[interface.state]]", f"name = {_quoted(state.name)}", f"kind = {_quoted(state.kind)}"]
            lines += [f"elements = {_list(state.elements, _quoted)}", f"unit = {_quoted(state.unit)}"]
        for camera in self.cameras:
            lines += ["", "[[interface.camera]]", f"name = {_quoted(camera.name)}"]
            lines += [f"shape = {_list(camera.shape, str)}", f"encoding = {_quoted(camera.encoding)}"]
            lines += [f"mask = {_quoted(camera.mask)}"] if camera.mask else []
        for action in self.actions:
            lines += ["", "[[interface.action]]", f"name = {_quoted(action.name)}", f"kind = {_quoted(action.kind)}"]
            lines += [f"mode = {_quoted(action.mode)}", f"elements = {_list(action.elements, _quoted)}"]
            lines += [f"unit = {_quoted(action.unit)}"]
            lines += [f"low = {_list(action.low, _decimal)}", f"high = {_list(action.high, _decimal)}"]
            lines += [f"rate_max = {_decimal(action.rate_max)}"] if action.rate_max is not None else []
            safe = action.fallback
            lines += [f"fallback = {_quoted(safe) if isinstance(safe, str) else _list(safe, _decimal)}"]
            lines += [f"measured = {_quoted(action.measured)}"] if action.measured else []
        return "\n".join(lines) + "\n"

    @property
    def hash(self) -> str:
        """The canonical text's SHA-256, in hexadecimal digits."""
        return hashlib.sha256(self.canonical().encode()).hexdigest()

    @property
    def state_numbers(self) -> int:
        """Numbers of all states together."""
        return sum(len(state.elements) for state in self.states)

    @property
    def action_numbers(self) -> int:
        """Numbers of all actions together."""
        return sum(len(action.elements) for action in self.actions)

    @property
    def state_names(self) -> list[str]:
        """`state.element` of every measured number, in the order of the wire."""
        return [f"{state.name}.{element}" for state in self.states for element in state.elements]

    @property
    def action_names(self) -> list[str]:
        """`action.element` of every commanded number, in the order of the wire."""
        return [f"{action.name}.{element}" for action in self.actions for element in action.elements]

    @property
    def low(self) -> np.ndarray:
        """[action numbers] f32: the smallest value of each, in its unit."""
        return np.array([x for action in self.actions for x in action.low], np.float32)

    @property
    def high(self) -> np.ndarray:
        """[action numbers] f32: the largest value of each, in its unit."""
        return np.array([x for action in self.actions for x in action.high], np.float32)

    def pack(self, values: Mapping[str, np.ndarray]) -> np.ndarray:
        """[state numbers] f32, all states in order. Raises `InterfaceError` where one is missing or too long."""
        parts = []
        for state in self.states:
            if state.name not in values:
                raise InterfaceError(f"state {state.name} is missing; there are {', '.join(values) or 'none'}")
            part = np.asarray(values[state.name], np.float32).reshape(-1)
            if len(part) != len(state.elements):
                raise InterfaceError(f"state {state.name} has {len(part)} numbers; expected {len(state.elements)}")
            parts.append(part)
        return np.concatenate(parts) if parts else np.zeros(0, np.float32)


def _quoted(text: str) -> str:
    return f'"{text}"'


def _decimal(x: float) -> str:
    """As Rust writes it: the shortest decimal number that reads as the same one; -0 is 0."""
    if not math.isfinite(x):
        return str(x)
    return re.sub(r"e([+-]?)0*(\d)", lambda m: f"e{m[1].strip('+')}{m[2]}", repr(x + 0.0)).replace(".0e", "e")


def _list(values: Sequence[Any], text: Callable[[Any], str]) -> str:
    return f"[{', '.join(text(value) for value in values)}]"
