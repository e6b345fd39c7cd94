"""LeRobot datasets (v3.0) in and out.

    python -m rcwm.lerobot from-npz data/lift --interface robot.toml --out lift-lerobot
    python -m rcwm.lerobot to-npz lift-lerobot --interface robot.toml --out data/lift

LeRobot's row t holds an observation and the action chosen at it; our step t holds an observation and the action that
led to it. So row t's action is step t + 1's, and with it the reward and what was reached. An episode of T observations
has T - 1 actions, and so T - 1 rows: what LeRobot has no row for, the last observation, and masks, lie beside the
dataset in `rcwm/episode-*.npz` and come back from there. A dataset of others does not have it: the last row's action,
which led to an observation that nobody stored, is left out. Units are untouched.

In Python: `rcwm.lerobot.read.to_npz` and `rcwm.lerobot.write.from_npz`.
"""
