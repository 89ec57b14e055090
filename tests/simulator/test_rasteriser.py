"""Depth and ids of single triangles, worked by hand."""

import math

import numpy as np
import pytest

from flowrep.simulator.meshes import Body, Mesh, gather
from flowrep.simulator.paint import swatch
from flowrep.simulator.rasteriser import Rasteriser

# Nothing is square and nothing centred, so that no two numbers can be swapped.
HEIGHT, WIDTH = 6, 9
K = np.array([[5.0, 0.0, 3.5], [0.0, 4.0, 2.0], [0.0, 0.0, 1.0]])
NEAR_M, FAR_M = 0.5, 100.0
STILL = np.eye(4)
WALL, BALL = (3, 0), (4, 7)  # class, instance


def quad(corners, ids=WALL):
    """A body of one quadrangle, counter-clockwise seen from its outside."""
    mesh = Mesh()
    mesh.polygon(np.array(corners, dtype=float), swatch("asphalt"))
    return Body(*mesh.triangles, *ids)


def facing(z, x0, x1, y0, y1, ids=WALL):
    """A rectangle across the optical axis that looks at the camera; y points down."""
    return quad([(x0, y1, z), (x1, y1, z), (x1, y0, z), (x0, y0, z)], ids)


def see(*bodies, cam_from_world=STILL, poses=(), is_shown=None):
    rasterise = Rasteriser(gather(bodies), K, (HEIGHT, WIDTH), (NEAR_M, FAR_M))
    is_shown = np.array([is_shown or [True] * len(bodies)])
    poses = np.array(poses or [STILL] * sum(body.instance > 0 for body in bodies))
    maps = rasterise(cam_from_world[None], poses.reshape(1, -1, 4, 4), is_shown)
    return [array[0] for array in maps[:3]]


def shifted(x, y, z):
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def test_a_rectangle_covers_the_pixels_whose_centres_lie_in_it():
    # At z = 2 it reaches from u = 5·0.3/2 + 3.5 = 4.25 to 5·1.3/2 + 3.5 = 6.75 and from
    # v = 4·(-0.7)/2 + 2 = 0.6 to 4·0.6/2 + 2 = 3.2: centres 4.5 to 6.5 and 1.5 to 2.5. A camera
    # that samples corners would see columns 5 and 6, rows 1 to 3.
    depth, semantic, instance = see(facing(2.0, 0.3, 1.3, -0.7, 0.6, BALL))
    covered = np.zeros((HEIGHT, WIDTH), dtype=bool)
    covered[1:3, 4:7] = True
    np.testing.assert_array_equal(semantic, np.where(covered, 4, 0))
    np.testing.assert_array_equal(instance, np.where(covered, 7, 0))
    np.testing.assert_array_equal(depth, np.where(covered, 2.0, np.inf))
    assert [array.dtype.name for array in (depth, semantic, instance)] == [
        "float32", "uint8", "uint8"
    ]  # fmt: skip


def test_depth_on_a_slanted_plane_is_the_rays():
    # z = 6 + 0.6 x - 0.5 y. On the ray (a, b, 1) z that is z = 6 / (1 - 0.6 a + 0.5 b).
    corners = [(x, y, 6 + 0.6 * x - 0.5 * y) for x, y in ((-5, 5), (5, 5), (5, -5), (-5, -5))]
    depth, *_ = see(quad(corners))
    a = (np.arange(WIDTH) + 0.5 - 3.5) / 5.0
    b = (np.arange(HEIGHT)[:, None] + 0.5 - 2.0) / 4.0
    seen = np.isfinite(depth)
    assert seen.sum() > 30
    np.testing.assert_allclose(depth[seen], (6.0 / (1 - 0.6 * a + 0.5 * b))[seen], rtol=1e-6)


