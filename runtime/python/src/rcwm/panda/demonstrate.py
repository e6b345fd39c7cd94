"""Records the expert's episodes, and measures the expert and the robot."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from .. import RcwmError
from ..cli import Progress, claim, write_json
from ..episode import Episode, EpisodeError, Recorder, read
from .expert import Expert, Pushes
from .robot import STREAM_PUSHES, PandaLift, random_stream

SETTINGS_FILE = "demonstrations.json"


@dataclass(frozen=True)
class Settings:
    """What the episodes of one folder have in common; `push` is the chance of a push beginning at a step."""

    seed: int
    layouts: str
    side: int
    cameras: tuple[str, ...]
    masks: bool
    horizon: int
    push: float

    def robot(self) -> PandaLift:
        """Makes the robot. Raises `RcwmError`."""
        return PandaLift(self.seed, self.layouts, self.side, self.cameras, self.masks, self.horizon)

    def path(self, folder: Path, layout: int) -> Path:
        """The file of a layout's episode."""
        return folder / f"{'pushed' if self.push else 'expert'}-seed{self.seed}-{layout:05}.npz"


def perform(robot: PandaLift, expert: Expert, layout: int, push: float) -> Episode:
    """One episode of the expert, pushed off course with the chance `push` at each step."""
    recorder = Recorder(robot.interface)
    pushes = Pushes(random_stream(robot.layouts, robot.seed, layout, STREAM_PUSHES), push)
    observation, _ = robot.reset(options={"layout": layout})
    recorder.begin(observation)
    expert.begin()
    over = False
    while not over:
        action = expert.act()
        pushed = pushes.next(action)
        if pushed is not None:
            action = expert.executed(pushed)
        observation, reward, _, over, info = robot.step(action)
        recorder.add(observation, action, reward, info["success"], pushed is not None)
    return recorder.finish()


def demonstrate(folder: Path, episodes: int, settings: Settings, json_file: Path | None = None) -> dict[str, Any]:
    """Records the layouts 0 to `episodes` - 1; those that are there are read and not done again. Raises `RcwmError`."""
    claim(folder, {**asdict(settings), "cameras": list(settings.cameras)}, SETTINGS_FILE)
    robot = settings.robot()
    expert = Expert(robot)
    progress = Progress(episodes, "episodes")
    steps = recorded = succeeded = 0
    seconds = 0.0
    try:
        for layout in range(episodes):
            path = settings.path(folder, layout)
            if path.exists():
                episode = _recorded(path, robot)
            else:
                begun = time.monotonic()
                episode = perform(robot, expert, layout, settings.push)
                seconds += time.monotonic() - begun
                episode.write(path)
                steps, recorded = steps + len(episode) - 1, recorded + 1
            succeeded += bool(episode.success.any())
            progress.add(f"success {succeeded}/{layout + 1}")
    finally:
        robot.close()
    result = {
        "episodes": episodes,
        "recorded": recorded,
        "successes": succeeded,
        "steps_per_second": steps / seconds if seconds else None,
        **asdict(settings),
    }
    write_json(json_file, result)
    return result


def measure(episodes: int, settings: Settings, plain: bool = False, json_file: Path | None = None) -> dict[str, Any]:
    """Success and speed without recording; `plain` draws as MuJoCo does by default. Raises `RcwmError`."""
    robot = PandaLift(
        settings.seed, settings.layouts, settings.side, settings.cameras, settings.masks, settings.horizon, plain
    )
    expert, progress = Expert(robot), Progress(episodes, "episodes")
    succeeded, solved_at, changes, rates = 0, [], [], []
    try:
        for layout in range(episodes):
            begun = time.monotonic()
            episode = perform(robot, expert, layout, settings.push)
            rates.append((len(episode) - 1) / (time.monotonic() - begun))
            succeeded += bool(episode.success.any())
            solved_at += [int(episode.success.argmax())] if episode.success.any() else []
            changes.append(np.abs(np.diff(episode.action[1:, :6], axis=0)).max())
            progress.add(f"success {succeeded}/{layout + 1}")
    finally:
        robot.close()
    result = {
        "episodes": episodes,
        "successes": succeeded,
        "solved_at_step_median": float(np.median(solved_at)) if solved_at else None,
        "solved_at_step_max": max(solved_at) if solved_at else None,
        "largest_change_of_an_action": float(max(changes)),
        "steps_per_second_median": float(np.median(rates)),
        "steps_per_second_max": float(max(rates)),
        "plain": plain,
        **asdict(settings),
    }
    write_json(json_file, result)
    return result


def _recorded(path: Path, robot: PandaLift) -> Episode:
    try:
        return read(path, robot.interface)
    except EpisodeError as error:
        raise RcwmError(f"{error}; remove the file to record it again") from None
