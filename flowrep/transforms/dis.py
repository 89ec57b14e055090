"""Optical flow by dense inverse search (DIS), computed by OpenCV on the CPU."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

PRESETS = ("ultrafast", "fast", "medium")  # OpenCV's numbers 0, 1, 2


@dataclass(frozen=True)
class DIS:
    """Dense inverse search: flow in a few milliseconds per picture on a CPU, without weights.

    Small pictures are enlarged by a whole factor and the flow is scaled back to their pixels,
    because the preset "medium" matches patches of 8 px at half size, too coarse for a picture of
    48 px (`benchmarks/estimated_flow.py` measures the effect). The faster presets choose their
    scale by the picture's width and gain less, or nothing.

    The pictures of a batch are split among as many threads as torch uses
    (`torch.set_num_threads`), since OpenCV releases Python's lock. Pictures on another device are
    copied to the CPU and their flow back, which waits for the device.

    Args:
        preset: `"ultrafast"`, `"fast"` or `"medium"`, OpenCV's own.
        min_side_px: pictures with a shorter side below this are enlarged to at least this; 1
            enlarges none.

    Raises:
        ValueError: for an unknown preset or a size below 1.
        ImportError: OpenCV is not installed.

    Example:
        >>> import torch
        >>> ramp = torch.linspace(0, 255, 40).to(torch.uint8).expand(1, 3, 40, 40)
        >>> DIS()(ramp, ramp).abs().max()  # nothing moved
        tensor(0.)
    """

    preset: str = "medium"
    min_side_px: int = 160

    def __post_init__(self) -> None:
        """Raises ValueError for invalid options, and ImportError without OpenCV."""
        if self.preset not in PRESETS:
            raise ValueError(f"preset must be one of {list(PRESETS)}, got {self.preset!r}")
        if self.min_side_px < 1:
            raise ValueError(f"min_side_px must be at least 1, got {self.min_side_px}")
        _opencv()

    def __call__(self, first: Tensor, second: Tensor) -> Tensor:
        """Returns the displacement of each pixel from the first picture to the second.

        Convention: `[N, 2, H, W]` float32, (u right, v down), pixels, on the first picture's grid.

        Args:
            first: uint8 `[N, 3, H, W]`, RGB.
            second: as `first`.
        """
        pairs = list(zip(_channels_last(first), _channels_last(second)))
        with ThreadPoolExecutor(max(1, min(len(pairs), torch.get_num_threads()))) as pool:
            flows = list(pool.map(lambda pair: self._flow(*pair), pairs))
        if not flows:
            return torch.zeros(0, 2, *first.shape[-2:], device=first.device)
        return torch.stack(flows).to(first.device)

    def _flow(self, first: Any, second: Any) -> Tensor:
        cv2 = _opencv()
        height, width = first.shape[:2]
        factor = whole_factor(height, width, self.min_side_px)
        grey = [cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (first, second)]
        if factor > 1:
            size = (width * factor, height * factor)
            grey = [cv2.resize(picture, size, interpolation=cv2.INTER_CUBIC) for picture in grey]
        # One estimator per call: its buffers aren't thread-safe, and creating it is cheap.
        flow = cv2.DISOpticalFlow_create(PRESETS.index(self.preset)).calc(*grey, None)
        if factor > 1:
            flow = cv2.resize(flow, (width, height), interpolation=cv2.INTER_AREA) / factor
        return torch.from_numpy(flow).movedim(-1, 0)


def whole_factor(height: int, width: int, min_side_px: int) -> int:
    """Returns the smallest whole factor that makes both sides at least `min_side_px`.

    >>> whole_factor(48, 84, 160), whole_factor(200, 300, 160)
    (4, 1)
    """
    return max(1, math.ceil(min_side_px / min(height, width)))


def _channels_last(pictures: Tensor) -> Any:
    """Returns the pictures as a numpy array [N, H, W, 3], which OpenCV reads."""
    return pictures.movedim(-3, -1).contiguous().cpu().numpy()


def _opencv() -> Any:
    try:
        import cv2
    except ImportError as error:
        raise ImportError(
            "flow estimated by DIS needs OpenCV: pip install 'flowrep[flow]'"
        ) from error
    return cv2
