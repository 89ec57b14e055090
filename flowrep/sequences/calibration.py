"""Cameras of recordings: intrinsics, lens distortion, poses, registration of depth to colour."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal, TypeAlias

import cv2
import numpy as np
import pydantic
import torch
import yaml
from numpy.typing import NDArray

from flowrep.geometry import adapt_pose
from flowrep.geometry.pose import POSE_SHAPES
from flowrep.sequences.files import UNREADABLE, read_lines, regular
from flowrep.sequences.recording import Pose, SequenceError

Matrix: TypeAlias = NDArray[np.float64]
Lens: TypeAlias = Literal["opencv", "fisheye"]
IntrinsicsKind: TypeAlias = Literal["pixels", "cam_from_uv"]


class Camera(pydantic.BaseModel):
    """A camera in `intrinsics.json`, see docs/factorize.md."""

    model_config = pydantic.ConfigDict(allow_inf_nan=False, extra="forbid")

    width: pydantic.PositiveInt
    height: pydantic.PositiveInt
    fx: pydantic.PositiveFloat
    fy: float
    cx: float
    cy: float
    first_pixel_centre: Literal[0.0, 0.5]  # type: ignore[valid-type]
    distortion: list[float] = []
    lens: Lens = "opencv"

    def numbers(self, first_pixel_centre: float) -> list[float]:
        """Returns fx, fy, cx, cy, with the centre of pixel (0, 0) at this place in x and y."""
        shift = first_pixel_centre - self.first_pixel_centre
        return [self.fx, self.fy, self.cx + shift, self.cy + shift]


# COLMAP's lens models, https://colmap.github.io/cameras.html: their numbers by NeRF tools' names.
_COLMAP = {
    "SIMPLE_PINHOLE": "fl_x cx cy", "PINHOLE": "fl_x fl_y cx cy",
    "SIMPLE_RADIAL": "fl_x cx cy k1", "RADIAL": "fl_x cx cy k1 k2",
    "OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fl_x fl_y cx cy k1 k2 p1 p2 k3 k4 k5 k6",
    "SIMPLE_RADIAL_FISHEYE": "fl_x cx cy k1", "RADIAL_FISHEYE": "fl_x cx cy k1 k2",
    "OPENCV_FISHEYE": "fl_x fl_y cx cy k1 k2 k3 k4",
}  # fmt: skip
_MODELS = ["none", "plumb_bob", "rational_polynomial", "equidistant", "fisheye"]  # ROS's
_MODELS += [*map(str.lower, _COLMAP), "is_fisheye", "fisheye_model"]
# Keys of instant-ngp and OpenCV that say what the model is, some of which `_MODELS` has.
_MODEL_KEYS = ("is_fisheye", "fisheye_model", "xi", "ftheta_p0", "latlong", "equirectangular")
_FOCAL_KEYS = {"fl_x", "fl_y", "camera_angle_x", "camera_angle_y"}
FILES = (".json", ".yaml", ".yml", "cameras.txt")


def read_cameras(path: Path) -> dict[str, Camera]:
    """Returns the camera, named "", of an `intrinsics.json` or of another tool's file.

    These are COLMAP's `cameras.txt`, a YAML of ROS or OpenCV, a JSON of Open3D, and NeRF's
    `transforms.json`. Where that gives frames different cameras, they are named by their pictures.
    """
    remedy = (
        'it holds {"width": .., "height": .., "fx": .., "fy": .., "cx": .., "cy": .., '
        '"first_pixel_centre": 0 (as OpenCV calibrates) or 0.5} and, of a lens that bends the '
        'picture, "distortion" and "lens"'
    )
    try:
        text, suffix = regular(path).read_text("utf-8-sig", "replace"), path.suffix.lower()
        if suffix == ".txt":
            given = _colmap(path)
        elif suffix == ".json":
            given = json.loads(text)
        else:  # OpenCV begins with a directive and names types that YAML doesn't know
            given = yaml.safe_load(re.sub(r"^%.*|!!opencv-matrix", "", text, flags=re.MULTILINE))
        given, cameras = dict(given), dict[str, Camera]()
        frames = given.get("frames")
        for number, frame in enumerate((isinstance(frames, list) and frames) or [{}]):
            # A frame's focal length replaces the file's, even if one is an angle.
            replaced = set() if _FOCAL_KEYS.isdisjoint(frame) else _FOCAL_KEYS
            whole = {key: value for key, value in given.items() if key not in replaced} | frame
            name = frame.get("file_path", f"frames.{number}")  # the latter is no picture's
            cameras[name] = Camera.model_validate(_renamed(whole, path))
    except FileNotFoundError:
        raise SequenceError(path, f"no such file; {remedy}") from None
    except pydantic.ValidationError as error:
        lines = [f"{'.'.join(map(str, e['loc']))} {e['msg']}".strip() for e in error.errors()]
        raise SequenceError(path, f"{', '.join(lines)}; {remedy}") from None
    except (*UNREADABLE, yaml.YAMLError) as error:
        says = f"is no {path.suffix[1:].upper()}: {' '.join(str(error).split())}"
        raise SequenceError(path, f"{says}; {remedy}") from None
    first, *others = cameras.values()
    if any((each.lens, each.distortion) != (first.lens, first.distortion) for each in others):
        raise SequenceError(path, "has frames of different lenses: rectify their pictures")
    return cameras if any(each != first for each in others) else {"": first}


def _colmap(path: Path) -> dict[str, Any]:
    cameras = [line.split() for line in read_lines(path)]
    if len(cameras) != 1 or len(cameras[0]) < 5:
        remedy = "make one of all pictures, with --ImageReader.single_camera 1"
        raise SequenceError(path, f"holds {len(cameras)} cameras: {remedy}")
    _, model, width, height, *numbers = cameras[0]
    lens_of(model, path)  # or an error
    named = zip(_COLMAP[model].split(), map(float, numbers), strict=True)
    return {"w": int(width), "h": int(height), "camera_model": model, **dict(named)}


def _renamed(given: dict[str, Any], path: Path) -> dict[str, Any]:
    """Returns the numbers of another tool's file, of ROS, OpenCV, Open3D or NeRF, by our names."""

    def of(*names: str) -> Any:
        value = next((given[name] for name in names if given.get(name) is not None), None)
        return value.get("data") if isinstance(value, dict) else value

    camera = {"width": of("width", "image_width", "w"), "height": of("height", "image_height", "h")}
    matrix = of("camera_matrix", "cameraMatrix", "intrinsic_matrix", "K", "k")
    models = [given[key] for key in ("distortion_model", "camera_model") if given.get(key)]
    models += [key for key in _MODEL_KEYS if given.get(key)]
    lens: Lens = "fisheye" if "fisheye" in [lens_of(each, path) for each in models] else "opencv"
    if matrix is not None:
        K = camera_matrix(matrix, (1, 1), 0.5)
        camera["first_pixel_centre"] = 0.0
        numbers = [K[0, 0], K[1, 1], K[0, 2], K[1, 2]]
        names = "distortion_coefficients", "distortionCoefficients", "dist_coeffs", "D", "d"
        coefficients = of(*names) or []
    elif {"fl_x", "camera_angle_x"} & {*given}:
        angle_y = given.get("camera_angle_y")
        camera["first_pixel_centre"] = 0.5
        width, height = (size or math.nan for size in (camera["width"], camera["height"]))
        fx = of("fl_x", "fx") or width / 2 / math.tan(given["camera_angle_x"] / 2)
        centre = given.get("cx", width / 2), given.get("cy", height / 2)
        fy = of("fl_y", "fy") or (height / 2 / math.tan(angle_y / 2) if angle_y else fx)
        numbers = [fx, fy, *centre]
        order = ["k1", "k2", "k3", "k4"]
        if lens == "opencv":
            order = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"][: 8 if "k4" in given else 5]
        coefficients = [given.get(name, 0.0) for name in order]
    else:
        return given
    camera |= dict(zip(("fx", "fy", "cx", "cy"), map(float, numbers)))
    if any(coefficients):
        camera |= {"distortion": list(map(float, coefficients)), "lens": lens}
    return camera


