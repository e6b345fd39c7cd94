"""What a robot offers: states, cameras and actions with names, units, limits and a safe action.

The text is the project's `robot.toml`. `load` and `parse` read and check it,
`Interface.canonical` writes it in one form only,
byte for byte the Rust programs' form, and `Interface.hash` is what two peers compare.

    robot = load("robot.toml")
    robot.action_numbers, robot.cameras[0].shape, robot.hash
"""

from ..errors import InterfaceError
from .checks import check
from .compare import compare_names, differences
from .model import Action, Camera, Interface, State
from .text import load, parse, with_cameras

__all__ = [
    "Action",
    "Camera",
    "Interface",
    "InterfaceError",
    "State",
    "check",
    "compare_names",
    "differences",
    "load",
    "parse",
    "with_cameras",
]
