"""What a declaration may say: files of many kinds, matching, poses, lenses."""

import json

import cv2
import numpy as np
import pytest

from flowrep.sequences import SequenceError, factorize_frames, open_recording
from tests.sequences import synthetic
from tests.sequences.synthetic import HEIGHT, WIDTH, K, numbers, put, quaternion_line

FRAMES = ("0000", "0001", "0002")


def open_frames(folder, **options):
    return open_recording(folder, "frames", **options)


@pytest.fixture
def moments(tmp_path):
    return synthetic.write_frames(tmp_path)


# Files.


@pytest.mark.parametrize(
    ("suffix", "dtype", "unit_m"),
    [
        (".pgm", np.uint16, 0.001), (".tiff", np.uint16, 0.001), (".tiff", np.float32, 1.0),
        (".pfm", np.float32, 1.0), (".npy", np.uint16, 0.001), (".npy", np.int32, 0.001),
        (".npy", np.float64, 1.0),
    ],
)  # fmt: skip
def test_depth_in_files_of_many_kinds(suffix, dtype, unit_m, moments, tmp_path):
    stored = moments[1].depth / unit_m
    stored = (np.rint(stored) if unit_m < 1 else stored).astype(dtype)
    stored = stored[..., None] if suffix == ".npy" else stored  # an axis for one channel
    (tmp_path / "depth/0001.png").unlink()
    put(tmp_path / f"depth/0001{suffix}", stored)
    np.testing.assert_allclose(open_frames(tmp_path)[1].depth, moments[1].depth, rtol=1e-6)
    scaled = open_frames(tmp_path, depth_unit_m=2 * unit_m)[1].depth
    np.testing.assert_allclose(scaled, 2 * moments[1].depth, rtol=1e-6)


def test_of_an_exr_file_the_depth_is_read(moments, tmp_path):
    OpenEXR = pytest.importorskip("OpenEXR", reason="no OpenEXR")
    (tmp_path / "depth/0001.png").unlink()
    path = tmp_path / "depth/0001.exr"
    planes = dict.fromkeys(("View.Combined.A", "View.Combined.R"), 0 * moments[1].depth)
    for name in ("View.Depth.Z", "View.Depth.V", "depth"):
        OpenEXR.File({}, planes | {name: moments[1].depth}).write(str(path))
        np.testing.assert_array_equal(open_frames(tmp_path)[1].depth, moments[1].depth)
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(SequenceError, match=r"0001\.exr"):
        open_frames(tmp_path)[1]


@pytest.mark.parametrize("suffix", [".ppm", ".tiff", ".bmp", ".npy"])
def test_pictures_in_files_of_many_kinds(suffix, moments, tmp_path):
    (tmp_path / "rgb/0001.png").unlink()
    put(tmp_path / f"rgb/0001{suffix}", moments[1].rgb)
    np.testing.assert_array_equal(open_frames(tmp_path)[1].rgb, moments[1].rgb)


@pytest.mark.parametrize("suffix", [".npy", ".pfm"])
def test_flow_in_files_of_many_kinds(suffix, moments, tmp_path):
    u, v = moments[1].raw
    (tmp_path / "flow/0001.flo").unlink()
    put(tmp_path / f"flow/0001{suffix}", np.stack([u, v, 0 * u], -1))
    np.testing.assert_array_equal(open_frames(tmp_path)[1].raw, moments[1].raw)


def test_a_byte_order_mark_is_not_a_number_and_brackets_in_a_name_are_brackets(moments, tmp_path):
    (tmp_path / "poses.txt").rename(tmp_path / "poses [cam1].txt")
    for name in ("intrinsics.json", "poses [cam1].txt"):
        path = tmp_path / name
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    recording = open_frames(tmp_path, poses="poses [cam1].txt")
    assert (recording.has_poses, len(recording)) == (True, 3)


# What belongs together.


