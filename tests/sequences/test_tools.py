"""Poses and calibrations as other tools write them, by their documentation."""

import json
from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowrep.sequences import SequenceError, open_recording
from tests.sequences import synthetic
from tests.sequences.synthetic import HEIGHT, OPENCV_K, WIDTH, K, numbers, pictures, put

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
NERF = {"fl_x": 31, "fl_y": 27, "cx": 18.5, "cy": 13, "w": WIDTH, "h": HEIGHT}


def inverse(moment):
    """Rotation and position of the world in the camera."""
    pose = np.linalg.inv(moment.world_from_cam)
    return Rotation.from_matrix(pose[:3, :3]), pose[:3, 3]


@pictures("images/{:04d}", "depth/{:04d}", 0.001)
def write_colmap(folder, moments):
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME", "#   POINTS2D[]"]
    for i in (2, 0, 1):  # unordered
        rotation, position = inverse(moments[i])
        x, y, z, w = rotation.as_quat()
        images += [f"{i + 5} {numbers([w, x, y, z, *position])} 1 {i:04d}.png"]
        images += ["" if i == 0 else "1.5 2.5 -1 " * 6]  # a line of points, which may be empty
    put(folder / "sparse/images.txt", images)
    camera = f"1 PINHOLE {WIDTH} {HEIGHT} 31 27 18.5 13"
    put(folder / "sparse/cameras.txt", ["# CAMERA_ID, MODEL", camera])


@pictures("images/{:04d}", "depths/{:04d}", 0.001)
def write_nerf(folder, moments):
    poses = [(moment.world_from_cam @ OPENGL).tolist() for moment in moments]
    files = [{"file_path": f"./images/{i:04d}.png"} for i in range(len(moments))]
    frames = [file | {"transform_matrix": pose} for file, pose in zip(files, poses)]
    put(folder / "transforms.json", [json.dumps(NERF | {"k1": 0.0, "frames": frames[::-1]})])


@pictures("rgb/{:06d}", "depth/{:06d}", 0.001)
def write_bop(folder, moments):
    scene = {}
    for i, moment in enumerate(moments):
        rotation, position = inverse(moment)
        camera = {"cam_K": OPENCV_K.ravel().tolist(), "depth_scale": 1.0}
        camera["cam_R_w2c"] = rotation.as_matrix().ravel().tolist()
        scene[str(i)] = camera | {"cam_t_w2c": (1000 * position).tolist()}
    put(folder / "scene_camera.json", [json.dumps(scene)])


TIMES = [f"{100 + i / 60:.3f}" for i in range(synthetic.FRAMES)]


@pictures("lowres_wide/7_{}", "lowres_depth/7_{}", 0.001, TIMES)
def write_arkitscenes(folder, moments):
    lines = []
    for time, moment in zip(TIMES, moments):
        rotation, position = inverse(moment)
        lines.append(f"{time} {numbers([*rotation.as_rotvec(), *position])}")
        pincam = f"{WIDTH} {HEIGHT} 31 27 18.5 13"
        put(folder / f"lowres_wide_intrinsics/7_{time}.pincam", [pincam])
    put(folder / "lowres_wide.traj", lines)


def write_hdf5(folder, key, suffix, arrays):
    h5py = pytest.importorskip("h5py", reason="pip install 'flowrep-rl[hdf5]'")
    for name, array in arrays.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        with h5py.File(folder / f"{name}{suffix}", "w") as file:
            file[key] = np.float32(array) if array.shape[:2] == (HEIGHT, WIDTH) else array


