"""A robot of your own: a hand that slides over a table towards a goal, at 20 Hz.

    rcwm-runtime run --bundle BUNDLE --instance mine &
    python robot.py --instance mine --realtime

Replace `Table` by your robot, and table.toml by what it measures, sees and executes.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from rcwm import interface
from rcwm.cli import run
from rcwm.gym import serve


class Table:
    """The calls of a Gymnasium environment: `reset` and `step`."""

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.random = np.random.default_rng(seed)
        self.hand, self.goal, self.steps = np.array([0.5, 0.5]), self.random.uniform(0.1, 0.9, 2), 0
        return self.observe(), {}

    def step(self, action):
        self.hand = np.clip(self.hand + 0.05 * action, 0, 1)
        self.steps += 1
        distance = float(np.linalg.norm(self.hand - self.goal))
        return self.observe(), -distance, False, self.steps >= 50, {"success": distance < 0.05}

    def observe(self):
        picture = np.full((64, 64, 3), 150, np.uint8)
        for place, colour in ((self.goal, (200, 32, 32)), (self.hand, (32, 64, 200))):
            column, row = (place * 60).astype(int)
            picture[row : row + 4, column : column + 4] = colour
        return {"top": picture, "hand_pos": self.hand}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instance", required=True, help="the name given to the controller")
    parser.add_argument("--episodes", type=int, default=2)
    parser.add_argument("--realtime", action="store_true", help="at 20 Hz; without it the robot waits for every answer")
    parser.add_argument("--timeout-s", type=float, default=60.0, help="give up after so long without an answer")
    options = parser.parse_args()
    robot = interface.load(Path(__file__).with_name("table.toml"))
    counts = serve(Table(), robot, options.instance, episodes=options.episodes, realtime=options.realtime,
                   timeout_s=options.timeout_s, seed=0)  # fmt: skip
    print(json.dumps(counts.as_dict(), indent=1))


if __name__ == "__main__":
    run(main)
