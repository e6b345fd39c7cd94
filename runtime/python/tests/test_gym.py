"""The loop between an environment and a controller, over a link in memory and with a clock of its own."""

from collections.abc import Callable

import numpy as np
import pytest

from rcwm import RcwmError, interface
from rcwm.gym import Answer, Clock, Flags, NoAnswer, PeerClosed, UnfitEnvironment, serve

STEP_NS = 1_000_000


class Time(Clock):
    """Time that passes only where somebody waits or works."""

    def __init__(self):
        self.ns = 0

    def now_ns(self):
        return self.ns

    def sleep_until(self, then_ns):
        self.ns = max(self.ns, then_ns)


class Memory:
    """A link whose controller is a function of an observation's number: an action, an answer, None, an exception."""

    def __init__(self, controller: Callable, clock: Time):
        self.controller, self.clock = controller, clock
        self.seen, self.closed, self.asked, self.misfits = [], False, 0, 0

    def publish(self, header, state, executed, images, masks):
        self.seen.append((header, state.copy(), executed.copy(), images, masks))
        self.asked = 0

    def wait_action(self, timeout_s):
        sequence = self.seen[-1][0].sequence
        self.asked += 1
        found = self.controller(sequence) if self.asked == 1 else None
        if found is None:
            self.clock.ns += int(timeout_s * 1e9)
            return None
        if isinstance(found, BaseException):
            raise found
        self.clock.ns += STEP_NS
        return found if isinstance(found, Answer) else Answer(sequence, np.array(found, np.float32))

    def close(self):
        self.closed = True


class Arm:
    """Joints that go where they are told; an episode of four steps, solved from the third on."""

    action_space = None

    def __init__(self, step_ns=0, clock=None, terminates=False):
        self.step_ns, self.clock, self.terminates = step_ns, clock, terminates
        self.executed = []

    def observe(self):
        picture = np.full((32, 48, 3), self.steps, np.uint8)
        mask = np.zeros((32, 48), bool)
        mask[3:5] = True
        return {
            "joint_pos": self.joints,
            "joint_vel": np.zeros(2),
            "front": picture,
            "front_mask": mask,
            "wrist": np.zeros((16, 16, 3), np.uint8),
        }

    def reset(self, *, seed=None, options=None):
        self.steps, self.joints = 0, np.array([0.25, -0.25], np.float32)
        return self.observe(), {}

    def step(self, action):
        self.executed.append(action.copy())
        self.steps, self.joints = self.steps + 1, np.array(action, np.float32)
        if self.clock:
            self.clock.ns += self.step_ns
        over = self.steps == 4
        done, cut = over and self.terminates, over and not self.terminates
        return self.observe(), 0.5, done, cut, {"success": self.steps >= 3}


def run(small, controller, env=None, **options):
    clock = options.pop("clock", None) or Time()
    link, env = Memory(controller, clock), env or Arm()
    counts = serve(env, small, link, clock=clock, **options)
    assert link.closed
    return link, env, counts


def test_in_lock_step_every_observation_is_answered_and_every_answer_executed(small):
    link, env, counts = run(small, lambda n: [0.1 * n, 0.0], episodes=2)
    headers = [seen[0] for seen in link.seen]
    assert [header.sequence for header in headers] == list(range(10))
    assert [header.step for header in headers] == [0, 1, 2, 3, 4] * 2
    assert [header.episode for header in headers] == [0] * 5 + [1] * 5
    assert {header.period_ns for header in headers} == {0}
    assert (counts.answers, counts.episodes, counts.successes, counts.total_reward) == (10, 2, 2, 4.0)
    # What led to an observation is reported with it.
    for at in (1, 2, 3, 4):
        assert np.array_equal(link.seen[at][2], env.executed[at - 1])


def test_flags_say_where_an_episode_begins_ends_and_is_solved(small):
    link, _, _ = run(small, lambda n: [0, 0])
    mask = Flags.MASK_VALID
    assert [seen[0].flags for seen in link.seen] == [
        Flags.FIRST | mask,
        mask,
        mask,
        Flags.SUCCESS | mask,
        Flags.SUCCESS | Flags.LAST | mask,
    ]
    link, _, _ = run(small, lambda n: [0, 0], env=Arm(terminates=True))
    assert Flags.TERMINAL | Flags.LAST in link.seen[-1][0].flags


def test_masks_travel_as_0_and_255_and_states_in_the_order_of_the_interface(small):
    link, _, _ = run(small, lambda n: [0.3, 0.2])
    _, state, _, images, masks = link.seen[1]
    assert np.allclose(state, [0.3, 0.2, 0, 0])
    assert np.unique(masks["front"]).tolist() == [0, 255]
    assert images["front"].shape == (32, 48, 3)


