"""Formats that are declared: small recordings, written as each data set's documentation says."""

from __future__ import annotations

import json

import numpy as np
import pytest

pytest.importorskip("cv2", reason="recordings need OpenCV")

import cv2
import imageio.v3 as imageio

from flowrep.sequences import factorize_frames, open_recording, recorded_flow
from tests.sequences import synthetic
from tests.sequences.synthetic import HEIGHT, WIDTH, K, make_moments, numbers, put, quaternion_line

OPENCV_K = K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
F = np.diag([1.0, -1.0, 1.0, 1.0])


def write_tartanair_v2(folder):
    moments = make_moments(unit_m=1e-6, K=synthetic.TARTANAIR_K)
    for i, moment in enumerate(moments):
        put(folder / f"image_lcam_front/{i:06d}_lcam_front.png", moment.rgb)
        # The four bytes of a float, in the order in which OpenCV writes blue, green, red, alpha.
        coded = cv2.imencode(".png", moment.depth.view(np.uint8).reshape(HEIGHT, WIDTH, 4))[1]
        put(folder / f"depth_lcam_front/{i:06d}_lcam_front_depth.png", coded.tobytes())
    poses = [moment.world_from_cam @ synthetic.NED_FROM_OPENCV.T for moment in moments]
    put(folder / "pose_lcam_front.txt", map(quaternion_line, poses))
    return moments


def write_icl_nuim(folder):
    # Pictures begin with 0, poses with 1. Camera and world are left-handed, with y up.
    moments = make_moments(unit_m=1 / 5000)
    for i, moment in enumerate(moments, 9):
        put(folder / f"rgb/{i}.png", moment.rgb)
        put(folder / f"depth/{i}.png", synthetic.stored(moment.depth, 1 / 5000))
    lines = [f"{i} {quaternion_line(F @ m.world_from_cam @ F)}" for i, m in enumerate(moments, 9)]
    put(folder / "livingRoom2.gt.freiburg", lines[1:])
    return moments[1:]


def write_replica(folder):
    moments = make_moments(unit_m=1 / 6553.5)
    for i, moment in enumerate(moments):
        put(folder / f"results/frame{i:06d}.png", moment.rgb)
        put(folder / f"results/depth{i:06d}.png", synthetic.stored(moment.depth, 1 / 6553.5))
    put(folder / "traj.txt", [numbers(moment.world_from_cam) for moment in moments])
    return moments


def write_scannet(folder):
    moments = make_moments(unit_m=0.001)
    lost = np.full((4, 4), -np.inf)
    for i, moment in enumerate(moments):
        put(folder / f"color/{i}.png", moment.rgb)
        put(folder / f"depth/{i}.png", synthetic.stored(moment.depth, 0.001))
        put(folder / f"pose/{i}.txt", map(numbers, lost if i == 2 else moment.world_from_cam))
    camera = np.eye(4)
    camera[:3, :3] = OPENCV_K
    for kind in ("color", "depth"):
        put(folder / f"intrinsic/intrinsic_{kind}.txt", map(numbers, camera))
    return moments[:2]


def write_realsense(folder):
    moments = make_moments(unit_m=0.001)
    for kind in ("rgb", "depth", "groundtruth"):
        lines = []
        for i, moment in enumerate(moments):
            file = f"{kind}/{1.5 + i / 30:.6f}.png"
            if kind == "rgb":
                put(folder / file, moment.rgb)
            elif kind == "depth":
                put(folder / file, synthetic.stored(moment.depth, 0.001))
            entry = quaternion_line(moment.world_from_cam) if kind == "groundtruth" else file
            lines.append(f"{1.5 + i / 30:.6f} {entry}")
        put(folder / f"{kind}.txt", lines)
    return moments


KUBRIC_K = np.array([[30.0, 0.0, 20.0], [0.0, 30.0, 12.0], [0.0, 0.0, 1.0]])


