"""What other simulators, data sets and robots mean, each convention worked by hand."""

import math
from functools import partial

import pytest
import torch

from flowrep.geometry import (
    adapt_depth,
    adapt_flow,
    adapt_pose,
    check_intrinsics,
    instance_rows,
    intrinsics_from_fov,
    intrinsics_from_opencv,
    invert_rigid,
    pose_from_quaternion,
    project,
    unproject,
)
from flowrep.geometry.depth import z_from_z_buffer
from tests.geometry.scenes import K, depth_map, rigid

# 1 x 3 pixels whose rays lead through (-0.75, 0.5), (0, 0.5) and (0.75, 0.5) at z = 1.
CAMERA = torch.tensor([[4.0, 0.0, 3.5], [0.0, 8.0, -3.5], [0.0, 0.0, 1.0]])


def depth_of(*values: float) -> torch.Tensor:
    return torch.tensor(values).reshape(1, 1, -1)


def test_depth_that_is_z_stays():
    depth = depth_of(2.0, math.inf, math.nan)
    assert adapt_depth(depth, "z") is depth


def test_the_length_of_a_ray_becomes_its_z():
    # Columns 0, 3 and 6 look along x = -0.75, 0 and 0.75, y = 0.5: the ray that reaches z = 1 is
    # sqrt(1 + 0.5625 + 0.25) = 1.34629 and sqrt(1.25) = 1.11803 long.
    length = depth_of(1.34629, 9.0, 9.0, 2.23607, math.inf, math.nan, 2.69258)
    z = adapt_depth(length, "ray_length", K=CAMERA).flatten()
    torch.testing.assert_close(z[[0, 3, 6]], torch.tensor([1.0, 2.0, 2.0]), atol=1e-5, rtol=0)
    assert z[4] == math.inf
    assert z[5].isnan()


def test_ray_length_comes_back_from_points_with_skew_and_batch():
    depth = depth_map(2, 3)
    length = unproject(depth, K).norm(dim=-1).unsqueeze(-3)
    torch.testing.assert_close(adapt_depth(length, "ray_length", K=K), depth)


def test_an_opengl_z_buffer_becomes_metres():
    # OpenGL writes b = (1/z - 1/near) / (1/far - 1/near). near 0.5 m, far 8 m, z = 2 m:
    # (0.5 - 2) / (0.125 - 2) = 0.8. Read as linear between the planes it would be 6.5 m.
    buffer = depth_of(0.0, 0.8, 1.0, -0.1, 1.1, math.nan)
    z = adapt_depth(buffer, "z_buffer", near_m=0.5, far_m=8.0).flatten()
    torch.testing.assert_close(z[:2], torch.tensor([0.5, 2.0]))
    assert z[2] == math.inf  # nothing was drawn
    assert z[3:].isnan().all()


def test_a_z_buffer_without_far_plane():
    # b = 1 - near / z: 0.75 at four times the near plane.
    z = adapt_depth(depth_of(0.75), "z_buffer", near_m=0.5, far_m=math.inf)
    assert z.item() == 2.0


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        (
            {"kind": "zbuffer"},
            r"\['z', 'ray_length', 'z_buffer'\], got 'zbuffer'",
        ),
        ({"kind": "ray_length"}, "'ray_length' needs K"),
        ({"kind": "z", "K": CAMERA}, "the other kinds do not read it; kind is 'z'"),
        ({"kind": "z_buffer", "near_m": 1.0}, "needs near_m and far_m.*far_m=None"),
        ({"kind": "z", "far_m": 1.0}, "do not read them; kind is 'z'"),
        ({"kind": "z_buffer", "near_m": 2.0, "far_m": 1.0}, "0 < near_m < far_m"),
        ({"kind": "z_buffer", "near_m": 0.0, "far_m": 1.0}, "0 < near_m < far_m"),
    ],
)
def test_depth_options_are_checked(options, expected):
    with pytest.raises(ValueError, match=expected):
        adapt_depth(depth_of(0.5), **options)


def test_whole_numbers_become_metres_and_nothing_becomes_nan():
    millimetres = torch.tensor([[[0, 2500, 31000]]], dtype=torch.int16)
    z = adapt_depth(millimetres, "z", scale_m=1e-3, nothing=0)
    torch.testing.assert_close(z, torch.tensor([[[torch.nan, 2.5, 31.0]]]), equal_nan=True)
    with pytest.raises(TypeError, match="depth"):  # 2500 m, if it were taken as it is
        adapt_depth(millimetres, "z")
    for wrong in (0.0, -1.0, torch.inf):
        with pytest.raises(ValueError, match="scale_m"):
            adapt_depth(millimetres, "z", scale_m=wrong)