def test_the_first_executed_action_of_an_absolute_command_is_where_the_robot_is(small):
    link, _, _ = run(small, lambda n: [0, 0])
    assert np.allclose(link.seen[0][2], [0.25, -0.25])


@pytest.mark.parametrize(
    ("bad", "count"),
    [
        ([float("nan"), 0], "refused_not_finite"),
        ([float("inf"), 0], "refused_not_finite"),
        ([2.1, 0], "refused_out_of_limits"),
        ([0, -1.001], "refused_out_of_limits"),
        ([0, 0, 0], "refused_length"),
    ],
)
def test_what_must_not_be_executed_never_is_and_is_counted(small, bad, count):
    link, env, counts = run(small, lambda n: bad if n == 2 else [0.2, 0.1])
    assert getattr(counts, count) == 1
    assert counts.rests == 1
    # At rest: where the joints were measured.
    assert np.allclose(env.executed[2], [0.2, 0.1])
    assert Flags.ACTION_HELD in link.seen[3][0].flags
    assert np.isfinite(env.executed).all()


def test_a_jump_is_cut_to_the_rate_and_reported_as_executed(small):
    link, env, counts = run(small, lambda n: [-1.0 if n % 2 else 1.0, 0.0])
    assert np.allclose([action[0] for action in env.executed], [0.75, 0.25, 0.75, 0.25])  # the arm stands at 0.25
    assert np.allclose(link.seen[2][2], [0.25, 0.0])
    assert counts.slowed_down == 4


def test_an_answer_to_another_observation_is_not_executed(small):
    stale = Answer(77, np.array([1, 1], np.float32))
    with pytest.raises(NoAnswer, match="no answer within 5 s"):
        run(small, lambda n: stale if n == 1 else [0, 0], timeout_s=5)


def test_in_lock_step_time_stands_still_when_the_controller_leaves(small):
    class Comeback:
        """Leaves at the third observation; the next controller answers it."""

        def __init__(self):
            self.left = False

        def __call__(self, n):
            return [0.1, 0.1]

    clock = Time()
    link, answers = Memory(Comeback(), clock), []

    def wait_action(timeout_s, original=link.wait_action):
        if len(link.seen) == 3 and not answers:
            answers.append("left")
            raise PeerClosed("the controller has closed")
        return original(timeout_s)

    link.wait_action = wait_action
    env = Arm()
    counts = serve(env, small, link, clock=clock)
    assert counts.controllers_left == 1
    assert counts.rests == 0
    assert len(env.executed) == 4


def test_without_a_controller_it_ends_with_one_line_and_the_link_is_closed(small):
    clock = Time()
    link = Memory(lambda n: None, clock)
    with pytest.raises(NoAnswer) as error:
        serve(Arm(), small, link, clock=clock, timeout_s=3)
    assert "\n" not in str(error.value)
    assert link.closed
    assert clock.ns == 3_000_000_000


def test_in_real_time_observations_go_out_at_the_rate(small):
    clock = Time()
    link, _, counts = run(small, lambda n: [0, 0], clock=clock, env=Arm(5_000_000, clock), realtime=True)
    due = [seen[0].scheduled_ns for seen in link.seen]
    assert np.diff(due[1:]).tolist() == [50_000_000] * 3
    assert {seen[0].period_ns for seen in link.seen} == {50_000_000}
    assert counts.missed_answers == 0
    assert counts.overruns == 0


def test_in_real_time_a_tick_without_an_answer_is_one_at_rest(small):
    clock = Time()
    script = [[0.3, 0.2], None, PeerClosed("left"), [0.1, 0.1], [0, 0]]
    link, env, counts = run(small, lambda n: script[n], clock=clock, env=Arm(0, clock), realtime=True)
    assert np.allclose(env.executed, [[0.3, 0.2], [0.3, 0.2], [0.3, 0.2], [0.1, 0.1]])
    assert (counts.missed_answers, counts.controllers_left, counts.rests) == (2, 1, 2)
    assert [Flags.ACTION_HELD in seen[0].flags for seen in link.seen] == [False, False, True, True, False]


def test_in_real_time_ticks_that_are_past_are_left_out_and_counted(small):
    clock = Time()
    link, _, counts = run(small, lambda n: [0, 0], clock=clock, env=Arm(120_000_000, clock), realtime=True)
    assert counts.overruns > 0
    due = [seen[0].scheduled_ns for seen in link.seen[1:]]
    assert all(step % 50_000_000 == 0 and step > 0 for step in np.diff(due))


