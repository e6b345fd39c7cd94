"""A controller in Python: answers every observation of a running simulator with random actions.

    rcwm-simulator serve --task reach --instance demo --episodes 2 &
    python controller.py --instance demo

Replace `decide` by your own policy.
"""

import argparse
import json
import random

from rcwm_link import FIRST, LAST, REPEATED, SUCCESS, ControllerLink, Observation, PeerClosed, SharedMemoryFull


def decide(observation: Observation, generator: random.Random) -> list[float]:
    """Four numbers in [-1, 1]: hand x, y, z and the gripper."""
    return [generator.uniform(-1.0, 1.0) for _ in range(4)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--instance", required=True, help="the name given to the simulator")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--timeout-s", type=float, default=60.0, help="give up after so long without an observation")
    parser.add_argument("--json", help="write the counts to this file")
    options = parser.parse_args()

    generator = random.Random(options.seed)
    try:
        link = ControllerLink(options.instance)
    except SharedMemoryFull as error:
        raise SystemExit(str(error)) from None
    counts = {"observations": 0, "episodes": 0, "repeated": 0, "gaps": 0, "total_reward": 0.0, "success": False}
    last_sequence, action = None, [0.0] * 4
    try:
        while True:
            observation = link.observe(options.timeout_s)
            if observation is None:
                raise SystemExit(f"no observation on {options.instance!r} within {options.timeout_s} s: is a simulator running?")
            if observation.sequence == last_sequence:
                # Seen before: the answer was lost on the way, so it is given again, not decided anew.
                counts["repeated"] += 1
                link.act(observation, action)
                continue
            if last_sequence is not None and observation.sequence != last_sequence + 1:
                counts["gaps"] += 1
            last_sequence = observation.sequence
            counts["observations"] += 1
            counts["episodes"] += bool(observation.flags & FIRST and not observation.flags & REPEATED) or counts["episodes"] == 0
            counts["total_reward"] += observation.reward
            counts["success"] |= bool(observation.flags & SUCCESS)
            action = decide(observation, generator)
            link.act(observation, action)
            if observation.flags & LAST:
                print(f"episode {observation.episode}: {observation.step + 1} observations, reward so far {counts['total_reward']:.1f}")
    except PeerClosed:
        pass
    finally:
        link.close()
    if options.json:
        with open(options.json, "w", encoding="utf-8") as file:
            json.dump(counts, file)
    print(f"{counts['observations']} observations answered, {counts['gaps']} missed, {counts['repeated']} repeated")


if __name__ == "__main__":
    main()
