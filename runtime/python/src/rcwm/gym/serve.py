"""The loop: an environment is observed, a controller answers, the answer is executed."""

from __future__ import annotations

import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from ..errors import PeerClosed, RcwmError
from ..interface import Interface
from ..messages import Answer, Flags, Header
from .link import Clock, Link
from .observe import Observe, Seen, check_action_space, see
from .safety import Refused, Safety

# Share of a period that is left to the controller, however long the environment takes for a step.
ANSWER_SHARE_MIN = 0.1
# Of a period: by how much an answer may be late.
LATE_MAX = 0.1
# Actions by which a robot comes to rest that may change its command only slowly, at most.
REST_ACTIONS_MAX = 200
# Longest wait before what is seen is said anew, while time stands still in real time.
SLICE_S = 0.1
# Steps whose longest duration is expected of the next.
STEPS_WATCHED = 20


class NoAnswer(RcwmError):
    """No controller answered in time."""


@dataclass
class Counts:
    """What happened. Answers are refused where they are not finite, out of limits or of another length."""

    episodes: int = 0
    successes: int = 0
    total_reward: float = 0.0
    observations: int = 0
    answers: int = 0
    slowed_down: int = 0
    refused_not_finite: int = 0
    refused_out_of_limits: int = 0
    refused_length: int = 0
    stale_answers: int = 0
    rests: int = 0
    missed_answers: int = 0
    controllers_left: int = 0
    overruns: int = 0

    def as_dict(self) -> dict[str, Any]:
        """For a result as JSON."""
        return asdict(self)


def serve(
    env: Any,
    interface: Interface,
    instance: str | Link,
    *,
    episodes: int = 1,
    seed: int | None = None,
    realtime: bool = False,
    observe: Observe | None = None,
    timeout_s: float = 60.0,
    rest: Callable[[np.ndarray], None] | None = None,
    clock: Clock | None = None,
) -> Counts:
    """Serves whole episodes of a Gymnasium environment as the robot of an instance (or of a link that is open already).

    In lock-step every observation waits for its answer. In real time an episode begins to run with its first answer:
    from then on an observation goes out every 1 / `rate_hz` s, and a tick without an answer, also where the controller
    has left, executes the safe action and goes on. An answer that is not finite, out of limits or of another
    length is never executed: the safe action is, and it is counted. `observe` is described in `rcwm.gym`.

    A robot that may still move by its last command is given its safe action at the end of each episode, and whatever
    else ends the loop: by `rest`, which a real robot should have; without it by `env.step`, but not where the
    episode is over, since environments are not stepped then.

    Success is `info["success"]` or `info["is_success"]`; it counts where it ever was in an episode.
    Raises `NoAnswer` after `timeout_s` without any answer, and `RcwmError` for an environment that is not this robot.
    """
    check_action_space(env, interface)
    link = _open(interface, instance) if isinstance(instance, str) else instance
    loop = None
    try:
        loop = _Loop(env, interface, link, observe, realtime, timeout_s, rest, clock or Clock())
        for episode in range(episodes):
            loop.episode(seed if episode == 0 else None)
        return loop.counts
    finally:
        # The peer first, then the robot: whatever ends the loop, neither is left with the last command. Another
        # Ctrl-C does not break that off.
        with _uninterrupted():
            try:
                link.close()
            finally:
                if loop is not None:
                    loop.come_to_rest()


@contextmanager
def _uninterrupted() -> Iterator[None]:
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [(number, signal.signal(number, signal.SIG_IGN)) for number in numbers]
    try:
        yield
    finally:
        for number, handler in before:
            signal.signal(number, handler)


def _open(interface: Interface, instance: str) -> Link:
    from ..link import RobotLink

    return RobotLink(interface, instance)


