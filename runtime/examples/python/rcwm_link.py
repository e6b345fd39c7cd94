"""The RCWM wire in Python: messages and both ends of the shared-memory link.

Copy this file beside your own robot's program. It needs only PyPI's `iceoryx2` (0.10.0); numpy is optional.
The layouts are those of `models/src/wire/messages.rs`; the type names carry the version, so that a peer of another
version is refused when it connects.
"""

import ctypes
import errno
import math
import os
import stat
import time

import iceoryx2 as iox2

IMAGE_SIDE = 64
FIRST, LAST, TERMINAL, SUCCESS, MASK_VALID, ACTION_HELD, REPEATED, PUSHED = (1 << bit for bit in range(8))
SOURCES = ("policy", "imagined", "fallback")
OWN_TASK = 0xFFFF_FFFF

_PUBLISHED, _HELLO, _CLOSED = 0, 1, 2
_SUBSCRIBERS_MAX, _NODES_MAX, _EVENT_ID_MAX = 8, 16, 7


class Observation(ctypes.Structure):
    """What a simulator or robot saw, and what it had done to get there. Times: CLOCK_MONOTONIC, ns."""

    _fields_ = [
        ("sequence", ctypes.c_uint64),  # counts up by one, from 0
        ("episode", ctypes.c_uint64),
        ("scheduled_ns", ctypes.c_uint64),
        ("published_ns", ctypes.c_uint64),
        ("period_ns", ctypes.c_uint64),  # 0: lock-step
        ("step", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("task", ctypes.c_uint32),
        ("reward", ctypes.c_float),
        ("executed_action", ctypes.c_float * 4),
        ("proprioception", ctypes.c_float * 18),
        ("image", ctypes.c_uint8 * (IMAGE_SIDE * IMAGE_SIDE * 3)),  # upright, rows first, RGB
        ("robot_mask", ctypes.c_uint8 * (IMAGE_SIDE * IMAGE_SIDE)),  # 255 where the robot is
    ]

    @staticmethod
    def type_name() -> str:
        return "rcwm.Observation.v1"


class Action(ctypes.Structure):
    """A controller's answer to one observation; each component in [-1, 1]."""

    _fields_ = [
        ("answers", ctypes.c_uint64),
        ("published_ns", ctypes.c_uint64),
        ("source", ctypes.c_uint32),
        ("reserved", ctypes.c_uint32),
        ("action", ctypes.c_float * 4),
    ]

    @staticmethod
    def type_name() -> str:
        return "rcwm.Action.v1"


class PeerClosed(Exception):
    """The other side said that it closes: a controller sends no further action, a simulator no further observation."""


# Messages that a publisher keeps room for, and some more; and the bytes of everything else.
_PAYLOADS, _OVERHEAD = 28, 64 << 10


class SharedMemoryFull(OSError):
    """No room in /dev/shm: said before anything is written, as the first write to a page without room ends a process by SIGBUS."""


def _full(needed: int) -> str:
    shared = os.statvfs("/dev/shm")
    free = shared.f_bavail * shared.f_frsize
    return (
        f"shared memory is full: /dev/shm has {free >> 10} KiB free and {-(-needed >> 10)} are needed; remove files there, "
        "or give the container more (--shm-size)"
    )


def _check_room(needed: int) -> None:
    try:
        shared = os.statvfs("/dev/shm")
    except OSError:  # where it cannot be told there may be room
        return
    free = shared.f_bavail * shared.f_frsize
    if free < needed:
        raise SharedMemoryFull(_full(needed))


def _own_files(prefix: str) -> set[str]:
    found = set()
    with os.scandir("/dev/shm") as entries:
        for entry in entries:
            try:
                status = entry.stat(follow_symlinks=False)
            except OSError:  # a peer has just removed its own
                continue
            if entry.name.startswith(prefix) and stat.S_ISREG(status.st_mode) and status.st_uid == os.geteuid():
                found.add(entry.path)
    return found


def _reserve(paths: set[str]) -> None:
    """Takes the room of files for good, so that no later write can find none."""
    for path in paths:
        try:
            descriptor = os.open(path, os.O_RDWR)
        except OSError:  # a peer has removed its own
            continue
        try:
            size = os.fstat(descriptor).st_size
            if size:
                os.posix_fallocate(descriptor, 0, size)
        except OSError as error:
            if error.errno == errno.ENOSPC:
                raise SharedMemoryFull(_full(size)) from None
        finally:
            os.close(descriptor)


class _Link:
    def __init__(self, instance: str, receives: tuple[str, type], sends: tuple[str, type]):
        _check_room(_PAYLOADS * ctypes.sizeof(sends[1]) + _OVERHEAD)
        iox2.set_log_level_from_env_or(iox2.LogLevel.Error)
        config = iox2.config.default()
        prefix = os.environ.get("RCWM_PREFIX")
        if prefix:
            config.global_cfg.prefix = iox2.FileName.new(prefix)
        before = _own_files(prefix or "iox2_")
        self._node = (
            iox2.NodeBuilder.new()
            .config(config)
            .signal_handling_mode(iox2.SignalHandlingMode.Disabled)
            .create(iox2.ServiceType.Ipc)
        )
        self._instance = instance
        self._seen: set[int] = set()
        received, awaited = self._direction(*receives)
        sent, woken = self._direction(*sends)
        self._subscriber = received.subscriber_builder().create()
        self._listener = awaited.listener_builder().create()
        self._publisher = sent.publisher_builder().create()
        self._notifier = woken.notifier_builder().create()
        _reserve(_own_files(prefix or "iox2_") - before)

    def _direction(self, topic: str, message: type):
        name = iox2.ServiceName.new(f"rcwm/{self._instance}/{topic}")
        data = (
            self._node.service_builder(name)
            .publish_subscribe(message)
            .history_size(0)
            .subscriber_max_buffer_size(1)
            .subscriber_max_borrowed_samples(2)
            .enable_safe_overflow(True)
            .max_publishers(1)
            .max_subscribers(_SUBSCRIBERS_MAX)
            .max_nodes(_NODES_MAX)
            .open_or_create()
        )
        event = (
            self._node.service_builder(name)
            .event()
            .max_notifiers(_SUBSCRIBERS_MAX)
            .max_listeners(_SUBSCRIBERS_MAX)
            .max_nodes(_NODES_MAX)
            .event_id_max_value(_EVENT_ID_MAX)
            .open_or_create()
        )
        return data, event

    def _send(self, message) -> None:
        message.published_ns = time.monotonic_ns()
        self._publisher.loan_uninit().write_payload(message).send()
        self._notify(_PUBLISHED)

    def _notify(self, event_id: int) -> None:
        self._notifier.notify_with_custom_event_id(iox2.EventId.new(event_id))

    def _receive(self, timeout_s: float):
        """The newest message, or None when the time is up or a signal other than a message has come.

        Signals are kept in `self._seen` until they are acted upon: a message that came with one goes first.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            sample = self._subscriber.receive()
            if sample is not None:
                # A copy: the sample's memory goes back to its publisher at the end of this function.
                message = sample.payload().contents
                return type(message).from_buffer_copy(message)
            left_s = deadline - time.monotonic()
            if self._seen or left_s <= 0:
                return None
            activations = self._listener.timed_wait(iox2.Duration.from_secs_f64(left_s))
            self._seen.update(seen.id.as_value for seen in activations if seen.id.as_value != _PUBLISHED)

    def close(self) -> None:
        """Tells the peer that nothing more will come, and leaves shared memory clean."""
        self._notify(_CLOSED)
        for port in (self._publisher, self._subscriber, self._notifier, self._listener):
            port.delete()


class ControllerLink(_Link):
    """A controller's end: observations in, actions out."""

    def __init__(self, instance: str):
        super().__init__(instance, receives=("observation", Observation), sends=("action", Action))
        # The simulator publishes its current observation again for a controller that has just connected.
        self._notify(_HELLO)

    def observe(self, timeout_s: float) -> Observation | None:
        """The next observation, or None when the time is up. Raises PeerClosed when the simulator has ended."""
        deadline = time.monotonic() + timeout_s
        while True:
            observation = self._receive(max(0.0, deadline - time.monotonic()))
            if observation is not None:
                return observation
            if _CLOSED in self._seen:
                raise PeerClosed("the simulator has closed")
            self._seen.clear()
            if time.monotonic() >= deadline:
                return None

    def act(self, observation: Observation, action, source: str = "policy") -> None:
        """Answers an observation with four numbers, clamped to [-1, 1]. Raises ValueError, and sends nothing, where one is not finite."""
        values = [float(value) for value in action]
        if not all(map(math.isfinite, values)):
            raise ValueError(f"an action that is not finite is not sent: {values}")
        answer = Action(answers=observation.sequence, source=SOURCES.index(source))
        answer.action[:] = [min(1.0, max(-1.0, value)) for value in values]
        self._send(answer)


class SimulatorLink(_Link):
    """A simulator's or robot's end: observations out, actions in."""

    def __init__(self, instance: str):
        super().__init__(instance, receives=("action", Action), sends=("observation", Observation))
        #: Actions that were not finite or not within [-1, 1], and were not returned.
        self.refused = 0

    def step(self, observation: Observation, timeout_s: float) -> Action | None:
        """Publishes an observation and waits for the action that answers it (lock-step).

        A controller that connects in the meantime gets the observation again. An answer that a robot must not execute is
        counted in `refused` and not returned. None when the time is up. Raises PeerClosed
        when the controller has said that it ends and no answer has come: bring the robot to rest. Calling this again with
        the same observation waits for the next controller.
        """
        deadline = time.monotonic() + timeout_s
        self._send(observation)
        while True:
            action = self._receive(max(0.0, deadline - time.monotonic()))
            if action is not None and action.answers == observation.sequence:
                # NaN is within nothing.
                if all(-1.0 <= value <= 1.0 for value in action.action):
                    return action
                self.refused += 1
            if action is None and _CLOSED in self._seen:
                self._seen.clear()
                observation.flags |= REPEATED
                raise PeerClosed("the controller has closed")
            if _HELLO in self._seen:
                self._seen.discard(_HELLO)
                observation.flags |= REPEATED
                self._send(observation)
            elif action is None:
                self._seen.clear()
            if time.monotonic() >= deadline:
                return None
