"""Episodes come back as they were written, and nothing else is read."""

from dataclasses import replace

import numpy as np
import pytest

from rcwm import interface
from rcwm.episode import EpisodeError, read


def assert_same(a, b):
    ours, theirs = a.arrays(), b.arrays()
    assert ours.keys() == theirs.keys()
    for key in ours:
        assert ours[key].dtype == theirs[key].dtype, key
        assert np.array_equal(ours[key], theirs[key]), key


def test_an_episode_comes_back_as_it_was(tmp_path, make_episode, small):
    episode = make_episode(5)
    episode.write(tmp_path / "deep" / "a.npz")
    assert_same(episode, read(tmp_path / "deep" / "a.npz"))
    assert_same(episode, read(tmp_path / "deep" / "a.npz", small))
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["a.npz"]


def test_the_file_has_the_keys_and_shapes_of_the_trainer(tmp_path, make_episode):
    make_episode(5).write(tmp_path / "a.npz")
    found = {key: value.shape for key, value in np.load(tmp_path / "a.npz").items()}
    assert found["image"] == (5, 32, 48, 3)
    assert found["image_2"] == (5, 16, 16, 3)
    assert found["robot_mask"] == (5, 32, 48, 1)
    assert found["action"] == (5, 2)
    assert found["proprio"] == (5, 4)
    assert found["interface"] == (1,)


def test_a_robot_that_measures_nothing_has_no_proprio(tmp_path, make_episode, small):
    text = small.canonical().replace('fallback = "hold-measured"\nmeasured = "joint_pos"', 'fallback = "hold"')
    states, rest = text.index("[[interface.state]]"), text.index("[[interface.camera]]")
    robot = interface.parse(text[:states] + text[rest:])
    episode = replace(make_episode(5), interface=robot, proprio=np.zeros((5, 0), np.float32))
    episode.write(tmp_path / "a.npz")
    assert "proprio" not in np.load(tmp_path / "a.npz")
    assert_same(episode, read(tmp_path / "a.npz"))
    assert read(tmp_path / "a.npz", robot).proprio.shape == (5, 0)


def test_an_episode_of_another_robot_is_refused(tmp_path, make_episode, small):
    make_episode(5).write(tmp_path / "a.npz")
    other = interface.parse(small.canonical().replace("rate_hz = 20.0", "rate_hz = 30.0"))
    with pytest.raises(EpisodeError, match="30 Hz expected, 20 Hz found"):
        read(tmp_path / "a.npz", other)


@pytest.mark.parametrize(
    ("key", "change", "reason"),
    [
        ("action", None, "'action' is missing"),
        ("action", lambda x: x[:, :1], "shape"),
        ("proprio", lambda x: np.full_like(x, np.nan), "finite"),
        ("image_2", lambda x: x.astype(np.float32), "expected uint8"),
        ("action", lambda x: np.ones_like(x), "the first action is not zero"),
    ],
)
def test_a_wrong_array_is_refused_in_one_line(tmp_path, make_episode, key, change, reason):
    arrays = make_episode(5).arrays()
    if change is None:
        del arrays[key]
    else:
        arrays[key] = change(arrays[key])
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(EpisodeError, match=reason) as error:
        read(tmp_path / "a.npz")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.99])
def test_a_file_cut_off_is_refused_in_one_line(tmp_path, make_episode, share):
    path = tmp_path / "a.npz"
    make_episode(5).write(path)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    with pytest.raises(EpisodeError) as error:
        read(path)
    assert "\n" not in str(error.value)


def test_actions_are_from_limit_to_limit_in_the_file_and_in_units_beside_it(tmp_path, make_episode, small):
    episode = make_episode(3)
    episode.action[:] = [[0, 0], [2.0, -1.0], [-1.0, 0.25]]
    episode.write(tmp_path / "a.npz")
    assert np.load(tmp_path / "a.npz")["action"].tolist() == [[0, 0], [1, -1], [-0.5, 0.25]]
    assert np.allclose(read(tmp_path / "a.npz", small).action, episode.action)
    episode.action[1] = [2.1, 0]
    with pytest.raises(EpisodeError, match="not within the interface's limits"):
        episode.write(tmp_path / "b.npz")
    arrays = dict(np.load(tmp_path / "a.npz")) | {"action": np.array([[0, 0], [1.7, 0], [0, 0]], np.float32)}
    np.savez(tmp_path / "c.npz", **arrays)
    with pytest.raises(EpisodeError, match=r"beyond \[-1, 1\]"):
        read(tmp_path / "c.npz")


def test_states_are_found_by_name_whatever_their_order_in_the_file(tmp_path, make_episode, small):
    episode = make_episode(4)
    episode.write(tmp_path / "a.npz")
    position, velocity = small.states
    swapped = replace(small, states=(velocity, position), cameras=small.cameras[1:])
    found = read(tmp_path / "a.npz", swapped)
    assert np.array_equal(found.proprio, episode.proprio[:, [2, 3, 0, 1]])
    assert list(found.images) == ["wrist"]
    assert found.interface == swapped


def test_actions_in_another_order_are_of_another_robot(small):
    arm = small.actions[0]
    both = [replace(arm, name=name) for name in ("left", "right")]
    lines = interface.differences(replace(small, actions=tuple(both)), replace(small, actions=tuple(both[::-1])))
    assert lines == ["actions: in another order from number 1 on: left, right expected, right, left found"]