def test_files_named_by_their_times_are_matched_by_these(moments, tmp_path):
    # Pictures every 100 ms in nanoseconds; depth 4 ms later, of the second picture 60 ms later.
    poses = []
    for i, moment in enumerate(moments):
        rgb_ns = 10**9 + i * 10**8
        depth_ns, pose_ns = rgb_ns + (4, 60, 4)[i] * 10**6, rgb_ns + 7 * 10**6
        for kind, ns in (("rgb", rgb_ns), ("depth", depth_ns)):
            (tmp_path / f"{kind}/{i:04d}.png").rename(tmp_path / f"{kind}/{ns}.png")
        poses.append(f"{pose_ns} {quaternion_line(moment.world_from_cam)}")
    put(tmp_path / "poses.txt", poses)
    options = {"depth_by": "time", "rows_by": "time", "time_unit_s": 1e-9, "flow": None}
    options |= {"pose_layout": "xyz_xyzw", "times": None}
    recording = open_frames(tmp_path, **options)
    assert [frame.timestamp_s for frame in recording] == pytest.approx([1.0, 1.2])
    assert "1100000000" in recording.notes[0]
    for frame, moment in zip(recording, (moments[0], moments[2])):
        np.testing.assert_allclose(frame.depth, moment.depth, rtol=1e-6)
        np.testing.assert_allclose(frame.world_from_cam, moment.world_from_cam, atol=1e-9)
    # 7 ms are too many; with an offset they are 1 ms.
    with pytest.raises(SequenceError, match="tolerance_s"):
        open_frames(tmp_path, **options, tolerance_s=0.005)
    assert len(open_frames(tmp_path, **options, tolerance_s=0.005, pose_offset_s=-0.006)) == 2


def test_depth_of_other_names_is_matched_by_its_order(moments, tmp_path):
    for i, name in enumerate(FRAMES):
        (tmp_path / f"depth/{name}.png").rename(tmp_path / f"depth/d{i}.png")
    with pytest.raises(SequenceError, match="frame 0000"):
        open_frames(tmp_path)
    frame = open_frames(tmp_path, depth_by="order")[2]
    np.testing.assert_allclose(frame.depth, moments[2].depth, rtol=1e-6)
    (tmp_path / "depth/d0.png").unlink()
    with pytest.raises(SequenceError, match="frame 2"):
        open_frames(tmp_path, depth_by="order")


@pytest.mark.parametrize("by", ["time", "name"])
def test_poses_by_the_times_of_a_table_or_by_names_that_come_first(by, moments, tmp_path):
    # Times in timestamps.txt are 0, 0.1 and 0.2 s, whatever the pictures' names are.
    keys = [f"{name}.png" for name in FRAMES] if by == "name" else [0.0, 0.101, 0.199]
    poses = [f"{k} {numbers(m.world_from_cam)}" for k, m in zip(keys, moments)]
    put(tmp_path / "poses.txt", poses[::-1] if by == "name" else poses)
    times = None if by == "name" else "timestamps.txt"
    recording = open_frames(tmp_path, rows_by=by, times=times)
    rows = [{"key": str(k), "pose": m.world_from_cam.tolist()} for k, m in zip(keys, moments)]
    put(tmp_path / "p.json", [json.dumps({"rows": rows})])  # with times as text
    options = {"poses": "p.json:rows.*.pose", "key": "p.json:rows.*.key"}
    for each in (recording, open_frames(tmp_path, rows_by=by, times=times, **options)):
        for frame, moment in zip(each, moments, strict=True):
            np.testing.assert_allclose(frame.world_from_cam, moment.world_from_cam)


