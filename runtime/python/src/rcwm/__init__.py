"""Policies, robots, simulators and datasets of the RCWM project.

    from rcwm import Policy

    policy = Policy("models/bundles/hammer")
    decision = policy.observe({"image": image})         # an episode begins
    decision = policy.observe({"image": image}, decision.action)

| module | holds | needs |
| --- | --- | --- |
| `rcwm` | `Policy`: a bundle inside a program of your own | numpy |
| `rcwm.link` | the link over shared memory: the robot's end, the controller's, and an observer's | numpy |
| `rcwm.gym` | any Gymnasium environment as a robot | numpy |
| `rcwm.interface` | what a robot offers: states, cameras, actions, as text and in Python | numpy |
| `rcwm.episode` | recorded episodes, `.npz` | numpy |
| `rcwm.errors` | every exception, all below `RcwmError` | |
| `rcwm.panda` | robosuite's Panda that lifts a cube, and its demonstrations | `rcwm[robosuite]` |
| `rcwm.lerobot` | LeRobot datasets in and out | `rcwm[lerobot]` |
"""

from ._rcwm import Decision, Policy
from .errors import RcwmError

__all__ = ["Decision", "Policy", "RcwmError"]
__version__ = "0.1.0"