def write_kubric(folder):
    moments = make_moments(unit_m=1e-6, K=KUBRIC_K)
    row, column = np.indices((HEIGHT, WIDTH)) + 0.5
    ray = np.sqrt(1 + ((column - 20) / 30) ** 2 + ((row - 12) / 30) ** 2)
    backward = [-moment.raw[::-1] for moment in moments]  # to the frame before, rows first
    least, most = float(np.min(backward)), float(np.max(backward))
    for i, moment in enumerate(moments):
        put(folder / f"rgba_{i:05d}.png", moment.rgb)
        tiff = cv2.imencode(".tiff", (moment.depth * ray).astype(np.float32))[1]
        put(folder / f"depth_{i:05d}.tiff", tiff.tobytes())
        coded = np.rint((backward[i] - least) * 65535 / (most - least)).astype(np.uint16)
        flow = np.stack([*coded, np.zeros_like(coded[0])], -1)
        put(folder / f"backward_flow_{i:05d}.png", flow)
    put(folder / "data_ranges.json", [json.dumps({"backward_flow": {"min": least, "max": most}})])
    camera = {"positions": [], "quaternions": []}
    camera["K"] = [[30 / WIDTH, 0, -0.5], [0, -30 / HEIGHT, -0.5], [0, 0, -1]]
    for moment in moments:
        blender = moment.world_from_cam @ np.diag([1.0, -1.0, -1.0, 1.0])
        *position, x, y, z, w = map(float, quaternion_line(blender).split())
        camera["positions"].append(position)
        camera["quaternions"].append([w, x, y, z])
    put(folder / "metadata.json", [json.dumps({"camera": camera})])
    return moments


FROM_K = [31.0, 27.0, 18.0, 12.5]  # K by OpenCV
FORMATS = {
    "tartanair_v2": (write_tartanair_v2, {}),
    "icl_nuim": (write_icl_nuim, {"poses": "livingRoom2.gt.freiburg", "intrinsics": FROM_K}),
    "replica": (write_replica, {"intrinsics": FROM_K}),
    "scannet": (write_scannet, {}),
    "realsense": (write_realsense, {"intrinsics": FROM_K}),
    "kubric": (write_kubric, {}),
}


@pytest.mark.parametrize("name", FORMATS)
def test_what_a_data_set_says_of_its_files_is_read(name, tmp_path):
    write, options = FORMATS[name]
    moments = write(tmp_path)
    recording = open_recording(tmp_path, name, **options)
    camera = {"tartanair_v2": synthetic.TARTANAIR_K, "kubric": KUBRIC_K}.get(name, K)
    assert len(recording) == len(moments)
    for frame, moment in zip(recording, moments):
        np.testing.assert_allclose(frame.K, camera, atol=1e-12)
        np.testing.assert_array_equal(frame.rgb, moment.rgb)
        np.testing.assert_allclose(frame.depth, moment.depth, rtol=1e-6)
    truth = iter(moments[1:])
    source = recorded_flow if recording.has_flow else lambda before, now: next(truth).raw
    _, *others = factorize_frames(recording, source)
    for made, moment in zip(others, moments[1:], strict=True):
        assert made.valid.all()
        # Kubric's flow is coded in 65,535 steps of its range, some 40 px.
        assert np.abs(made.obj - moment.obj).max() <= (2e-3 if name == "kubric" else 2e-4)


def test_what_is_lost_is_left_out_and_counted(tmp_path):
    write_scannet(tmp_path / "scannet")
    (note,) = open_recording(tmp_path / "scannet", "scannet").notes
    assert "1 of 3" in note
    write_icl_nuim(tmp_path / "icl")
    poses = {"poses": "livingRoom2.gt.freiburg"}
    recording = open_recording(tmp_path / "icl", "icl_nuim", **poses)
    assert [frame.name for frame in recording] == ["10", "11"]
    assert "1 of 3" in recording.notes[0]


def brute_force(depth, K, pose, K_before, pose_before):
    """Returns p_t - p_t' of a static world `[2, H, W]`, by points in the world."""
    row, column = np.indices(depth.shape) + 0.5
    pixels = np.stack([column, row, np.ones(depth.shape)]).reshape(3, -1)
    points = np.linalg.inv(K) @ pixels * depth.ravel().astype(np.float64)
    world = pose[:3, :3] @ points + pose[:3, 3:]
    seen = K_before @ (pose_before[:3, :3].T @ (world - pose_before[:3, 3:]))
    return (pixels[:2] - seen[:2] / seen[2]).reshape(2, *depth.shape)