def write_hypersim(folder):
    """Frames 1 to 3 of a camera whose frame 0 was left out; asset units are inches."""
    row, column = np.indices((HEIGHT, WIDTH)) + 0.5
    ray = np.sqrt(1 + ((column - 18.5) / 31) ** 2 + ((row - 13) / 27) ** 2)
    moments = synthetic.make_moments(unit_m=1e-6)
    poses = np.stack([np.eye(4), *(moment.world_from_cam @ OPENGL for moment in moments)])
    arrays = {"_detail/cam_00/camera_keyframe_orientations": poses[:, :3, :3]}
    arrays["_detail/cam_00/camera_keyframe_positions"] = poses[:, :3, 3] / 0.0254
    for i, moment in enumerate(moments, 1):
        arrays[f"images/scene_cam_00_geometry_hdf5/frame.{i:04d}.depth_meters"] = moment.depth * ray
        grey = np.full((HEIGHT, WIDTH, 3), 50 * i, np.uint8)  # which JPEG keeps
        moments[i - 1] = replace(moment, rgb=grey)
        picture = cv2.imencode(".jpg", grey)[1].tobytes()
        put(folder / f"images/scene_cam_00_final_preview/frame.{i:04d}.tonemap.jpg", picture)
    write_hdf5(folder, "dataset", ".hdf5", arrays)
    return moments


def write_spring(folder):
    """Maps have four times the pictures' pixels, and values in pixels of the pictures."""
    moments = synthetic.make_moments(unit_m=1e-6)
    for i, moment in enumerate(moments, 1):
        small = moment.rgb[::2, ::2]
        moments[i - 1] = replace(moment, rgb=small.repeat(2, 0).repeat(2, 1))
        put(folder / f"frame_left/frame_left_{i:04d}.png", small)
        write_hdf5(folder, "disparity", ".dsp5",
                   {f"disp1_left/disp1_left_{i:04d}": 15.5 * 0.065 / moment.depth})  # fmt: skip
        if i > 1:
            flow = -moment.raw.transpose(1, 2, 0) / 2
            write_hdf5(folder, "flow", ".flo5", {f"flow_BW_left/flow_BW_left_{i:04d}": flow})
    cameras = [np.linalg.inv(moment.world_from_cam) for moment in moments]
    put(folder / "cam_data/extrinsics.txt", map(numbers, cameras))
    put(folder / "cam_data/intrinsics.txt", 3 * [numbers([15.5, 13.5, 9.25, 6.5])])
    return moments


@pictures("color/{:05d}", "depth/{:05d}", 0.001)
def write_open3d(folder, moments):
    log = []
    for i, moment in enumerate(moments):
        log += [f"{i} {i} {i + 1}", *map(numbers, moment.world_from_cam)]
    put(folder / "scene/trajectory.log", log)
    columns = OPENCV_K.T.ravel().tolist()
    camera = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": columns}
    put(folder / "camera_intrinsic.json", [json.dumps(camera)])


def test_a_picture_that_colmap_did_not_register_is_left_out(tmp_path):
    write_colmap(tmp_path)
    path = tmp_path / "sparse/images.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:4]))
    recording = open_recording(tmp_path, "colmap", pose_unit_m=2.0)
    assert [frame.name for frame in recording] == ["0002"]
    assert recording.notes[0].startswith("2 of 3")
    assert "0000, 0001" in recording.notes[0]
    np.testing.assert_allclose(recording[0].world_from_cam[:3, 3], 2 * synthetic.pose(2)[:3, 3])


def test_rows_of_json_may_also_be_read_in_their_order(tmp_path):
    write_bop(tmp_path)
    recording = open_recording(tmp_path, "bop", rows_by="order", depth_unit_m=0.001)
    np.testing.assert_allclose(recording[2].world_from_cam, synthetic.pose(2), atol=1e-7)


LENS = [-0.2, 0.05, 0.001, -0.002, 0.0]
ROS = f"""
image_width: {WIDTH}
image_height: {HEIGHT}
camera_matrix:
  rows: 3
  cols: 3
  data: {OPENCV_K.ravel().tolist()}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: {LENS}}}
"""
TAG = " !!opencv-matrix"
OPENCV = "%YAML:1.0\n---" + ROS.replace("_matrix:", f"_matrix:{TAG}").replace("s: {", f"s:{TAG} {{")
COLMAP = f"1 OPENCV {WIDTH} {HEIGHT} 31 27 18.5 13 {numbers(LENS[:4])}"
NERF_FISHEYE = {"camera_model": "OPENCV_FISHEYE", **dict(zip(("k1", "k2", "k3", "k4"), LENS))}
NGP_FISHEYE = {"is_fisheye": True, **dict(zip(("k1", "k2", "k3", "k4"), LENS))}
# Half of 40 x 24 pixels over 31 and 27; without the second angle, fy would be 31.
ANGLES = dict(zip(("camera_angle_x", "camera_angle_y"), 2 * np.arctan([20 / 31, 12 / 27])))
ANGLES |= {name: NERF[name] for name in ("cx", "cy", "w", "h")}
BROWN, FISHEYE = {"distortion": LENS}, {"distortion": LENS[:4], "lens": "fisheye"}