def lens_of(model: object, source: object) -> Lens:
    """Returns the lens that ROS, COLMAP or a NeRF tool calls by this name; refuses another."""
    if (name := str(model).lower()) not in _MODELS:
        says = f"has the lens model {model}; flowrep reads {', '.join(_MODELS)}"
        remedy = "rectify the pictures, or give a folder's format.intrinsics, distortion and lens"
        raise SequenceError(source, f"{says}: {remedy}")
    return "fisheye" if re.search("fisheye|equidistant", name) else "opencv"


def camera_matrix(
    numbers: Sequence[float] | Matrix,
    size: tuple[int, ...],
    first_pixel_centre: float,
    source: object = "intrinsics",
    kind: IntrinsicsKind = "pixels",
) -> Matrix:
    """Returns K `[3, 3]` in flowrep's convention.

    Args:
        numbers: fx, fy, cx, cy; the 9, 12 or 16 numbers of a matrix; or one, the focal length in
            picture widths, of a camera with square pixels and a centred axis.
        kind: what a matrix is: `"pixels"`, K; `"cam_from_uv"`, the rays, in OpenGL's axes, of u to
            the right and v upwards, which are -1 and 1 at the picture's borders (HyperSim).
        size: of the picture, height and width.
        first_pixel_centre: the coordinates of the centre of pixel (0, 0) for these numbers: 0 from
            an OpenCV calibration, or 0.5.

    >>> camera_matrix([525.0, 525.0, 319.5, 239.5], (480, 640), 0.0)[:2, 2]
    array([320., 240.])
    """
    values = np.array(numbers, dtype=np.float64).ravel()
    if len(values) == 1 and kind == "pixels":
        width, shift = size[1], 0.5 - first_pixel_centre
        values = np.array([*(values * width).repeat(2), width / 2 - shift, size[0] / 2 - shift])
    if len(values) not in ((4, 9, 12, 16) if kind == "pixels" else (9,)):
        meaning = "[fx, fy, cx, cy], a matrix, or [a focal length in picture widths]"
        meaning = meaning if kind == "pixels" else "the nine numbers of cam_from_uv"
        raise SequenceError(source, f"should be {meaning}, not {values.tolist()}")
    if len(values) == 4:
        fx, fy, cx, cy = values
        K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    else:
        K = values.reshape(4 if len(values) == 16 else 3, -1)[:3, :3]
        if kind == "cam_from_uv":
            height, width = size
            uv_from_pixel = np.array([[2 / width, 0.0, -1.0], [0.0, -2 / height, 1.0], [0, 0, 1]])
            K = np.linalg.inv(np.diag([1.0, -1.0, -1.0]) @ K @ uv_from_pixel)
            K = np.round(K / K[2, 2], 12)
            K[:2, 2] += first_pixel_centre - 0.5  # borders are whole, whatever the pixels' centres
            if K[2, :2].any():
                raise SequenceError(source, "are of a tilted lens, whose picture no K describes")
        if K[2].tolist() != [0, 0, 1] and K[:, 2].tolist() == [0, 0, 1]:  # written by columns
            K = K.T.copy()
    if K[1, 1] < 0:
        cause = (
            "fy is positive. Where it is negative (ICL-NUIM) the camera is left-handed, with y up"
        )
        remedy = "give fy without its sign, and format.pose_axes=unity mirrors the poses"
        raise SequenceError(source, f"{cause}, z ahead: {remedy}")
    K[:2, 2] += 0.5 - first_pixel_centre
    return K


