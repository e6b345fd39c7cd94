"""LeRobot's own package opens what we write, and we read what it writes. Runs where `lerobot` (0.4) is installed."""

import numpy as np
import pytest

pytest.importorskip("lerobot")
from lerobot.datasets.lerobot_dataset import LeRobotDataset

from rcwm import episode
from rcwm.lerobot.read import to_npz
from rcwm.lerobot.write import from_npz

TOLERANCE = {"images": 0.0, "video": 4.0}


@pytest.mark.parametrize("stored", ["images", "video"])
def test_lerobot_opens_a_dataset_of_ours(tmp_path, make_episode, small, stored):
    episodes = [make_episode(steps, steps) for steps in (6, 9)]
    for index, one in enumerate(episodes):
        one.write(tmp_path / "npz" / f"{index}.npz")
    from_npz(tmp_path / "npz", small, tmp_path / "set", "lift the cube", images=stored == "images")
    found = LeRobotDataset(
        "local/set", root=tmp_path / "set", video_backend="pyav", delta_timestamps={"action": [0, 0.05]}
    )
    assert (len(found), found.num_episodes, found.fps) == (13, 2, 20)
    row = found[5 + 3]  # of the second episode
    assert np.array_equal(row["action"].numpy(), episodes[1].action[4:6])
    assert np.array_equal(row["observation.state"].numpy(), episodes[1].proprio[3])
    assert row["next.reward"].item() == episodes[1].reward[4]
    assert row["task"] == "lift the cube"
    for camera in small.cameras:
        picture = row[f"observation.images.{camera.name}"].permute(1, 2, 0).numpy() * 255
        off = np.abs(picture - episodes[1].images[camera.name][3]).mean()
        assert off <= TOLERANCE[stored] + 1e-3, camera.name
    everything = np.concatenate([one.action[1:] for one in episodes])
    assert np.allclose(found.meta.stats["action"]["mean"], everything.mean(0), atol=1e-6)
    assert np.allclose(found.meta.stats["action"]["std"], everything.std(0), atol=1e-6)


def test_a_dataset_that_lerobot_wrote_is_read(tmp_path, make_episode, small):
    features = {
        "observation.state": {"dtype": "float32", "shape": (4,), "names": small.state_names},
        "action": {"dtype": "float32", "shape": (2,), "names": ["j1.pos", "j2.pos"]},
    }
    for name, camera in (("top", small.cameras[0]), ("wrist", small.cameras[1])):
        shape = {"dtype": "image", "shape": camera.shape, "names": ["height", "width", "channels"]}
        features[f"observation.images.{name}"] = shape
    theirs = LeRobotDataset.create(
        "local/theirs", fps=20, features=features, root=tmp_path / "theirs", use_videos=False
    )
    episodes = [make_episode(steps, steps) for steps in (6, 9)]
    for one in episodes:
        for at in range(len(one) - 1):
            frame = {"observation.state": one.proprio[at], "action": one.action[at + 1], "task": "lift"}
            frame["observation.images.top"] = one.images["front"][at]
            frame["observation.images.wrist"] = one.images["wrist"][at]
            theirs.add_frame(frame)
        theirs.save_episode()
    theirs.finalize()
    renamed = {"observation.images.top": "front"}
    assert to_npz(tmp_path / "theirs", small, tmp_path / "back", renamed)["actions_left_out"] == 2
    for before, path in zip(episodes, sorted((tmp_path / "back").iterdir()), strict=True):
        after = episode.read(path, small)
        assert np.array_equal(after.action, before.action[:-1])
        assert np.array_equal(after.proprio, before.proprio[:-1])
        assert np.array_equal(after.images["front"], before.images["front"][:-1])
