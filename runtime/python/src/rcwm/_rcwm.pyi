"""The native module: the runtime's policy and the link, in Rust."""

import os
from collections.abc import Iterator, Mapping
from types import TracebackType
from typing import Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .interface import Interface
from .messages import Answer, Flags, Header

class Policy:
    """A bundle that carries its state from tick to tick.

    Any thread may use it, one call after the other; other threads of Python run while it computes.
    """

    def __init__(self, bundle: str | os.PathLike[str], *, threads: int = 1, sample: int | None = None) -> None:
        """Loads and checks a bundle's folder. `threads`: 1 or 2 of a tick. `sample`: a seed of samples; without it the
        mean action. Raises `BundleError`, `PolicyError` and `InputError`.
        """

    @property
    def bundle(self) -> str | os.PathLike[str]:
        """The folder that was given."""

    @property
    def kind(self) -> str:
        """`rcwm`, `dreamer` or `recurrent`."""

    @property
    def imagines(self) -> bool:
        """Whether there is a world model, which imagines what is not observed."""

    @property
    def interface(self) -> Interface:
        """What it needs of a robot: rate, states, cameras, actions."""

    @property
    def inputs(self) -> list[str]:
        """Names of the cameras and states that it reads."""

    @property
    def low(self) -> NDArray[np.float32]:
        """[action numbers]: the smallest value of each, in the interface's units."""

    @property
    def high(self) -> NDArray[np.float32]:
        """[action numbers]: the largest value of each."""

    def observe(self, inputs: Mapping[str, ArrayLike] | Observation, executed: ArrayLike | None = None) -> Decision:
        """Decides on one observation.

        `inputs` by name: a camera's picture [rows, columns, 3] u8, upright, RGB, which is read where it lies (do not
        write to it meanwhile) and copied only where its bytes do not lie one after another; a state's numbers [n], in
        units. Others than the bundle's are not read. `executed` is the action that was really executed to get here
        [action numbers]; without it an episode begins, from the bundle's initial state.

        Raises `InputError` for what is missing, of another shape or type, or not finite; `NotFinite` where the policy's
        own numbers are not; the state is then that of the last good tick.
        """

    def work_ahead(self, executed: ArrayLike | None = None) -> None:
        """Computes all of the next tick that needs only the action: in the idle time after it was sent. `observe` with
        the same action then has that much less to do; with another one it is done again (`Decision.recomputed`).
        """

    def imagine(self, executed: ArrayLike) -> Decision:
        """Goes on without a picture: the world model imagines it. Without a world model `executed` is held."""

    def warm_caches(self) -> None:
        """Gets ready for a picture that comes soon; takes as long as a tick and changes nothing."""

    def close(self) -> None:
        """Frees its memory; later calls raise `PolicyError`."""

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

class Decision:
    """What the policy decided on one observation."""

    @property
    def action(self) -> NDArray[np.float32]:
        """[action numbers] in the interface's units, within the bundle's limits: a new array each time."""

    @property
    def mean(self) -> NDArray[np.float32]:
        """Mean of the action's distribution, which is over [-1, 1]."""

    @property
    def std(self) -> NDArray[np.float32]:
        """Its standard deviation."""

    @property
    def surprise(self) -> dict[str, float]:
        """How unexpected the picture was, in nats: `robot` and `environment`, or `dynamics`; empty without a world
        model or a picture.
        """

    @property
    def stage_ns(self) -> dict[str, int]:
        """Time of each part after the picture was there; 0 for what had been worked ahead."""

    @property
    def recomputed(self) -> bool:
        """What had been worked ahead was for another action."""

    @property
    def helper_late(self) -> bool:
        """The second thread was late, and the first computed its share."""

