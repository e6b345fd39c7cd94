"""A robot or simulator with a loop of its own: a hand that slides over a table towards a goal.

    rcwm-runtime run --bundle models/bundles/untrained --instance mine &
    python simulator.py --instance mine --episodes 2

Replace `Table` by your robot, and the interface by its own. `robot.py` leaves the loop to `rcwm.gym.serve`.
"""

import argparse
import json
import math
import random
import sys
from pathlib import Path

import numpy as np

from rcwm import RcwmError, interface
from rcwm.link import Flags, Header, PeerClosed, RobotLink

METAWORLD = Path(__file__).parents[3] / "models/src/interface/metaworld.toml"


class Table:
    """The hand moves with the first two action components; the reward is higher the nearer it is to the goal."""

    def __init__(self, generator: random.Random):
        self.hand = [0.5, 0.5]
        self.goal = [generator.uniform(0.1, 0.9), generator.uniform(0.1, 0.9)]

    def move(self, action: np.ndarray) -> float:
        for axis in range(2):
            self.hand[axis] = min(1.0, max(0.0, self.hand[axis] + 0.02 * float(action[axis])))
        return -math.dist(self.hand, self.goal)

    def picture(self) -> np.ndarray:
        image = np.full((64, 64, 3), (180, 150, 120), np.uint8)
        for (x, y), colour in ((self.goal, (200, 32, 32)), (self.hand, (32, 64, 200))):
            column, row = int(x * 60), int(y * 60)
            image[row : row + 4, column : column + 4] = colour
        return image


def ask(link: RobotLink, sequence: int, counts: dict, timeout_s: float) -> np.ndarray:
    """The answer to an observation that can be executed, of the next controller where one leaves."""
    low, high = link.robot.low, link.robot.high
    while True:
        try:
            answer = link.wait_action(timeout_s)
        except PeerClosed:
            # A robot that moves by itself comes to rest here: nobody steers it any more.
            print("the controller has closed: at rest until the next one answers", file=sys.stderr)
            continue
        if answer is None:
            refused = counts["actions_refused"]
            raise RcwmError(f"no answer within {timeout_s} s ({refused} refused): is a controller running?")
        if answer.answers != sequence:
            continue
        # NaN is within nothing.
        if ((low <= answer.action) & (answer.action <= high)).all():
            counts["answers"] += 1
            return answer.action
        counts["actions_refused"] += 1


def serve(link: RobotLink, options: argparse.Namespace) -> dict:
    generator = random.Random(options.seed)
    state = np.zeros(link.robot.state_numbers)
    counts = {"observations": 0, "answers": 0, "total_reward": 0.0, "actions_refused": 0}
    for episode in range(options.episodes):
        table, action, reward = Table(generator), np.zeros(link.robot.action_numbers), 0.0
        for step in range(options.steps):
            flags = Flags.SUCCESS if math.dist(table.hand, table.goal) < 0.05 else Flags(0)
            flags |= Flags.FIRST if step == 0 else Flags(0)
            flags |= Flags.LAST if step == options.steps - 1 else Flags(0)
            sequence = counts["observations"]
            header = Header(sequence, episode, step, flags, reward, captured_ns=0, scheduled_ns=0, period_ns=0)
            link.publish(header, state, action, {"image": table.picture()}, {})
            counts["observations"] += 1
            action = ask(link, sequence, counts, options.timeout_s)
            reward = table.move(action)
            counts["total_reward"] += reward
        print(f"episode {episode}: {options.steps} observations answered")
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instance", required=True, help="the name given to the controller")
    parser.add_argument("--episodes", type=int, default=1)
    parser.add_argument("--steps", type=int, default=50, help="observations an episode")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timeout-s", type=float, default=60.0, help="give up after so long without an answer")
    parser.add_argument("--json", type=Path, help="write the counts to this file")
    options = parser.parse_args()
    try:
        with RobotLink(interface.load(METAWORLD), options.instance) as link:
            counts = serve(link, options)
    except RcwmError as error:
        raise SystemExit(str(error)) from None
    if options.json:
        options.json.write_text(json.dumps(counts))


if __name__ == "__main__":
    main()