def test_a_pose_without_its_last_row():
    whole = torch.tensor([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1.0]])
    assert adapt_pose(whole[:3], layout="matrix_3x4").equal(whole.double())
    inverted = adapt_pose(whole[:3], layout="matrix_3x4", direction="world_to_camera")
    torch.testing.assert_close(inverted @ whole.double(), torch.eye(4).double())


def test_angles_turn_left_and_look_up():
    pose = torch.tensor([5.0, 6.0, 7.0, math.pi / 2, math.pi / 6], dtype=torch.float64)
    camera = adapt_pose(pose, layout="xyz_yaw_pitch", axes="x_forward_z_up")
    ahead = camera @ torch.tensor([0.0, 0.0, 2.0, 1.0], dtype=torch.float64)
    # a quarter turn to the left of x is y; 30 degrees up: 2 sin 30 = 1, not -1
    expected = torch.tensor([5.0, 6 + math.sqrt(3), 8.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(ahead, expected)
    right = camera @ torch.tensor([1.0, 0.0, 0.0, 1.0], dtype=torch.float64)
    torch.testing.assert_close(right[:3], torch.tensor([6.0, 6.0, 7.0], dtype=torch.float64))
    level = adapt_pose(pose[:4], layout="xyz_yaw", axes="x_forward_z_up")
    torch.testing.assert_close(level[:3, 2], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))
    with pytest.raises(ValueError, match="x_forward_z_up"):
        adapt_pose(pose[:4], layout="xyz_yaw")


def test_pixels_that_are_not_square():
    wide = intrinsics_from_fov(90.0, axis="horizontal", height=240, width=320, pixel_aspect=1.2)
    assert [wide[0, 0].item(), wide[1, 1].item()] == pytest.approx([160.0, 192.0])
    tall = intrinsics_from_fov(90.0, axis="vertical", height=240, width=320, pixel_aspect=1.2)
    assert [tall[0, 0].item(), tall[1, 1].item()] == pytest.approx([100.0, 120.0])


def test_field_of_view_across_the_width_or_the_height():
    # tan(45 deg) = 1: half of the picture, 3 or 2 px, lies as far out as the focal length.
    across_width = intrinsics_from_fov(90.0, axis="horizontal", height=4, width=6)
    across_height = intrinsics_from_fov(90.0, axis="vertical", height=4, width=6)
    assert across_width.tolist() == [[3.0, 0.0, 3.0], [0.0, 3.0, 2.0], [0.0, 0.0, 1.0]]
    assert across_height.tolist() == [[2.0, 0.0, 3.0], [0.0, 2.0, 2.0], [0.0, 0.0, 1.0]]
    # What lies on the field's rim is seen at the picture's: 30 degrees to the right of the axis.
    rim = torch.tensor([math.tan(math.radians(30.0)), 0.0, 1.0])
    K_60 = intrinsics_from_fov(60.0, axis="horizontal", height=4, width=6)
    torch.testing.assert_close(project(rim, K_60), torch.tensor([6.0, 2.0]))


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"axis": "diagonal"}, r"axis must be one of \['horizontal', 'vertical'\], got 'diagonal'"),
        ({"fov_deg": 180.0}, "between 0 and 180 degrees, got 180"),
        ({"height": 0}, "at least 1 pixel, got 0 and 6"),
    ],
)
def test_field_of_view_is_checked(changed, expected):
    options = {"fov_deg": 90.0, "axis": "vertical", "height": 4, "width": 6, **changed}
    with pytest.raises(ValueError, match=expected):
        intrinsics_from_fov(**options)


def test_a_picture_may_be_one_pixel_wide():
    # One pixel across 90 degrees: the focal length is half of it, and its centre lies at 0.5.
    K = intrinsics_from_fov(90.0, axis="horizontal", height=1, width=1)
    assert (K[0, 0], K[0, 2], K[1, 2]) == (pytest.approx(0.5), 0.5, 0.5)


def test_opencv_calibration_moves_by_half_a_pixel_and_no_more():
    moved = intrinsics_from_opencv(CAMERA.expand(2, 3, 3)) - CAMERA
    half = [[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]]
    assert moved.tolist() == [half, half]