def test_at_the_end_of_every_episode_a_robot_with_a_rest_is_brought_to_rest(small):
    rests = []
    run(small, lambda n: [0.1, 0.0], episodes=2, rest=lambda action: rests.append(action.tolist()))
    assert len(rests) == 2, "once after each last observation, and not once more"
    rests.clear()
    with pytest.raises(KeyboardInterrupt):
        run(small, lambda n: [0.1, 0.0] if n < 2 else KeyboardInterrupt(), rest=lambda action: rests.append(1))
    assert rests == [1]


def test_in_real_time_what_waits_for_its_first_answer_is_said_anew(small):
    clock = Time()
    # A controller that comes after a second, and passes over what was due more than two periods ago.
    late = Memory(lambda n: None, clock)
    period_ns = round(1e9 / small.rate_hz)

    def wait_action(timeout_s):
        header = late.seen[-1][0]
        fresh = clock.ns - header.scheduled_ns < 2 * period_ns
        if clock.ns < 1_000_000_000 or not fresh:
            clock.ns += int(timeout_s * 1e9)
            return None
        clock.ns += STEP_NS
        return Answer(header.sequence, np.zeros(2, np.float32))

    late.wait_action = wait_action
    counts = serve(Arm(), small, late, realtime=True, clock=clock)
    assert (counts.episodes, counts.observations, counts.answers) == (1, 5, 5)


def test_in_real_time_a_robot_slower_than_its_period_leaves_its_controller_a_moment(small):
    clock = Time()
    env = Arm(step_ns=round(1.02e9 / small.rate_hz), clock=clock)
    _, _, counts = run(small, lambda n: [0, 0], env=env, clock=clock, realtime=True, episodes=3)
    assert counts.missed_answers == 0


def test_in_real_time_an_answer_that_is_found_long_after_its_time_is_not_executed(small):
    clock = Time()

    def stopped(n):
        if n == 2:
            # The whole program stood still.
            clock.ns += 30_000_000_000
        return [0.1, 0.0]

    _, _, counts = run(small, stopped, clock=clock, realtime=True)
    assert (counts.missed_answers, counts.rests) == (1, 1)


def test_an_environment_of_another_robot_is_refused_before_anything_is_sent(small):
    gymnasium = pytest.importorskip("gymnasium")
    clock = Time()
    for space, reason in [
        (gymnasium.spaces.Discrete(3), "expected a Box"),
        (gymnasium.spaces.Box(-1, 1, (3,)), r"takes \[3\] numbers; the interface has 2"),
        (gymnasium.spaces.Box(-1, 1, (2,)), "arm.j1: the interface allows -2 to 2, the environment -1 to 1"),
    ]:
        env = Arm()
        env.action_space = space
        with pytest.raises(UnfitEnvironment, match=reason):
            serve(env, small, Memory(lambda n: [0, 0], clock), clock=clock)


def test_a_missing_camera_a_wrong_picture_and_a_bad_number_are_refused(small):
    for change, reason in [
        (lambda seen: seen.pop("wrist"), "no picture of camera wrist"),
        (lambda seen: seen.update(wrist=np.zeros((16, 16, 3))), "expected uint8"),
        (lambda seen: seen.update(joint_vel=np.array([0, np.nan])), "joint_vel.j2 is not finite"),
        (lambda seen: seen.pop("joint_pos"), "state joint_pos is missing"),
    ]:

        def observe(seen, change=change):
            seen = dict(seen)
            change(seen)
            return seen

        with pytest.raises(RcwmError, match=reason) as error:
            run(small, lambda n: [0, 0], observe=observe)
        assert "\n" not in str(error.value)


def test_a_gymnasium_environment_runs_as_it_is():
    gymnasium = pytest.importorskip("gymnasium")
    robot = interface.parse("""
[interface]
name = "pendulum"
rate_hz = 20.0
[[interface.state]]
name = "pendulum"
kind = "state/pendulum"
elements = ["cos", "sin", "speed"]
unit = "1"
[[interface.action]]
name = "torque"
kind = "command/torque"
mode = "velocity"
elements = ["torque"]
unit = "N*m"
low = [-2.0]
high = [2.0]
fallback = "zero"
""")
    clock = Time()
    link = Memory(lambda n: [0.5], clock)
    counts = serve(gymnasium.make("Pendulum-v1"), robot, link, seed=3, clock=clock)
    assert counts.observations == 201
    assert Flags.LAST in link.seen[-1][0].flags
    assert Flags.TERMINAL not in link.seen[-1][0].flags