def as_pose(numbers: NDArray[np.float64], source: object, **options: Any) -> Pose:
    """Returns `world_from_cam` `[*B, 4, 4]` from the numbers of each pose, side by side.

    A matrix may lack its last row. The options are those of `flowrep.geometry.adapt_pose`.
    """
    values = torch.from_numpy(np.array(numbers, dtype=np.float64))
    layout, count = options.pop("layout", "matrix"), values.shape[-1]
    if layout == "matrix" and count == 12:
        layout = "matrix_3x4"
    if count != math.prod(POSE_SHAPES[layout]):
        fitting = [name for name, shape in POSE_SHAPES.items() if math.prod(shape) == count]
        remedy = (
            f"give format.pose_layout={' or '.join(fitting)}" if fitting else "no pose has so many"
        )
        raise SequenceError(source, f"has {count} numbers a pose: {remedy}")
    try:
        values = values.unflatten(-1, POSE_SHAPES[layout])
        pose: Pose = adapt_pose(values, layout=layout, **options).numpy()
    except ValueError as error:
        raise SequenceError(source, str(error)) from None
    return pose


def fixed_pose(numbers: Sequence[float] | None, source: str) -> Pose:
    """Returns the pose `[4, 4]` of 3 (x, y, z), 7 (with qx, qy, qz, qw), 12 or 16 numbers."""
    given = np.array([0.0, 0.0, 0.0] if numbers is None else numbers)
    given = np.array([*given, 0.0, 0.0, 0.0, 1.0]) if len(given) == 3 else given
    return as_pose(given, source, layout="xyz_xyzw" if len(given) == 7 else "matrix")


