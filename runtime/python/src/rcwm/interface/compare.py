"""Where two interfaces differ, in words."""

from __future__ import annotations

from collections.abc import Sequence

from .model import Action, Camera, Interface, State


def differences(wanted: Interface, has: Interface) -> list[str]:
    """A line for each thing in which `has` differs from `wanted`; masks and what `has` offers besides do not count.

    Empty: data or robots of one fit the other. Everything is compared by name; actions must be the same in all.
    """
    found = []
    if abs(wanted.rate_hz - has.rate_hz) > 1e-6 * wanted.rate_hz:
        found.append(f"rate: {wanted.rate_hz:g} Hz expected, {has.rate_hz:g} Hz found")
    for what, ours, theirs in (
        ("state", wanted.states, has.states),
        ("camera", wanted.cameras, has.cameras),
        ("action", wanted.actions, has.actions),
    ):
        by_name = {part.name: part for part in theirs}
        for part in ours:
            if part.name not in by_name:
                found.append(f"{what} {part.name}: missing; there is {', '.join(by_name) or 'none'}")
            else:
                found += [f"{what} {part.name}: {line}" for line in _parts(part, by_name[part.name])]
    ordered = [action.name for action in wanted.actions], [action.name for action in has.actions]
    if ordered[0] != ordered[1] and sorted(ordered[0]) == sorted(ordered[1]):
        found += [f"actions: {line}" for line in compare_names(*ordered)]
    own = {action.name for action in wanted.actions}
    found += [f"action {action.name}: not expected" for action in has.actions if action.name not in own]
    return found


def compare_names(wanted: Sequence[str], has: Sequence[str]) -> list[str]:
    """Which names are missing, unknown or in another order."""
    missing = [name for name in wanted if name not in has]
    unknown = [name for name in has if name not in wanted]
    found = [f"no {', '.join(missing)}"] if missing else []
    found += [f"unknown {', '.join(unknown)}"] if unknown else []
    if not found and list(wanted) != list(has):
        at = next((i for i, (a, b) in enumerate(zip(wanted, has, strict=False)) if a != b), min(len(wanted), len(has)))
        found.append(f"in another order from number {at + 1} on: {', '.join(wanted)} expected, {', '.join(has)} found")
    return found


def _parts(ours: State | Camera | Action, theirs: State | Camera | Action) -> list[str]:
    keys = [key for key in vars(ours) if key not in ("name", "elements", "mask")]
    found = []
    for key in keys:
        a, b = getattr(ours, key), getattr(theirs, key)
        if a != b:
            found.append(f"{key} {_label(a)} expected, {_label(b)} found")
    if not isinstance(ours, Camera) and not isinstance(theirs, Camera):
        found += compare_names(ours.elements, theirs.elements)
    return found


def _label(value: object) -> str:
    return ", ".join(map(str, value)) if isinstance(value, tuple) else str(value if value is not None else "none")
