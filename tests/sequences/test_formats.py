"""Recordings whose camera changes from frame to frame."""

import json

import imageio.v3 as imageio
import numpy as np
import pytest

from flowrep.sequences import factorize_frames, open_recording
from tests.sequences import synthetic, test_tools
from tests.sequences.synthetic import HEIGHT, WIDTH, K, make_moments, put, quaternion_line


def brute_force(depth, K, pose, K_before, pose_before):
    """Returns p_t - p_t' of a static world `[2, H, W]`, by points in the world."""
    row, column = np.indices(depth.shape) + 0.5
    pixels = np.stack([column, row, np.ones(depth.shape)]).reshape(3, -1)
    points = np.linalg.inv(K) @ pixels * depth.ravel().astype(np.float64)
    world = pose[:3, :3] @ points + pose[:3, 3:]
    seen = K_before @ (pose_before[:3, :3].T @ (world - pose_before[:3, 3:]))
    return (pixels[:2] - seen[:2] / seen[2]).reshape(2, *depth.shape)


def camera(i, scale):
    """fx, fy, cx, cy of an autofocus that changes by 2 % a frame, for pictures this much larger."""
    K_i = scale * np.diag([1.02**i, 1.02**i, 1.0]) @ K
    return [float(K_i[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2))]


def write_stray_scanner(folder):
    """Pictures four times as large as depth."""
    moments = make_moments(unit_m=0.001)
    large = [m.rgb.repeat(4, 0).repeat(4, 1) for m in moments]
    folder.mkdir()
    imageio.imwrite(folder / "rgb.mp4", np.stack(large), plugin="FFMPEG", fps=30, quality=10)
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy, distortion_center_x"]
    for i, moment in enumerate(moments):
        put(folder / f"depth/{i:06d}.png", synthetic.stored(moment.depth, 0.001))
        trust = np.full((HEIGHT, WIDTH), 2, np.uint8)
        trust[3, 4], trust[3, 5] = 0, 1
        put(folder / f"confidence/{i:06d}.png", trust)
        pose = quaternion_line(moment.world_from_cam).split()
        lines.append(", ".join(map(str, [100 + i / 60, i, *pose, *camera(i, 4)])) + ", ")
    put(folder / "odometry.csv", lines)
    rows = np.diag([4.0, 4.0, 1.0]) @ K
    put(folder / "camera_matrix.csv", [", ".join(map(str, row)) for row in rows])
    return moments


def write_record3d(folder):
    OpenEXR = pytest.importorskip("OpenEXR", reason="no OpenEXR")
    moments = make_moments(unit_m=1e-6)
    metadata = {"poses": [], "perFrameIntrinsicCoeffs": [], "frameTimestamps": []}
    (folder / "depth").mkdir(parents=True)
    for i, moment in enumerate(moments):
        put(folder / f"rgb/{i}.png", moment.rgb.repeat(2, 0).repeat(2, 1))
        OpenEXR.File({}, {"R": moment.depth}).write(str(folder / f"depth/{i}.exr"))
        opengl = moment.world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0])
        *position, x, y, z, w = map(float, quaternion_line(opengl).split())
        metadata["poses"].append([x, y, z, w, *position])
        metadata["perFrameIntrinsicCoeffs"].append(camera(i, 2))
        metadata["frameTimestamps"].append(i / 60)
    put(folder / "metadata.json", [json.dumps(metadata)])
    return moments


@pytest.mark.parametrize("name", ["stray_scanner", "record3d"])
def test_an_iphones_recording_has_a_camera_for_each_frame(name, tmp_path):
    write = {"stray_scanner": write_stray_scanner, "record3d": write_record3d}[name]
    moments = write(tmp_path / "in")
    recording = open_recording(tmp_path / "in", name)
    for i, (frame, moment) in enumerate(zip(recording, moments, strict=True)):
        np.testing.assert_allclose(frame.K, np.diag([1.02**i, 1.02**i, 1]) @ K, rtol=1e-9)
        np.testing.assert_allclose(frame.world_from_cam, moment.world_from_cam, atol=1e-9)
        assert frame.timestamp_s == pytest.approx((100 if name == "stray_scanner" else 0) + i / 60)
        trusted = np.ones((HEIGHT, WIDTH), bool)
        trusted[3, 4] = name != "stray_scanner"  # its confidence is 0
        np.testing.assert_array_equal(np.isfinite(frame.depth), trusted)
        np.testing.assert_allclose(frame.depth[trusted], moment.depth[trusted], rtol=1e-6)
        # A video loses colour.
        lossy = np.abs(frame.rgb.astype(float) - moment.rgb).mean()
        assert lossy < 20 if name == "stray_scanner" else lossy == 0

    def raw(before, now):
        cameras = now.K, now.world_from_cam, before.K, before.world_from_cam
        return brute_force(now.depth, *cameras).astype(np.float32)

    for made in [*factorize_frames(recording, raw)][1:]:
        assert np.abs(made.obj).max() < 1e-3  # with the current K alone it would be 0.4 px


def test_frames_of_nerf_may_have_a_camera_each(tmp_path):
    test_tools.write_nerf(tmp_path)
    given = json.loads((tmp_path / "transforms.json").read_text())
    last, middle, _ = given["frames"]  # in that order
    last["camera_angle_x"] = 2 * np.arctan(WIDTH / 2 / 50)  # fx and fy of 50 px
    middle |= dict(zip(("fl_x", "fl_y", "cx", "cy"), camera(1, 1)))
    put(tmp_path / "transforms.json", [json.dumps(given)])
    expected = K, np.diag([1.02, 1.02, 1]) @ K, [[50, 0, 18.5], [0, 50, 13], [0, 0, 1]]
    frames = open_recording(tmp_path, "nerf")
    np.testing.assert_allclose([frame.K for frame in frames], expected)


def test_a_video_s_picture_is_that_of_the_frame_s_number_in_any_order(tmp_path):
    write_stray_scanner(tmp_path / "in")
    recording = open_recording(tmp_path / "in", "stray_scanner")
    whole = [frame.rgb for frame in recording]
    for index in (2, 0, 1, 1):
        np.testing.assert_array_equal(recording[index].rgb, whole[index])
    older = {"intrinsics": "camera_matrix.csv", "intrinsics_columns": None}  # one for all frames
    np.testing.assert_allclose(open_recording(recording.folder, "stray_scanner", **older)[2].K, K)
    for kind in ("depth", "confidence"):
        (tmp_path / f"in/{kind}/000001.png").unlink()
    recording = open_recording(tmp_path / "in", "stray_scanner")
    assert [frame.name for frame in recording] == ["000000", "000002"]
    np.testing.assert_array_equal(recording[1].rgb, whole[2])
    # Without numbers nothing says whose pictures they are, and the second would be frame 2's.
    plain = {"rgb": "rgb.mp4", "intrinsics": [0.5], "resize_rgb": True}
    (note,) = open_recording(tmp_path / "in", "frames", **plain).notes
    assert "rgb.mp4 has 3 pictures for 2" in note
