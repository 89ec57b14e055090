"""TUM's three clocks: what belongs together, and poses between those that were measured."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("cv2", reason="recordings need OpenCV")

import cv2

from flowrep.sequences import SequenceError, Tum
from flowrep.sequences.tum import interpolated_pose
from tests.sequences.synthetic import png, text


def write(folder, rgb_s, depth_s, poses):
    """Writes pictures at these times; the grey of one and the metres of the other count them."""
    for i, time in enumerate(rgb_s):
        png(folder / f"rgb/{time:.3f}.png", np.full((4, 6, 3), i, np.uint8))
    for i, time in enumerate(depth_s):
        png(folder / f"depth/{time:.3f}.png", np.full((4, 6), 5000 * (i + 1), np.uint16))
    text(folder / "rgb.txt", [f"{time} rgb/{time:.3f}.png" for time in rgb_s])
    text(folder / "depth.txt", [f"{time} depth/{time:.3f}.png" for time in depth_s])
    text(folder / "groundtruth.txt", [f"{time} {pose}" for time, pose in poses])


def at(x):
    return f"{x} 0 0 0 0 0 1"


def matches(recording):
    return [
        (int(f.rgb[0, 0, 0]), float(f.depth[0, 0]), round(float(f.world_from_cam[0, 3]), 9))
        for f in recording
    ]


def test_each_picture_has_the_nearest_depth_and_pose_within_the_tolerance(tmp_path):
    poses = [(0.995, at(1)), (1.1, at(2)), (1.198, at(3)), (1.203, at(4))]
    write(tmp_path, [1.0, 1.1, 1.2], [1.01, 1.13, 1.19, 1.215], poses)
    recording = Tum(tmp_path, tolerance_s=0.02)
    # 1.1 has no depth within 0.02 s (1.13); of 1.19 and 1.215 the first is nearer to 1.2.
    assert matches(recording) == [(0, 1.0, 1.0), (2, 3.0, 3.0)]
    assert [frame.timestamp_s for frame in recording] == [1.0, 1.2]
    (note,) = recording.notes
    assert note.startswith("1 of 3 pictures have no depth map or pose within 0.02 s")


def test_a_depth_map_belongs_to_one_picture_alone(tmp_path):
    write(tmp_path, [1.0, 1.012], [1.01], [(1.0, at(1)), (1.012, at(2))])
    assert matches(Tum(tmp_path)) == [(1, 1.0, 2.0)]  # 1.01 is 2 ms from one and 10 from the other


def test_a_pose_at_the_pictures_own_time_lies_between_its_neighbours(tmp_path):
    # A quarter of the way from x = 1 to x = 3, and of a right angle about y.
    turned = "3 0 0 0 0.7071067811865476 0 0.7071067811865476"
    write(tmp_path, [1.0025], [1.0], [(1.0, at(1)), (1.01, turned)])
    (frame,) = Tum(tmp_path, interpolate=True)
    np.testing.assert_allclose(frame.world_from_cam[:3, 3], [1.5, 0, 0], atol=1e-9)
    expected = cv2.Rodrigues(np.array([0.0, np.pi / 8, 0.0]))[0]
    np.testing.assert_allclose(frame.world_from_cam[:3, :3], expected, atol=1e-9)
    (nearest,) = Tum(tmp_path)
    np.testing.assert_allclose(nearest.world_from_cam, np.array(
        [[1.0, 0, 0, 1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))  # fmt: skip


def test_poses_are_not_interpolated_across_a_gap_nor_beyond_the_ends(tmp_path):
    poses = [(1.0, at(1)), (1.5, at(2)), (1.51, at(3))]
    write(tmp_path, [0.99, 1.2, 1.505], [0.99, 1.2, 1.505], poses)
    assert matches(Tum(tmp_path, interpolate=True)) == [(2, 3.0, 2.5)]


def test_a_pose_that_was_measured_is_not_changed(tmp_path):
    write(tmp_path, [1.0, 1.5], [1.0, 1.5], [(1.0, at(1)), (1.5, at(2))])
    assert matches(Tum(tmp_path, interpolate=True)) == [(0, 1.0, 1.0), (1, 2.0, 2.0)]


def test_clocks_that_never_meet(tmp_path):
    write(tmp_path, [1.0], [2.0], [(1.0, at(1))])
    with pytest.raises(SequenceError, match=r"within 0\.02 s: raise tolerance_s, or check"):
        Tum(tmp_path)


def test_a_half_turn_is_halved():
    # Near pi the axis is read from the diagonal: a sign lost there would turn the wrong way.
    after = np.eye(4)
    after[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.0, np.pi - 1e-3]))[0]
    half = interpolated_pose(np.eye(4), after, 0.5)[:3, :3]
    np.testing.assert_allclose(
        half, cv2.Rodrigues(np.array([0, 0, np.pi / 2 - 5e-4]))[0], atol=1e-6
    )
