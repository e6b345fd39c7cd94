"""Any Gymnasium environment as a robot on the link.

    import gymnasium
    from rcwm import interface
    from rcwm.gym import serve

    robot = interface.load("pendulum.toml")
    serve(gymnasium.make("Pendulum-v1", render_mode="rgb_array"), robot, "a", episodes=10)

An observation is a dictionary by the interface's names of states and cameras (masks: `<camera>_mask`), or one state's
vector; a single camera that is not in it is what the environment renders. `observe=` translates any other.
"""

from ..errors import PeerClosed
from ..messages import Answer, Flags, Header
from .link import Clock, Link
from .observe import UnfitEnvironment
from .serve import Counts, NoAnswer, serve

__all__ = [
    "Answer",
    "Clock",
    "Counts",
    "Flags",
    "Header",
    "Link",
    "NoAnswer",
    "PeerClosed",
    "UnfitEnvironment",
    "serve",
]