class Observation:
    """What was received: a mapping of names to arrays, as `Policy.observe` takes it.

    States are [n] f32; cameras' pictures [rows, columns, 3] u8; masks, `<camera>_mask`, [rows, columns] u8, 255 where
    the robot is. Arrays cannot be written to. They lie in shared memory, whose room goes back to the sender when the
    last of them is gone: an end of a link may hold two observations at a time. `copy()` is for those that are kept.
    """

    @property
    def sequence(self) -> int:
        """Counts up by one; an answer names it."""

    @property
    def episode(self) -> int: ...
    @property
    def step(self) -> int:
        """Observations since the first of the episode."""

    @property
    def flags(self) -> Flags: ...
    @property
    def task(self) -> int: ...
    @property
    def reward(self) -> float:
        """Of the transition that led here; 0 at the first of an episode."""

    @property
    def period_ns(self) -> int:
        """0 in lock-step, where the robot waits for each answer."""

    @property
    def scheduled_ns(self) -> int:
        """When it was due, CLOCK_MONOTONIC, as all times."""

    @property
    def published_ns(self) -> int: ...
    @property
    def captured_ns(self) -> list[int]:
        """When each camera took its picture; 0 where that is not known."""

    @property
    def executed(self) -> NDArray[np.float32]:
        """The action that led here, as executed."""

    @property
    def state(self) -> NDArray[np.float32]:
        """All states' numbers, one state after the other."""

    def copy(self) -> Observation:
        """The same in memory of its own."""

    def keys(self) -> list[str]: ...
    def __getitem__(self, name: str) -> NDArray[np.float32] | NDArray[np.uint8]: ...
    def __contains__(self, name: object) -> bool: ...
    def __iter__(self) -> Iterator[str]: ...
    def __len__(self) -> int: ...
    def __buffer__(self, flags: int, /) -> memoryview: ...

class RobotLink:
    """The robot's end: observations go out, answers come in. One robot an instance.

    The robot says its interface when the link is opened and whenever somebody asks during `wait_action`.
    """

    robot: Interface
    instance: str

    def __init__(self, robot: Interface, instance: str) -> None:
        """Raises `LinkError`, `LinkTaken`, `SharedMemoryFull` and `InterfaceError`."""

    def publish(
        self,
        header: Header,
        state: ArrayLike,
        executed: ArrayLike,
        images: Mapping[str, ArrayLike],
        masks: Mapping[str, ArrayLike],
    ) -> None:
        """Writes an observation into shared memory and sends it: state [n] and executed action [n] in the interface's
        order and units; a picture [rows, columns, 3] u8 of each camera; a mask [rows, columns] u8, 255 where the robot
        is, of each that has one. Raises `InputError`, and publishes nothing, for what is not the interface's.
        """

    def wait_action(self, timeout_s: float) -> Answer | None:
        """The newest answer, or None when the time is up. What was published last is published again, with
        `Flags.REPEATED`, for a controller that connects meanwhile. Raises `PeerClosed` once when the controller leaves.
        """

    @property
    def misfits(self) -> int:
        """Answers of another length than the interface's, which were dropped."""

    def close(self) -> None:
        """Tells the controller that no further observation will come, and leaves shared memory clean."""

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

class ControllerLink:
    """A controller's end: observations come in, answers go out. It may be opened before its robot."""

    instance: str

    def __init__(self, instance: str, policy: Policy | None = None) -> None:
        """With a policy, a robot that is not what it needs is refused (`DoesNotFit`), here or by a later wait. Raises
        `LinkError`, `LinkTaken` and `SharedMemoryFull`.
        """

    def wait_robot(self, timeout_s: float) -> Interface | None:
        """The robot's interface, or None when the time is up."""

    def observe(self, timeout_s: float) -> Observation | None:
        """The next observation, or None when the time is up. Raises `PeerClosed` when the robot has ended."""

    def act(self, answers: int, numbers: ArrayLike, source: int = 0) -> None:
        """Answers the observation of the sequence `answers`, in units; numbers beyond the limits are clamped to them.
        `source`: see `rcwm.link.Source`. Raises `InputError`, and sends nothing, where a number is not finite or their
        count is not the robot's.
        """

    def forget_robot(self) -> None:
        """After `PeerClosed`: the next robot may be another one."""

    def close(self) -> None:
        """Tells the robot that no further answer will come."""

    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

class ObserverLink:
    """Listens in: nobody waits for it, and it sees the newest observation only."""

    instance: str

    def __init__(self, instance: str) -> None:
        """Raises `LinkError` and `SharedMemoryFull`."""

    def wait_robot(self, timeout_s: float) -> Interface | None:
        """The robot's interface, or None when the time is up."""

    def observe(self, timeout_s: float) -> Observation | None:
        """The next observation, or None when the time is up. Raises `PeerClosed` when the robot has ended."""

    def close(self) -> None: ...
    def __enter__(self) -> Self: ...
    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...
