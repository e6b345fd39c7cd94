"""The command line of the Panda."""

from __future__ import annotations

import argparse
from pathlib import Path

from .. import RcwmError
from ..cli import Parser, check_writable, count, run, write_json

EXAMPLES = """examples:
  python -m rcwm.panda demonstrate --out data/lift --episodes 50 --seed 0
  python -m rcwm.panda demonstrate --out data/lift-pushed --episodes 50 --push 0.03 --masks
  python -m rcwm.panda measure --episodes 50 --layouts reporting --json runs/lift.json
  python -m rcwm.panda serve --instance a --episodes 10 --layouts reporting --json runs/served.json
  python -m rcwm.panda interface --side 128 > robot.toml
"""


def main() -> None:
    """Parses the command line and does what it says."""
    parser = Parser(prog="python -m rcwm.panda", description="robosuite's Panda that lifts a cube.", epilog=EXAMPLES)
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB", parser_class=Parser)
    demonstrate = verbs.add_parser("demonstrate", help="record the scripted expert's episodes as .npz", epilog=EXAMPLES)
    demonstrate.add_argument(
        "--out", type=Path, required=True, help="folder of the episodes; it is resumed where it is"
    )
    measure = verbs.add_parser("measure", help="the expert's success and the steps a second", epilog=EXAMPLES)
    measure.add_argument("--plain", action="store_true", help="draw as MuJoCo does by default, for comparison")
    show = verbs.add_parser("interface", help="print the robot's interface", epilog=EXAMPLES)
    serve = verbs.add_parser("serve", help="the robot of an instance, for a controller", epilog=EXAMPLES)
    serve.add_argument("--instance", required=True, help="the name given to the controller", metavar="NAME")
    serve.add_argument("--realtime", action="store_true", help="at 20 Hz; without it the robot waits for every answer")
    serve.add_argument("--timeout-s", type=float, default=60.0, help="give up after so long without an answer (60)")
    for verb in (demonstrate, measure, serve):
        verb.add_argument("--episodes", type=count, default=50, help="layouts 0 to N - 1 (50)", metavar="N")
        verb.add_argument("--seed", type=int, default=0, help="of the layouts (0)")
        verb.add_argument(
            "--layouts",
            choices=("learning", "choosing", "reporting"),
            default="learning",
            help="sets of layouts that never meet, whatever the seeds (learning)",
        )
        verb.add_argument("--steps", type=count, default=100, help="of an episode (100)")
    for verb in (demonstrate, measure):
        verb.add_argument("--push", type=_chance, default=0.0, help="chance of a push off course at each step (0)")
    for verb in (demonstrate, measure, serve):
        verb.add_argument("--json", type=Path, help="write the result to this file", metavar="FILE")
    for verb in (demonstrate, measure, serve, show):
        verb.add_argument("--side", type=int, choices=(64, 128), default=64, help="of the pictures, in pixels (64)")
        verb.add_argument("--cameras", default="front,wrist", help="with commas between (front,wrist)")
        verb.add_argument("--masks", action="store_true", help="with masks of the robot; takes longer")
    _do(parser.parse_args())


def _do(options: argparse.Namespace) -> None:
    from .robot import panda_lift

    cameras = tuple(options.cameras.split(","))
    robot = panda_lift(options.side, cameras, options.masks)
    if options.verb == "interface":
        print(robot.canonical(), end="")
        return
    if not 0 <= options.seed < 2**64:
        raise RcwmError(f"--seed {options.seed}: expected 0 to 2^64 - 1")
    check_writable(options.json)
    if options.verb == "serve":
        _serve(options, cameras)
        return
    from .demonstrate import Settings, demonstrate, measure

    settings = Settings(
        options.seed, options.layouts, options.side, cameras, options.masks, options.steps, options.push
    )
    if options.verb == "demonstrate":
        result = demonstrate(options.out, options.episodes, settings, options.json)
        rate = result["steps_per_second"]
        speed = f", {rate:.1f} steps/s" if rate else ""
        print(f"{options.out}: {result['episodes']} episodes ({result['recorded']} new{speed}), "
              f"success {result['successes']}/{result['episodes']}")  # fmt: skip
        return
    result = measure(options.episodes, settings, options.plain, options.json)
    print(
        f"success {result['successes']}/{result['episodes']}, solved at step {result['solved_at_step_median']} "
        f"(median; last {result['solved_at_step_max']}), {result['steps_per_second_median']:.1f} steps/s"
    )


def _serve(options: argparse.Namespace, cameras: tuple[str, ...]) -> None:
    from ..gym import serve
    from .robot import PandaLift

    robot = PandaLift(options.seed, options.layouts, options.side, cameras, options.masks, options.steps)
    try:
        counts = serve(
            robot,
            robot.interface,
            options.instance,
            episodes=options.episodes,
            realtime=options.realtime,
            timeout_s=options.timeout_s,
        )
    finally:
        robot.close()
    write_json(options.json, counts.as_dict())
    refused = counts.refused_not_finite + counts.refused_out_of_limits + counts.refused_length
    print(
        f"{counts.episodes} episodes, success {counts.successes}; {counts.observations} observations, "
        f"{counts.answers} answers ({refused} refused, {counts.missed_answers} missed)"
    )


def _chance(text: str) -> float:
    value = float(text)
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"{text}: expected a chance from 0 to 1")
    return value


if __name__ == "__main__":
    run(main)
