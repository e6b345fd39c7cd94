"""Which of a dataset's columns is which number and which camera of the robot: by name, never by place."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..interface import Action, Interface, State
from .form import ACTION, IMAGES, DatasetError

# Names that one line of an error shows.
NAMES_SHOWN_MAX = 8
Features = Mapping[str, dict[str, Any]]


@dataclass(frozen=True)
class Columns:
    """The feature of each camera, by the robot's name; feature and place of each number, in the robot's order."""

    cameras: dict[str, str]
    states: list[tuple[str, int]]
    actions: list[tuple[str, int]]


def find(features: Features, robot: Interface, renamed: Mapping[str, str]) -> Columns:
    """Finds everything the robot has. `renamed` says what names of the dataset (features, elements) are called by the
    robot. Raises `DatasetError`, which says what is missing and what there is.
    """
    elements = {name for key, entry in features.items() for name in _names(key, entry) or ()}
    for name in renamed:
        if name not in features and name not in elements:
            raise DatasetError(
                f"--map {name}=...: the dataset has no such feature or element; it has {_offer(features)}"
            )
    ours = {camera.name for camera in robot.cameras} | {state.name for state in robot.states}
    ours |= {action.name for action in robot.actions} | set(robot.state_names) | set(robot.action_names)
    ours |= {name.rpartition(".")[2] for name in (*robot.state_names, *robot.action_names)}
    for theirs, name in renamed.items():
        if name not in ours:
            raise DatasetError(f"--map {theirs}={name}: the robot has no {name}; see its interface")
    observed = [key for key in features if key.startswith("observation.") and not _is_camera(features[key])]
    states = [_group(state, "state", observed, features, robot.states, renamed) for state in robot.states]
    actions = [_group(action, "action", [ACTION], features, robot.actions, renamed) for action in robot.actions]
    return Columns(
        cameras={camera.name: _camera(camera.name, camera.shape, features, renamed) for camera in robot.cameras},
        states=[place for group in states for place in group],
        actions=[place for group in actions for place in group],
    )


def _offer(features: Features) -> str:
    return ", ".join(key for key in features if key.startswith(("observation.", ACTION)))


def _some(names: list[str]) -> str:
    more = len(names) - NAMES_SHOWN_MAX
    return ", ".join(names[:NAMES_SHOWN_MAX]) + (f" and {more} more" if more > 0 else "")


def _is_camera(entry: Mapping[str, Any]) -> bool:
    return entry.get("dtype") in ("video", "image")


def _camera(name: str, shape: tuple[int, int, int], features: Features, renamed: Mapping[str, str]) -> str:
    cameras = [key for key, entry in features.items() if _is_camera(entry)]
    found = [key for key in cameras if renamed.get(key, key.removeprefix(IMAGES)) == name]
    if len(found) != 1:
        what = "no" if not found else "more than one"
        offer = ", ".join(cameras) or "none"
        raise DatasetError(f"camera {name}: {what} camera of that name; there is {offer} (--map THEIRS={name})")
    entry = features[found[0]]
    stored = [int(side) for side in entry["shape"]]
    if (entry.get("names") or [""])[0] in ("channels", "channel", "c"):
        stored = [*stored[1:], stored[0]]
    if stored != list(shape):
        raise DatasetError(f"camera {name}: {found[0]} has pictures of {stored}; the robot's are {list(shape)}")
    return found[0]


def _group(
    part: State | Action,
    what: str,
    keys: list[str],
    features: Features,
    parts: tuple[State, ...] | tuple[Action, ...],
    renamed: Mapping[str, str],
) -> list[tuple[str, int]]:
    """Feature and place of each element of a state or an action."""
    own = [key for key in keys if key in features and renamed.get(key, key.removeprefix("observation.")) == part.name]
    for key in own:
        names = _names(key, features[key])
        if names is None and len(part.elements) == int(features[key]["shape"][0]):
            return [(key, place) for place in range(len(part.elements))]  # named as a whole
    wanted = own or [key for key in keys if key in features]
    named = [
        (key, place, renamed.get(n, n)) for key in wanted for place, n in enumerate(_names(key, features[key]) or ())
    ]
    found = []
    for element in part.elements:
        once = sum(element in other.elements for other in parts) == 1 or bool(own)
        accepted = (f"{part.name}.{element}", *((element, f"{element}.pos") if once else ()))
        places = [(key, place) for key, place, name in named if name in accepted]
        if len(places) != 1:
            how = "no" if not places else "more than one"
            offer = _some([name for _, _, name in named]) or "none with names"
            hint = f"--map THEIRS={part.name}.{element}"
            raise DatasetError(f"{what} {part.name}: {how} number {element}; there is {offer} ({hint})")
        found += places
    return found


def _names(key: str, entry: Mapping[str, Any]) -> list[str] | None:
    """Names of a vector's numbers, or None. Datasets write a list, or a table of lists or of places."""
    names = entry.get("names")
    if _is_camera(entry) or not names or len(entry.get("shape", ())) != 1:
        return None
    if isinstance(names, dict):
        values = list(names.values())
        flat = [name for value in values for name in value] if all(isinstance(v, list) for v in values) else list(names)
    else:
        flat = list(names)
    if len(flat) != int(entry["shape"][0]) or not all(isinstance(name, str) for name in flat):
        raise DatasetError(f"feature {key}: {len(flat)} names for {entry['shape'][0]} numbers; the dataset is damaged")
    return flat
