"""A controller of your own: here random, on any robot or simulator.

    rcwm-simulator serve --task reach --instance demo --episodes 2 &
    python controller.py --instance demo

Replace `decide` by your own policy. One of the project's bundles in a program of your own: `policy.py`.
"""

import argparse
import json
import random
from pathlib import Path

import numpy as np

from rcwm import RcwmError
from rcwm.interface import Interface
from rcwm.link import ControllerLink, Flags, Observation, PeerClosed


def decide(observation: Observation, robot: Interface, generator: random.Random) -> np.ndarray:
    """An action in units. `observation["image"]` is a camera's picture, `observation.state` what is measured."""
    return np.array([generator.uniform(low, high) for low, high in zip(robot.low, robot.high, strict=True)])


def control(link: ControllerLink, options: argparse.Namespace) -> dict:
    generator = random.Random(options.seed)
    counts = {"observations": 0, "episodes": 0, "repeated": 0, "gaps": 0, "total_reward": 0.0, "success": False}
    robot = link.wait_robot(options.timeout_s)
    last_sequence, action = None, None
    while True:
        try:
            observation = link.observe(options.timeout_s) if robot else None
        except PeerClosed:
            return counts
        if robot is None or observation is None:
            raise RcwmError(f"no observation within {options.timeout_s} s: is a simulator running?")
        if observation.sequence == last_sequence and action is not None:
            # Seen before: the answer was lost on the way, so it is given again, not decided anew.
            counts["repeated"] += 1
            link.act(observation.sequence, action)
            continue
        if last_sequence is not None and observation.sequence != last_sequence + 1:
            counts["gaps"] += 1
        last_sequence = observation.sequence
        counts["observations"] += 1
        counts["episodes"] += Flags.FIRST in observation.flags or counts["episodes"] == 0
        counts["total_reward"] += observation.reward
        counts["success"] |= Flags.SUCCESS in observation.flags
        action = decide(observation, robot, generator)
        link.act(observation.sequence, action)
        if Flags.LAST in observation.flags:
            print(f"episode {observation.episode}: {observation.step + 1} observations")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instance", required=True, help="the name given to the simulator")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timeout-s", type=float, default=60.0, help="give up after so long without an observation")
    parser.add_argument("--json", type=Path, help="write the counts to this file")
    options = parser.parse_args()
    try:
        with ControllerLink(options.instance) as link:
            counts = control(link, options)
    except RcwmError as error:
        raise SystemExit(f"{options.instance}: {error}") from None
    if options.json:
        options.json.write_text(json.dumps(counts))
    print(f"{counts['observations']} observations answered, {counts['gaps']} missed, {counts['repeated']} repeated")


if __name__ == "__main__":
    main()
