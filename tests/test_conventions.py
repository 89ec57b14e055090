"""The lines of CONVENTIONS.md: each names a test that exists, and those that no other file pins."""

import ast
import re

import pytest
import torch

from flowrep.geometry import ego_flow, project, relative_motion, unproject
from tests.running import ROOT

LINES = re.findall(r"^- .*", (ROOT / "CONVENTIONS.md").read_text("utf-8"), re.MULTILINE)


@pytest.mark.parametrize("line", LINES, ids=lambda line: line[2:40])
def test_every_line_names_a_test_that_exists(line):
    named = re.findall(r"`(tests/[\w/]+\.py)::(test_\w+)`", line)
    assert named, "no test is named on this line"
    for path, name in named:
        tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
        tests = [node.name for node in tree.body if isinstance(node, ast.FunctionDef)]
        assert name in tests, f"{path} has no {name}"


def camera(fx=4.0, cx=1.5, fy=8.0, cy=1.0) -> torch.Tensor:
    return torch.tensor([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def test_world_axes_and_yaw():
    motion = pytest.importorskip("flowrep.simulator.motion", exc_type=ImportError)
    at_yaw_0, left = motion.planar(5.0, 7.0, 0.0), motion.planar(5.0, 7.0, torch.pi / 2)
    one_ahead = [1.0, 0.0, 0.0, 1.0]
    assert (at_yaw_0 @ one_ahead).tolist() == [6.0, 7.0, 0.0, 1.0]
    # Clockwise, as on a compass, it would be (5, 6, 0).
    assert (left @ one_ahead).round(9).tolist() == [5.0, 8.0, 0.0, 1.0]
    assert (left @ [0.0, 0.0, 1.0, 1.0]).tolist() == [5.0, 7.0, 1.0, 1.0]  # up stays up


def test_camera_axes_are_right_down_forward():
    ahead, right, below = torch.tensor([[0.0, 0.0, 2.0], [1.0, 0.0, 2.0], [0.0, 1.0, 2.0]])
    assert project(ahead, camera()).tolist() == [1.5, 1.0]
    assert project(right, camera()).tolist() == [3.5, 1.0]
    # With OpenGL's axes (y up, z backward) this would be (1.5, -3), and `ahead` behind the camera.
    assert project(below, camera()).tolist() == [1.5, 5.0]


def test_pixel_centres_lie_at_halves():
    # A 2 x 3 image with cx = 3/2, cy = 2/2: columns at -1, 0, 1 px and rows at -0.5, 0.5 px from
    # the centre. With centres at whole numbers: -1.5, -0.5, 0.5 and -1, 0.
    points = unproject(torch.full((1, 2, 3), 8.0), camera())
    assert points[0, :, 0].tolist() == [-2.0, 0.0, 2.0]
    assert points[:, 0, 1].tolist() == [-0.5, 0.5]


def test_opencv_calibration_gains_half_a_pixel():
    # OpenCV says that this camera sees the point at the centre of column 3, row 2:
    # 4 * 1 / 2 + 1 = 3, 8 * 0.5 / 2 + 0 = 2.
    point, cx_opencv, cy_opencv = torch.tensor([1.0, 0.5, 2.0]), 1.0, 0.0
    K = camera(cx=cx_opencv + 0.5, cy=cy_opencv + 0.5)
    assert project(point, K).tolist() == [3.5, 2.5]
    # Taken over as it is, that K would put the point of column 3, row 2 at (1.25, 0.625, 2).
    assert unproject(torch.full((1, 4, 5), 2.0), K)[2, 3].tolist() == point.tolist()


def test_depth_is_z_not_the_length_of_the_ray():
    # The last column looks along (0.75, 0, 1), a ray of 5/4 of its z. As ray length, 5 m would
    # lie at z = 4.
    K = torch.tensor([[4.0, 0.0, 0.5], [0.0, 8.0, 0.5], [0.0, 0.0, 1.0]])
    assert unproject(torch.full((1, 1, 4), 5.0), K)[0, 3].tolist() == [3.75, 0.0, 5.0]


def test_a_wide_world_costs_no_precision():
    # 10 km out, a step of 0.83 m. Composed in float32, whose spacing there is 1 mm, the
    # translation would be wrong by up to 1e-3 m.
    world_from_prev, world_from_curr = torch.eye(4).double(), torch.eye(4).double()
    world_from_prev[:3, 3] = torch.tensor([10_000.1, -9_000.7, 1.2], dtype=torch.float64)
    world_from_curr[:3, 3] = torch.tensor([10_000.93, -9_000.7, 1.2], dtype=torch.float64)
    prev_from_curr = relative_motion(world_from_prev, world_from_curr)
    assert prev_from_curr.dtype == torch.float32
    expected = torch.tensor([0.83, 0.0, 0.0])
    torch.testing.assert_close(prev_from_curr[:3, 3], expected, rtol=0, atol=1e-7)


def test_ego_flow_is_that_of_dungeon_maps_which_the_paper_used():
    # github.com/Ending2015a/dungeon_maps: pixels at whole numbers, the bottom row is 0, centre
    # (W/2, H/2), x right, y up, z forward, yaw to the left. On 4 x 2 pixels with f = (2, 4), the
    # camera turned by a yaw of sin 0.6, cos 0.8 and moved by x = 0.5, z = 1; all depths are 4.
    # Column 3 of the top row, 1: (2, 0, 4) was at (0.8 * 2 - 0.6 * 4 + 0.5, 0, 0.6 * 2 + 0.8 * 4
    # + 1) = (-0.3, 0, 5.4), pixel (2 - 0.6 / 5.4, 1). Column 0 of the bottom row: (-4, -1, 4) was
    # at (-5.1, -1, 1.8), pixel (2 - 10.2 / 1.8, 1 - 4 / 1.8). In flowrep rows count downwards.
    # With yaw to the right, the first would be 3 - 5.
    K = camera(fx=2.0, cx=4 / 2 + 0.5, fy=4.0, cy=2 / 2 - 0.5)
    prev_from_curr = torch.eye(4)
    prev_from_curr[0, [0, 2, 3]] = torch.tensor([0.8, -0.6, 0.5])
    prev_from_curr[2, [0, 2, 3]] = torch.tensor([0.6, 0.8, 1.0])
    flow, _ = ego_flow(torch.full((1, 2, 4), 4.0), K, prev_from_curr)
    torch.testing.assert_close(flow[:, 0, 3], torch.tensor([3 - 2 + 0.6 / 5.4, 0.0]))
    torch.testing.assert_close(flow[:, 1, 0], torch.tensor([0 - 2 + 10.2 / 1.8, 1 - 4 / 1.8]))
