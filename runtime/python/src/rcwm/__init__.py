"""Robots, simulators and datasets of the RCWM project.

| module | holds | needs |
| --- | --- | --- |
| `rcwm.interface` | what a robot offers: states, cameras, actions, as text and in Python | numpy |
| `rcwm.episode` | recorded episodes, `.npz` | numpy |
| `rcwm.panda` | robosuite's Panda that lifts a cube, and its demonstrations | `rcwm[robosuite]` |
| `rcwm.lerobot` | LeRobot datasets in and out | `rcwm[lerobot]` |
| `rcwm.gym` | any Gymnasium environment as a robot | numpy |
| `rcwm.link` | the robot's end of the link | `rcwm[link]` |
"""

__version__ = "0.1.0"


class RcwmError(Exception):
    """What a user can put right; its text is one line that says how."""
