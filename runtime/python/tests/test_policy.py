"""A bundle inside a Python program."""

import threading
from pathlib import Path

import numpy as np
import pytest

from rcwm import Policy, RcwmError
from rcwm.errors import BundleError, DoesNotFit, InputError, PolicyError
from rcwm.link import ControllerLink, Flags, Header, RobotLink

BUNDLES = Path(__file__).parents[3] / "models/bundles"
BUNDLE = BUNDLES / "untrained"


@pytest.fixture
def policy():
    with Policy(BUNDLE) as policy:
        yield policy


def pictures(count, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (count, 64, 64, 3), np.uint8)


def run(policy, images):
    """An episode: what is decided on each picture, each action executed as it was decided."""
    decisions, executed = [], None
    for image in images:
        decisions.append(policy.observe({"image": image}, executed))
        executed = decisions[-1].action
    return np.stack([decision.action for decision in decisions])


def test_a_bundle_says_what_it_reads_and_what_it_commands(policy):
    assert (policy.kind, policy.inputs, policy.imagines) == ("rcwm", ["image"], True)
    assert policy.interface.action_names == ["hand.x", "hand.y", "hand.z", "hand.gripper"]
    assert (policy.interface.rate_hz, policy.low.tolist(), policy.high.tolist()) == (40, [-1] * 4, [1] * 4)
    assert policy.bundle == BUNDLE
    assert "reads image" in repr(policy)


def test_a_decision_is_within_the_limits_and_says_how_it_came_about(policy):
    decision = policy.observe({"image": pictures(1)[0]})
    assert decision.action.dtype == np.float32
    assert decision.action.shape == decision.mean.shape == decision.std.shape == (4,)
    assert (np.abs(decision.action) <= 1).all()
    assert (decision.std > 0).all()
    assert decision.surprise.keys() == {"robot", "environment"}
    assert sum(decision.stage_ns.values()) > 0
    assert not decision.recomputed
    decision.action[:] = 5
    assert (np.abs(decision.action) <= 1).all()  # every array is a new one


def test_without_an_executed_action_an_episode_begins_anew(policy):
    images = pictures(5)
    assert np.array_equal(run(policy, images), run(policy, images))
    continued = run(policy, images)[-1]
    assert not np.array_equal(continued, policy.observe({"image": images[-1]}).action)


def test_what_is_worked_ahead_changes_nothing_but_the_time(policy):
    images = pictures(4)
    expected, executed = run(policy, images), None
    for at, image in enumerate(images):
        decision = policy.observe({"image": image}, executed)
        assert np.array_equal(decision.action, expected[at])
        assert not decision.recomputed
        executed = decision.action
        policy.work_ahead(executed)
    policy.warm_caches()
    assert policy.observe({"image": images[0]}, np.zeros(4)).recomputed


def test_a_missing_picture_is_imagined(policy):
    first = policy.observe({"image": pictures(1)[0]})
    imagined = policy.imagine(first.action)
    assert imagined.surprise == {}
    assert np.isfinite(imagined.action).all()


def test_samples_are_those_of_their_seed():
    images = pictures(3)
    one, again, other = (run(Policy(BUNDLE, sample=seed), images) for seed in (7, 7, 8))
    assert np.array_equal(one, again)
    assert not np.array_equal(one, other)


def test_two_threads_of_a_tick_decide_the_same(policy):
    images = pictures(5)
    assert np.allclose(run(policy, images), run(Policy(BUNDLE, threads=2), images), atol=1e-5)


def test_a_picture_may_lie_in_memory_as_it_likes(policy):
    image = pictures(1)[0]
    expected = policy.observe({"image": image}).action
    wide = np.zeros((64, 128, 3), np.uint8)
    wide[:, ::2] = image
    readonly = image.copy()
    readonly.flags.writeable = False

    class Tensor:
        """What says that it is an array."""

        def __array__(self, dtype=None, copy=None):
            return image

    for same in (wide[:, ::2], image[::-1].copy()[::-1], readonly, Tensor(), memoryview(image)):
        assert np.array_equal(policy.observe({"image": same, "others": None}).action, expected)


