"""Episodes come back as they were written, and nothing else is read."""

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
