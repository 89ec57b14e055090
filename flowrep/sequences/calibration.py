"""A camera's intrinsics from a list of four numbers or a JSON file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.files import finite_number, read_json
from flowrep.sequences.frame import SequenceError
from flowrep.sequences.pictures import check_pixels


@dataclass(frozen=True)
class Camera:
    """K `[3, 3]` in flowrep's convention, and the size of the pictures it belongs to."""

    K: NDArray[np.float64]
    height: int
    width: int

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.height, self.width


def intrinsics(fx: float, fy: float, cx: float, cy: float, skew: float = 0.0) -> NDArray:
    """Returns K `[3, 3]`, float64."""
    return np.array([[fx, skew, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def opencv_intrinsics(numbers: Sequence[float]) -> NDArray[np.float64]:
    """Returns K from fx, fy, cx, cy of a calibration with the centre of pixel (0, 0) at (0, 0).

    >>> opencv_intrinsics([525.0, 525.0, 319.5, 239.5])[:2, 2]
    array([320., 240.])
    """
    fx, fy, cx, cy = numbers
    return intrinsics(fx, fy, cx + 0.5, cy + 0.5)


def four_intrinsics(name: str, numbers: Sequence[float]) -> tuple[float, float, float, float]:
    """Returns fx, fy, cx, cy of an option; the error for anything else names the option."""
    values = [float(number) for number in numbers]
    if len(values) != 4 or not np.isfinite(values).all() or min(values[:2]) <= 0:
        raise SequenceError(name, f"should be [fx, fy, cx, cy] in pixels, not {list(numbers)}")
    return values[0], values[1], values[2], values[3]


def read_cameras(path: Path) -> tuple[Camera, Camera | None, NDArray[np.float64] | None]:
    """Returns the depth camera, the colour camera if it is different, and `colour_from_depth`.

    The file is the `intrinsics.json` of `frames` and `zed` folders, see docs/factorize.md.

    Raises:
        SequenceError: a key is missing, or its value is invalid.
    """
    content = read_json(path)
    camera = _camera(path, content)
    if "colour" not in content:
        return camera, None, None
    colour = content["colour"]
    if not isinstance(colour, Mapping):
        raise SequenceError(path, "colour should be an object")
    try:
        extrinsics = np.array(colour.get("colour_from_depth"), dtype=np.float64)
    except (TypeError, ValueError):
        extrinsics = np.empty(0)
    if extrinsics.shape != (4, 4):
        raise SequenceError(path, "colour.colour_from_depth should be four rows of four numbers")
    return camera, _camera(path, colour, "colour."), extrinsics


def _camera(path: Path, content: Mapping[str, Any], prefix: str = "") -> Camera:
    keys = ("width", "height", "fx", "fy", "cx", "cy", "first_pixel_centre")
    missing = [prefix + key for key in keys if key not in content]
    if missing:
        raise SequenceError(path, f"lacks {', '.join(missing)}")
    value = {key: finite_number(path, prefix + key, content[key]) for key in keys}
    if value["first_pixel_centre"] not in (0.0, 0.5):
        raise SequenceError(
            path, f"{prefix}first_pixel_centre is 0 (as OpenCV calibrates) or 0.5, "
            f"not {value['first_pixel_centre']}",
        )  # fmt: skip
    for key in ("width", "height"):
        if not value[key].is_integer():
            raise SequenceError(path, f"{prefix}{key} should be a whole number, not {value[key]}")
    width, height = int(value["width"]), int(value["height"])
    check_pixels(path, width, height)
    if not (value["fx"] > 0 and value["fy"] > 0):
        raise SequenceError(path, f"{prefix}fx and {prefix}fy should be positive")
    shift = 0.5 - value["first_pixel_centre"]
    K = intrinsics(value["fx"], value["fy"], value["cx"] + shift, value["cy"] + shift)
    return Camera(K, height, width)
