"""A small robot and episodes of it, made from a seed."""

import numpy as np
import pytest

from rcwm import interface
from rcwm.episode import Episode

SMALL = """
[interface]
name = "small"
rate_hz = 20.0

[[interface.state]]
name = "joint_pos"
kind = "state/joint/position"
elements = ["j1", "j2"]
unit = "rad"

[[interface.state]]
name = "joint_vel"
kind = "state/joint/velocity"
elements = ["j1", "j2"]
unit = "rad/s"

[[interface.camera]]
name = "front"
shape = [32, 48, 3]
encoding = "rgb8"
mask = "robot"

[[interface.camera]]
name = "wrist"
shape = [16, 16, 3]
encoding = "rgb8"

[[interface.action]]
name = "arm"
kind = "command/joint/position"
mode = "absolute"
elements = ["j1", "j2"]
unit = "rad"
low = [-2.0, -1.0]
high = [2.0, 1.0]
rate_max = 0.5
fallback = "hold-measured"
measured = "joint_pos"
"""


@pytest.fixture
def small() -> interface.Interface:
    return interface.parse(SMALL)


@pytest.fixture
def make_episode(small):
    """Smooth pictures, which video stores well, and numbers at random."""

    def make(steps: int, seed: int = 0) -> Episode:
        random = np.random.default_rng(seed)
        at = np.arange(steps)
        pictures = {}
        for camera in small.cameras:
            rows, columns, _ = camera.shape
            y, x = np.mgrid[:rows, :columns]
            ramps = [(4 * x + 3 * t) % 128 + 64 + 0 * y for t in range(steps)]
            pictures[camera.name] = np.repeat(np.stack(ramps)[..., None], 3, 3).astype(np.uint8)
        action = random.uniform(-1, 1, (steps, 2)).astype(np.float32)
        action[0] = 0
        return Episode(
            interface=small,
            images=pictures,
            masks={"front": random.integers(0, 2, (steps, 32, 48)).astype(np.uint8)},
            action=action,
            reward=random.normal(size=steps).astype(np.float32),
            proprio=random.normal(size=(steps, 4)).astype(np.float32),
            is_first=at == 0,
            is_last=at == steps - 1,
            is_terminal=at == steps - 1,
            success=at > steps // 2,
            pushed=at == 2,
        )

    return make