@pytest.mark.parametrize(
    ("inputs", "line"),
    [
        ({}, "input image is missing; the policy reads image"),
        ({"image": np.zeros((64, 64, 3))}, r"picture image: float64 \[64, 64, 3\]; expected uint8 \[64, 64, 3\]"),
        ({"image": np.zeros((64, 64), np.uint8)}, r"uint8 \[64, 64\]; expected uint8 \[64, 64, 3\]"),
        ({"image": np.zeros((1, 64, 64, 3), np.uint8)}, r"uint8 \[1, 64, 64, 3\]"),
        ({"image": "nothing"}, "picture image"),
        ({"image": None}, "picture image"),
        (np.zeros((64, 64, 3), np.uint8), "expected a dictionary of image"),
        (None, "expected a dictionary of image"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(policy, inputs, line):
    with pytest.raises(InputError, match=line) as error:
        policy.observe(inputs)
    assert "\n" not in str(error.value)
    assert isinstance(error.value, RcwmError)
    assert isinstance(error.value, ValueError)


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize(
    ("executed", "line"),
    [
        ([0, 0, 0], "executed action: 3 numbers, expected 4"),
        ([0, 0, 0, np.nan], "not finite"),
        ([0, 0, 0, 1e300], "not finite"),
        (["a", "b", "c", "d"], "expected 4 numbers"),
    ],
)
def test_an_executed_action_that_is_none_is_refused(policy, executed, line):
    image = pictures(1)[0]
    for call in (lambda: policy.observe({"image": image}, executed), lambda: policy.imagine(executed)):
        with pytest.raises(InputError, match=line):
            call()


def test_numbers_of_any_type_are_an_action(policy):
    images = pictures(2)
    expected = run(policy, images)
    executed = [float(x) for x in expected[0]]
    for same in (executed, tuple(executed), np.array(executed), expected[0], np.array(executed * 2, np.float32)[:4]):
        policy.observe({"image": images[0]})
        assert np.array_equal(policy.observe({"image": images[1]}, same).action, expected[1])


def test_cameras_and_states_are_taken_by_name():
    policy = Policy(BUNDLES / "panda-lift")
    robot = policy.interface
    random = np.random.default_rng(0)
    given = {camera.name: random.integers(0, 256, camera.shape, np.uint8) for camera in robot.cameras}
    given |= {state.name: random.normal(size=len(state.elements)) for state in robot.states}
    assert set(policy.inputs) == set(given)
    action = policy.observe(given).action
    assert np.array_equal(policy.observe(dict(reversed(given.items()))).action, action)
    front, wrist = (camera.name for camera in robot.cameras)
    assert not np.array_equal(policy.observe(given | {front: given[wrist], wrist: given[front]}).action, action)
    for state in robot.states:
        assert not np.array_equal(policy.observe(given | {state.name: given[state.name] + 1}).action, action)
        with pytest.raises(InputError, match=f"state {state.name}: 1 numbers, expected {len(state.elements)}"):
            policy.observe(given | {state.name: [0.0]})
        with pytest.raises(InputError, match=f"state {state.name}: .* is not finite"):
            policy.observe(given | {state.name: given[state.name] * np.nan})


def test_no_bundle_is_one_line(tmp_path):
    with pytest.raises(BundleError) as error:
        Policy(tmp_path)
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match="threads = 3"):
        Policy(BUNDLE, threads=3)


def test_after_closing_there_is_no_decision():
    policy = Policy(BUNDLE)
    policy.close()
    policy.close()
    with pytest.raises(PolicyError, match="was closed"):
        policy.observe({"image": pictures(1)[0]})


def test_threads_share_a_policy_and_others_run_meanwhile(policy):
    images = pictures(8)
    expected = run(policy, images)
    results = []
    threads = [threading.Thread(target=lambda: results.append(run(Policy(BUNDLE), images))) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(np.array_equal(result, expected) for result in results)
    # One policy from several threads: in some order, and nothing breaks.
    threads = [threading.Thread(target=run, args=(policy, images)) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert np.array_equal(run(policy, images), expected)


def test_a_policy_answers_a_robot_through_shared_memory(policy, monkeypatch, tmp_path):
    monkeypatch.setenv("RCWM_PREFIX", f"rcwmtest{tmp_path.name[-8:]}_")
    images = pictures(4)
    expected, executed = run(policy, images), None
    robot = policy.interface
    with RobotLink(robot, "a") as link, ControllerLink("a", policy) as controller:
        link.wait_action(0.01)
        assert controller.wait_robot(5) is not None
        for step, image in enumerate(images):
            flags = Flags.FIRST if step == 0 else Flags(0)
            state = np.zeros(robot.state_numbers)
            done = np.zeros(4) if executed is None else executed
            link.publish(Header(step, 0, step, flags, 0, 0, 0, 0), state, done, {"image": image}, {})
            seen = controller.observe(1)
            decision = policy.observe(seen, None if Flags.FIRST in seen.flags else seen.executed)
            controller.act(seen.sequence, decision.action)
            executed = link.wait_action(1).action
            assert np.array_equal(executed, expected[step])


def test_a_robot_that_a_policy_does_not_know_is_refused_by_name(policy, small, monkeypatch, tmp_path):
    monkeypatch.setenv("RCWM_PREFIX", f"rcwmtest{tmp_path.name[-8:]}_")
    with (
        RobotLink(small, "a") as link,
        pytest.raises(DoesNotFit, match="robot small does not fit.*image"),
        ControllerLink("a", policy) as controller,
    ):
        link.wait_action(0.01)
        controller.observe(5)
