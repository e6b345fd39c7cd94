"""The RCWM wire, version 2, in Python: interfaces, messages and both ends of the shared-memory link.

Copy this file beside your own robot's program. It needs only PyPI's `iceoryx2` (0.10.0); numpy is optional.
A message is a header of fixed size (`models/src/wire/messages.rs`) and bytes that the robot's interface lays out
(`models/src/interface/layout.rs`). The type names carry the version, so that a peer of another version is refused when
it connects, and the services carry the interface's hash.
"""

import ctypes
import errno
import functools
import hashlib
import math
import os
import stat
import time
import tomllib

import iceoryx2 as iox2

IMAGE_SIDE = 64
FIRST, LAST, TERMINAL, SUCCESS, MASK_VALID, ACTION_HELD, REPEATED, PUSHED = (1 << bit for bit in range(8))
SOURCES = ("policy", "imagined", "fallback")
OWN_TASK = 0xFFFF_FFFF

_WIRE = 2
_PUBLISHED, _HELLO, _CLOSED, _ASKED = 0, 1, 2, 3
_SUBSCRIBERS_MAX, _NODES_MAX, _EVENT_ID_MAX = 8, 16, 7
_ALIGNMENT, _CAMERAS_MAX = 64, 8
_ASK_EVERY_S = 0.25

#: The interface of Meta-World's arm.
METAWORLD = """
[interface]
name = "metaworld"
rate_hz = 40.0
[[interface.state]]
name = "joint_pos"
kind = "state/joint/position"
elements = ["right_j0", "right_j1", "right_j2", "right_j3", "right_j4", "right_j5", "right_j6", "r_close", "l_close"]
unit = "1"
[[interface.state]]
name = "arm_vel"
kind = "state/joint/velocity"
elements = ["right_j0", "right_j1", "right_j2", "right_j3", "right_j4", "right_j5", "right_j6"]
unit = "rad/s"
[[interface.state]]
name = "finger_vel"
kind = "state/joint/velocity"
elements = ["r_close", "l_close"]
unit = "m/s"
[[interface.camera]]
name = "image"
shape = [64, 64, 3]
encoding = "rgb8"
mask = "robot"
[[interface.action]]
name = "hand"
kind = "command/hand/position"
mode = "delta"
elements = ["x", "y", "z", "gripper"]
unit = "1"
low = [-1.0, -1.0, -1.0, -1.0]
high = [1.0, 1.0, 1.0, 1.0]
fallback = "zero"
"""


def _number(value: float) -> str:
    """The shortest decimal number that reads as the same one, with a point or an exponent."""
    text = repr(float(value) + 0.0)
    if "e" in text:
        mantissa, exponent = text.split("e")
        return f"{mantissa}e{int(exponent)}"
    return text


def _value(value) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return _number(value) if isinstance(value, float) else str(value)


class Interface:
    """What a robot offers: its states, cameras and actions, in the order of the wire (`docs/own-robot.md`).

    `rcwm-runtime check robot.toml` says what is wrong with a text; this reads one that is right.
    """

    def __init__(self, text: str):
        table = tomllib.loads(text)["interface"]
        self.name: str = table["name"]
        self.rate_hz = float(table["rate_hz"])
        self.states: list[dict] = table.get("state", [])
        self.cameras: list[dict] = table.get("camera", [])
        self.actions: list[dict] = table["action"]
        #: Smallest and largest value of each number of an action, in units.
        #: As the messages have them: an action at its limit is within it.
        self.low = [ctypes.c_float(x).value for action in self.actions for x in action["low"]]
        self.high = [ctypes.c_float(x).value for action in self.actions for x in action["high"]]
        self.state_numbers = sum(len(state["elements"]) for state in self.states)

    def canonical(self) -> str:
        """The interface as text in one form only; its hash is what peers compare."""
        lines = ["[interface]", f"name = {_value(self.name)}", f"rate_hz = {_number(self.rate_hz)}"]
        floats = {"low", "high", "rate_max"}
        keys = {
            "state": ("name", "kind", "elements", "unit"),
            "camera": ("name", "shape", "encoding", "mask"),
            "action": ("name", "kind", "mode", "elements", "unit", "low", "high", "rate_max", "fallback", "measured"),
        }
        for what, groups in (("state", self.states), ("camera", self.cameras), ("action", self.actions)):
            for group in groups:
                lines.append(f"\n[[interface.{what}]]")
                for key in keys[what]:
                    if key not in group:
                        continue
                    value = group[key]
                    if key in floats or key == "fallback" and isinstance(value, list):
                        value = [float(x) for x in value] if isinstance(value, list) else float(value)
                    lines.append(f"{key} = {_value(value)}")
        return "\n".join(lines) + "\n"

    def hash(self) -> str:
        return hashlib.sha256(self.canonical().encode()).hexdigest()


