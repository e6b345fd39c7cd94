"""The robot's end over shared memory, against a controller's end that is written here from the wire's description."""

import ctypes
import importlib.util
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

iox2 = pytest.importorskip("iceoryx2")

from rcwm import interface
from rcwm.gym import Flags, Header, PeerClosed
from rcwm.link import Layout, LinkError, RobotLink
from rcwm.link.messages import ActionHeader, ObservationHeader


class Controller:
    """The least that a controller does."""

    def __init__(self, instance, robot, prefix):
        config = iox2.config.default()
        config.global_cfg.prefix = iox2.FileName.new(prefix)
        builder = iox2.NodeBuilder.new().config(config).signal_handling_mode(iox2.SignalHandlingMode.Disabled)
        self.node, self.instance, self.robot = builder.create(iox2.ServiceType.Ipc), instance, robot
        self.texts = self.data("interface", None).subscriber_builder().create()
        self.observations = self.data("observation", ObservationHeader).subscriber_builder().create()
        actions = self.data("action", ActionHeader).publisher_builder().initial_max_slice_len(4 * robot.action_numbers)
        self.actions = actions.allocation_strategy(iox2.AllocationStrategy.Static).create()
        self.waker = self.service("action").event().open_or_create().notifier_builder().create()

    def close(self):
        for port in (self.texts, self.observations, self.actions, self.waker):
            port.delete()

    def service(self, topic):
        return self.node.service_builder(iox2.ServiceName.new(f"rcwm/{self.instance}/{topic}"))

    def data(self, topic, header):
        builder = self.service(topic).publish_subscribe(iox2.Slice[ctypes.c_uint8])
        wanted = {"rcwm.wire": "2"} | ({"rcwm.interface": self.robot.hash} if header else {})
        attributes = iox2.AttributeVerifier.new()
        for key, value in wanted.items():
            attributes = attributes.require(iox2.AttributeKey.new(key), iox2.AttributeValue.new(value))
        builder = builder.user_header(header) if header else builder
        return builder.open_with_attributes(attributes)

    def signal(self, event):
        self.waker.notify_with_custom_event_id(iox2.EventId.new(event))

    def receive(self):
        sample = self.observations.receive()
        header = ObservationHeader.from_buffer_copy(ctypes.string_at(sample.user_header_ptr, 120))
        return header, ctypes.string_at(sample.payload_ptr, sample.payload().len())

    def send(self, answers, numbers):
        data = np.array(numbers, "<f4").tobytes()
        header = ActionHeader(answers=answers)
        sample = self.actions.loan_slice_uninit(len(data))
        ctypes.memmove(sample.user_header_ptr, ctypes.addressof(header), ctypes.sizeof(header))
        ctypes.memmove(sample.payload_ptr, data, len(data))
        sample.assume_init().send()
        self.signal(0)


@pytest.fixture
def prefix(monkeypatch):
    name = f"rcwmtest{os.getpid()}_"
    monkeypatch.setenv("RCWM_PREFIX", name)
    return name


@pytest.fixture
def link(small, prefix):
    link = RobotLink(small, "a")
    yield link
    link.close()


@pytest.fixture
def join(small, prefix):
    """Makes a controller of instance `a`."""
    joined = []

    def make():
        joined.append(Controller("a", small, prefix))
        return joined[-1]

    yield make
    for controller in joined:
        controller.close()


def publish(link, sequence=0, flags=Flags.FIRST):
    images = {"front": np.full((32, 48, 3), 7, np.uint8), "wrist": np.full((16, 16, 3), 8, np.uint8)}
    masks = {"front": np.full((32, 48), 255, np.uint8)}
    header = Header(sequence, 0, sequence, flags, 0.5, 123, 456, 0)
    link.publish(header, np.arange(4, dtype=np.float32), np.array([0.5, -0.5], np.float32), images, masks)


def test_headers_and_blocks_lie_where_the_rust_programs_have_them(small):
    assert (ctypes.sizeof(ObservationHeader), ctypes.sizeof(ActionHeader)) == (120, 24)
    assert (ObservationHeader.captured_ns.offset, ObservationHeader.step.offset) == (40, 104)
    assert (ObservationHeader.reward.offset, ActionHeader.source.offset) == (116, 16)
    front, wrist = 32 * 48 * 3, 16 * 16 * 3
    layout = Layout.of(small)
    assert (layout.state, layout.executed) == (0, 64)
    assert layout.images == {"front": 128, "wrist": 128 + front}
    assert layout.masks == {"front": 128 + front + wrist}
    assert layout.observation_bytes % 64 == 0


def test_an_observation_arrives_and_its_answer_comes_back(link, small, join):
    controller = join()
    controller.signal(3)  # asks for the interface
    assert link.wait_action(0.05) is None
    text = controller.texts.receive()
    assert ctypes.string_at(text.payload_ptr, text.payload().len()).decode() == small.canonical()
    publish(link)
    header, payload = controller.receive()
    assert (header.sequence, header.flags, header.reward, header.period_ns) == (0, int(Flags.FIRST), 0.5, 0)
    assert header.captured_ns[1] == 123
    assert header.scheduled_ns == header.published_ns > 0
    layout = Layout.of(small)
    assert np.frombuffer(payload, "<f4", 4, layout.state).tolist() == [0, 1, 2, 3]
    assert np.frombuffer(payload, "<f4", 2, layout.executed).tolist() == [0.5, -0.5]
    assert payload[layout.images["wrist"]] == 8
    assert payload[layout.masks["front"]] == 255
    controller.send(0, [1.5, 0.25])
    answer = link.wait_action(1.0)
    assert answer.answers == 0
    assert answer.action.tolist() == [1.5, 0.25]
    assert link.wait_action(0.0) is None


