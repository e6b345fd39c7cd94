"""Ten lines: a bundle acts. python policy.py [BUNDLE]"""

import sys

import numpy as np

from rcwm import Policy

policy, executed = Policy(sys.argv[1] if len(sys.argv) > 1 else "models/bundles/hammer"), None
for step in range(10):
    image = np.random.default_rng(step).integers(0, 256, (64, 64, 3), np.uint8)  # your camera's: upright, RGB
    decision = policy.observe({"image": image}, executed)  # nothing executed yet: an episode begins
    executed = decision.action  # send it to the robot; say what was really executed
    policy.work_ahead(executed)  # in the idle time: what the next tick needs besides the picture
    print(step, executed.round(3), decision.surprise)
