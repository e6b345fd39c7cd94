"""The robot's end of the link over shared memory (iceoryx2)."""

from __future__ import annotations

import ctypes
import os
import re
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from .. import RcwmError
from ..gym.link import Answer, Flags, Header, PeerClosed
from ..interface import Interface
from .messages import CAMERAS_MAX, OWN_TASK, WIRE, ActionHeader, Layout, ObservationHeader
from .shm import reserved

try:
    import iceoryx2 as iox2
except ImportError as error:
    raise RcwmError(f"the link cannot be used ({error}); install rcwm[link]") from None

PUBLISHED, HELLO, CLOSED, ASKED = 0, 1, 2, 3
SUBSCRIBERS_MAX, NODES_MAX, EVENT_ID_MAX = 8, 16, 7
# Environment variable that keeps programs apart that run side by side, and iceoryx2's own.
PREFIX, PREFIX_DEFAULT = "RCWM_PREFIX", "iox2_"


class LinkError(RcwmError):
    """The link cannot be made."""


class RobotLink:
    """Publishes observations of `robot` and receives answers, as `rcwm.gym.Link` says.

    The robot says its interface when it is opened and whenever somebody asks. One robot an instance.
    """

    def __init__(self, robot: Interface, instance: str):
        """Raises `LinkError` and `SharedMemoryFull`."""
        if not re.fullmatch(r"[A-Za-z0-9_-][A-Za-z0-9_.-]{0,63}", instance):
            raise LinkError(f"instance {instance!r}: expected 1 to 64 letters, digits, '-', '_' or '.', no '.' first")
        if len(robot.cameras) > CAMERAS_MAX:
            raise LinkError(f"{len(robot.cameras)} cameras: the wire carries at most {CAMERAS_MAX}")
        self.robot, self.instance, self.layout = robot, instance, Layout.of(robot)
        self._text = robot.canonical().encode()
        self._published: tuple[ObservationHeader, bytearray] | None = None
        self._signals: set[int] = set()
        self._ports: list[Any] = []
        iox2.set_log_level_from_env_or(iox2.LogLevel.Error)
        config = iox2.config.default()
        prefix = os.environ.get(PREFIX)
        if prefix:
            config.global_cfg.prefix = iox2.FileName.new(prefix)
        with reserved(prefix or PREFIX_DEFAULT, self.layout.observation_bytes):
            try:
                self._open(config)
            except (RcwmError, KeyboardInterrupt):
                raise
            except Exception as error:  # iceoryx2 has an exception for each call
                raise self._explained(error) from None
        self._announce()

    def publish(
        self,
        header: Header,
        state: np.ndarray,
        executed: np.ndarray,
        images: Mapping[str, np.ndarray],
        masks: Mapping[str, np.ndarray],
    ) -> None:
        """See `rcwm.gym.Link`. Raises `LinkError` for numbers, pictures and masks that are not the interface's."""
        out = ObservationHeader(
            sequence=header.sequence,
            episode=header.episode,
            scheduled_ns=header.scheduled_ns,
            period_ns=header.period_ns,
            step=header.step,
            flags=int(header.flags),
            task=OWN_TASK,
            reward=header.reward,
        )
        payload = bytearray(self.layout.observation_bytes)
        _put(payload, self.layout.state, "state", _numbers("state", state), (self.robot.state_numbers,))
        _put(
            payload,
            self.layout.executed,
            "executed action",
            _numbers("executed action", executed),
            self.robot.low.shape,
        )
        if set(images) != set(self.layout.images) or not set(masks) <= set(self.layout.masks):
            raise LinkError(
                f"pictures {sorted(images)}, masks {sorted(masks)}; the robot's cameras are {list(self.layout.images)}"
            )
        for place, camera in enumerate(self.robot.cameras):
            out.captured_ns[place] = header.captured_ns
            _put(payload, self.layout.images[camera.name], f"picture {camera.name}", images[camera.name], camera.shape)
            if camera.name in masks:
                shape = camera.shape[:2]
                _put(payload, self.layout.masks[camera.name], f"mask {camera.name}", masks[camera.name], shape)
        self._published = (out, payload)
        self._send()

    def wait_action(self, timeout_s: float) -> Answer | None:
        """See `rcwm.gym.Link`."""
        deadline = time.monotonic() + timeout_s
        while True:
            sample = self._subscriber.receive()
            if sample is not None:
                return self._answer(sample)
            if CLOSED in self._signals:
                self._signals.discard(CLOSED)
                raise PeerClosed("the controller has closed")
            left_s = deadline - time.monotonic()
            if left_s <= 0:
                return None
            try:
                activations = self._listener.timed_wait(iox2.Duration.from_secs_f64(left_s))
            except iox2.ListenerWaitError:
                # A signal to the program: what Python makes of it comes before the next wait.
                continue
            self._signals.update(one.id.as_value for one in activations)
            self._handle_signals()

    def close(self) -> None:
        """Tells the controller that no further observation will come, and leaves shared memory clean."""
        if self._ports:
            try:
                _notify(self._notifier, CLOSED)
            except KeyboardInterrupt:
                _notify(self._notifier, CLOSED)
                raise
        for port in self._ports:
            port.delete()
        self._ports = []

    def _open(self, config: Any) -> None:
        disabled = iox2.SignalHandlingMode.Disabled
        builder = iox2.NodeBuilder.new().config(config).signal_handling_mode(disabled)
        self._node = builder.create(iox2.ServiceType.Ipc)
        answers = self._data("action", ActionHeader)
        observations = self._data("observation", ObservationHeader)
        self._subscriber = answers.subscriber_builder().create()
        self._listener = self._event("action").listener_builder().create()
        self._publisher = _publisher(observations, self.layout.observation_bytes)
        self._notifier = self._event("observation").notifier_builder().create()
        self._announcer = _publisher(self._data("interface", None), len(self._text))
        self._announcer_waker = self._event("interface").notifier_builder().create()
        self._ports = [
            self._publisher,
            self._subscriber,
            self._notifier,
            self._listener,
            self._announcer,
            self._announcer_waker,
        ]

    def _data(self, topic: str, header: type | None) -> Any:
        """A publish-subscribe service; without a header it is that of the interface, whose last message is kept."""
        builder = self._node.service_builder(self._name(topic)).publish_subscribe(iox2.Slice[ctypes.c_uint8])
        attributes = _require(iox2.AttributeVerifier.new(), "rcwm.wire", str(WIRE))
        if header is not None:
            builder = builder.user_header(header)
            attributes = _require(attributes, "rcwm.interface", self.robot.hash)
        return (
            builder.history_size(1 if header is None else 0)
            .subscriber_max_buffer_size(1)
            .subscriber_max_borrowed_samples(2)
            .enable_safe_overflow(True)
            .max_publishers(1)
            .max_subscribers(SUBSCRIBERS_MAX)
            .max_nodes(NODES_MAX)
            .open_or_create_with_attributes(attributes)
        )

    def _event(self, topic: str) -> Any:
        return (
            self._node.service_builder(self._name(topic))
            .event()
            .max_notifiers(SUBSCRIBERS_MAX)
            .max_listeners(SUBSCRIBERS_MAX)
            .max_nodes(NODES_MAX)
            .event_id_max_value(EVENT_ID_MAX)
            .open_or_create()
        )

    def _name(self, topic: str) -> Any:
        return iox2.ServiceName.new(f"rcwm/{self.instance}/{topic}")

    def _explained(self, error: Exception) -> LinkError:
        text = f"{type(error).__name__} {error!r}"
        if "ExceedsMaxSupportedPublishers" in text:
            return LinkError(f"instance {self.instance}: a robot is there already; choose another instance or end it")
        if "IncompatibleAttributes" in text:
            return LinkError(f"instance {self.instance}: somebody is there with another interface; end it first")
        if "IncompatibleTypes" in text:
            return LinkError(f"instance {self.instance}: somebody is there with another version of the messages")
        return LinkError(f"instance {self.instance}: the link cannot be made ({text})")

    def _handle_signals(self) -> None:
        """Acts on signals, all but that the controller has left."""
        if ASKED in self._signals:
            self._announce()
        if HELLO in self._signals and self._published is not None:
            self._published[0].flags |= int(Flags.REPEATED)
            self._send()
        self._signals &= {CLOSED}

    def _announce(self) -> None:
        sample = self._announcer.loan_slice_uninit(len(self._text))
        ctypes.memmove(sample.payload_ptr, self._text, len(self._text))
        sample.assume_init().send()
        _notify(self._announcer_waker, PUBLISHED)

    def _send(self) -> None:
        """Publishes what is to be published, with the time of now."""
        if self._published is None:
            return
        header, payload = self._published
        header.published_ns = time.monotonic_ns()
        if header.period_ns == 0:
            header.scheduled_ns = header.published_ns  # in lock-step nothing is due at a time of its own
        sample = self._publisher.loan_slice_uninit(len(payload))
        ctypes.memmove(sample.user_header_ptr, ctypes.addressof(header), ctypes.sizeof(header))
        ctypes.memmove(sample.payload_ptr, bytes(payload), len(payload))
        sample.assume_init().send()
        _notify(self._notifier, PUBLISHED)

    def _answer(self, sample: Any) -> Answer:
        # One of another length is refused where it would be executed.
        length = sample.payload().len() // 4 * 4
        # Copied: the memory goes back to its publisher when the sample is dropped.
        header = ActionHeader.from_buffer_copy(ctypes.string_at(sample.user_header_ptr, ctypes.sizeof(ActionHeader)))
        numbers = np.frombuffer(ctypes.string_at(sample.payload_ptr, length), "<f4").copy()
        return Answer(int(header.answers), numbers)


