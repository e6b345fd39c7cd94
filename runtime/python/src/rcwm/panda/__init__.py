"""robosuite's Panda that lifts a cube: a second robot, its scripted expert, its demonstrations.

python -m rcwm.panda demonstrate --out demonstrations --episodes 50 --seed 0
python -m rcwm.panda measure --episodes 50
"""

from .expert import Expert, Pushes
from .robot import LAYOUTS, PandaLift, panda_lift

__all__ = ["LAYOUTS", "Expert", "PandaLift", "Pushes", "panda_lift"]
