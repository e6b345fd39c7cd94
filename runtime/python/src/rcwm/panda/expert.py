"""A scripted expert that lifts the cube, and pushes that bring it off its course.

What it does depends on where hand and cube are, not on how long it has been at it, so that it goes on after a push:
above the cube it opens and turns the hand, then it lowers, closes and lifts it.
"""

from __future__ import annotations

import numpy as np

from .robot import PandaLift

# What an action of 1 moves (m) and turns (rad) the hand's target by.
METRES, RADIANS = 0.05, 0.5
OPEN, CLOSED = -1.0, 1.0
# Largest action of a calm movement, and its largest change from one step to the next; the gripper is switched at once.
ACTION_MAX, CHANGE_MAX = 0.7, 0.25
# How far off the cube's middle (m) and its sides (rad) the hand may be and still go down.
OFF_MAX, TURNED_MAX = 0.012, 0.15
# How high above the cube the hand waits until then, and how high the cube is lifted above where the table is (m).
ABOVE, LIFTED_TO = 0.07, 0.97
# How near (m) to the cube's middle the hand closes.
NEAR = 0.012


class Expert:
    """Gives actions for one robot; `begin` before each episode."""

    def __init__(self, robot: PandaLift):
        self.robot = robot
        self.last = np.zeros(7)

    def begin(self) -> None:
        """Forgets the last action."""
        self.last = np.zeros(7)

    def act(self) -> np.ndarray:
        """[7] f32 in [-1, 1] for the robot's present state."""
        place, axes = self.robot.hand
        cube, cube_axes = self.robot.cube
        turn = turn_to(axes, down_along(axes[:, 1], cube_axes))
        off = np.linalg.norm((cube - place)[:2])
        near = off < OFF_MAX and abs(cube[2] - place[2]) < NEAR
        grasped = near and self.robot.is_grasped
        target = cube.copy()
        if grasped:
            target, turn = np.array([place[0], place[1], LIFTED_TO]), np.zeros(3)
        elif off > OFF_MAX or np.linalg.norm(turn) > TURNED_MAX:
            target[2] += ABOVE
        action = np.concatenate([(target - place) / METRES, turn / RADIANS])
        action = np.clip(action, -ACTION_MAX, ACTION_MAX)
        action = self.last[:6] + np.clip(action - self.last[:6], -CHANGE_MAX, CHANGE_MAX)
        return self.executed(np.append(action, CLOSED if near else OPEN))

    def executed(self, action: np.ndarray) -> np.ndarray:
        """Notes what was executed, from which the next action goes on; returned as f32."""
        self.last = np.asarray(action, np.float64)
        return self.last.astype(np.float32)


class Pushes:
    """Now and then a movement at random for a few steps; the gripper stays as the expert has it.

    `chance` is that of a push beginning at a step; pushes are `STEPS` long.
    """

    STEPS = (3, 9)

    def __init__(self, random: np.random.Generator, chance: float):
        self.random, self.chance = random, chance
        self.left, self.movement = 0, np.zeros(6)

    def next(self, action: np.ndarray) -> np.ndarray | None:
        """The push in place of an expert's action, [7] f32, or None."""
        if self.left == 0:
            if self.random.random() >= self.chance:
                return None
            self.left = int(self.random.integers(*self.STEPS))
            direction = self.random.standard_normal(6) * (1, 1, 1, 0.3, 0.3, 0.6)
            self.movement = np.clip(direction / np.linalg.norm(direction[:3]) * self.random.uniform(0.4, 1), -1, 1)
        self.left -= 1
        return np.append(self.movement, action[6]).astype(np.float32)


def down_along(fingers: np.ndarray, cube_axes: np.ndarray) -> np.ndarray:
    """The axes, [3, 3], of a hand that points down and closes along the side of the cube that is next to `fingers`."""
    sides = [sign * side for side in cube_axes.T if abs(side[2]) < 0.7 for sign in (1, -1)]
    flat = max(sides, key=lambda side: side @ fingers) * (1, 1, 0)
    across, down = flat / np.linalg.norm(flat), np.array([0.0, 0.0, -1.0])
    return np.stack([np.cross(across, down), across, down], 1)


def turn_to(axes: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The turn from one to the other, [3]: an axis in the world's frame times an angle in rad."""
    turn = target @ axes.T
    angle = np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))
    axis = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
    length = np.linalg.norm(axis)
    return axis / length * angle if length > 1e-9 else np.zeros(3)
