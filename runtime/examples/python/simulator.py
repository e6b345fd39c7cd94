"""A robot or simulator of your own in Python: a hand that slides over a table towards a goal.

    rcwm-runtime run --bundle BUNDLE --instance mine &
    python simulator.py --instance mine --episodes 2

Replace `Table` by your robot: it must give an upright 64x64 RGB picture and accept four numbers in [-1, 1].
"""

import argparse
import ctypes
import json
import math
import random
import sys

from rcwm_link import FIRST, IMAGE_SIDE, LAST, OWN_TASK, SUCCESS, Observation, PeerClosed, SharedMemoryFull, SimulatorLink


class Table:
    """The hand moves with the first two action components; the reward is higher the nearer it is to the goal."""

    def __init__(self, generator: random.Random):
        self.hand = [0.5, 0.5]
        self.goal = [generator.uniform(0.1, 0.9), generator.uniform(0.1, 0.9)]

    def move(self, action) -> float:
        for axis in range(2):
            self.hand[axis] = min(1.0, max(0.0, self.hand[axis] + 0.02 * action[axis]))
        return -math.dist(self.hand, self.goal)

    def picture(self) -> bytes:
        image = bytearray(b"\xb4\x96\x78" * (IMAGE_SIDE * IMAGE_SIDE))
        for (x, y), colour in ((self.goal, b"\xc8\x20\x20"), (self.hand, b"\x20\x40\xc8")):
            column, row = int(x * (IMAGE_SIDE - 4)), int(y * (IMAGE_SIDE - 4))
            for line in range(row, row + 4):
                start = 3 * (line * IMAGE_SIDE + column)
                image[start : start + 12] = colour * 4
        return bytes(image)


def ask(link: SimulatorLink, observation: Observation, timeout_s: float):
    """The answer to an observation, of the next controller where one leaves; None when the time is up."""
    while True:
        try:
            return link.step(observation, timeout_s)
        except PeerClosed:
            # A robot that moves by itself comes to rest here: nobody steers it any more.
            print("the controller has closed: at rest until the next one answers", file=sys.stderr)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instance", required=True, help="the name given to the controller")
    parser.add_argument("--episodes", type=int, default=1)
    parser.add_argument("--steps", type=int, default=50, help="observations an episode")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timeout-s", type=float, default=60.0, help="give up after so long without an answer")
    parser.add_argument("--json", help="write the counts to this file")
    options = parser.parse_args()

    generator = random.Random(options.seed)
    try:
        link = SimulatorLink(options.instance)
    except SharedMemoryFull as error:
        raise SystemExit(str(error)) from None
    counts = {"observations": 0, "answers": 0, "total_reward": 0.0, "actions_refused": 0}
    try:
        for episode in range(options.episodes):
            table, action, reward = Table(generator), [0.0] * 4, 0.0
            for step in range(options.steps):
                observation = Observation(sequence=counts["observations"], episode=episode, step=step, task=OWN_TASK, reward=reward)
                observation.executed_action[:] = action
                near = math.dist(table.hand, table.goal) < 0.05
                observation.flags = (FIRST if step == 0 else 0) | (LAST if step == options.steps - 1 else 0) | (SUCCESS if near else 0)
                ctypes.memmove(observation.image, table.picture(), ctypes.sizeof(observation.image))
                counts["observations"] += 1
                answer = ask(link, observation, options.timeout_s)
                if answer is None:
                    raise SystemExit(
                        f"no answer on {options.instance!r} within {options.timeout_s} s ({link.refused} refused): is a controller running?"
                    )
                counts["answers"] += 1
                action = list(answer.action)
                reward = table.move(action)
                counts["total_reward"] += reward
            print(f"episode {episode}: {options.steps} observations answered")
    finally:
        link.close()
    counts["actions_refused"] = link.refused
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(counts, file)


if __name__ == "__main__":
    main()