# A camera at (5, 6, 7) that looks along the world's x, with z up: right is -y, down is -z.
LOOKING_ALONG_X = torch.tensor(
    [[0.0, 0.0, 1.0, 5.0], [-1.0, 0.0, 0.0, 6.0], [0.0, -1.0, 0.0, 7.0], [0.0, 0.0, 0.0, 1.0]]
).double()
# The same camera's axes in the other conventions, a column each, written down by hand.
AXES = {
    "opencv": [[0, 0, 1], [-1, 0, 0], [0, -1, 0]],  # right, down, forward
    "opengl": [[0, 0, -1], [-1, 0, 0], [0, 1, 0]],  # right, up, backward
    "ned": [[1, 0, 0], [0, -1, 0], [0, 0, -1]],  # forward, right, down
    "x_forward_z_up": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],  # forward, left, up
}


@pytest.mark.parametrize("axes", AXES)
def test_axes_of_one_and_the_same_camera(axes):
    pose = LOOKING_ALONG_X.clone()
    pose[:3, :3] = torch.tensor(AXES[axes]).double()
    assert torch.equal(adapt_pose(pose, axes=axes), LOOKING_ALONG_X)
    # and of world-to-camera matrices, which are given in those axes too
    extrinsics = invert_rigid(pose)
    assert torch.equal(
        adapt_pose(extrinsics, direction="world_to_camera", axes=axes), LOOKING_ALONG_X
    )


def test_world_to_camera_is_inverted():
    world_from_cam = rigid((0.3, -0.2, 0.9), (5.0, 6.0, 7.0))
    got = adapt_pose(invert_rigid(world_from_cam).float(), direction="world_to_camera")
    assert got.dtype == torch.float64
    torch.testing.assert_close(got, world_from_cam, atol=1e-5, rtol=0)


def test_a_quaternion_s_real_part_is_first_or_last():
    # A quarter turn about z takes x to y: w = z = sqrt(1/2).
    half = math.sqrt(0.5)
    expected = [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0]]
    last = torch.tensor([1.0, 2.0, 3.0, 0.0, 0.0, half, half])
    first = torch.tensor([1.0, 2.0, 3.0, half, 0.0, 0.0, half])
    for pose, layout in ((last, "xyz_xyzw"), (first, "xyz_wxyz")):
        matrix = adapt_pose(pose, layout=layout)
        torch.testing.assert_close(matrix[:3], torch.tensor(expected).double(), atol=1e-6, rtol=0)
        assert matrix[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    # Read the other way round, `last` would be a quarter turn about y and then some.
    assert not torch.allclose(
        adapt_pose(last, layout="xyz_wxyz")[:3], torch.tensor(expected).double()
    )


@pytest.mark.parametrize(("axis", "moves", "to"), [(0, 1, 2), (1, 2, 0), (2, 0, 1)])
def test_a_quarter_turn_about_each_axis(axis, moves, to):
    quaternion = torch.zeros(2, 7).double()
    quaternion[:, 3 + axis] = quaternion[:, 6] = math.sqrt(0.5)
    turned = (
        pose_from_quaternion(quaternion, "xyz_xyzw")[..., :3, :3] @ torch.eye(3).double()[moves]
    )
    torch.testing.assert_close(turned, torch.eye(3).double()[to].expand(2, 3))


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"layout": "xyzw"}, r"layout.*'matrix_3x4'.*xyzw"),
        ({"direction": "cam2world"}, r"\['camera_to_world', 'world_to_camera'\], got 'cam2world'"),
        (
            {"axes": "blender"},
            r"axes must be one of \['opencv', 'opengl', 'ned', 'x_forward_z_up'\]",
        ),
        ({"layout": "xyz_xyzw"}, r"pose must be \[\*B, 7\], got \[4, 4\]"),
    ],
)
def test_pose_options_are_checked(options, expected):
    with pytest.raises(ValueError, match=expected):
        adapt_pose(torch.eye(4), **options)


def ill_formed(what: str) -> torch.Tensor:
    pose = rigid((0.3, -0.2, 0.9), (5.0, 6.0, 7.0))
    if what == "nan":
        pose[0, 3] = math.nan
    elif what == "transposed":
        pose = pose.mT
    elif what == "scaled":
        pose[:3, :3] *= 1.01
    else:
        pose[:3, 1] *= -1.0
    return pose


@pytest.mark.parametrize(
    ("what", "expected"),
    [
        ("nan", "holds nan or inf"),
        ("transposed", r"has a last row other than \(0, 0, 0, 1\): is it transposed"),
        ("scaled", "is not rigid"),
        ("mirrored", "is left-handed"),
    ],
)
def test_an_ill_formed_pose_is_refused_by_name_and_place(what, expected):
    poses = torch.eye(4).double().repeat(2, 3, 1, 1)
    poses[1, 2] = ill_formed(what)
    with pytest.raises(ValueError, match=rf"^pose\[1, 2\] {expected}"):
        adapt_pose(poses)
    assert adapt_pose(poses, check=False).shape == (2, 3, 4, 4)


