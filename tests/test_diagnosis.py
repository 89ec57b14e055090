"""What the diagnosis says of right data, and of mistakes that separate code has put into them."""

import pytest

from tests.injected.matrix import cells

OF_A_RECORDING = [
    "mirrored world", "quaternion order", "poses a frame late", "poses of a marker",
    "depth along the ray", "flow v negated", "flow to the next frame",
]  # fmt: skip
OF_AN_ENV = [
    "poses world-to-camera", "mirrored world", "poses a frame late", "depth in mm",
    "K of twice the size",
]  # fmt: skip


def only(source, mistake):
    (cell,) = cells([source], [mistake])
    return cell


@pytest.mark.parametrize("source", ["room", "street, env"])
def test_right_data_are_right(source):
    cell = only(source, "right")
    assert cell.found.is_right
    assert cell.found.error_px < 0.002


@pytest.mark.parametrize("mistake", OF_A_RECORDING)
def test_a_mistake_in_a_recording_is_named(mistake):
    assert only("room", mistake).kind == "named"


@pytest.mark.parametrize("mistake", OF_AN_ENV)
def test_a_mistake_in_an_env_is_named(mistake):
    assert only("street, env", mistake).kind == "named"


def test_a_mistake_that_nobody_listed_is_noticed():
    assert only("room", "cx 8 % off").found.is_wrong
