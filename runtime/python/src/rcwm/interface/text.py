"""Reads the text of an interface."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from ..errors import InterfaceError
from .checks import check
from .model import Action, Camera, Interface, State


def load(path: str | Path) -> Interface:
    """Reads a file. Raises `InterfaceError`, which names the file."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InterfaceError(f"interface {path}: cannot be read ({error}); give the path of a robot.toml") from None
    try:
        return parse(text)
    except InterfaceError as error:
        raise InterfaceError(f"{path}: {error}") from None


def parse(text: str) -> Interface:
    """Reads and checks a text; a bundle's `[policy]` beside it is not read. Raises `InterfaceError`."""
    try:
        file = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InterfaceError(f"no interface: {error}") from None
    _only("the file", file, ("interface", "policy"))
    table = file.get("interface")
    if not isinstance(table, dict):
        raise InterfaceError("no interface: the table [interface] is missing")
    _only("[interface]", table, ("name", "rate_hz", "state", "camera", "action"))
    interface = Interface(
        name=_text("[interface]", table, "name"),
        rate_hz=_number("[interface]", table, "rate_hz"),
        states=tuple(_state(entry) for entry in _tables(table, "state")),
        cameras=tuple(_camera(entry) for entry in _tables(table, "camera")),
        actions=tuple(_action(entry) for entry in _tables(table, "action")),
    )
    check(interface)
    return interface


def with_cameras(interface: Interface, cameras: Iterable[Camera]) -> Interface:
    """The same robot with other cameras. Raises `InterfaceError`."""
    changed = replace(interface, cameras=tuple(cameras))
    check(changed)
    return changed


def _only(place: str, table: Mapping[str, Any], known: Sequence[str]) -> None:
    for key in table:
        if key not in known:
            raise InterfaceError(f"interface: {place}: unknown key {key!r}; expected {', '.join(known)}")


def _tables(table: Mapping[str, Any], key: str) -> list[dict[str, Any]]:
    entries = table.get(key, [])
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise InterfaceError(f"interface: {key} must be written as [[interface.{key}]]")
    return entries


def _value(place: str, table: Mapping[str, Any], key: str) -> Any:
    if key not in table:
        raise InterfaceError(f"interface: {place}: {key} is missing")
    return table[key]


def _text(place: str, table: Mapping[str, Any], key: str) -> str:
    value = _value(place, table, key)
    if not isinstance(value, str):
        raise InterfaceError(f"interface: {place}: {key} = {value!r}; expected a text")
    return value


def _as_number(place: str, key: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise InterfaceError(f"interface: {place}: {key} = {value!r}; expected a number")
    return float(value)


def _number(place: str, table: Mapping[str, Any], key: str) -> float:
    return _as_number(place, key, _value(place, table, key))


def _sequence(place: str, table: Mapping[str, Any], key: str) -> list[Any]:
    value = _value(place, table, key)
    if not isinstance(value, list):
        raise InterfaceError(f"interface: {place}: {key} = {value!r}; expected a list")
    return value


def _numbers(place: str, table: Mapping[str, Any], key: str) -> tuple[float, ...]:
    return tuple(_as_number(place, key, value) for value in _sequence(place, table, key))


def _elements(place: str, table: Mapping[str, Any]) -> tuple[str, ...]:
    values = _sequence(place, table, "elements")
    if not all(isinstance(value, str) for value in values):
        raise InterfaceError(f"interface: {place}: elements = {values!r}; expected a list of names")
    return tuple(values)


def _state(table: dict[str, Any]) -> State:
    place = f"state {table.get('name', '?')}"
    _only(place, table, ("name", "kind", "elements", "unit"))
    text = {key: _text(place, table, key) for key in ("name", "kind", "unit")}
    return State(elements=_elements(place, table), **text)


def _camera(table: dict[str, Any]) -> Camera:
    place = f"camera {table.get('name', '?')}"
    _only(place, table, ("name", "shape", "encoding", "mask"))
    shape = _sequence(place, table, "shape")
    if len(shape) != 3 or not all(isinstance(side, int) for side in shape):
        raise InterfaceError(f"interface: {place}: shape = {shape!r}; expected [rows, columns, 3]")
    mask = _text(place, table, "mask") if "mask" in table else None
    text = {key: _text(place, table, key) for key in ("name", "encoding")}
    return Camera(shape=(shape[0], shape[1], shape[2]), mask=mask, **text)


def _action(table: dict[str, Any]) -> Action:
    place = f"action {table.get('name', '?')}"
    known = ("name", "kind", "mode", "elements", "unit", "low", "high", "rate_max", "fallback", "measured")
    _only(place, table, known)
    safe = _value(place, table, "fallback")
    return Action(
        **{key: _text(place, table, key) for key in ("name", "kind", "mode", "unit")},
        elements=_elements(place, table),
        low=_numbers(place, table, "low"),
        high=_numbers(place, table, "high"),
        fallback=safe if isinstance(safe, str) else _numbers(place, table, "fallback"),
        rate_max=_number(place, table, "rate_max") if "rate_max" in table else None,
        measured=_text(place, table, "measured") if "measured" in table else None,
    )