def test_intrinsics_that_are_none_are_refused_by_name_and_place():
    cameras = CAMERA.repeat(2, 3, 1, 1)
    check_intrinsics("K", cameras)
    cameras[1, 2, 2, 0] = 3.5  # and so (3.5, 0, 1) as the last row
    with pytest.raises(ValueError, match=r"^K\[1, 2\] should .*got \[\[4.0, 0.0, 3.5\], .*, \[3.5"):
        check_intrinsics("K", cameras)


def test_a_quaternion_that_is_not_of_unit_length_is_refused():
    pose = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0])
    with pytest.raises(ValueError, match=r"a quaternion must have length 1, got \[2.0\]"):
        adapt_pose(pose, layout="xyz_xyzw")
    normalised = adapt_pose(pose, layout="xyz_xyzw", check=False)
    assert torch.equal(normalised, torch.eye(4).double())


@pytest.mark.parametrize(
    ("adapt", "expected"),
    [
        (partial(adapt_depth, kind="z"), r"^depth must be .*1, H, W\], got \[5, 7\]"),
        (partial(z_from_z_buffer, near_m=0.1, far_m=9.0), r"^z_buffer must be .*1, H, W\]"),
        (adapt_pose, r"^pose must be .*4, 4\], got \[5, 7\]"),
        (
            partial(adapt_flow, direction="forward", grid="current"),
            r"^flow must be .*2, H, W\], got \[5, 7\]",
        ),
    ],
    ids=["depth", "z-buffer", "pose", "flow"],
)
def test_a_tensor_of_another_shape_is_refused_by_name_and_with_the_right_one(adapt, expected):
    with pytest.raises(ValueError, match=expected):
        adapt(torch.ones(5, 7))


def test_flow_that_needs_no_change_and_flow_that_points_back():
    # The point at column 7, row 2 came from column 4, row 3: p_t - p_t' = (3, -1).
    want = torch.tensor([3.0, -1.0]).reshape(2, 1, 1)
    grid = {"grid": "current"}
    assert torch.equal(adapt_flow(want, direction="forward", **grid), want)
    assert torch.equal(adapt_flow(-want, direction="backward", **grid), want)
    rows_first = torch.tensor([1.0, -3.0]).reshape(1, 2, 1, 1)
    back = adapt_flow(rows_first, direction="backward", channels="row_column", **grid)
    assert torch.equal(back[0], want)


@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_flow_on_the_previous_grid_is_refused_with_a_way_out(direction):
    with pytest.raises(ValueError, match=rf"{direction} flow on the previous.*swap the two"):
        adapt_flow(torch.zeros(2, 3, 4), direction=direction, grid="previous")


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"direction": "back"}, r"\['forward', 'backward'\], got 'back'"),
        ({"grid": "next"}, r"\['current', 'previous'\], got 'next'"),
        ({"channels": "vu"}, r"\['uv', 'row_column'\], got 'vu'"),
    ],
)
def test_flow_options_are_checked(changed, expected):
    options = {"direction": "forward", "grid": "current", **changed}
    with pytest.raises(ValueError, match=expected):
        adapt_flow(torch.zeros(2, 3, 4), **options)


def test_ids_of_any_simulator_become_rows():
    ids = torch.tensor([[[17, 0, 3], [-1, 4, 16_777_215]]])
    rows = instance_rows(ids, torch.tensor([17, 3, 16_777_215]))
    # A static world of id 0, a background of -1 and the unknown body 4 are row 0.
    assert rows.tolist() == [[[1, 0, 2], [0, 0, 3]]]
    assert rows.dtype == torch.uint8
    assert instance_rows(ids, torch.arange(400)).dtype == torch.int32
    assert instance_rows(ids, torch.arange(0)).tolist() == [[[0, 0, 0], [0, 0, 0]]]
    assert instance_rows(ids.short()[..., :1].mT, torch.tensor([17])).tolist() == [[[1, 0]]]


def test_ids_are_checked():
    with pytest.raises(TypeError, match=r"ids must hold integer ids, got torch\.float32"):
        instance_rows(torch.zeros(1, 2, 3), torch.tensor([1]))
    with pytest.raises(TypeError, match=r"body_ids must hold integer ids, got torch\.bool"):
        instance_rows(torch.zeros(1, 2, 3).int(), torch.tensor([True]))
    with pytest.raises(ValueError, match=r"body_ids must be \[N\], got \[1, 1\]"):
        instance_rows(torch.zeros(1, 2, 3).int(), torch.tensor([[1]]))
