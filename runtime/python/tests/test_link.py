"""All ends of the link over shared memory, against each other."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from rcwm import interface
from rcwm.errors import InputError
from rcwm.link import (
    ControllerLink,
    Flags,
    Header,
    LinkError,
    LinkTaken,
    ObserverLink,
    PeerClosed,
    RobotLink,
    Source,
    WrongThread,
)


@pytest.fixture
def prefix(monkeypatch):
    name = f"rcwmtest{os.getpid()}_"
    monkeypatch.setenv("RCWM_PREFIX", name)
    return name


@pytest.fixture
def link(small, prefix):
    with RobotLink(small, "a") as link:
        yield link


@pytest.fixture
def pair(link):
    """The robot's end, and a controller's that has found it."""
    with ControllerLink("a") as controller:
        link.wait_action(0.01)
        assert controller.wait_robot(5) == link.robot
        link.wait_action(0.01)
        yield link, controller


def publish(link, sequence=0, flags=Flags.FIRST | Flags.MASK_VALID):
    images = {"front": np.full((32, 48, 3), 7, np.uint8), "wrist": np.full((16, 16, 3), sequence % 256, np.uint8)}
    masks = {"front": np.full((32, 48), 255, np.uint8)}
    header = Header(sequence, 2, sequence, flags, 0.5, 123, 456, 0)
    link.publish(header, np.arange(4, dtype=np.float32), np.array([0.5, -0.5], np.float32), images, masks)


def test_an_observation_arrives_and_its_answer_comes_back(pair):
    link, controller = pair
    publish(link)
    seen = controller.observe(1)
    assert (seen.sequence, seen.episode, seen.step, seen.reward, seen.period_ns) == (0, 2, 0, 0.5, 0)
    assert seen.flags == Flags.FIRST | Flags.MASK_VALID
    assert seen.captured_ns == [123, 123]
    assert seen.scheduled_ns == seen.published_ns > 0  # in lock-step nothing is due at a time of its own
    assert list(seen) == seen.keys() == ["joint_pos", "joint_vel", "front", "front_mask", "wrist"]
    assert (seen["joint_vel"].tolist(), seen.state.tolist()) == ([2, 3], [0, 1, 2, 3])
    assert seen.executed.tolist() == [0.5, -0.5]
    assert seen["front"].shape == (32, 48, 3)
    assert (seen["front"] == 7).all()
    assert (seen["front_mask"] == 255).all()
    controller.act(seen.sequence, [1.5, 0.25], Source.FALLBACK)
    answer = link.wait_action(1)
    assert (answer.answers, answer.action.tolist(), answer.source) == (0, [1.5, 0.25], Source.FALLBACK)
    assert link.wait_action(0.0) is None


def test_a_controller_that_comes_later_gets_the_observation_again(link):
    publish(link)
    with ControllerLink("a") as controller:
        link.wait_action(0.01)
        assert controller.wait_robot(5) is not None
        assert link.wait_action(0.05) is None
        assert controller.observe(1).flags == Flags.FIRST | Flags.MASK_VALID | Flags.REPEATED


def test_a_controller_that_leaves_is_noticed_once_and_after_its_last_answer(pair):
    link, controller = pair
    publish(link)
    controller.act(controller.observe(1).sequence, [0, 0])
    controller.close()
    assert link.wait_action(1.0).answers == 0
    with pytest.raises(PeerClosed):
        link.wait_action(1.0)
    assert link.wait_action(0.0) is None


def test_a_robot_that_leaves_is_noticed_and_another_may_come(pair, prefix):
    link, controller = pair
    publish(link)
    link.close()
    assert controller.observe(1).sequence == 0
    with pytest.raises(PeerClosed):
        controller.observe(1)
    controller.forget_robot()
    other = interface.parse(link.robot.canonical().replace("small", "other"))
    with RobotLink(other, "a") as second:
        second.wait_action(0.01)
        assert controller.wait_robot(5) == other


def test_an_observer_sees_what_the_controller_sees(pair):
    link, controller = pair
    with ObserverLink("a") as observer:
        link.wait_action(0.01)
        assert observer.wait_robot(5) == link.robot
        publish(link, 3)
        assert observer.observe(1).sequence == controller.observe(1).sequence == 3


def test_arrays_lie_in_shared_memory_and_outlive_the_link(pair):
    link, controller = pair
    publish(link, 1)
    seen = controller.observe(1)
    first, again = seen["wrist"], seen["wrist"]
    assert np.shares_memory(first, again)
    assert not first.flags.writeable
    kept = seen.copy()
    assert not np.shares_memory(first, kept["wrist"])
    del seen, again
    publish(link, 2)
    second = controller.observe(1)["wrist"]
    publish(link, 3)
    with pytest.raises(LinkError, match="two observations"):
        controller.observe(1)
    assert (first[0, 0, 0], second[0, 0, 0]) == (1, 2)
    del second
    assert controller.observe(1)["wrist"][0, 0, 0] == 3
    controller.close()
    link.close()
    assert (first == 1).all()
    assert (kept["wrist"] == 1).all()


def test_what_another_thread_lets_go_goes_back_to_the_robot(pair):
    link, controller = pair
    for sequence in range(6):
        publish(link, sequence)
        held = [controller.observe(1)]
        assert held[0].sequence == sequence
        thread = threading.Thread(target=held.clear)
        thread.start()
        thread.join()


def test_an_end_belongs_to_its_thread(pair):
    link, controller = pair
    raised = []

    def use():
        for call in (lambda: link.wait_action(0), lambda: controller.observe(0), link.close):
            try:
                call()
            except WrongThread as error:
                raised.append(str(error))

    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    assert len(raised) == 3
    assert "thread that opened it" in raised[0]


def test_other_threads_run_while_an_end_waits(link):
    counted, done = [0], threading.Event()

    def count():
        while not done.is_set():
            counted[0] += 1
            time.sleep(0.001)

    thread = threading.Thread(target=count)
    thread.start()
    assert link.wait_action(0.3) is None
    done.set()
    thread.join()
    assert counted[0] > 20


def test_a_second_robot_and_a_second_controller_are_refused_in_one_line(pair, small):
    link, _ = pair
    with pytest.raises(LinkTaken, match="another simulator is already connected"):
        RobotLink(small, "a")
    # As soon as it knows the interface, which the robot says once more where it must.
    with pytest.raises(LinkTaken, match="another controller"), ControllerLink("a") as second:
        link.wait_action(0.01)
        second.observe(5)


@pytest.mark.parametrize("instance", ["", "a/b", ".a", "a" * 65])
def test_a_bad_name_of_an_instance_is_refused(small, prefix, instance):
    for end in (lambda: RobotLink(small, instance), lambda: ControllerLink(instance), lambda: ObserverLink(instance)):
        with pytest.raises(LinkError, match="expected 1 to 64"):
            end()


def test_nothing_is_left_in_shared_memory(small, prefix):
    link = RobotLink(small, "b")
    publish(link)
    link.close()
    link.close()
    left = [path.name for path in Path("/dev/shm").iterdir() if path.name.startswith(prefix)]
    assert [name for name in left if ".data" in name] == []
    with pytest.raises(LinkError, match="was closed"):
        link.wait_action(0)


def test_what_is_not_the_interfaces_is_not_published(pair):
    link, controller = pair
    images = {"front": np.zeros((32, 48, 3), np.uint8), "wrist": np.zeros((16, 16, 3), np.uint8)}
    header, state, executed = Header(0, 0, 0, Flags.FIRST, 0.0, 0, 0, 0), np.zeros(4), np.zeros(2)
    half = images | {"front": images["front"][:16]}
    real = images | {"wrist": np.zeros((16, 16, 3))}
    masks = {"wrist": np.zeros((16, 16), np.uint8)}
    for arguments, line in (
        ((np.zeros(20), executed, images, {}), "state: 20 numbers, expected 4"),
        ((state, np.array([np.nan, 0]), images, {}), "not finite"),
        ((state, executed, half, {}), r"picture front: uint8 \[16, 48, 3\]; expected uint8 \[32, 48, 3\]"),
        ((state, executed, real, {}), "float64"),
        ((state, executed, {"front": images["front"]}, {}), "cameras are"),
        ((state, executed, images, masks), "masks"),
    ):
        with pytest.raises(InputError, match=line):
            link.publish(header, *arguments)
    assert controller.observe(0) is None
    # What does not lie row after row is written all the same.
    link.publish(header, state, executed, images | {"front": np.full((32, 96, 3), 9, np.uint8)[:, ::2]}, {})
    assert (controller.observe(1)["front"] == 9).all()


def test_a_controller_sends_no_action_that_a_robot_must_not_execute(pair):
    link, controller = pair
    publish(link)
    assert controller.observe(1) is not None
    for bad, line in (([0, np.nan], "not finite"), ([0, np.inf], "not finite"), ([0], "expected 2"), ("ab", "numbers")):
        with pytest.raises(InputError, match=line):
            controller.act(0, bad)
    assert link.wait_action(0.02) is None
    controller.act(0, [9, -9])
    assert link.wait_action(1).action.tolist() == [2, -1]  # the limits
    with pytest.raises(InputError, match="source 7"):
        controller.act(0, [0, 0], 7)


def test_a_wait_of_no_time_is_refused(link):
    for timeout_s in (-1, float("nan")):
        with pytest.raises(InputError, match="timeout_s"):
            link.wait_action(timeout_s)


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_whoever_ends_the_robot_the_controller_is_told(small, prefix, tmp_path, name):
    (tmp_path / "robot.toml").write_text(small.canonical())
    script = (
        "import sys\nfrom rcwm import cli\nfrom rcwm.interface import load\nfrom rcwm.link import RobotLink\n"
        "def main():\n"
        "    with RobotLink(load(sys.argv[1]), 'c') as link:\n"
        "        print('up', flush=True)\n"
        "        while True: link.wait_action(60)\n"
        "cli.run(main)"
    )
    command = [sys.executable, "-c", script, str(tmp_path / "robot.toml")]
    robot = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert robot.stdout.readline() == "up\n"
    with ControllerLink("c") as controller:
        assert controller.wait_robot(10) == small
        robot.send_signal(getattr(signal, name))
        assert robot.wait(10) == 130
        with pytest.raises(PeerClosed):
            controller.observe(5)