def test_the_nearer_triangle_hides_the_farther_one_in_any_order():
    near, far = facing(2.0, -9, 0.1, -9, 9, BALL), facing(4.0, -9, 9, -9, 9, WALL)
    # The near one ends at u = 5·0.1/2 + 3.5 = 3.75: columns 0 to 3.
    for bodies in ((near, far), (far, near)):
        depth, semantic, _ = see(*bodies)
        np.testing.assert_array_equal(depth[2], [2.0] * 4 + [4.0] * 5)
        np.testing.assert_array_equal(semantic[2], [4] * 4 + [3] * 5)
    # What is not shown hides nothing.
    np.testing.assert_array_equal(see(near, far, is_shown=[False, True])[0], 4.0)


def test_triangles_are_invisible_from_behind():
    corners = [(-9, 9, 2.0), (9, 9, 2.0), (9, -9, 2.0), (-9, -9, 2.0)]
    assert np.isfinite(see(quad(corners))[0]).all()
    assert not np.isfinite(see(quad(corners[::-1]))[0]).any()


def test_a_floor_behind_the_camera_is_cut_at_the_near_plane():
    # 1 m below the camera, from 50 m behind it to 50 m ahead: row j sees it at
    # z = 1 / b, b = (j + 0.5 - 2) / 4, where that is from 0.5 to 50 m: rows 2 (8 m) to 5 (1.14 m).
    floor = quad([(-80, 1, -50), (80, 1, -50), (80, 1, 50), (-80, 1, 50)])
    depth, semantic, _ = see(floor)
    expected = [math.inf, math.inf, 8.0, 8 / 3, 1.6, 8 / 7]
    np.testing.assert_allclose(depth, np.repeat(np.array(expected)[:, None], WIDTH, 1), rtol=1e-6)
    np.testing.assert_array_equal(semantic > 0, np.isfinite(depth))
    # 0.3 m below: row 5 would see it at 0.34 m, before the near plane.
    low = quad([(-80, 0.3, -50), (80, 0.3, -50), (80, 0.3, 50), (-80, 0.3, 50)])
    np.testing.assert_allclose(see(low)[0][2:, 0], [2.4, 0.8, math.inf, math.inf], rtol=1e-6)


@pytest.mark.parametrize(("z", "is_seen"), [(0.49, 0), (0.51, 1), (99.0, 1), (101.0, 0)])
def test_only_surfaces_between_near_and_far_plane_are_seen(z, is_seen):
    assert np.isfinite(see(facing(z, -200, 200, -200, 200))[0]).all() == is_seen


def test_bodies_move_with_their_poses_and_the_camera_with_its_own():
    ball, wall = facing(0.0, -0.2, 0.2, -0.2, 0.2, BALL), facing(8.0, -9, 9, -9, 9)
    # The camera stands at (1, 0, -1), so that the ball at (1.2, 0.3, 3) is seen from 4 m, at
    # u = 5·0.2/4 + 3.5 = 3.75, v = 4·0.3/4 + 2 = 2.3; it reaches 0.25 px and 0.2 px around: from
    # (3.5, 2.1) to (4.0, 2.5), whose rim the centre (3.5, 2.5) of column 3, row 2 is on.
    for x, seen_at in ((1.21, []), (1.19, [[2, 3]])):
        poses = [shifted(x, 0.31, 3)]
        depth, _, instance = see(ball, wall, cam_from_world=shifted(-1, 0, 1), poses=poses)
        assert np.argwhere(instance == 7).tolist() == seen_at
    assert depth[2, 3] == 4.0
    assert depth[2, 4] == 9.0


def test_neighbouring_triangles_leave_no_gap():
    # A fan of thin triangles around a point that is no pixel's centre covers everything.
    angles = np.linspace(0, 2 * math.pi, 61)[:-1]
    rim = np.stack([50 * np.cos(angles), 50 * np.sin(angles), np.full(60, 3.0)], axis=1)
    middle = np.tile((0.123, -0.077, 3.0), (60, 1))
    fan = Mesh()
    for corners in np.stack([middle, np.roll(rim, -1, axis=0), rim], axis=1):
        fan.polygon(corners, swatch("asphalt"))
    assert np.isfinite(see(Body(*fan.triangles, *WALL))[0]).all()
