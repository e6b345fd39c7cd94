"""The command line of LeRobot's datasets."""

from __future__ import annotations

from pathlib import Path

from .. import RcwmError, interface
from ..cli import Parser, check_writable, run, write_json

EXAMPLES = """examples:
  python -m rcwm.panda interface > robot.toml
  python -m rcwm.panda demonstrate --out data/lift --episodes 5
  python -m rcwm.lerobot from-npz data/lift --interface robot.toml --out data/lift-lerobot --task "lift the cube"
  python -m rcwm.lerobot to-npz data/lift-lerobot --interface robot.toml --out data/lift-again

Other names are mapped, THEIRS=OURS: a camera, a state, or one number.
  --map observation.images.top=front --map observation.state=joint_pos --map shoulder_pan.pos=arm.j1
"""


def main() -> None:
    """Parses the command line and does what it says."""
    parser = Parser(prog="python -m rcwm.lerobot", description="LeRobot datasets (v3.0) in and out.", epilog=EXAMPLES)
    verbs = parser.add_subparsers(dest="verb", required=True, metavar="VERB", parser_class=Parser)
    to_npz = verbs.add_parser("to-npz", help="a dataset as .npz episodes", epilog=EXAMPLES)
    to_npz.add_argument("dataset", type=Path, help="folder of the dataset, the one that holds meta/")
    to_npz.add_argument("--map", action="append", default=[], metavar="THEIRS=OURS", help="what a name is called here")
    from_npz = verbs.add_parser("from-npz", help=".npz episodes as a dataset", epilog=EXAMPLES)
    from_npz.add_argument("folder", type=Path, help="folder of .npz episodes")
    from_npz.add_argument("--task", help="what the robot does, in a sentence (the robot's name)")
    from_npz.add_argument("--images", action="store_true", help="store images without loss, not video")
    for verb in (to_npz, from_npz):
        verb.add_argument("--interface", type=Path, required=True, help="the robot's interface", metavar="ROBOT.TOML")
        verb.add_argument("--out", type=Path, required=True, help="folder to write")
        verb.add_argument("--json", type=Path, help="write the counts to this file", metavar="FILE")
    options = parser.parse_args()
    robot = interface.load(options.interface)
    check_writable(options.json)
    try:
        from .read import to_npz as read
        from .write import from_npz as write
    except ImportError as error:
        raise RcwmError(f"datasets cannot be read or written ({error}); install rcwm[lerobot]") from None
    if options.verb == "from-npz":
        result = write(options.folder, robot, options.out, options.task, options.images)
        write_json(options.json, result)
        pushed = result["pushed_actions"]
        note = f"; {pushed} of them pushes off course (next.pushed), no examples of what to do" if pushed else ""
        print(f"{options.out}: {result['episodes']} episodes, {result['rows']} rows{note}")
        return
    result = read(options.dataset, robot, options.out, dict(_pair(text) for text in options.map))
    write_json(options.json, result)
    print(f"{options.out}: {result['episodes']} episodes ({result['new']} new)")
    if result["actions_left_out"]:
        lost = result["successes_left_out"]
        print(f"  {result['actions_left_out']} last actions led to observations that were not stored, and are left out"
              + (f"; {lost} of them were the episode's only success" if lost else ""))  # fmt: skip


def _pair(text: str) -> tuple[str, str]:
    theirs, equals, ours = text.partition("=")
    if not (theirs and equals and ours):
        raise RcwmError(f"--map {text}: expected THEIRS=OURS, for example observation.images.top=front")
    return theirs, ours


if __name__ == "__main__":
    run(main)
