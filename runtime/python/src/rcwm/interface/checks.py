"""What makes an interface one that a robot can be run by; the same rules as the Rust programs'."""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import NoReturn

import numpy as np

from ..errors import InterfaceError
from .model import (
    ACTION_NUMBERS_MAX,
    CAMERAS_MAX,
    ELEMENTS_MAX,
    GROUPS_MAX,
    MODES,
    NAME_MAX,
    OBSERVATION_BYTES_MAX,
    RULES,
    SIDE_MAX,
    Action,
    Interface,
)


def _refuse(place: str, found: str, expected: str) -> NoReturn:
    raise InterfaceError(f"interface: {place}: {found}; expected {expected}")


def check(interface: Interface) -> None:
    """Raises `InterfaceError`, which names the place."""
    _name("name", interface.name)
    if not 0.001 <= interface.rate_hz <= 10_000:
        _refuse(interface.name, f"rate_hz = {interface.rate_hz}", "decisions a second, from 0.001 to 10000")
    groups = len(interface.states) + len(interface.cameras) + len(interface.actions)
    if groups > GROUPS_MAX:
        _refuse(interface.name, f"{groups} states, cameras and actions", f"at most {GROUPS_MAX}")
    if len(interface.cameras) > CAMERAS_MAX:
        _refuse(interface.name, f"{len(interface.cameras)} cameras", f"at most {CAMERAS_MAX}")
    numbers = sum(len(action.elements) for action in interface.actions)
    if numbers > ACTION_NUMBERS_MAX:
        _refuse(interface.name, f"{numbers} numbers of all actions together", f"at most {ACTION_NUMBERS_MAX}")
    if not interface.actions:
        _refuse(interface.name, "no [[interface.action]]", "at least one: what the controller commands")
    inputs = [state.name for state in interface.states] + [camera.name for camera in interface.cameras]
    _unique("states and cameras", inputs)
    _unique("actions", [action.name for action in interface.actions])
    for state in interface.states:
        _name("state", state.name)
        _group(f"state {state.name}", state.kind, "state/", state.unit, state.elements)
    for camera in interface.cameras:
        _name("camera", camera.name)
        place = f"camera {camera.name}"
        rows, columns, channels = camera.shape
        if not (1 <= rows <= SIDE_MAX and 1 <= columns <= SIDE_MAX and channels == 3):
            _refuse(place, f"shape = {list(camera.shape)}", f"[rows, columns, 3] with sides of 1 to {SIDE_MAX}")
        if camera.encoding != "rgb8":
            _refuse(place, f"encoding = {camera.encoding!r}", "rgb8")
        if camera.mask not in (None, "robot"):
            _refuse(place, f"mask = {camera.mask!r}", "robot, or none")
    for action in interface.actions:
        _action(action, interface)
    pixels = sum(camera.shape[0] * camera.shape[1] * (4 if camera.mask else 3) for camera in interface.cameras)
    if pixels > OBSERVATION_BYTES_MAX:
        _refuse(interface.name, f"pictures of {pixels} bytes", f"at most {OBSERVATION_BYTES_MAX}")


def _action(action: Action, interface: Interface) -> None:
    _name("action", action.name)
    place, count = f"action {action.name}", len(action.elements)
    if "discrete" in action.kind.split("/"):
        _refuse(place, f"kind = {action.kind!r}", "a continuous action")
    _group(place, action.kind, "command/", action.unit, action.elements)
    if action.mode not in MODES:
        _refuse(place, f"mode = {action.mode!r}", ", ".join(MODES))
    numbers = [("low", action.low), ("high", action.high)]
    if not isinstance(action.fallback, str):
        numbers.append(("fallback", action.fallback))
    for key, values in numbers:
        if len(values) != count:
            _refuse(place, f"{len(values)} numbers in {key}", f"{count}, one for each element")
        if not np.isfinite(_f32(values)).all():
            _refuse(place, f"{key} = {list(values)}", "finite numbers")
    for low, high, element in zip(action.low, action.high, action.elements, strict=True):
        if _f32([low])[0] >= _f32([high])[0]:
            _refuse(place, f"{element} from {low} to {high}", "low below high")
    if action.rate_max is not None and not 0 < _f32([action.rate_max])[0] < np.inf:
        expected = "a change above 0 from one decision to the next, or none"
        _refuse(place, f"rate_max = {action.rate_max}", expected)
    _fallback(place, action)
    if action.measured is not None:
        _measured(place, action, interface)