def _numbers(what: str, values: np.ndarray) -> np.ndarray:
    numbers = np.asarray(values, "<f4")
    if not np.isfinite(numbers).all():
        raise LinkError(f"{what}: {numbers.tolist()} is not finite; nothing was published")
    return numbers


def _put(payload: bytearray, at: int, what: str, values: np.ndarray, shape: tuple[int, ...]) -> None:
    dtype = "float32" if values.dtype == np.float32 else "uint8"
    if values.shape != shape or values.dtype != dtype:
        found = f"{list(values.shape)} {values.dtype}"
        raise LinkError(f"{what}: {found}; expected {list(shape)} {dtype}; nothing was published")
    data = np.ascontiguousarray(values).tobytes()
    payload[at : at + len(data)] = data


def _require(attributes: Any, key: str, value: str) -> Any:
    return attributes.require(iox2.AttributeKey.new(key), iox2.AttributeValue.new(value))


def _publisher(service: Any, bytes_max: int) -> Any:
    builder = service.publisher_builder().max_loaned_samples(1).initial_max_slice_len(bytes_max)
    return builder.allocation_strategy(iox2.AllocationStrategy.Static).create()


def _notify(notifier: Any, event: int) -> None:
    notifier.notify_with_custom_event_id(iox2.EventId.new(event))
