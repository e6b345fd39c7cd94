"""Datasets of LeRobot: what is written comes back, and what does not fit is refused in one line."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("pyarrow")
pytest.importorskip("av")
import pyarrow as pa
import pyarrow.parquet as pq

from rcwm import RcwmError, episode, interface
from rcwm.lerobot import __main__ as program
from rcwm.lerobot.read import to_npz
from rcwm.lerobot.write import from_npz

FRONT = "observation.images.front"


@pytest.fixture
def dataset(tmp_path, make_episode, small):
    """Two episodes, of 6 and 9 observations, as a dataset with images."""
    for index, steps in enumerate((6, 9)):
        make_episode(steps, index).write(tmp_path / "npz" / f"{index}.npz")
    from_npz(tmp_path / "npz", small, tmp_path / "set", images=True)
    return tmp_path / "set"


def originals(root):
    return [episode.read(path) for path in sorted((root.parent / "npz").glob("*.npz"))]


def returned(folder):
    return [episode.read(path) for path in sorted(folder.glob("*.npz"))]


def change_info(root, change):
    path = root / "meta/info.json"
    info = json.loads(path.read_text())
    change(info)
    path.write_text(json.dumps(info))


def rewrite(path, change):
    pq.write_table(change(pq.read_table(path)), path)


def refusal(root, robot, renamed=None):
    with pytest.raises(RcwmError) as error:
        to_npz(root, robot, root.parent / "refused", renamed)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_with_images_everything_comes_back_as_it_was(dataset, small, tmp_path):
    result = to_npz(dataset, small, tmp_path / "back")
    assert result == {"episodes": 2, "new": 2, "actions_left_out": 0, "successes_left_out": 0}
    for before, after in zip(originals(dataset), returned(tmp_path / "back"), strict=True):
        for key, values in before.arrays().items():
            assert np.array_equal(values, after.arrays()[key]), key


def test_with_video_numbers_come_back_and_pictures_nearly_so(dataset, small, tmp_path):
    from_npz(tmp_path / "npz", small, tmp_path / "video")
    to_npz(tmp_path / "video", small, tmp_path / "back")
    for before, after in zip(originals(dataset), returned(tmp_path / "back"), strict=True):
        for key, values in before.arrays().items():
            if key.startswith("image"):
                off = np.abs(values.astype(int) - after.arrays()[key])
                assert off.mean() < 4, key
                # Each picture is that of its own step: its neighbours differ more.
                assert off[1:].mean() < np.abs(values[1:].astype(int) - values[:-1]).mean(), key
            else:
                assert np.array_equal(values, after.arrays()[key]), key


def test_a_row_holds_the_action_chosen_at_its_observation(dataset):
    rows = pq.read_table(dataset / "data/chunk-000/file-000.parquet").to_pydict()
    for index, before in enumerate(originals(dataset)):
        own = [at for at, other in enumerate(rows["episode_index"]) if other == index]
        assert len(own) == len(before) - 1
        assert np.array_equal([rows["action"][at] for at in own], before.action[1:])
        assert np.array_equal([rows["observation.state"][at] for at in own], before.proprio[:-1])
        assert [rows["next.pushed"][at] for at in own] == before.pushed[1:].tolist()
        assert [rows["next.done"][at] for at in own] == [False] * (len(own) - 1) + [True]


def test_without_the_last_observation_the_last_action_is_left_out(dataset, small, tmp_path):
    for path in (dataset / "rcwm").iterdir():
        path.unlink()
    assert to_npz(dataset, small, tmp_path / "back")["actions_left_out"] == 2
    for before, after in zip(originals(dataset), returned(tmp_path / "back"), strict=True):
        assert len(after) == len(before) - 1
        assert np.array_equal(after.action, before.action[:-1])
        assert np.array_equal(after.images["front"], before.images["front"][:-1])
        assert np.array_equal(after.reward[1:], before.reward[1:-1])
        assert after.is_last.tolist() == [False] * (len(after) - 1) + [True]
        assert not after.is_terminal.any()


def test_episodes_that_are_there_are_not_done_again(dataset, small, tmp_path):
    to_npz(dataset, small, tmp_path / "back")
    (tmp_path / "back/episode-000001.npz").unlink()
    assert to_npz(dataset, small, tmp_path / "back")["new"] == 1


def test_many_files_are_written_and_read_where_files_are_small(tmp_path, make_episode, small):
    for index in range(3):
        make_episode(5, index).write(tmp_path / "npz" / f"{index}.npz")
    from_npz(tmp_path / "npz", small, tmp_path / "set", limits=(0, 0))
    assert len(list((tmp_path / "set/data").glob("*/*.parquet"))) == 3
    to_npz(tmp_path / "set", small, tmp_path / "back")
    for before, after in zip(originals(tmp_path / "set"), returned(tmp_path / "back"), strict=True):
        assert np.array_equal(before.action, after.action)


def test_numbers_are_found_by_name_in_any_order(dataset, small, tmp_path):
    swap = [1, 0]

    def reverse(info):
        info["features"]["action"]["names"] = ["j2", "j1"]

    change_info(dataset, reverse)

    def reorder(table):
        values = pa.array([[row[at] for at in swap] for row in table["action"].to_pylist()], table["action"].type)
        return table.set_column(table.column_names.index("action"), "action", values)

    rewrite(dataset / "data/chunk-000/file-000.parquet", reorder)
    to_npz(dataset, small, tmp_path / "back")
    for before, after in zip(originals(dataset), returned(tmp_path / "back"), strict=True):
        assert np.array_equal(before.action, after.action)


def test_other_names_are_mapped(dataset, small, tmp_path):
    for path in (dataset / "rcwm").iterdir():
        path.unlink()
    text = small.canonical().replace('name = "front"', 'name = "top"').replace('name = "joint_vel"', 'name = "speed"')
    robot = interface.parse(text)
    renamed = {FRONT: "top", "joint_vel.j1": "speed.j1", "joint_vel.j2": "speed.j2"}
    assert to_npz(dataset, robot, tmp_path / "back", renamed)["new"] == 2
    assert "state speed: no number j1" in refusal(dataset, robot)
    assert "camera top" in refusal(dataset, robot, {"joint_vel.j1": "speed.j1", "joint_vel.j2": "speed.j2"})
    assert "the robot has no tip" in refusal(dataset, robot, {**renamed, FRONT: "tip"})
    assert "no such feature" in refusal(dataset, robot, {"observation.images.side": "top"})


def test_another_rate_is_refused(dataset, small):
    assert "fps 20, and the robot's rate_hz is 25" in refusal(dataset, replace(small, rate_hz=25.0))


def test_rows_at_another_distance_than_the_rate_says_are_refused(dataset, small):
    def stretch(table):
        times = pa.array([2 * x for x in table["timestamp"].to_pylist()], pa.float32())
        return table.set_column(table.column_names.index("timestamp"), "timestamp", times)

    rewrite(dataset / "data/chunk-000/file-000.parquet", stretch)
    assert "0.05 s apart" in refusal(dataset, small)


def test_a_missing_camera_is_refused(dataset, small):
    change_info(dataset, lambda info: info["features"].pop(FRONT))
    assert refusal(dataset, small).startswith("camera front: no camera of that name; there is observation.images.wrist")


def test_a_camera_of_another_size_is_refused(dataset, small):
    change_info(dataset, lambda info: info["features"][FRONT].update(shape=[64, 64, 3]))
    assert "pictures of [64, 64, 3]" in refusal(dataset, small)


def test_a_misnamed_joint_is_refused(dataset, small):
    def misname(info):
        info["features"]["observation.state"]["names"][1] = "joint_pos.jj2"

    change_info(dataset, misname)
    assert refusal(dataset, small).startswith("state joint_pos: no number j2; there is joint_pos.j1, joint_pos.jj2")


def test_numbers_without_names_are_not_guessed(dataset, small):
    change_info(dataset, lambda info: info["features"]["action"].update(names=None))
    assert "action arm: no number j1; there is none with names" in refusal(dataset, small)


@pytest.mark.parametrize("place", ["data", "meta/episodes"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.95])
def test_damaged_parquet_is_refused(dataset, small, place, share):
    path = dataset / place / "chunk-000/file-000.parquet"
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    assert "file-000.parquet" in refusal(dataset, small)


def test_rows_that_are_missing_are_refused(dataset, small):
    rewrite(dataset / "data/chunk-000/file-000.parquet", lambda table: table.slice(0, 8))
    assert "meta/episodes says 8" in refusal(dataset, small)


def test_a_damaged_video_is_refused(dataset, small, tmp_path):
    from_npz(tmp_path / "npz", small, tmp_path / "video")
    path = tmp_path / "video/videos" / FRONT / "chunk-000/file-000.mp4"
    path.write_bytes(path.read_bytes()[:300])
    assert "file-000.mp4" in refusal(tmp_path / "video", small)


def test_numbers_that_are_not_finite_are_refused(dataset, small):
    def poison(table):
        values = pa.array([[float("nan")] * 2] * table.num_rows, table["action"].type)
        return table.set_column(table.column_names.index("action"), "action", values)

    rewrite(dataset / "data/chunk-000/file-000.parquet", poison)
    assert "not finite" in refusal(dataset, small)


def test_an_older_version_is_refused(dataset, small):
    change_info(dataset, lambda info: info.update(codebase_version="v2.1"))
    assert "v2.1; expected v3.0" in refusal(dataset, small)


def test_what_is_no_dataset_is_refused(tmp_path, small):
    assert "no dataset of LeRobot" in refusal(tmp_path / "nothing", small)


def test_a_dataset_is_never_written_over(dataset, small):
    with pytest.raises(RcwmError, match="exists already"):
        from_npz(dataset.parent / "npz", small, dataset)


def test_a_damaged_episode_leaves_no_dataset_behind(tmp_path, make_episode, small):
    make_episode(5).write(tmp_path / "npz/0.npz")
    (tmp_path / "npz/1.npz").write_bytes(b"PK")
    with pytest.raises(RcwmError, match="1.npz"):
        from_npz(tmp_path / "npz", small, tmp_path / "set")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["npz"]


def test_the_command_line_goes_there_and_back(dataset, small, tmp_path, monkeypatch, capsys):
    robot = tmp_path / "robot.toml"
    robot.write_text(small.canonical())
    call = ["rcwm.lerobot", "to-npz", str(dataset), "--interface", str(robot), "--out", str(tmp_path / "back")]
    monkeypatch.setattr(sys, "argv", [*call, "--json", str(tmp_path / "result.json")])
    program.main()
    assert "2 episodes (2 new)" in capsys.readouterr().out
    assert json.loads((tmp_path / "result.json").read_text())["new"] == 2


def test_a_folder_of_another_dataset_is_not_taken_for_this_ones(tmp_path, make_episode, small):
    for seed in (0, 1):
        make_episode(5, seed).write(tmp_path / f"npz{seed}" / "a.npz")
        from_npz(tmp_path / f"npz{seed}", small, tmp_path / f"set{seed}", images=True)
    info = tmp_path / "set1" / "meta" / "info.json"
    info.write_text(info.read_text() + " ")
    to_npz(tmp_path / "set0", small, tmp_path / "out")
    assert to_npz(tmp_path / "set0", small, tmp_path / "out")["new"] == 0
    with pytest.raises(RcwmError, match="another dataset"):
        to_npz(tmp_path / "set1", small, tmp_path / "out")
