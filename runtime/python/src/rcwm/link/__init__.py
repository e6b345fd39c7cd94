"""The robot's end of the link over shared memory, version 2 of the wire.

    from rcwm import interface
    from rcwm.link import RobotLink

    link = RobotLink(interface.load("robot.toml"), "a")

`rcwm.gym.serve` makes one by an instance's name; a driver of its own calls `publish` and `wait_action`.
"""

from .messages import Layout
from .robot import LinkError, RobotLink
from .shm import SharedMemoryFull

__all__ = ["Layout", "LinkError", "RobotLink", "SharedMemoryFull"]