class Rig:
    """Brings a frame's picture and depth, as they are stored, to one grid without distortion.

    Args:
        distortion: OpenCV's k1, k2, p1, p2, k3, ..., 4, 5, 8, 12 or 14 numbers, or k1 to k4 of its
            fisheye model; of pictures, and of depth that isn't registered.
        lens: their formula.
        colour_from_depth: the pose of a separate depth camera in the pictures' camera, whose depth
            is registered; None if depth is on the pictures' pixels.
    """

    def __init__(
        self, distortion: Sequence[float], lens: Lens, colour_from_depth: Pose | None
    ) -> None:
        counts = (4,) if lens == "fisheye" else (4, 5, 8, 12, 14)
        if len(distortion) not in (0, *counts):
            says = f"has {len(distortion)} numbers, a lens={lens} one of {counts}"
            raise SequenceError("distortion", says)
        self.distortion, self.lens, self.colour_from_depth = distortion, lens, colour_from_depth
        self._made: dict[Any, tuple[Any, Any]] = {}

    def __call__(self, rgb: Any, depth: Any, K: Matrix, K_depth: Matrix) -> tuple[Any, Any]:
        """Returns the picture, or None, and depth; outside of the lens's picture, black and nan."""
        size = depth.shape if rgb is None else rgb.shape[:2]
        is_registered = self.colour_from_depth is not None
        if is_registered:
            depth = self._once(Registration, K_depth, K, self.colour_from_depth, size)(depth)
        if self.distortion:
            columns, rows = self._once(self._stored_pixels, K, size)
            rgb = None if rgb is None else cv2.remap(rgb, columns, rows, cv2.INTER_LINEAR)
            # Registered depth has no lens; it is missing where the picture is.
            stored = np.zeros(size, np.float32) if is_registered else depth
            seen = cv2.remap(stored, columns, rows, cv2.INTER_NEAREST, borderValue=[np.nan])
            depth = depth + seen if is_registered else seen
        return rgb, depth

    def _stored_pixels(self, K: Matrix, size: tuple[int, int]) -> Any:
        """Returns the column and the row at which the lens shows each pixel of K."""
        opencv = K.copy()
        opencv[:2, 2] -= 0.5  # its pixel centres are whole numbers
        make: Any = cv2.fisheye if self.lens == "fisheye" else cv2
        arguments = opencv, np.array(self.distortion, dtype=np.float64), np.eye(3), opencv
        return make.initUndistortRectifyMap(*arguments, size[::-1], cv2.CV_32FC1)

    def _once(self, make: Any, *arguments: Any) -> Any:
        """Returns `make` of the arguments, and the same object until they change."""
        made = self._made.get(make)
        if made is None or not all(map(np.array_equal, made[0], arguments)):
            made = self._made[make] = arguments, make(*arguments)
        return made[1]