class _Loop:
    def __init__(
        self,
        env: Any,
        robot: Interface,
        link: Link,
        observe: Observe | None,
        realtime: bool,
        timeout_s: float,
        rest: Callable[[np.ndarray], None] | None,
        clock: Clock,
    ):
        self.env, self.robot, self.link, self.observe = env, robot, link, observe
        self.realtime, self.timeout_ns, self.clock = realtime, int(timeout_s * 1e9), clock
        self.period_ns = round(1e9 / robot.rate_hz)
        self.safety, self.counts = Safety(robot), Counts()
        self.sequence = 0
        self.rest = rest
        #: What was measured last, where the robot may still move by its last command.
        self.moving: np.ndarray | None = None
        #: Whether the environment can be stepped.
        self.runs = False
        self.durations_ns: deque[int] = deque([0], STEPS_WATCHED)

    def episode(self, seed: int | None) -> None:
        """From `reset` to the observation that is the last."""
        observation, info = self.env.reset(seed=seed)
        seen = see(self.env, self.robot, observation, self.observe)
        executed, reward, flags = self.safety.begin(seen.state), 0.0, Flags.FIRST | _success(info)
        step, succeeded = 0, Flags.SUCCESS in flags
        scheduled_ns: int | None = None
        while True:
            captured_ns = self.clock.now_ns()
            if scheduled_ns is not None:
                scheduled_ns = self._next_tick(scheduled_ns)
            header = Header(
                self.sequence, self.counts.episodes, step, flags, reward, captured_ns,
                scheduled_ns or captured_ns, self.period_ns if self.realtime else 0,
            )  # fmt: skip
            self._publish(seen, executed, header)
            self.counts.observations += 1
            over = Flags.LAST in flags
            self.runs = not over
            if self.moving is not None:
                self.moving = seen.state
            if over:
                # Nothing more is answered: whatever moves by its last command would go on.
                self.come_to_rest()
            answer: Answer | None
            if scheduled_ns is None:
                answer = self._first_answer((seen, executed, header) if self.realtime else None)
            else:
                answer = self._answer_by(scheduled_ns)
            if self.realtime and scheduled_ns is None:
                scheduled_ns = self.clock.now_ns()
            self.sequence += 1
            if over:
                break
            executed, held = self._choose(answer, seen.state)
            begun_ns = self.clock.now_ns()
            self.moving = seen.state
            observation, reward, terminated, truncated, info = self.env.step(executed.copy())
            self.safety.executed(executed)
            self.durations_ns.append(self.clock.now_ns() - begun_ns)
            seen, reward, step = see(self.env, self.robot, observation, self.observe), float(reward), step + 1
            if not np.isfinite(reward):
                raise RcwmError(f"the environment's reward is not finite at step {step}")
            flags = _success(info) | held
            flags |= Flags.LAST if terminated or truncated else Flags(0)
            flags |= Flags.TERMINAL if terminated else Flags(0)
            self.counts.total_reward += reward
            succeeded |= Flags.SUCCESS in flags
        self.counts.episodes += 1
        self.counts.successes += succeeded

    def come_to_rest(self) -> None:
        """The safe action, where the robot may still move by another; once more while it may change only slowly."""
        measured, self.moving = self.moving, None
        if measured is None or (self.rest is None and not self.runs):
            return
        for _ in range(REST_ACTIONS_MAX):
            rest = self.safety.rest(measured)
            if rest is None:
                return
            if self.rest is not None:
                self.rest(rest.copy())
            else:
                self.env.step(rest.copy())
            self.safety.executed(rest)
            if not self.safety.still_moves(rest):
                return
            if self.realtime:
                self.clock.sleep_until(self.clock.now_ns() + self.period_ns)

    def _publish(self, seen: Seen, executed: np.ndarray, header: Header) -> None:
        with_mask = [camera.name for camera in self.robot.cameras if camera.mask]
        if with_mask and all(name in seen.masks for name in with_mask):
            header = header.with_flag(Flags.MASK_VALID)
        self.link.publish(header, seen.state, executed, seen.images, seen.masks)

    def _first_answer(self, stands: tuple[Seen, np.ndarray, Header] | None) -> Answer:
        """Time stands still until somebody answers. Raises `NoAnswer`.

        A controller passes over what was due long ago: in real time, what stands is published anew, due now.
        """
        deadline_ns = self.clock.now_ns() + self.timeout_ns
        slice_ns = min(int(SLICE_S * 1e9), self.period_ns)
        while True:
            now_ns = self.clock.now_ns()
            answer = self._wait(deadline_ns if stands is None else min(deadline_ns, now_ns + slice_ns))
            if answer is not None:
                return answer
            if self.clock.now_ns() >= deadline_ns:
                waited, stale = self.timeout_ns / 1e9, self.counts.stale_answers
                raise NoAnswer(
                    f"no answer within {waited:g} s ({stale} to something else): "
                    "is a controller running on this instance?"
                )
            if stands is not None:
                seen, executed, header = stands
                self._publish(seen, executed, replace(header, scheduled_ns=self.clock.now_ns()))

    def _answer_by(self, scheduled_ns: int) -> Answer | None:
        """What comes early enough to be executed before the next observation is due."""
        room_ns = int(ANSWER_SHARE_MIN * self.period_ns)
        # However late the observation was, a controller gets a moment.
        deadline_ns = max(scheduled_ns + self.period_ns - max(self.durations_ns), self.clock.now_ns() + room_ns)
        while True:
            answer = self._wait(deadline_ns)
            now_ns = self.clock.now_ns()
            if answer is not None and now_ns <= deadline_ns + int(LATE_MAX * self.period_ns):
                return answer
            # It came, but this program was stopped meanwhile: it says what was right then.
            if answer is not None or now_ns >= deadline_ns:
                self.counts.missed_answers += 1
                return None

    def _wait(self, deadline_ns: int) -> Answer | None:
        """One wait for an answer to the present observation; None does not mean that the time is up."""
        left_s = max(0.0, (deadline_ns - self.clock.now_ns()) / 1e9)
        misfits = self.link.misfits
        try:
            answer = self.link.wait_action(left_s)
        except PeerClosed:
            self.counts.controllers_left += 1
            return None
        finally:
            self.counts.refused_length += self.link.misfits - misfits
        if answer is None:
            return None
        if answer.answers != self.sequence:
            self.counts.stale_answers += 1
            return None
        self.counts.answers += 1
        return answer

    def _choose(self, answer: Answer | None, state: np.ndarray) -> tuple[np.ndarray, Flags]:
        """What is executed, and the flag that says that it was nobody's answer."""
        if answer is not None:
            accepted = self.safety.accept(answer.action)
            if isinstance(accepted, np.ndarray):
                asked = np.asarray(answer.action, np.float32).reshape(-1)
                self.counts.slowed_down += not np.allclose(accepted, asked, rtol=0, atol=1e-6)
                return accepted, Flags(0)
            if accepted is Refused.NOT_FINITE:
                self.counts.refused_not_finite += 1
            elif accepted is Refused.OUT_OF_LIMITS:
                self.counts.refused_out_of_limits += 1
            else:
                self.counts.refused_length += 1
        rest = self.safety.rest(state)
        if rest is None:
            raise RcwmError(
                'fallback = "hold" before there was a command: give the action `measured`, or a safe action'
            )
        self.counts.rests += 1
        return rest, Flags.ACTION_HELD

    def _next_tick(self, scheduled_ns: int) -> int:
        """Waits for the next tick; ticks that are past are left out and counted."""
        scheduled_ns += self.period_ns
        behind = (self.clock.now_ns() - scheduled_ns) // self.period_ns
        if behind > 0:
            self.counts.overruns += int(behind)
            scheduled_ns += int(behind) * self.period_ns
        self.clock.sleep_until(scheduled_ns)
        return scheduled_ns


def _success(info: dict[str, Any]) -> Flags:
    return Flags.SUCCESS if info.get("success", info.get("is_success", False)) else Flags(0)
