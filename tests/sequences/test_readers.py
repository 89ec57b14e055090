"""Every format gives back what was written in it, and object flow equals the truth."""

from dataclasses import replace
from functools import partial

import cv2
import numpy as np
import pytest

from flowrep.sequences import factorize_frames, open_recording, recorded_flow
from tests.sequences import synthetic, test_tools
from tests.sequences.synthetic import HEIGHT, OPENCV_INTRINSICS, WIDTH

CAMERA = (31.0, 27.0, 18.5, 13.0)
# By format: the options that have to be given.
FORMATS = {
    "frames": {},
    "tum": {"intrinsics": OPENCV_INTRINSICS},
    "sevenscenes": {"depth_intrinsics": CAMERA, "intrinsics": CAMERA},
    "vkitti2": {},
    "sintel": {"scene": "cave", "backwards": True},
    "tartanair": {"backwards": True},
    "kitti": {},
    "zed": {},
}
DECLARED = {
    "tartanair_v2": {},
    "icl_nuim": {"poses": "livingRoom2.gt.freiburg", "intrinsics": OPENCV_INTRINSICS},
    "replica": {"intrinsics": OPENCV_INTRINSICS},
    "scannet": {},
    "realsense": {"intrinsics": OPENCV_INTRINSICS},
    "kubric": {},
    "hypersim": {"intrinsics": CAMERA, "pose_unit_m": 0.0254},
    "spring": {},
    "colmap": {},
    "nerf": {},
    "bop": {"depth_unit_m": 0.001},
    "arkitscenes": {"scene": "7"},
    "open3d": {},
}
# Those with flow of their own, and how far it may be from the truth: half a step of the format's
# own, for Kubric's a part of 65,535 in a range of some 40 px.
STEPS_PX = {"frames": 0, "sintel": 0, "tartanair": 0, "spring": 0}
STEPS_PX |= {"vkitti2": (WIDTH - 1) / 65535, "kitti": 0.5 / 64, "kubric": 1e-3}
CAMERAS = {
    "kitti": synthetic.KITTI_K, "kubric": synthetic.KUBRIC_K,
    "tartanair": synthetic.TARTANAIR_K, "tartanair_v2": synthetic.TARTANAIR_K,
}  # fmt: skip


def written(name, folder):
    """Writes a recording; returns its moments, and what opens it."""
    module = synthetic if hasattr(synthetic, f"write_{name}") else test_tools
    moments = getattr(module, f"write_{name}")(folder)
    return moments, partial(open_recording, folder, name, **(FORMATS | DECLARED)[name])


@pytest.mark.parametrize("in_capitals", [False, True])
@pytest.mark.parametrize("name", FORMATS | DECLARED)
def test_what_was_written_is_read_and_object_flow_equals_the_truth(name, in_capitals, tmp_path):
    moments, open_it = written(name, tmp_path)
    for path in [path for path in tmp_path.rglob("*.*") if in_capitals and path.is_file()]:
        path.rename(path.with_suffix(path.suffix.upper()))
    ordered = moments[::-1] if name in ("sintel", "tartanair") else moments
    recording, step_px = open_it(), STEPS_PX.get(name, 0)
    assert (recording.has_flow, len(recording)) == (name in STEPS_PX, len(moments))
    # OpenCV's cx = 18 is the centre of column 18, which lies at 18.5.
    K = CAMERAS.get(name, synthetic.K)
    for frame, moment in zip(recording, ordered):
        assert frame.K.tolist() == K.tolist()
        assert frame.size == (HEIGHT, WIDTH)
        assert frame.depth.dtype == np.float32
        np.testing.assert_array_equal(frame.rgb, moment.rgb)
        # To the last bit, but where depth is registered, a ray's length or disparity: whole numbers
        # times the unit, as float32.
        bits = 1e-6 if name in ("sevenscenes", "kubric", "hypersim", "spring") else 0
        np.testing.assert_allclose(frame.depth, moment.depth, rtol=bits)
        pose = frame.world_from_cam
        if name == "kitti":
            assert pose is None
        elif name != "icl_nuim":  # whose world is mirrored
            assert pose.dtype == np.float64
            np.testing.assert_allclose(pose, moment.world_from_cam, rtol=0, atol=1e-8)
        if frame.raw is not None:
            np.testing.assert_allclose(frame.raw, moment.raw, rtol=0, atol=step_px)
    assert len({frame.name for frame in recording}) == len(recording)
    truth = iter(ordered[1:])
    source = recorded_flow if recording.has_flow else lambda previous, current: next(truth).raw
    if name == "kitti":
        posed = zip(recording, ordered)
        recording = [replace(frame, world_from_cam=m.world_from_cam) for frame, m in posed]
    first, *others = factorize_frames(recording, source)
    assert first is None
    for made, moment in zip(others, ordered[1:], strict=True):
        known = np.isfinite(moment.depth) & np.isfinite(moment.raw).all(0)
        np.testing.assert_array_equal(made.valid, known)
        error = np.abs(made.obj - moment.obj)[:, known]
        assert error.max() <= step_px + 2e-4
        if name != "tartanair":  # whose flow is the camera's alone
            assert np.abs(moment.obj).max() > 0.5