@pytest.mark.parametrize(
    ("file", "text", "lens"),
    [
        ("ros.yaml", ROS, BROWN),
        ("ros.yaml", ROS.replace("plumb_bob", "equidistant").replace(", 0.0]}", "]}"), FISHEYE),
        ("opencv.yml", OPENCV, BROWN),
        ("opencv.yml", OPENCV.replace(", 0.0]}", "]}") + "fisheye_model: 1", FISHEYE),
        ("cameras.txt", COLMAP, BROWN),
        ("cameras.txt", COLMAP.replace("OPENCV", "OPENCV_FISHEYE"), FISHEYE),
        ("t.json", json.dumps(NERF | dict(zip(("k1", "k2", "p1", "p2"), LENS))), BROWN),
        ("t.json", json.dumps(NERF | NERF_FISHEYE), FISHEYE),
        ("t.json", json.dumps(NERF | NGP_FISHEYE), FISHEYE),
        ("t.json", json.dumps(ANGLES), {}),
    ],
)
def test_a_calibration_of_another_tool_is_that_camera_and_lens(file, text, lens, tmp_path):
    synthetic.write_frames(tmp_path)
    given = {"first_pixel_centre": 0.5, "intrinsics": [31.0, 27.0, 18.5, 13.0]}
    plain = open_recording(tmp_path, "frames", **given, **lens)[1]
    put(tmp_path / file, [text])
    frame = open_recording(tmp_path, "frames", intrinsics=file)[1]
    np.testing.assert_allclose(frame.K, K)
    np.testing.assert_array_equal(frame.depth, plain.depth)


@pytest.mark.parametrize(
    ("file", "text", "says"),
    [
        ("cameras.txt", "1 FOV 4 3 1 2 2 0.5", "FOV"),
        ("cameras.txt", "1 PINHOLE 4 3 1 1 2 2\n2 PINHOLE 4 3 1 1 2 2", "2 cameras"),
        ("a.yaml", "a: [1, }", "a.yaml"),
        ("a.yaml", ROS.replace("plumb_bob", "thin_prism"), r"a\.yaml.* thin_prism;.*rectify"),
        ("a.yaml", ROS + "camera_model: omni", r"a\.yaml.* omni;.*rectify"),
        ("a.yml", OPENCV.replace("distortion_model: plumb_bob", "xi: 1.2"), r" xi;.*rectify"),
        ("t.json", json.dumps(NERF | {"camera_model": "EQUIRECTANGULAR"}), " EQUIRECTANGULAR;"),
        ("t.json", json.dumps(NERF | {"camera_model": "FISHEYE624"}), " FISHEYE624;"),
        ("t.json", json.dumps(NERF | {"ftheta_p0": 0.1}), " ftheta_p0;"),
        ("t.json", json.dumps(NERF | {"frames": [{"k1": 0.1}, {"k1": 0.2}]}), "lenses"),
        ("t.json", json.dumps(NERF | {"frames": [{"cx": 18}, {"cx": 19}]}), "without intrinsics"),
        ("transforms.json", '{"camera_angle_x": 0.7}', "width"),
    ],
)
def test_a_calibration_that_cannot_be_read_is_named(file, text, says, tmp_path):
    synthetic.write_frames(tmp_path)
    put(tmp_path / file, [text])
    with pytest.raises(SequenceError, match=says):
        open_recording(tmp_path, "frames", intrinsics=file)
