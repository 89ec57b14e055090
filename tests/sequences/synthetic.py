"""Recordings whose flow is known exactly, written in each format as its data set writes it.

And four frames of 7-Scenes that lie beside the checkout; tests that use them skip without.
"""

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from flowrep.geometry import ego_flow, relative_motion, rigid_flow
from tests.geometry.scenes import rigid

PLACES = [parent / "shared/data/7scenes" for parent in Path(__file__).resolve().parents]
SEVEN_SCENES = next((place for place in PLACES if place.is_dir()), None)
needs_7scenes = pytest.mark.skipif(
    SEVEN_SCENES is None, reason="no frames of 7-Scenes in shared/data/7scenes beside the checkout"
)

HEIGHT, WIDTH, FRAMES = 24, 40, 3
K = np.array([[31.0, 0.0, 18.5], [0.0, 27.0, 13.0], [0.0, 0.0, 1.0]])
# The same, with pixel (0, 0)'s centre at (0, 0).
OPENCV_K = K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
OPENCV_INTRINSICS = (31.0, 27.0, 18.0, 12.5)


@dataclass(frozen=True)
class Moment:
    """A frame, and its flow since the frame before (since the one after, if time runs back)."""

    rgb: np.ndarray
    depth: np.ndarray
    world_from_cam: np.ndarray
    raw: np.ndarray
    obj: np.ndarray


def pose(index: int) -> np.ndarray:
    """A camera that flies on a curve and turns about all its axes, far from the world's origin."""
    place = (3.0 + 0.3 * index, -2.0 + 0.1 * index**2, 5.0 - 0.2 * index)
    return rigid((0.4 + 0.01 * index, -0.7 + 0.02 * index, 1.1 - 0.015 * index), place).numpy()


def make_moments(*, unit_m: float, K=K, backwards=False, body=True) -> list[Moment]:
    """Returns frames whose depth is a whole number of units, as a 16-bit file keeps it."""
    random = np.random.default_rng(3)
    moments = []
    for index in range(FRAMES):
        depth = 2.0 + 6.0 * random.random((HEIGHT, WIDTH))
        depth = (np.rint(depth / unit_m) * unit_m).astype(np.float32)
        rgb = random.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
        other = index + 1 if backwards else index - 1
        motion = relative_motion(*map(torch.from_numpy, (pose(other), pose(index))))
        raw, obj = flow_of(depth, K, motion, body)
        moments.append(Moment(rgb, depth, pose(index), raw, obj))
    return moments


def flow_of(depth, K, prev_from_curr, body):
    """Returns raw and object flow; a rectangle moves by itself."""
    instance = torch.zeros(1, *depth.shape, dtype=torch.uint8)
    instance[0, 5:14, 8:20] = int(body)
    own = torch.eye(4)
    own[:3, 3] = torch.tensor([0.11, -0.06, 0.2])
    motions = torch.stack([prev_from_curr, prev_from_curr @ own])
    camera = torch.from_numpy(K).float()
    raw = rigid_flow(torch.from_numpy(depth)[None], instance, camera, motions).flow
    ego = ego_flow(torch.from_numpy(depth)[None], camera, prev_from_curr).flow
    return raw.numpy(), (raw - ego).numpy()


