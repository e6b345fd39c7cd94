"""robosuite's Panda: layouts, pictures, the expert, recordings."""

import json
import subprocess
import sys
from importlib.util import find_spec

import numpy as np
import pytest

if find_spec("robosuite") is None:
    pytest.skip("needs rcwm[robosuite]", allow_module_level=True)

from rcwm import RcwmError, episode, interface
from rcwm.panda import Expert, PandaLift, panda_lift
from rcwm.panda.demonstrate import Settings, demonstrate, perform


@pytest.fixture(scope="module")
def robot():
    robot = PandaLift(masks=True, horizon=60)
    yield robot
    robot.close()


def state(robot):
    return np.concatenate([robot.data.qpos, robot.data.qvel])


def test_observations_are_what_the_interface_says(robot):
    seen, info = robot.reset(options={"layout": 0})
    own = robot.interface
    assert interface.parse(own.canonical()) == own
    assert own.pack(seen).shape == (16,)
    for camera in own.cameras:
        assert seen[camera.name].shape == camera.shape
        assert seen[camera.name].dtype == np.uint8
        assert set(np.unique(seen[f"{camera.name}_mask"])) == {0, 1}
    assert info == {"success": False, "layout": 0}


def test_a_layout_is_the_same_whatever_came_before(robot):
    first, _ = robot.reset(options={"layout": 3})
    begun = state(robot)
    for _ in range(5):
        after, *_ = robot.step([0.5, -0.5, -1, 0.1, 0, 0.3, 1])
    robot.reset(options={"layout": 4})
    assert not np.array_equal(state(robot), begun)
    robot.step([1, 0, 0, 0, 0, 0, -1])
    again, _ = robot.reset(options={"layout": 3})
    assert np.array_equal(state(robot), begun)
    for _ in range(5):
        later, *_ = robot.step([0.5, -0.5, -1, 0.1, 0, 0.3, 1])
    for name in first:
        assert np.array_equal(first[name], again[name]), name
        assert np.array_equal(after[name], later[name]), name


def test_the_three_sets_of_layouts_do_not_meet(robot):
    begun = []
    for layouts in ("learning", "choosing", "reporting"):
        robot.layouts = layouts
        for layout in range(3):
            robot.reset(options={"layout": layout})
            begun.append(tuple(state(robot)))
    robot.layouts = "learning"
    assert len(set(begun)) == 9


def test_drawing_leaves_the_physics_bit_for_bit_as_it_is(robot):
    random = np.random.default_rng(0)
    actions = random.uniform(-1, 1, (300, 7))
    robot.reset(options={"layout": 1})
    drawn = []
    for action in actions:
        robot.step(action)
        drawn.append(state(robot))
    robot.reset(options={"layout": 1})
    for action, expected in zip(actions, drawn, strict=True):
        robot.env.step(action)  # without pictures
        assert np.array_equal(state(robot), expected)


def test_the_fast_picture_shows_what_the_plain_one_does(robot):
    plain = PandaLift(masks=True, plain=True)
    try:
        slow, _ = plain.reset(options={"layout": 2})
    finally:
        plain.close()
    fast, _ = robot.reset(options={"layout": 2})
    for camera in ("front", "wrist"):
        a, b = (seen[f"{camera}_mask"].astype(bool) for seen in (fast, slow))
        assert (a & b).sum() / (a | b).sum() > 0.93, camera
        assert np.abs(fast[camera].astype(int) - slow[camera]).mean() < 12, camera


def test_the_cube_is_seen_red_and_large_enough_by_both_cameras(robot):
    seen, _ = robot.reset(options={"layout": 0})
    for camera in ("front", "wrist"):
        red = seen[camera].astype(int)
        red = red[..., 0] - red[..., 1:].max(-1)
        assert (red > 40).sum() >= 25, camera


def test_the_expert_lifts_the_cube_smoothly_and_within_limits(robot):
    expert = Expert(robot)
    for layout in range(3):
        done = perform(robot, expert, layout, push=0.0)
        assert done.success.any()
        assert np.abs(done.action).max() <= 1
        assert np.abs(np.diff(done.action[1:, :6], axis=0)).max() <= 0.25 + 1e-6
        assert not done.pushed.any()
        assert not done.action[0].any()


def test_pushes_are_marked_and_the_expert_goes_on_after_them():
    robot = PandaLift(horizon=150)
    try:
        done = perform(robot, Expert(robot), 0, push=0.05)
    finally:
        robot.close()
    assert done.success.any()
    assert 0 < done.pushed.sum() < 120


@pytest.mark.parametrize("action", [[0] * 6, [0] * 6 + [1.01], [np.nan] * 7])
def test_what_must_not_be_executed_is_refused(robot, action):
    robot.reset(options={"layout": 0})
    with pytest.raises(ValueError, match="numbers in"):
        robot.step(action)


def test_demonstrations_are_resumed_and_never_mixed(tmp_path):
    settings = Settings(5, "choosing", 64, ("front",), False, 8, 0.0)
    assert demonstrate(tmp_path / "d", 2, settings, tmp_path / "r.json")["recorded"] == 2
    assert json.loads((tmp_path / "r.json").read_text())["episodes"] == 2
    before = (tmp_path / "d/expert-seed5-00000.npz").stat().st_mtime_ns
    (tmp_path / "d/expert-seed5-00001.npz").unlink()
    assert demonstrate(tmp_path / "d", 2, settings)["recorded"] == 1
    assert (tmp_path / "d/expert-seed5-00000.npz").stat().st_mtime_ns == before
    recorded = episode.read(tmp_path / "d/expert-seed5-00001.npz", panda_lift(64, ("front",)))
    assert len(recorded) == 9
    with pytest.raises(RcwmError, match="another seed"):
        demonstrate(tmp_path / "d", 2, Settings(6, "choosing", 64, ("front",), False, 8, 0.0))


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["demonstrate", "--out", "x", "--episodes", "0"], "at least 1"),
        (["demonstrate", "--out", "x", "--cameras", "front,side"], "front, wrist"),
        (["demonstrate", "--out", "x", "--seed", "-1"], "0 to 2^64"),
        (["measure", "--push", "1.5"], "a chance from 0 to 1"),
        (["dance"], "invalid choice"),
    ],
)
def test_bad_input_is_one_line(tmp_path, arguments, reason):
    call = [sys.executable, "-m", "rcwm.panda", *arguments]
    done = subprocess.run(call, capture_output=True, text=True, cwd=tmp_path, check=False)
    assert done.returncode != 0
    assert reason in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "x").exists()