def zoomed(factor):
    return np.diag([factor, factor, 1.0]) @ K


def write_stray_scanner(folder):
    """Pictures four times as large as depth, and an autofocus that changes K by 2 % a frame."""
    moments = make_moments(unit_m=0.001)
    large = [m.rgb.repeat(4, 0).repeat(4, 1) for m in moments]
    folder.mkdir()
    imageio.imwrite(folder / "rgb.mp4", np.stack(large), plugin="FFMPEG", fps=30, quality=10)
    header = "timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy, distortion_center_x"
    lines = [header]
    for i, moment in enumerate(moments):
        put(folder / f"depth/{i:06d}.png", synthetic.stored(moment.depth, 0.001))
        trust = np.full((HEIGHT, WIDTH), 2, np.uint8)
        trust[3, 4], trust[3, 5] = 0, 1
        put(folder / f"confidence/{i:06d}.png", trust)
        camera = 4 * zoomed(1.02**i)
        focus = [camera[0, 0], camera[1, 1], camera[0, 2], camera[1, 2]]
        pose = [float(x) for x in quaternion_line(moment.world_from_cam).split()]
        lines.append(", ".join(map(repr, [100 + i / 60, i, *pose, *map(float, focus)])) + ", ")
    put(folder / "odometry.csv", lines)
    put(
        folder / "camera_matrix.csv",
        [", ".join(map(str, row)) for row in np.diag([4.0, 4.0, 1.0]) @ K],
    )
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
        camera = 2 * zoomed(1.02**i)
        focus = [camera[0, 0], camera[1, 1], camera[0, 2], camera[1, 2]]
        metadata["perFrameIntrinsicCoeffs"].append(focus)
        metadata["frameTimestamps"].append(i / 60)
    put(folder / "metadata.json", [json.dumps(metadata)])
    return moments


@pytest.mark.parametrize("name", ["stray_scanner", "record3d"])
def test_an_iphones_recording_has_a_camera_for_each_frame(name, tmp_path):
    write = {"stray_scanner": write_stray_scanner, "record3d": write_record3d}[name]
    moments = write(tmp_path / "in")
    recording = open_recording(tmp_path / "in", name)
    assert len(recording) == len(moments)
    frames = list(recording)
    for i, (frame, moment) in enumerate(zip(frames, moments)):
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


def test_pictures_of_a_video_in_any_order(tmp_path):
    write_stray_scanner(tmp_path / "in")
    recording = open_recording(tmp_path / "in", "stray_scanner")
    forwards = [frame.rgb for frame in recording]
    for index in (2, 0, 1, 1):
        np.testing.assert_array_equal(recording[index].rgb, forwards[index])


def test_an_older_stray_recording_has_one_camera(tmp_path):
    write_stray_scanner(tmp_path / "in")
    one = {"intrinsics": "camera_matrix.csv", "intrinsics_columns": None}
    frame = open_recording(tmp_path / "in", "stray_scanner", **one)[2]
    np.testing.assert_allclose(frame.K, K)


def test_sintels_focal_length_may_grow(tmp_path):
    moments = synthetic.write_sintel(tmp_path)
    cameras = [np.diag([1.01**i, 1.01**i, 1.0]) @ K for i in range(len(moments))]
    for i, moment in enumerate(moments):
        path = tmp_path / f"camdata_left/cave/frame_{i + 1:04d}.cam"
        opencv = cameras[i] - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
        content = path.read_bytes()
        put(path, content[:4] + opencv.tobytes() + content[4 + 72 :])
        if i + 1 < len(moments):
            next_one = cameras[i + 1], moments[i + 1].world_from_cam
            flow = brute_force(moment.depth, cameras[i], moment.world_from_cam, *next_one)
            put(tmp_path / f"flow/cave/frame_{i + 1:04d}.flo", -flow.astype(np.float32))
    recording = open_recording(tmp_path, "sintel", scene="cave", backwards=True)
    for made in [*factorize_frames(recording, recorded_flow)][1:]:
        assert made.valid.all()
        assert np.abs(made.obj).max() < 1e-3  # with the current K alone it would be 0.2 px
