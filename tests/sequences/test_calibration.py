"""Depth from one camera on the pixels of another."""

import cv2
import numpy as np
import pytest

from flowrep.sequences import Registration, SequenceError
from flowrep.sequences.calibration import camera_matrix

K_DEPTH = np.array([[58.0, 0.0, 33.0], [0.0, 61.0, 22.5], [0.0, 0.0, 1.0]])
K_COLOUR = np.array([[50.0, 0.0, 30.5], [0.0, 52.0, 26.0], [0.0, 0.0, 1.0]])
SIZE = (48, 64)


def shifted(x=0.0, y=0.0, z=0.0):
    colour_from_depth = np.eye(4)
    colour_from_depth[:3, 3] = x, y, z
    return colour_from_depth


def test_registration_to_the_same_camera_changes_no_depth():
    depth = np.random.default_rng(0).uniform(1, 5, SIZE).astype(np.float32)
    depth[3, 4], depth[5, 6] = np.nan, np.inf
    same = Registration(K_DEPTH, K_DEPTH, np.eye(4), SIZE)(depth)
    depth[5, 6] = np.nan  # no surface, so nothing to carry over
    np.testing.assert_allclose(same, depth, rtol=1e-6)


def test_a_wall_seen_by_a_wider_camera_has_a_border_and_no_holes():
    wall = np.full(SIZE, 2.0, np.float32)
    seen = Registration(K_DEPTH, K_COLOUR, shifted(z=0.5), SIZE)(wall)
    found = np.isfinite(seen)
    assert np.unique(seen[found]).tolist() == [2.5]
    # The first and the last column, u = 0.5 and 63.5, lie at X = (u - 33) / 58 * 2 m, which the
    # colour camera sees at 50 X / 2.5 + 30.5: 8.09 and 51.53. Rows 0.5 and 47.5 lie at
    # Y = (v - 22.5) / 61 * 2, seen at 52 Y / 2.5 + 26: 10.997 and 43.05.
    rows, columns = np.flatnonzero(found.any(1)), np.flatnonzero(found.any(0))
    assert (columns[0], columns[-1]) == (8, 51)
    assert (rows[0], rows[-1]) == (10, 43)
    assert found[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].all()
    # A finer camera has no holes either.
    wall = np.full((12, 16), 3.0, np.float32)
    coarse = np.array([[12.0, 0.0, 8.0], [0.0, 12.0, 6.0], [0.0, 0.0, 1.0]])
    fine = np.array([[40.0, 0.0, 27.0], [0.0, 40.0, 20.0], [0.0, 0.0, 1.0]])
    seen = Registration(coarse, fine, np.eye(4), (40, 54))(wall)
    assert (seen == 3.0).all()


def test_the_nearest_surface_hides_what_is_behind_it():
    # The colour camera is 0.2 m to the left, so that points lie 0.2 m further right in it: by
    # 10 px at 1 m, by 2 px at 5 m. A post at 1 m in columns 30 to 33 covers the wall there.
    depth = np.full(SIZE, 5.0, np.float32)
    depth[:, 30:34] = 1.0
    K = np.array([[50.0, 0.0, 32.0], [0.0, 50.0, 24.0], [0.0, 0.0, 1.0]])
    seen = Registration(K, K, shifted(x=0.2), SIZE)(depth)
    row = seen[20]
    assert row[40:44].tolist() == [1.0] * 4
    assert np.isnan(row[32:36]).all()  # the wall behind the post, which nobody measured
    assert row[36:40].tolist() == row[44:48].tolist() == [5.0] * 4


def test_a_turned_camera_sees_each_point_where_it_projects_to():
    # A wall turned about y is not parallel to the picture any more: compare point by point.
    colour_from_depth = np.eye(4)
    colour_from_depth[:3, :3] = cv2.Rodrigues(np.array([0.0, 0.05, 0.0]))[0]
    colour_from_depth[:3, 3] = 0.1, -0.05, 0.02
    depth = np.full(SIZE, np.nan, np.float32)
    depth[10, 20] = 2.0
    point = np.linalg.inv(K_DEPTH) @ [20.5, 10.5, 1.0] * 2.0
    x, y, z = colour_from_depth[:3, :3] @ point + colour_from_depth[:3, 3]
    column = int(np.floor(50.0 * x / z + 30.5))
    row = int(np.floor(52.0 * y / z + 26.0))
    seen = Registration(K_DEPTH, K_COLOUR, colour_from_depth, SIZE)(depth)
    assert np.argwhere(np.isfinite(seen)).tolist() == [[row, column]]
    assert seen[row, column] == pytest.approx(z, rel=1e-6)


def test_rays_of_a_pictures_borders_are_k_unless_the_lens_is_tilted():
    # On 8 x 4 pixels: x = 0.5 u + 0.1 and u = column / 4 - 1, so column = 8 x + 3.2;
    # y = -(0.4 v - 0.05) and v = 1 - row / 2, so row = 5 y + 1.75.
    rays = np.array([[0.5, 0, 0.1], [0, 0.4, -0.05], [0, 0, -1]])
    K = camera_matrix(rays, (4, 8), 0.0, kind="cam_from_uv")
    np.testing.assert_allclose(K, [[8, 0, 3.2], [0, 5, 1.75], [0, 0, 1]])
    rays[2, 1] = 0.1
    with pytest.raises(SequenceError, match="tilted"):
        camera_matrix(rays, (4, 8), 0.5, kind="cam_from_uv")
