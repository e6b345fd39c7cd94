"""The link over shared memory, all ends of it.

A robot:

    link = RobotLink(interface.load("robot.toml"), "a")
    link.publish(header, state, executed, {"front": image}, {})
    answer = link.wait_action(1.0)

A controller of your own, and `rcwm.Policy` in it:

    link = ControllerLink("a", policy)
    observation = link.observe(1.0)
    link.act(observation.sequence, policy.observe(observation, executed).action)

`ObserverLink` listens in. An end belongs to the thread that opened it; while it waits, other threads run.
`rcwm.gym.serve` opens a robot's end by an instance's name.
"""

from ._rcwm import ControllerLink, Observation, ObserverLink, RobotLink
from .errors import DoesNotFit, LinkError, LinkTaken, PeerClosed, SharedMemoryFull, WrongThread
from .messages import Answer, Flags, Header, Source

__all__ = [
    "Answer",
    "ControllerLink",
    "DoesNotFit",
    "Flags",
    "Header",
    "LinkError",
    "LinkTaken",
    "Observation",
    "ObserverLink",
    "PeerClosed",
    "RobotLink",
    "SharedMemoryFull",
    "Source",
    "WrongThread",
]
