"""The wire, version 2: two headers, and where everything lies behind them."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

from ..interface import Interface

WIRE = 2
CAMERAS_MAX = 8
ALIGNMENT = 64
# The number of a task that is none of the project's.
OWN_TASK = 0xFFFF_FFFF


class ObservationHeader(ctypes.Structure):
    """What stands before the numbers and pictures of an observation. Times: CLOCK_MONOTONIC, ns."""

    _fields_ = [
        ("sequence", ctypes.c_uint64),  # counts up by one, from 0
        ("episode", ctypes.c_uint64),
        ("scheduled_ns", ctypes.c_uint64),
        ("published_ns", ctypes.c_uint64),
        ("period_ns", ctypes.c_uint64),  # 0: lock-step
        ("captured_ns", ctypes.c_uint64 * CAMERAS_MAX),  # of each camera; 0: not known
        ("step", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("task", ctypes.c_uint32),
        ("reward", ctypes.c_float),
    ]

    @staticmethod
    def type_name() -> str:
        """By which peers of another version are refused."""
        return "rcwm.Observation.v2"


class ActionHeader(ctypes.Structure):
    """What stands before the numbers of a controller's answer."""

    _fields_ = [
        ("answers", ctypes.c_uint64),
        ("published_ns", ctypes.c_uint64),
        ("source", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32),
    ]

    @staticmethod
    def type_name() -> str:
        """By which peers of another version are refused."""
        return "rcwm.Action.v2"


@dataclass(frozen=True)
class Layout:
    """Where each block of an observation begins, in bytes: state and executed action (f32), pictures, masks."""

    state: int
    executed: int
    images: dict[str, int]
    masks: dict[str, int]
    observation_bytes: int
    action_bytes: int

    @staticmethod
    def of(robot: Interface) -> Layout:
        """Blocks lie one after the other, each at a multiple of 64."""
        end = 0

        def block(size: int) -> int:
            nonlocal end
            start = -(-end // ALIGNMENT) * ALIGNMENT
            end = start + size
            return start

        state = block(4 * robot.state_numbers)
        executed = block(4 * robot.action_numbers)
        images = {camera.name: block(3 * camera.shape[0] * camera.shape[1]) for camera in robot.cameras}
        masks = {camera.name: block(camera.shape[0] * camera.shape[1]) for camera in robot.cameras if camera.mask}
        return Layout(state, executed, images, masks, -(-end // ALIGNMENT) * ALIGNMENT, 4 * robot.action_numbers)