class ObservationHeader(ctypes.Structure):
    """What stands before the numbers and pictures of an observation. Times: CLOCK_MONOTONIC, ns."""

    _fields_ = [
        ("sequence", ctypes.c_uint64),  # counts up by one, from 0
        ("episode", ctypes.c_uint64),
        ("scheduled_ns", ctypes.c_uint64),
        ("published_ns", ctypes.c_uint64),
        ("period_ns", ctypes.c_uint64),  # 0: lock-step
        ("captured_ns", ctypes.c_uint64 * _CAMERAS_MAX),  # of each camera; 0: not known
        ("step", ctypes.c_uint32),
        ("flags", ctypes.c_uint32),
        ("task", ctypes.c_uint32),
        ("reward", ctypes.c_float),
    ]

    @staticmethod
    def type_name() -> str:
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
        return "rcwm.Action.v2"


class _Message(ctypes.Structure):
    """A header, and the payload behind it as one structure."""

    _header: type

    def header(self):
        return self._header.from_buffer(self)

    def payload(self) -> memoryview:
        return memoryview(self).cast("B")[ctypes.sizeof(self._header) :]


def _message(name: str, header: type, blocks: list[tuple[str, type]], alignment: int) -> type:
    """A structure of the header's fields and of blocks, each aligned from the payload's beginning."""
    fields, size = list(header._fields_), 0
    for block, kind in blocks:
        padding = -size % alignment
        if padding:
            fields.append((f"_{block}_padding", ctypes.c_uint8 * padding))
        fields.append((block, kind))
        size += padding + ctypes.sizeof(kind)
    if -size % alignment:
        fields.append(("_padding", ctypes.c_uint8 * (-size % alignment)))
    # Packed: a header of 24 or 120 bytes is followed by the payload at once.
    return type(name, (_Message,), {"_pack_": 1, "_layout_": "ms", "_fields_": fields, "_header": header})


@functools.cache
def observation_type(canonical: str) -> type:
    """The observation of an interface: `ObservationHeader`'s fields, then `proprioception` (all states, f32), `executed_action`
    (f32), and a picture a camera (upright, rows first, RGB) and a mask (255 where the robot is), named `image` and `robot_mask` for
    the first camera, `image_NAME` and `mask_NAME` for each other.
    """
    interface = Interface(canonical)
    blocks = [
        ("proprioception", ctypes.c_float * interface.state_numbers),
        ("executed_action", ctypes.c_float * len(interface.low)),
    ]
    name = lambda at, first, other: first if at == 0 else f"{other}_{interface.cameras[at]['name']}"  # noqa: E731
    for at, camera in enumerate(interface.cameras):
        rows, columns, channels = camera["shape"]
        blocks.append((name(at, "image", "image"), ctypes.c_uint8 * (rows * columns * channels)))
    for at, camera in enumerate(interface.cameras):
        if "mask" in camera:
            rows, columns, _ = camera["shape"]
            blocks.append((name(at, "robot_mask", "mask"), ctypes.c_uint8 * (rows * columns)))
    return _message("Observation", ObservationHeader, blocks, _ALIGNMENT)