def test_virtual_kittis_second_camera_and_sky(tmp_path):
    synthetic.write_vkitti2(tmp_path)
    for kind in ("rgb", "depth"):
        (tmp_path / f"frames/{kind}/Camera_0").rename(tmp_path / f"frames/{kind}/Camera_1")
    path = tmp_path / "frames/depth/Camera_1/depth_00001.png"
    depth = np.full((HEIGHT, WIDTH), 1234, np.uint16)
    depth[2, 3] = 65535
    synthetic.put(path, depth)
    recording = open_recording(tmp_path, "vkitti2", camera=1)
    frame = recording[1]
    assert not recording.has_flow
    assert frame.depth[2, 3] == np.inf
    assert frame.depth[2, 4] == pytest.approx(12.34)
    # The right camera is half a metre to the right: x of the world in it is 0.5 less.
    right = synthetic.pose(1)[:3, 3] + 0.5 * synthetic.pose(1)[:3, 0]
    np.testing.assert_allclose(frame.world_from_cam[:3, 3], right, atol=1e-9)


# TUM's three clocks: what belongs together, and poses between those that were measured.


def write_times(folder, rgb_s, depth_s, poses):
    """Writes pictures at these times; the grey of one and the metres of the other count them."""
    for i, time in enumerate(rgb_s):
        synthetic.put(folder / f"rgb/{time:.3f}.png", np.full((4, 6, 3), i, np.uint8))
    for i, time in enumerate(depth_s):
        synthetic.put(folder / f"depth/{time:.3f}.png", np.full((4, 6), 5000 * (i + 1), np.uint16))
    synthetic.put(folder / "rgb.txt", [f"{time} rgb/{time:.3f}.png" for time in rgb_s])
    synthetic.put(folder / "depth.txt", [f"{time} depth/{time:.3f}.png" for time in depth_s])
    synthetic.put(folder / "groundtruth.txt", [f"{time} {pose}" for time, pose in poses])


def at(x):
    return f"{x} 0 0 0 0 0 1"


def matches(recording):
    return [
        (int(f.rgb[0, 0, 0]), float(f.depth[0, 0]), round(float(f.world_from_cam[0, 3]), 9))
        for f in recording
    ]


def test_each_picture_has_the_nearest_depth_and_pose_within_the_tolerance(tmp_path):
    poses = [(0.995, at(1)), (1.1, at(2)), (1.198, at(3)), (1.203, at(4))]
    write_times(tmp_path, [1.0, 1.1, 1.2], [1.01, 1.13, 1.19, 1.215], poses)
    recording = open_recording(tmp_path, "tum", interpolate=False)
    # 1.1 has no depth within 0.02 s (1.13); of 1.19 and 1.215 the first is nearer to 1.2.
    assert matches(recording) == [(0, 1.0, 1.0), (2, 3.0, 3.0)]
    assert [frame.timestamp_s for frame in recording] == [1.0, 1.2]
    (note,) = recording.notes
    assert note.startswith("1 of 3 frames")
    assert note.endswith("1.100")
    # A depth map belongs to one picture alone: 1.01 is 10 ms from one and 2 from the other.
    write_times(tmp_path, [1.0, 1.012], [1.01], [(1.0, at(1)), (1.012, at(2))])
    assert matches(open_recording(tmp_path, "tum")) == [(1, 1.0, 2.0)]


def test_a_pose_belongs_to_one_picture_alone(tmp_path):
    # With the first one's pose, the second picture would have no ego flow, and the third too much.
    times, poses = [1.0, 1.012, 1.03], [(1.001, at(1)), (1.03, at(3))]
    write_times(tmp_path, times, times, poses)
    recording = open_recording(tmp_path, "tum", interpolate=False)
    assert matches(recording) == [(0, 1.0, 1.0), (2, 3.0, 3.0)]
    assert recording.notes[0].endswith("1.012")
    between = open_recording(tmp_path, "tum")
    assert matches(between) == [(1, 2.0, round(1 + 2 * 11 / 29, 9)), (2, 3.0, 3.0)]


def test_a_pose_at_the_pictures_own_time_lies_between_its_neighbours(tmp_path):
    # A quarter of the way from x = 1 to x = 3, and of a right angle about y.
    turned = "3 0 0 0 0.7071067811865476 0 0.7071067811865476"
    write_times(tmp_path, [1.0025], [1.0], [(1.0, at(1)), (1.01, turned)])
    (frame,) = open_recording(tmp_path, "tum")
    np.testing.assert_allclose(frame.world_from_cam[:3, 3], [1.5, 0, 0], atol=1e-9)
    expected = cv2.Rodrigues(np.array([0.0, np.pi / 8, 0.0]))[0]
    np.testing.assert_allclose(frame.world_from_cam[:3, :3], expected, atol=1e-9)
    nearest = open_recording(tmp_path, "tum", interpolate=False)
    assert matches(nearest) == [(0, 1.0, 1.0)]


def test_poses_as_rare_as_pictures_are_theirs_up_to_a_rounded_time(tmp_path):
    # 30 a second; the last one is 0.7 ms off, too much for a rounded time.
    poses, times = [(1.0, at(1)), (1.0334, at(2)), (1.0667, at(3))], [1.0003, 1.033, 1.066]
    write_times(tmp_path, times, times, poses)
    assert matches(open_recording(tmp_path, "tum")) == [(0, 1.0, 1.0), (1, 2.0, 2.0)]


def test_poses_are_not_interpolated_across_a_gap_nor_beyond_the_ends(tmp_path):
    poses = [(1.0, at(1)), (1.5, at(2)), (1.51, at(3))]
    times = [0.99, 1.0, 1.2, 1.505]  # the second is a pose's own
    write_times(tmp_path, times, times, poses)
    recording = open_recording(tmp_path, "tum")
    assert matches(recording) == [(1, 2.0, 1.0), (3, 4.0, 2.5)]
