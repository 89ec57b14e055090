"""Rows of bodies that come and go."""

import pytest
import torch

from flowrep.transforms import BodyRows


def pose(x):
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[0, 3] = x
    return matrix


def test_a_body_keeps_its_row_while_others_leave():
    rows = BodyRows(3)
    rows({"a": pose(1), "b": pose(2)})
    assert rows({"b": pose(3)})[:, 0, 3].tolist()[1] == 3
    assert rows({"c": pose(7), "b": pose(4)})[:, 0, 3].tolist()[:2] == [7, 4]


def test_a_row_is_empty_for_a_step_before_another_body_takes_it():
    rows = BodyRows(2)
    first = rows({"a": pose(1)})
    second = rows({"b": pose(9)})
    # in one row, motion from 1 m to 9 m would be a jump that nobody made
    both_known = first.isfinite() & second.isfinite()
    assert not both_known.any()


def test_labels_follow_their_bodies_from_frame_to_frame():
    rows = BodyRows(2)
    rows({"a": pose(1), "b": pose(2)})
    picture = torch.tensor([[[0, 200, 7]]], dtype=torch.uint8)
    assert rows.instance(picture, {200: "b", 7: "a"}).tolist() == [[[0, 2, 1]]]
    assert rows.instance(picture, {200: "a", 7: "b"}).tolist() == [[[0, 1, 2]]]
    assert rows.instance(picture, {200: "gone"}).tolist() == [[[0, 0, 0]]]


def test_too_many_bodies_say_how_many_rows_they_need():
    rows = BodyRows(1)
    with pytest.raises(ValueError, match=r"BodyRows\(2\)"):
        rows({"a": pose(1), "b": pose(2)})
    rows.clear()
    rows({"a": pose(1)})