def test_frames_may_be_left_out_by_name(moments, tmp_path):
    recording = open_frames(tmp_path, leave_out=["0001"])
    assert [frame.name for frame in recording] == ["0000", "0002"]
    assert "0001" in recording.notes[0]
    # Flow of its own is that since frame 1, so that no pair is left.
    assert [*factorize_frames(recording, lambda a, b: b.raw)] == [None, None]
    assert [frame.position for frame in recording] == [0, 2]
    with pytest.raises(SequenceError, match=r"leave_out.*0009"):
        open_frames(tmp_path, leave_out=["0009"])


# Poses.

LOST = {"-inf": " ".join(["-inf"] * 16), "nan": " ".join(["nan"] * 12), "0": "0 " * 15 + "1"}


@pytest.mark.parametrize("lost", LOST)
def test_a_lost_pose_is_left_out_and_counted(lost, moments, tmp_path):
    width = len(LOST[lost].split())
    lines = [numbers(m.world_from_cam.ravel()[:width]) for m in moments]
    put(tmp_path / "poses.txt", [lines[0], LOST[lost], lines[2]])
    recording = open_frames(tmp_path)
    assert [frame.name for frame in recording] == ["0000", "0002"]
    (note,) = recording.notes
    assert note.startswith("1 of 3")
    assert "poses.txt" in note
    np.testing.assert_allclose(recording[1].world_from_cam, moments[2].world_from_cam)
    # The row of one that is wrong is named as before.
    put(tmp_path / "poses.txt", [LOST[lost], lines[1], numbers(2 * np.eye(4)[: width // 4])])
    with pytest.raises(SequenceError, match=r"poses\.txt.*\[2\]"):
        open_frames(tmp_path)


@pytest.mark.parametrize("count", [7, 12, 16])
def test_poses_of_a_marker_and_poses_that_lag(count, moments, tmp_path):
    marker_from_cam = synthetic.rigid((0.1, -0.2, 0.3), (0.05, 0.12, -0.02)).numpy()
    poses = [m.world_from_cam @ np.linalg.inv(marker_from_cam) for m in moments]
    # The pose of frame i is in row i + 1.
    put(tmp_path / "poses.txt", map(numbers, [np.eye(4), *poses[:2]]))
    given = quaternion_line(marker_from_cam).split() if count == 7 else marker_from_cam.ravel()
    given = [float(x) for x in given][:count]
    recording = open_frames(tmp_path, marker_from_cam=given, pose_lag_frames=1)
    assert [frame.name for frame in recording] == ["0000", "0001"]  # the last has no row
    for frame, moment in zip(recording, moments):
        np.testing.assert_allclose(frame.world_from_cam, moment.world_from_cam, atol=1e-9)


# Cameras.


def test_intrinsics_in_files_and_lists(moments, tmp_path):
    put(tmp_path / "K.txt", map(numbers, K))
    for name in FRAMES:
        put(tmp_path / f"K/{name}.txt", [numbers([31.0, 27.0, 18.5, 13.0])])
    for given in ("K.txt", "K/*.txt", [31.0, 27.0, 18.5, 13.0], [*K.ravel()]):
        assert open_frames(tmp_path, intrinsics=given)[1].K.tolist() == K.tolist()
    # A focal length of 0.75 picture widths, of which there are 40.
    expected = [[30, 0, 20], [0, 30, 12], [0, 0, 1]]
    assert open_frames(tmp_path, intrinsics=[0.75])[1].K.tolist() == expected


def test_rays_are_those_of_depths_camera(moments, tmp_path):
    # Of the same place, but with half the focal length: pixel (12, 20) sees along the axis of both,
    # (12, 30) of the pictures sees x = 10 / 30 where depth's camera has its column 25, x = 5 / 15.
    for name in FRAMES:
        (tmp_path / f"depth/{name}.png").unlink()
        put(tmp_path / f"depth/{name}.npy", np.full((HEIGHT, WIDTH), 2.0, np.float32))
    cameras = {"intrinsics": [30.0, 30.0, 20.5, 12.5], "depth_intrinsics": [15.0, 15.0, 20.5, 12.5]}
    depth = open_frames(tmp_path, **cameras, depth_kind="ray_length")[0].depth
    assert depth[12, 20] == pytest.approx(2.0)
    assert depth[12, 30] == pytest.approx(2.0 / np.hypot(1, 1 / 3), rel=1e-6)
    # Beside a file, which says it for its own numbers, the option is that of depth's camera.
    put(tmp_path / "intrinsics.json", synthetic.camera_json(fx=30.0, fy=30.0, cx=20.5, cy=12.5))
    opencv = {"depth_intrinsics": [15.0, 15.0, 20.0, 12.0], "first_pixel_centre": 0.0}
    same = open_frames(tmp_path, **opencv, depth_kind="ray_length")[0].depth
    np.testing.assert_array_equal(same, depth)


def test_a_disparity_of_0_is_no_surface_unless_it_means_missing(moments, tmp_path):
    put(tmp_path / "depth/0001.png", np.tile(np.uint16([[0, 31]]), (HEIGHT, WIDTH // 2)))
    options = {"depth_kind": "disparity", "baseline_m": 0.25, "depth_unit_m": 1 / 256}
    depth = open_frames(tmp_path, **options, depth_missing=[])[1].depth
    assert depth[0, :2].tolist() == [np.inf, 64.0]  # fx = 31 px: 31 * 0.25 / (31 / 256)
    assert np.isnan(open_frames(tmp_path, **options)[1].depth[0, 0])


def test_depth_of_little_confidence_is_missing(moments, tmp_path):
    for name in FRAMES:
        trust = np.full((HEIGHT, WIDTH), 2, np.uint8)
        trust[3, 4], trust[5, 6] = 0, 1
        put(tmp_path / f"trust/{name}.png", trust)
    for least, missing in ((1, [[3, 4]]), (2, [[3, 4], [5, 6]])):
        depth = open_frames(tmp_path, confidence="trust/*", min_confidence=least)[1].depth
        assert np.argwhere(np.isnan(depth)).tolist() == missing
    put(tmp_path / "trust/0001.png", np.zeros((3, 4), np.uint8))
    with pytest.raises(SequenceError, match=r"trust/0001\.png"):
        open_frames(tmp_path, confidence="trust/*")[1]


# Lenses.
RADIAL = [0.18, 0.07, 0.002, -0.003, 0.01]  # k1, k2, p1, p2, k3
FISHEYE = [0.08, -0.03, 0.01, -0.002]


@pytest.mark.parametrize("lens", ["opencv", "fisheye"])
@pytest.mark.parametrize("place", ["options", "intrinsics.json"])
def test_a_lens_is_taken_out_of_pictures_and_depth(lens, place, tmp_path):
    # A stored pixel's values say where it is, so that a rectified one says where the lens put it.
    row, column = np.indices((90, 120))
    for name in ("0", "1"):
        put(tmp_path / f"rgb/{name}.png", np.stack([2 * column, 2 * row, row], -1).astype(np.uint8))
        put(tmp_path / f"depth/{name}.npy", (1.0 + column).astype(np.float32))
    coefficients = FISHEYE if lens == "fisheye" else RADIAL
    options = {"intrinsics": [95.0, 90.0, 62.5, 44.0], "distortion": coefficients, "lens": lens}
    if place == "intrinsics.json":
        camera = {"width": 120, "height": 90, "fx": 95, "fy": 90, "cx": 62, "cy": 43.5}
        camera |= {"first_pixel_centre": 0, "distortion": coefficients, "lens": lens}
        put(tmp_path / "intrinsics.json", [json.dumps(camera)])
        options = {}
    recording = open_frames(tmp_path, **options)
    frame = recording[1]
    assert any("undistorted" in note for note in recording.notes)
    opencv = np.array([[95, 0, 62], [0, 90, 43.5], [0, 0, 1]])  # pixel centres are whole numbers
    np.testing.assert_allclose(frame.K, [[95, 0, 62.5], [0, 90, 44], [0, 0, 1]])
    rays = np.stack([(column - 62) / 95, (row - 43.5) / 90, np.ones((90, 120))], -1)
    project = cv2.fisheye.projectPoints if lens == "fisheye" else cv2.projectPoints
    camera = np.zeros(3), np.zeros(3), opencv, np.array(coefficients)
    u, v = project(rays.reshape(-1, 1, 3), *camera)[0].reshape(90, 120, 2).transpose(2, 0, 1)
    inside = (u >= 0) & (u <= 119) & (v >= 0) & (v <= 89)
    assert inside.mean() > 0.8
    # Colour is interpolated; with pixel centres half a pixel off it would be 1 off. Depth is not.
    np.testing.assert_allclose(
        frame.rgb[inside][:, :2].T, 2 * np.stack([u, v])[:, inside], atol=0.7
    )
    assert np.abs(frame.depth - 1 - u)[inside].max() < 0.55
    assert (frame.depth[inside] % 1 == 0).all()
    outside = (u < -1) | (u > 120) | (v < -1) | (v > 90)
    assert outside.any() == (lens == "opencv")
    assert np.isnan(frame.depth[outside]).all()
    # Depth of a camera of its own has no lens, but there it would meet the picture's black.
    registered = open_frames(tmp_path, **options, depth_intrinsics=[95.0, 90.0, 62.5, 44.0])[1]
    assert np.isnan(registered.depth[outside]).all()
    np.testing.assert_array_equal(registered.depth[inside], 1.0 + column[inside])


def test_a_ray_s_length_is_that_of_the_pixel_without_the_lens(tmp_path):
    row, column = np.indices((90, 120), dtype=np.float64)
    opencv, pixels = np.array([[95, 0, 62], [0, 90, 43.5], [0, 0, 1]]), np.stack([column, row], -1)
    rays = cv2.undistortPoints(pixels.reshape(-1, 1, 2), opencv, np.array(RADIAL))
    wall = 2.0 * np.sqrt(1 + np.square(rays).sum(-1)).reshape(90, 120)  # 2 m ahead
    put(tmp_path / "depth/0.npy", wall.astype(np.float32))
    options = {"rgb": None, "intrinsics": [95.0, 90.0, 62.5, 44.0], "depth_kind": "ray_length"}
    depth = open_frames(tmp_path, **options, distortion=RADIAL)[0].depth
    # Of the nearest pixel; by K's rays, the bent corners would be 3 cm off.
    assert np.nanmax(np.abs(depth - 2)) < 0.012


def test_flow_of_distorted_pictures_is_not_used(moments, tmp_path):
    recording = open_frames(tmp_path, distortion=RADIAL)
    assert not recording.has_flow
    assert "distorted" in recording.no_flow


# Files and options that aren't what they should be.


def test_frames_are_in_the_order_of_numbers_and_of_times(tmp_path):
    def opened(*names):
        folder = tmp_path / names[-1]
        for name in names:
            put(folder / f"rgb/{name}.png", np.zeros((4, 6, 3), np.uint8))
            put(folder / f"depth/{name}.png", np.full((4, 6), 1000, np.uint16))
        put(folder / "depth/._old.png", np.zeros((4, 6), np.uint16))  # as macOS writes
        (folder / "depth/old.png").mkdir()
        return [frame.name for frame in open_frames(folder, intrinsics=[1.0])]

    decimal = ("0.05", "0.1", "0.15", "0.2", "10.0")
    assert opened(*decimal) == [*decimal]
    assert opened("f9", "f10", "f٣") == ["f9", "f10", "f٣"]  # an Arabic digit, which is a letter
    long = ("1403636579763555583", "1403636579763555584")  # equal as floats
    assert opened(*long) == [*long]


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({"flow_direction": "Forward"}, "flow_direction"),
        ({"depth_inf": "Missing"}, "depth_inf"),
        ({"backwards": "false"}, "backwards"),
        ({"depth_unit_m": "0.001"}, "depth_unit_m"),
        ({"depth_unit_m": -0.001}, "depth_unit_m"),
        ({"flow_unit_px": 0.0}, "flow_unit_px"),
        ({"camera": "right"}, r"format\.camera"),
        ({"flow_range": [1.0]}, "flow_range"),
        ({"intrinsics_kind": "cam_from_uv", "intrinsics": [0.5]}, "intrinsics: .*cam_from_uv"),
        ({"poses": ["depth/*", "poses.txt"]}, r"depth/\*: is a file per frame"),
        ({"depth_intrinsics": [0.0, 0.0, 18.5, 13.0]}, r"format\.depth_intrinsics"),
        ({"poses": "no.txt"}, r"format\.poses: there is no file .*no\.txt"),
        ({"times": "no.txt"}, r"format\.times: there is no file .*no\.txt"),
        ({"flow": "no.flo"}, r"format\.flow: there is no file .*no\.flo"),
        ({"flow_mask": "no.png"}, r"format\.flow_mask: there is no file .*no\.png"),
        ({"rows_by": "number", "key": 99}, r"timestamps\.txt.* 99"),
        ({"rows_by": "name", "poses": "intrinsics.json:fx", "times": None}, "no column of names"),
        ({"rows_where": [99, 0]}, r"format\.rows_where.*timestamps\.txt.* 99"),
        ({"rows_where": ["first", 0]}, r"format\.rows_where"),
        ({"rows_where": [0]}, r"format\.rows_where"),
        ({"dept": "d/*"}, r"format\.dept"),
        ({"marker_from_cam": [0.1, 0.2]}, "marker_from_cam: has 2 numbers"),
        ({"colour_from_depth": [1.0, 2.0]}, "colour_from_depth: has 2 numbers"),
        ({"colour_from_depth": [0.1, 0.0, 0.0]}, "colour_from_depth: .*depth_intrinsics"),
        ({"intrinsics": [31.0, 27.0]}, "fx, fy, cx, cy"),
        ({"distortion": RADIAL, "lens": "fisheye"}, r"distortion.*fisheye"),
        ({"depth_kind": "disparity", "depth_unit_m": 1.0}, "baseline_m"),
        ({"depth_kind": "disparity", "baseline_m": 0.25}, "depth_unit_m"),  # not thousandths of px
    ],
)
def test_options_are_checked(given, named, moments, tmp_path):
    with pytest.raises((SequenceError, ValueError), match=named):
        open_frames(tmp_path, **given)[1]


def test_an_unknown_format_is_told_which_there_are(tmp_path):
    with pytest.raises(SequenceError, match=r"format=tun: is unknown; there are: tum, .*zed"):
        open_recording(tmp_path, "tun")


@pytest.mark.parametrize("key", ["1", "nan", "inf"])
def test_a_table_has_one_row_for_a_frame_s_number(key, moments, tmp_path):
    poses = [f"{i} {numbers(m.world_from_cam)}" for i, m in enumerate(moments)]
    put(tmp_path / "poses.txt", poses)
    keyed = {"rows_by": "number", "times": None}
    assert len(open_frames(tmp_path, **keyed)) == 3
    put(tmp_path / "poses.txt", [*poses, f"{key} {numbers(np.eye(4))}"])
    with pytest.raises(SequenceError, match=r"poses\.txt: has two rows"):
        open_frames(tmp_path, **keyed)


def test_a_row_is_not_that_of_several_frames(moments, tmp_path):
    put(tmp_path / "poses.txt", [f"{i} {numbers(m.world_from_cam)}" for i, m in enumerate(moments)])
    for kind in ("rgb", "depth"):
        for name in FRAMES:
            (tmp_path / f"{kind}/{name}.png").rename(tmp_path / f"{kind}/{name}_cam1.png")
    keyed = {"rows_by": "number", "times": None, "flow": None}
    with pytest.raises(SequenceError, match=r"poses\.txt.*0000_cam1.*format\.rgb"):
        open_frames(tmp_path, **keyed)
    recording = open_frames(tmp_path, **keyed, rgb="rgb/*_cam1", depth="depth/*_cam1")
    np.testing.assert_array_equal(recording[2].world_from_cam, moments[2].world_from_cam)


def test_pictures_are_shrunk_to_the_size_of_depth_with_their_camera(moments, tmp_path):
    for i, moment in enumerate(moments):
        put(tmp_path / f"rgb/{i:04d}.png", moment.rgb.repeat(3, 0).repeat(2, 1))
    large = [2 * 31.0, 3 * 27.0, 2 * 18.5, 3 * 13.0]
    with pytest.raises(SequenceError, match="differ in size"):
        open_frames(tmp_path, intrinsics=large)[0]
    frame = open_frames(tmp_path, intrinsics=large, resize_rgb=True)[0]
    np.testing.assert_array_equal(frame.rgb, moments[0].rgb)
    np.testing.assert_allclose(frame.K, K)
    # K of a file is of depth or of the pictures, as its size says.
    np.testing.assert_allclose(open_frames(tmp_path, resize_rgb=True)[0].K, K)
    size = {"width": 2 * WIDTH, "height": 3 * HEIGHT}
    put(tmp_path / "intrinsics.json", synthetic.camera_json(**size))
    shrunk = np.diag([1 / 2, 1 / 3, 1]) @ K
    np.testing.assert_allclose(open_frames(tmp_path, resize_rgb=True)[0].K, shrunk)
    registered = open_frames(tmp_path, depth_intrinsics=[31.0, 27.0, 18.5, 13.0])[0]
    assert registered.depth.shape == (3 * HEIGHT, 2 * WIDTH)


# Gaps.


def test_times_do_not_hide_that_a_frame_is_missing(tmp_path):
    synthetic.write_frames(tmp_path)
    for number in range(3, 7):
        for file in ("rgb/*.png", "depth/*.png", "flow/*.flo"):
            source = tmp_path / file.replace("*", "0002")
            (tmp_path / file.replace("*", f"{number:04d}")).write_bytes(source.read_bytes())
    options = {"poses": None, "intrinsics": [0.5]}

    def since(times):
        put(tmp_path / "timestamps.txt", map(str, times))
        return [frame.raw_since for frame in open_frames(tmp_path, **options)]

    whole = [None, *(f"{i:04d}" for i in range(6))]
    assert since([0, 0.1, 0.2, 0.5, 0.6, 0.7, 0.8]) == whole  # a pause of the camera
    for file in ("rgb/0003.png", "depth/0003.png", "flow/0003.flo"):
        (tmp_path / file).unlink()
    lost = [None, "0000", "0001", None, "0004", "0005"]
    assert since([0, 0.1, 0.2, 0.4, 0.5, 0.5]) == lost
    assert since([0, 0.1, 0.2, 0.3, 0.4, 0.5]) == lost


@pytest.mark.parametrize("timed", [False, True])
def test_a_frame_knows_its_place_in_a_recording_with_gaps(timed, tmp_path):
    places = [0, 1, 2, 4, 5, 8]
    for place in places:
        name = f"{10 * place:04d}_left.png"
        put(tmp_path / f"rgb/{name}", np.zeros((4, 6, 3), np.uint8))
        put(tmp_path / f"depth/{name}", np.full((4, 6), 1000, np.uint16))
    if timed:  # 30 a second, with a jitter of 3 ms
        put(tmp_path / "timestamps.txt", [f"{p / 30 + 0.003 * (p % 2)}" for p in places])
    recording = open_frames(tmp_path, intrinsics=[1.0])
    assert [frame.position for frame in recording] == places