def test_a_controller_that_comes_later_gets_the_observation_again(link, join):
    publish(link)
    controller = join()
    controller.signal(1)
    assert link.wait_action(0.05) is None
    header, _ = controller.receive()
    assert header.flags == int(Flags.FIRST | Flags.REPEATED)


def test_a_controller_that_leaves_is_noticed_once_and_after_its_last_answer(link, join):
    controller = join()
    publish(link)
    controller.send(0, [0, 0])
    controller.signal(2)
    assert link.wait_action(1.0).answers == 0
    with pytest.raises(PeerClosed):
        link.wait_action(1.0)
    assert link.wait_action(0.0) is None


def test_a_second_robot_is_refused_in_one_line(link, small):
    with pytest.raises(LinkError, match="a robot is there already"):
        RobotLink(small, "a")


@pytest.mark.parametrize("instance", ["", "a/b", ".a", "a" * 65])
def test_a_bad_name_of_an_instance_is_refused(small, prefix, instance):
    with pytest.raises(LinkError, match="expected 1 to 64"):
        RobotLink(small, instance)


def test_nothing_is_left_in_shared_memory(small, prefix):
    link = RobotLink(small, "b")
    publish(link)
    link.close()
    link.close()
    del link
    left = [path.name for path in Path("/dev/shm").iterdir() if path.name.startswith(prefix)]
    assert [name for name in left if ".data" in name] == []


def test_what_is_not_the_interfaces_is_not_published(link):
    images = {"front": np.zeros((32, 48, 3), np.uint8), "wrist": np.zeros((16, 16, 3), np.uint8)}
    header, state, executed = Header(0, 0, 0, Flags.FIRST, 0.0, 0, 0, 0), np.zeros(4), np.zeros(2)
    half = images | {"front": images["front"][:16]}
    real = images | {"wrist": np.zeros((16, 16, 3))}
    masks = {"wrist": np.zeros((16, 16), np.uint8)}
    for arguments, line in (
        ((np.zeros(20), executed, images, {}), "state"),
        ((state, np.array([np.nan, 0]), images, {}), "not finite"),
        ((state, executed, half, {}), "picture front"),
        ((state, executed, real, {}), "float64"),
        ((state, executed, {"front": images["front"]}, {}), "cameras are"),
        ((state, executed, images, masks), "masks"),
    ):
        with pytest.raises(LinkError, match=line):
            link.publish(header, *arguments)


def test_an_action_of_another_length_is_left_to_who_would_execute_it(link, join):
    controller = join()
    publish(link)
    controller.send(0, [0.5])
    assert link.wait_action(1.0).action.tolist() == [0.5]


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_whoever_ends_the_robot_the_controller_is_told(small, prefix, tmp_path, name):
    (tmp_path / "robot.toml").write_text(small.canonical())
    script = (
        "import sys, time\nfrom rcwm import cli\nfrom rcwm.interface import load\nfrom rcwm.link import RobotLink\n"
        "def main():\n"
        "    link = RobotLink(load(sys.argv[1]), 'c')\n"
        "    print('up', flush=True)\n"
        "    try:\n"
        "        while True: link.wait_action(60)\n"
        "    finally: link.close()\n"
        "cli.run(main)"
    )
    source = str(Path(__file__).parent.parent / "src")
    environment = os.environ | {"PYTHONPATH": source}
    command = [sys.executable, "-c", script, str(tmp_path / "robot.toml")]
    robot = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    assert robot.stdout.readline() == "up\n"
    controller = Controller("c", small, prefix)
    listener = controller.service("observation").event().open_or_create().listener_builder().create()
    robot.send_signal(getattr(signal, name))
    assert robot.wait(10) == 130
    assert [event.id.as_value for event in listener.timed_wait(iox2.Duration.from_secs_f64(5))] == [2]
    listener.delete()
    controller.close()


def test_the_example_that_is_copied_beside_a_robot_has_the_same_messages(small):
    examples = Path(__file__).parents[2] / "examples" / "python"
    spec = importlib.util.spec_from_file_location("rcwm_link", examples / "rcwm_link.py")
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    metaworld = interface.parse(example.METAWORLD)
    for robot in (small, metaworld, interface.parse(small.canonical().replace("0.5", "0.00001"))):
        theirs = example.Interface(robot.canonical())
        assert (theirs.canonical(), theirs.hash()) == (robot.canonical(), robot.hash)
        layout, message = Layout.of(robot), example.observation_type(robot.canonical())
        assert ctypes.sizeof(message) == 120 + layout.observation_bytes
        assert message.executed_action.offset == 120 + layout.executed
        assert message.image.offset == 120 + layout.images[robot.cameras[0].name]
    assert example.ObservationHeader._fields_ == ObservationHeader._fields_
    assert example.ActionHeader._fields_ == ActionHeader._fields_