_LARGEST_FOOTPRINT_PX = 8


class Registration:
    """Registers depth to the pixels of colour pictures of a size (height, width).

    Each depth pixel becomes a square that faces the camera, as large as the pixel is at its
    distance and at least one colour pixel; if several fall on one colour pixel, the nearest is
    visible. Colour pixels that no square reaches (hidden from the depth camera, or outside its
    picture) are missing, nan.

    >>> K = np.array([[4.0, 0.0, 1.0], [0.0, 4.0, 0.5], [0.0, 0.0, 1.0]])
    >>> colour_from_depth = np.eye(4)
    >>> colour_from_depth[0, 3] = 0.5  # at 2 m that is 4 * 0.5 / 2 = 1 px to the right
    >>> Registration(K, K, colour_from_depth, (1, 2))(np.array([[2.0, 8.0]], np.float32))
    array([[nan,  2.]], dtype=float32)
    """

    def __init__(
        self, K_depth: Matrix, K_colour: Matrix, colour_from_depth: Pose, size: tuple[int, int]
    ) -> None:
        self.size = size
        # The largest focal length of the colour camera divided by the smallest of the depth camera.
        self._finer = np.float32(
            max(K_colour[0, 0], K_colour[1, 1]) / min(K_depth[0, 0], K_depth[1, 1])
        )
        # p_colour ~ z (to_colour @ pixel) + shift, so each frame needs only one product per pixel.
        self._to_colour = K_colour @ colour_from_depth[:3, :3] @ np.linalg.inv(K_depth)
        self._shift = (K_colour @ colour_from_depth[:3, 3]).astype(np.float32)
        self._rays = np.empty((3, 0, 0), np.float32)  # to_colour @ pixel, of the last size seen

    def __call__(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the colour camera's depth, nan where missing; nan and inf are no surface."""
        if self._rays.shape[1:] != depth.shape:
            row, column = np.indices(depth.shape) + 0.5
            pixels = np.stack([column, row, np.ones(depth.shape)]).reshape(3, -1)
            self._rays = (self._to_colour @ pixels).reshape(3, *depth.shape).astype(np.float32)
        x, y, z = (ray * depth + shift for ray, shift in zip(self._rays, self._shift))
        surface = np.isfinite(depth) & (depth > 0) & (z > 0)
        u, v, z, z_depth = x[surface], y[surface], z[surface], depth[surface]
        u, v = u / z, v / z
        side = np.maximum((z_depth / z) * self._finer, 1.0)
        # The nearest square around (u, v) covers the pixels whose centres lie in
        # [u - side / 2, u + side / 2).
        height, width = self.size
        seen = np.full(height * width + 1, np.inf, dtype=np.float32)  # the last: outside
        first_u, first_v = (np.ceil(a - (side + 1) / 2).astype(np.int64) for a in (u, v))
        reach = min(math.ceil(side.max(initial=0.0)), _LARGEST_FOOTPRINT_PX)
        for right, down in np.ndindex(reach, reach):
            column, row = first_u + right, first_v + down
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            if right or down:
                inside &= (column + 0.5 < u + side / 2) & (row + 0.5 < v + side / 2)
            np.minimum.at(seen, np.where(inside, row * width + column, height * width), z)
        seen[np.isinf(seen)] = np.nan
        return seen[:-1].reshape(height, width)