@functools.cache
def action_type(numbers: int) -> type:
    """A controller's answer: `ActionHeader`'s fields, then `action`, in the interface's units."""
    return _message("Action", ActionHeader, [("action", ctypes.c_float * numbers)], 4)


#: Messages of Meta-World's arm.
Observation = observation_type(Interface(METAWORLD).canonical())
Action = action_type(4)


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


class _Sender:
    """Publishes messages of one type."""

    def __init__(self, publisher):
        self._publisher = publisher

    def loan_uninit(self) -> "_Sender":
        return self

    def write_payload(self, message) -> "_Outgoing":
        return _Outgoing(self._publisher, message)

    def delete(self) -> None:
        self._publisher.delete()


class _Outgoing:
    def __init__(self, publisher, message):
        payload = message.payload()
        sample = publisher.loan_slice_uninit(len(payload))
        ctypes.memmove(sample.user_header_ptr, ctypes.addressof(message), ctypes.sizeof(message._header))
        ctypes.memmove(sample.payload_ptr, ctypes.addressof(message) + ctypes.sizeof(message._header), len(payload))
        self._sample = sample.assume_init()

    def send(self) -> None:
        self._sample.send()


class InterfaceMismatch(Exception):
    """The peer's messages are laid out by another interface, or do not keep to it."""


