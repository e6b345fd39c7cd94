"""Interfaces are the same text and the same hash here and in the Rust programs."""

from pathlib import Path

import pytest

from rcwm import interface
from rcwm.interface import InterfaceError, differences
from rcwm.interface.model import _decimal

THEIRS = Path(__file__).parents[3] / "models/src/interface"


def test_the_canonical_text_of_the_rust_crate_is_ours():
    text = (THEIRS / "arm.toml").read_text()
    assert interface.parse(text).canonical() == text
    assert interface.parse(text).hash == "2e31c33aa376cbf4c3f4af8e467de83a711c08198da89814a7a31149d06c4a05"


def test_the_canonical_text_is_read_as_the_same_interface(small):
    assert interface.parse(small.canonical()) == small


@pytest.mark.parametrize(
    ("value", "text"),
    [(2.0, "2.0"), (-0.0, "0.0"), (1e16, "1e16"), (1.5e20, "1.5e20"), (1e-5, "1e-5"), (0.0001, "0.0001")],
)
def test_numbers_are_written_as_rust_writes_them(value, text):
    assert _decimal(value) == text


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("rate_hz = 20.0", "rate_hz = 0.0"), "decisions a second"),
        (('"j1", "j2"', '"j1", "j1"'), "'j1' twice"),
        (("low = [-2.0, -1.0]", "low = [-2.0]"), "1 numbers in low"),
        (("low = [-2.0, -1.0]", "low = [2.0, -1.0]"), "low below high"),
        (("low = [-2.0, -1.0]", "low = [nan, -1.0]"), "finite numbers"),
        (('fallback = "hold-measured"', 'fallback = "zero"'), "absolute"),
        (('measured = "joint_pos"', 'measured = "joint_vel"'), "the same kind"),
        (("shape = [16, 16, 3]", "shape = [16, 16, 4]"), "[rows, columns, 3]"),
        (('encoding = "rgb8"', 'encoding = "bgr8"'), "rgb8"),
        (('unit = "rad"', 'units = "rad"'), "unknown key 'units'"),
        (("[[interface.camera]]", "[interface.camera]"), "no interface"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(small, change, reason):
    text = small.canonical()
    assert change[0] in text
    with pytest.raises(InterfaceError) as error:
        interface.parse(text.replace(*change))
    assert reason in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_names_itself(tmp_path):
    with pytest.raises(InterfaceError, match=r"nothing\.toml"):
        interface.load(tmp_path / "nothing.toml")


def test_differences_name_what_differs(small):
    other = interface.parse(small.canonical().replace('name = "wrist"', 'name = "hand"').replace("-2.0", "-3.0"))
    assert differences(small, small) == []
    lines = differences(small, other)
    assert any(line.startswith("camera wrist: missing") for line in lines)
    assert any(line.startswith("action arm: low") for line in lines)


def test_states_are_packed_by_name_and_a_wrong_length_is_refused(small):
    assert small.pack({"joint_vel": [3, 4], "joint_pos": [1, 2]}).tolist() == [1, 2, 3, 4]
    with pytest.raises(InterfaceError, match="joint_vel has 1 numbers"):
        small.pack({"joint_vel": [3], "joint_pos": [1, 2]})