def put(path: Path, content) -> None:
    """Writes bytes, or an array or lines as the file's name says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif path.suffix == ".npy":
        np.save(path, content)
    elif path.suffix == ".flo":
        assert cv2.writeOpticalFlow(str(path), np.ascontiguousarray(content.transpose(1, 2, 0)))
    elif isinstance(content, np.ndarray):
        assert cv2.imwrite(str(path), content[..., ::-1] if content.ndim == 3 else content)
    else:
        path.write_text("".join(f"{line}\n" for line in content))


def stored(depth: np.ndarray, unit_m: float) -> np.ndarray:
    return np.rint(depth / unit_m).astype(np.uint16)


def pictures(rgb: str, depth: str, unit_m: float, names=range(FRAMES)):
    """Decorates what writes the rest of a format: before it, pictures and depth are written.

    Names stand for the braces of their files' names.
    """

    def decorate(write_rest):
        def write(folder: Path) -> list[Moment]:
            moments = make_moments(unit_m=unit_m)
            for name, moment in zip(names, moments):
                put(folder / f"{rgb.format(name)}.png", moment.rgb)
                put(folder / f"{depth.format(name)}.png", stored(moment.depth, unit_m))
            return write_rest(folder, moments) or moments

        return write

    return decorate


def numbers(values) -> str:
    return " ".join(repr(float(value)) for value in np.ravel(values))


def quaternion_line(world_from_cam: np.ndarray) -> str:
    """Returns tx ty tz qx qy qz qw."""
    axis_angle = cv2.Rodrigues(world_from_cam[:3, :3])[0].ravel()
    angle = np.linalg.norm(axis_angle)
    xyz = np.sin(angle / 2) * axis_angle / angle
    return numbers([*world_from_cam[:3, 3], *xyz, np.cos(angle / 2)])


def camera_json(**changes) -> list[str]:
    size = {"width": WIDTH, "height": HEIGHT, "first_pixel_centre": 0.5}
    return [json.dumps(size | {"fx": 31.0, "fy": 27.0, "cx": 18.5, "cy": 13.0} | changes)]


@pictures("rgb/{:04d}", "depth/{:04d}", 0.001)
def write_frames(folder, moments):
    for i in (1, 2):
        put(folder / f"flow/{i:04d}.flo", moments[i].raw)
    put(folder / "poses.txt", [numbers(m.world_from_cam) for m in moments])
    put(folder / "timestamps.txt", [f"{0.1 * i}" for i in range(len(moments))])
    put(folder / "intrinsics.json", camera_json())


def write_tum(folder, unit_m=1 / 5000, depth_late_s=0.012, pose_late_s=0.004) -> list[Moment]:
    moments = make_moments(unit_m=unit_m)
    index: dict[str, list[str]] = {"rgb": [], "depth": [], "groundtruth": []}
    for i, moment in enumerate(moments):
        rgb_s = 100 + 0.1 * i
        depth_s = rgb_s + depth_late_s
        put(folder / f"rgb/{rgb_s:.6f}.png", moment.rgb)
        put(folder / f"depth/{depth_s:.6f}.png", stored(moment.depth, unit_m))
        index["rgb"].append(f"{rgb_s:.6f} rgb/{rgb_s:.6f}.png")
        index["depth"].append(f"{depth_s:.6f} depth/{depth_s:.6f}.png")
        for pose_s in (rgb_s - pose_late_s, rgb_s + pose_late_s):
            index["groundtruth"].append(f"{pose_s:.6f} {quaternion_line(moment.world_from_cam)}")
    for name, lines in index.items():
        put(folder / f"{name}.txt", ["# a comment", *lines])
    return moments


def write_realsense(folder: Path) -> list[Moment]:
    return write_tum(folder, unit_m=0.001, depth_late_s=0.0, pose_late_s=0.0)


@pictures("frame-{:06d}.color", "frame-{:06d}.depth", 0.001)
def write_sevenscenes(folder, moments):
    for i, moment in enumerate(moments):
        put(folder / f"frame-{i:06d}.pose.txt", map(numbers, moment.world_from_cam))


@pictures("frames/rgb/Camera_0/rgb_{:05d}", "frames/depth/Camera_0/depth_{:05d}", 0.01)
def write_vkitti2(folder, moments):
    extrinsics = ["frame cameraID r1,1 r1,2 r1,3 t1 r2,1 r2,2 r2,3 t2 r3,1 r3,2 r3,3 t3 0 0 0 1"]
    intrinsics = ["frame cameraID K[0,0] K[1,1] K[0,2] K[1,2]"]
    for i, moment in enumerate(moments):
        if i > 0:
            flow = vkitti_flow(-moment.raw)
            put(folder / f"frames/backwardFlow/Camera_0/backwardFlow_{i:05d}.png", flow)
        cam_from_world = np.linalg.inv(moment.world_from_cam)
        for camera, shift in ((0, 0.0), (1, -0.5)):
            other = cam_from_world.copy()
            other[0, 3] += shift
            extrinsics.append(f"{i} {camera} {numbers(other)}")
            intrinsics.append(f"{i} {camera} {numbers(OPENCV_INTRINSICS)}")
    put(folder / "extrinsic.txt", extrinsics)
    put(folder / "intrinsic.txt", intrinsics)


def vkitti_flow(flow: np.ndarray) -> np.ndarray:
    """Returns red, green, blue: 2 I / 65535 - 1 times width - 1 and height - 1."""
    size = np.array([flow.shape[2] - 1, flow.shape[1] - 1])[:, None, None]
    red, green = np.rint((flow / size + 1) / 2 * 65535)
    return np.stack([red, green, np.full_like(red, 65535)], -1).astype(np.uint16)


def masked(moment: Moment) -> np.ndarray:
    """Makes the flow of a pixel unknown, and returns the mask of it."""
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[4, 5], moment.raw[:, 4, 5] = 100, np.nan
    return mask


def write_sintel(folder) -> list[Moment]:
    moments = make_moments(unit_m=1e-6, backwards=True)
    for i, moment in enumerate(moments):
        stem = f"cave/frame_{i + 1:04d}"
        put(folder / f"final/{stem}.png", moment.rgb)
        head = struct.pack("<fii", 202021.25, WIDTH, HEIGHT)
        put(folder / f"depth/{stem}.dpt", head + moment.depth.astype("<f4").tobytes())
        cam_from_world = np.linalg.inv(moment.world_from_cam)[:3]
        cam = struct.pack("<f", 202021.25) + OPENCV_K.tobytes() + cam_from_world.tobytes()
        put(folder / f"camdata_left/{stem}.cam", cam)
        if i + 1 < len(moments):
            put(folder / f"flow/{stem}.flo", -moment.raw)
            put(folder / f"invalid/{stem}.png", masked(moment))
    return moments


TARTANAIR_K = np.array([[20.0, 0.0, 20.0], [0.0, 20.0, 12.0], [0.0, 0.0, 1.0]])
# The columns are OpenCV's right, down and forward in north-east-down axes of the camera.
NED_FROM_OPENCV = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def write_tartanair(folder) -> list[Moment]:
    moments = make_moments(unit_m=1e-6, K=TARTANAIR_K, backwards=True, body=False)
    for i, moment in enumerate(moments):
        put(folder / f"image_left/{i:06d}_left.png", moment.rgb)
        put(folder / f"depth_left/{i:06d}_left_depth.npy", moment.depth)
        if i + 1 < FRAMES:
            pair = f"{i:06d}_{i + 1:06d}"
            put(folder / f"flow/{pair}_flow.npy", -moment.raw.transpose(1, 2, 0))
            put(folder / f"flow/{pair}_mask.npy", masked(moment))
    poses = [moment.world_from_cam @ NED_FROM_OPENCV.T for moment in moments]
    put(folder / "pose_left.txt", map(quaternion_line, poses))
    return moments


def write_zed(folder) -> list[Moment]:
    moments = make_moments(unit_m=0.001)
    for i, moment in enumerate(moments):
        put(folder / f"left{i:06d}.png", moment.rgb)
        if i % 2 == 0:
            put(folder / f"depth{i:06d}.png", stored(moment.depth, 0.001))
            continue
        moment.depth[0, :3] = np.nan, np.inf, -np.inf  # beyond its range: missing
        put(folder / f"depth{i:06d}.npy", moment.depth)
        moment.depth[0, :3] = np.nan
    put(folder / "poses.txt", [quaternion_line(m.world_from_cam) for m in moments])
    put(folder / "intrinsics.json", camera_json())
    return moments


KITTI_K = np.array([[31.0, 0.0, 18.5], [0.0, 31.0, 13.0], [0.0, 0.0, 1.0]])
KITTI_BASELINE_M = 0.5


def write_kitti(folder: Path) -> list[Moment]:
    """One pair; its two moments in the order they are read in, the later picture first."""
    random = np.random.default_rng(4)
    rgb = random.integers(0, 256, (2, HEIGHT, WIDTH, 3), dtype=np.uint8)
    disparity = random.integers(300, 900, (HEIGHT, WIDTH)).astype(np.uint16)
    disparity[0, :3] = 0
    measured = np.where(disparity == 0, np.nan, disparity / 256)
    depth = (31.0 * KITTI_BASELINE_M / measured).astype(np.float32)
    motion = relative_motion(*map(torch.from_numpy, (pose(1), pose(0))))
    raw_flow, obj = flow_of(depth, KITTI_K, motion, body=True)
    for i, name in enumerate(("10", "11")):
        put(folder / f"image_2/000000_{name}.png", rgb[i])
    put(folder / "disp_occ_0/000000_10.png", disparity)
    u, v = np.rint(-raw_flow * 64) + 2**15
    put(folder / "flow_occ/000000_10.png", np.stack([u, v, u * 0 + 1], -1).astype(np.uint16))
    projection = np.hstack([KITTI_K - (K - OPENCV_K), np.zeros((3, 1))])
    left, right = projection.copy(), projection.copy()
    left[0, 3], right[0, 3] = 31.0 * 0.06, 31.0 * (0.06 - KITTI_BASELINE_M)
    lines = ["calib_time: 09-Jan-2012 13:57:47", f"P_rect_02: {numbers(left)}"]
    put(folder / "calib_cam_to_cam/000000.txt", [*lines, f"P_rect_03: {numbers(right)}"])
    nothing = np.zeros_like(obj)
    later = Moment(rgb[1], np.full_like(depth, np.nan), pose(1), nothing, nothing)
    return [later, Moment(rgb[0], depth, pose(0), raw_flow, obj)]


FLIPPED_Y = np.diag([1.0, -1.0, 1.0, 1.0])


def write_tartanair_v2(folder) -> list[Moment]:
    moments = make_moments(unit_m=1e-6, K=TARTANAIR_K)
    for i, moment in enumerate(moments):
        put(folder / f"image_lcam_front/{i:06d}_lcam_front.png", moment.rgb)
        # The four bytes of a float, in the order in which OpenCV writes blue, green, red, alpha.
        coded = cv2.imencode(".png", moment.depth.view(np.uint8).reshape(HEIGHT, WIDTH, 4))[1]
        put(folder / f"depth_lcam_front/{i:06d}_lcam_front_depth.png", coded.tobytes())
    poses = [moment.world_from_cam @ NED_FROM_OPENCV.T for moment in moments]
    put(folder / "pose_lcam_front.txt", map(quaternion_line, poses))
    return moments


@pictures("rgb/{}", "depth/{}", 1 / 5000, range(9, 12))
def write_icl_nuim(folder, moments):
    # Pictures begin with 0, poses with 1. Camera and world are left-handed, with y up.
    poses = [FLIPPED_Y @ moment.world_from_cam @ FLIPPED_Y for moment in moments]
    lines = [f"{i} {quaternion_line(pose)}" for i, pose in enumerate(poses, 9)]
    put(folder / "livingRoom2.gt.freiburg", lines[1:])
    return moments[1:]


@pictures("results/frame{:06d}", "results/depth{:06d}", 1 / 6553.5)
def write_replica(folder, moments):
    put(folder / "traj.txt", [numbers(moment.world_from_cam) for moment in moments])


@pictures("color/{}", "depth/{}", 0.001)
def write_scannet(folder, moments):
    lost = np.full((4, 4), -np.inf)
    for i, moment in enumerate(moments):
        put(folder / f"pose/{i}.txt", map(numbers, lost if i == 2 else moment.world_from_cam))
    camera = np.eye(4)
    camera[:3, :3] = OPENCV_K
    for kind in ("color", "depth"):
        put(folder / f"intrinsic/intrinsic_{kind}.txt", map(numbers, camera))
    return moments[:2]


KUBRIC_K = np.array([[30.0, 0.0, 20.0], [0.0, 30.0, 12.0], [0.0, 0.0, 1.0]])


def write_kubric(folder) -> list[Moment]:
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