def _fallback(place: str, action: Action) -> None:
    safe = action.fallback
    if not isinstance(safe, str):
        for value, low, high, element in zip(safe, action.low, action.high, action.elements, strict=True):
            if not low <= value <= high:
                _refuse(place, f"fallback of {element} is {value}", f"a number within its limits, {low} to {high}")
        return
    if safe not in RULES:
        _refuse(place, f"fallback = {safe!r}", f"{', '.join(RULES)} or a list of numbers")
    absolute = action.mode == "absolute"
    if safe == "zero" and absolute:
        _refuse(place, 'fallback = "zero" of a command that is absolute', "hold, hold-measured or numbers")
    if safe == "zero" and (max(action.low) > 0 or min(action.high) < 0):
        _refuse(place, 'fallback = "zero" beyond the limits', "limits on both sides of 0, or numbers")
    if safe == "hold-measured" and not absolute:
        _refuse(place, f'fallback = "hold-measured" of a command that is a {action.mode}', "zero")
    if safe == "hold-measured" and action.measured is None:
        _refuse(place, 'fallback = "hold-measured" without measured', "measured = the name of a state")


def _measured(place: str, action: Action, interface: Interface) -> None:
    state = next((state for state in interface.states if state.name == action.measured), None)
    if state is None:
        _refuse(place, f"measured = {action.measured!r}", "the name of a state")
    if state.elements != action.elements:
        _refuse(place, f"measured {state.name} has other elements", "the action's own elements, in their order")
    if state.kind.partition("/")[2] != action.kind.partition("/")[2]:
        _refuse(place, f"measured {state.name} is a {state.kind}", f"the same kind as the action's {action.kind}")
    if state.unit != action.unit:
        _refuse(place, f"measured {state.name} is in {state.unit}", f"the action's unit, {action.unit}")


def _f32(values: Iterable[float]) -> np.ndarray:
    with np.errstate(over="ignore"):
        return np.array(list(values), np.float64).astype(np.float32)


def _group(place: str, kind: str, begin: str, unit: str, elements: tuple[str, ...]) -> None:
    words = kind[len(begin) :].split("/") if kind.startswith(begin) else [""]
    if len(kind) > NAME_MAX or not all(_word(word, "_-") for word in words):
        _refuse(place, f"kind = {kind!r}", f"words after {begin!r}, for example {begin}joint/position")
    if not _word(unit, "/^%.*-"):
        _refuse(place, f"unit = {unit!r}", "for example rad, m/s or N; 1 for what has none")
    if not 1 <= len(elements) <= ELEMENTS_MAX:
        _refuse(place, f"{len(elements)} elements", f"1 to {ELEMENTS_MAX}")
    for element in elements:
        _name(place, element)
    _unique(f"elements of {place}", elements)


def _name(place: str, name: str) -> None:
    if not _word(name, "_.-"):
        _refuse(place, f"the name {name!r}", f"1 to {NAME_MAX} letters, digits, '_', '-' or '.'")


def _word(text: str, also: str) -> bool:
    return len(text) <= NAME_MAX and re.fullmatch(f"[A-Za-z0-9{re.escape(also)}]+", text) is not None


def _unique(place: str, names: Iterable[str]) -> None:
    seen = set()
    for name in names:
        if name in seen:
            _refuse(place, f"{name!r} twice", "every name once")
        seen.add(name)