class _Link:
    """A node under the prefix, and what both ends share. Ports are made when the interface is known."""

    def __init__(self, instance: str, needed: int):
        _check_room(needed)
        iox2.set_log_level_from_env_or(iox2.LogLevel.Error)
        config = iox2.config.default()
        self._prefix = os.environ.get("RCWM_PREFIX") or "iox2_"
        if os.environ.get("RCWM_PREFIX"):
            config.global_cfg.prefix = iox2.FileName.new(self._prefix)
        before = _own_files(self._prefix)
        self._node = (
            iox2.NodeBuilder.new()
            .config(config)
            .signal_handling_mode(iox2.SignalHandlingMode.Disabled)
            .create(iox2.ServiceType.Ipc)
        )
        self._instance = instance
        self._seen: set[int] = set()
        self._ports: list = []
        self._subscriber = self._listener = self._publisher = None
        _reserve(_own_files(self._prefix) - before)

    def _connect(self, interface: Interface, receives: tuple[str, type], sends: tuple[str, type]) -> None:
        """Makes the ports of a robot of this interface."""
        self.interface = interface
        self._receives = receives[1]
        bytes_max = ctypes.sizeof(sends[1]) - ctypes.sizeof(sends[1]._header)
        _check_room(_PAYLOADS * bytes_max + _OVERHEAD)
        before = _own_files(self._prefix)
        received = self._data(receives[0], receives[1]._header, interface.hash())
        sent = self._data(sends[0], sends[1]._header, interface.hash())
        self._subscriber = received.subscriber_builder().create()
        self._listener = self._event(receives[0]).listener_builder().create()
        self._publisher = _Sender(self._publish(sent, bytes_max))
        self._notifier = self._event(sends[0]).notifier_builder().create()
        self._ports += [self._publisher, self._subscriber, self._notifier, self._listener]
        _reserve(_own_files(self._prefix) - before)

    def _name(self, topic: str):
        return iox2.ServiceName.new(f"rcwm/{self._instance}/{topic}")

    def _data(self, topic: str, header: type | None, interface_hash: str | None = None):
        builder = self._node.service_builder(self._name(topic)).publish_subscribe(iox2.Slice[ctypes.c_uint8])
        if header is not None:
            builder = builder.user_header(header)
        attributes = iox2.AttributeVerifier.new()
        for key, value in (("rcwm.wire", str(_WIRE)), ("rcwm.interface", interface_hash)):
            if value is not None:
                attributes = attributes.require(iox2.AttributeKey.new(key), iox2.AttributeValue.new(value))
        return (
            builder.history_size(1 if header is None else 0)
            .subscriber_max_buffer_size(1)
            .subscriber_max_borrowed_samples(2)
            .enable_safe_overflow(True)
            .max_publishers(1)
            .max_subscribers(_SUBSCRIBERS_MAX)
            .max_nodes(_NODES_MAX)
            .open_or_create_with_attributes(attributes)
        )

    def _event(self, topic: str):
        return (
            self._node.service_builder(self._name(topic))
            .event()
            .max_notifiers(_SUBSCRIBERS_MAX)
            .max_listeners(_SUBSCRIBERS_MAX)
            .max_nodes(_NODES_MAX)
            .event_id_max_value(_EVENT_ID_MAX)
            .open_or_create()
        )

    @staticmethod
    def _publish(service, bytes_max: int):
        builder = service.publisher_builder().max_loaned_samples(1).initial_max_slice_len(bytes_max)
        return builder.allocation_strategy(iox2.AllocationStrategy.Static).create()

    def _send(self, message) -> None:
        message.published_ns = time.monotonic_ns()
        self._publisher.loan_uninit().write_payload(message).send()
        self._notify(_PUBLISHED)

    def _notify(self, event_id: int) -> None:
        self._notifier.notify_with_custom_event_id(iox2.EventId.new(event_id))

    def _asked(self) -> None:
        """Somebody wants to know the interface; the robot's end says it."""

    def _receive(self, timeout_s: float):
        """The newest message, or None when the time is up or a signal other than a message has come.

        Signals are kept in `self._seen` until they are acted upon: a message that came with one goes first.
        """
        deadline = time.monotonic() + timeout_s
        while True:
            sample = self._subscriber.receive()
            if sample is not None:
                return self._copied(sample)
            left_s = deadline - time.monotonic()
            if self._seen or left_s <= 0:
                return None
            try:
                activations = self._listener.timed_wait(iox2.Duration.from_secs_f64(left_s))
            except iox2.ListenerWaitError:
                # A signal to the program: what Python makes of it comes before the next wait.
                continue
            self._seen.update(seen.id.as_value for seen in activations if seen.id.as_value != _PUBLISHED)
            if _ASKED in self._seen:
                self._seen.discard(_ASKED)
                self._asked()

    def _copied(self, sample):
        # A copy: the sample's memory goes back to its publisher when it is dropped.
        payload = sample.payload()
        message = self._receives()
        expected = ctypes.sizeof(message) - ctypes.sizeof(message._header)
        if payload.len() != expected:
            raise InterfaceMismatch(f"a message of {payload.len()} bytes, expected {expected}")
        ctypes.memmove(ctypes.addressof(message), sample.user_header_ptr, ctypes.sizeof(message._header))
        ctypes.memmove(ctypes.addressof(message) + ctypes.sizeof(message._header), sample.payload_ptr, expected)
        return message

    def close(self) -> None:
        """Tells the peer that nothing more will come, and leaves shared memory clean."""
        self._notify(_CLOSED)
        for port in self._ports:
            port.delete()


class ControllerLink(_Link):
    """A controller's end: observations in, actions out. It waits for its robot, whose interface is then in `interface`."""

    interface: Interface | None = None

    def __init__(self, instance: str):
        super().__init__(instance, _OVERHEAD)
        self._texts = self._data("interface", None).subscriber_builder().create()
        self._said = self._event("interface").listener_builder().create()
        self._notifier = self._event("action").notifier_builder().create()
        self._ports += [self._texts, self._said, self._notifier]

    def wait_robot(self, timeout_s: float) -> Interface | None:
        """The robot's interface, or None when the time is up."""
        deadline = time.monotonic() + timeout_s
        while self.interface is None:
            self._notify(_ASKED)
            left_s = min(_ASK_EVERY_S, max(0.0, deadline - time.monotonic()))
            try:
                self._said.timed_wait(iox2.Duration.from_secs_f64(left_s))
            except iox2.ListenerWaitError:
                continue  # as above
            sample = self._texts.receive()
            if sample is not None:
                text = bytes(sample.payload().as_memory_view()).decode()
                interface = Interface(text)
                kind = observation_type(interface.canonical())
                self._connect(interface, ("observation", kind), ("action", action_type(len(interface.low))))
                # The simulator publishes its current observation again for a controller that has just connected.
                self._notify(_HELLO)
            elif time.monotonic() >= deadline:
                return None
        return self.interface

    def observe(self, timeout_s: float):
        """The next observation, or None when the time is up. Raises PeerClosed when the simulator has ended."""
        deadline = time.monotonic() + timeout_s
        if self.wait_robot(timeout_s) is None:
            return None
        while True:
            observation = self._receive(max(0.0, deadline - time.monotonic()))
            if observation is not None:
                return observation
            if _CLOSED in self._seen:
                raise PeerClosed("the simulator has closed")
            self._seen.clear()
            if time.monotonic() >= deadline:
                return None

    def act(self, observation, action, source: str = "policy") -> None:
        """Answers an observation, in units, clamped to the limits. Raises ValueError, and sends nothing, where a number is not finite or
        their count is not the robot's.
        """
        values = [float(value) for value in action]
        if not all(map(math.isfinite, values)):
            raise ValueError(f"an action that is not finite is not sent: {values}")
        interface = self.interface or Interface(METAWORLD)
        if len(values) != len(interface.low):
            raise ValueError(f"an action of {len(values)} numbers, the robot expects {len(interface.low)}")
        answer = action_type(len(values))(answers=observation.sequence, source=SOURCES.index(source))
        answer.action[:] = [min(high, max(low, x)) for x, low, high in zip(values, interface.low, interface.high)]
        self._send(answer)


class SimulatorLink(_Link):
    """A simulator's or robot's end: observations out, actions in. `interface` is the text of its `robot.toml`."""

    def __init__(self, instance: str, interface: str = METAWORLD):
        robot = Interface(interface)
        self.Observation = observation_type(robot.canonical())
        super().__init__(instance, _PAYLOADS * ctypes.sizeof(self.Observation) + _OVERHEAD)
        #: Actions that were not finite or not within the limits, and were not returned.
        self.refused = 0
        self._connect(robot, ("action", action_type(len(robot.low))), ("observation", self.Observation))
        self._text = robot.canonical().encode()
        self._says = self._publish(self._data("interface", None), len(self._text))
        self._tells = self._event("interface").notifier_builder().create()
        self._ports += [self._says, self._tells]
        self._asked()

    def _asked(self) -> None:
        sample = self._says.loan_slice_uninit(len(self._text))
        ctypes.memmove(sample.payload_ptr, self._text, len(self._text))
        sample.assume_init().send()
        self._tells.notify_with_custom_event_id(iox2.EventId.new(_PUBLISHED))

    def step(self, observation, timeout_s: float):
        """Publishes an observation and waits for the action that answers it (lock-step).

        A controller that connects in the meantime gets the observation again. An answer that a robot must not execute is
        counted in `refused` and not returned. None when the time is up. Raises PeerClosed
        when the controller has said that it ends and no answer has come: bring the robot to rest. Calling this again with
        the same observation waits for the next controller.
        """
        deadline = time.monotonic() + timeout_s
        self._send(observation)
        limits = list(zip(self.interface.low, self.interface.high))
        while True:
            action = self._receive(max(0.0, deadline - time.monotonic()))
            if action is not None and action.answers == observation.sequence:
                # NaN is within nothing.
                if all(low <= value <= high for value, (low, high) in zip(action.action, limits)):
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
