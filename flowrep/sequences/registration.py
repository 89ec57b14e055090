"""Registers depth from one camera to the pixels of another, as a Kinect's recordings need."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

_LARGEST_FOOTPRINT_PX = 8


class Registration:
    """Registers depth to the colour camera's pixels.

    Each depth pixel becomes a square that faces the camera, as large as the pixel is at its
    distance and at least one colour pixel; if several fall on one colour pixel, the nearest is
    visible. Colour pixels that no square reaches (hidden from the depth camera, or outside its
    picture) are missing, nan.

    Args:
        K_depth: `[3, 3]` of the depth camera, pixels.
        K_colour: `[3, 3]` of the colour camera, pixels.
        colour_from_depth: `[4, 4]`, takes points of the depth camera into the colour camera's
            frame, metres.
        size: height and width of the colour pictures.

    >>> K = np.array([[4.0, 0.0, 1.0], [0.0, 4.0, 0.5], [0.0, 0.0, 1.0]])
    >>> colour_from_depth = np.eye(4)
    >>> colour_from_depth[0, 3] = 0.5  # at 2 m that is 4 * 0.5 / 2 = 1 px to the right
    >>> Registration(K, K, colour_from_depth, (1, 2))(np.array([[2.0, 8.0]], np.float32))
    array([[nan,  2.]], dtype=float32)
    """

    def __init__(
        self,
        K_depth: NDArray[np.float64],
        K_colour: NDArray[np.float64],
        colour_from_depth: NDArray[np.float64],
        size: tuple[int, int],
    ) -> None:
        self.K_colour, self.size = K_colour, size
        self.depth_from_colour = np.linalg.inv(colour_from_depth)
        self._depth_focal = float(min(K_depth[0, 0], K_depth[1, 1]))
        # p_colour ~ z (to_colour @ pixel) + shift, so only one product per pixel is left to do.
        self._to_colour = K_colour @ colour_from_depth[:3, :3] @ np.linalg.inv(K_depth)
        self._shift = K_colour @ colour_from_depth[:3, 3]
        self._rays: NDArray[np.float32] | None = None  # [3, H, W] of the last size seen

    def __call__(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Returns the colour camera's depth, `[height, width]`, metres, nan where missing.

        Args:
            depth: `[H, W]` of the depth camera, metres; nan and inf are no surface.
        """
        rays = self._rays_of(depth.shape)
        surface = np.isfinite(depth) & (depth > 0)
        x, y, z = (ray * depth + shift for ray, shift in zip(rays, self._shift.astype(np.float32)))
        surface &= z > 0
        u, v, z_colour, z_depth = x[surface], y[surface], z[surface], depth[surface]
        u, v = u / z_colour, v / z_colour
        footprint = (z_depth / z_colour) * np.float32(self._colour_focal / self._depth_focal)
        return self._nearest(u, v, z_colour, np.maximum(footprint, 1.0))

    def _nearest(
        self,
        u: NDArray[np.float32],
        v: NDArray[np.float32],
        z: NDArray[np.float32],
        footprint: NDArray[np.float32],
    ) -> NDArray[np.float32]:
        """Returns the depth of the nearest square around (u, v) in each pixel."""
        height, width = self.size
        seen = np.full(height * width + 1, np.inf, dtype=np.float32)  # the last: outside
        # The pixels whose centres lie in [u - side / 2, u + side / 2).
        first_u = np.ceil(u - (footprint + 1) / 2).astype(np.int64)
        first_v = np.ceil(v - (footprint + 1) / 2).astype(np.int64)
        widest = float(footprint.max()) if len(footprint) else 0.0
        reach = min(math.ceil(widest), _LARGEST_FOOTPRINT_PX)
        for right in range(reach):
            for down in range(reach):
                column, row = first_u + right, first_v + down
                inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
                if right or down:
                    inside &= column + 0.5 < u + footprint / 2
                    inside &= row + 0.5 < v + footprint / 2
                place = np.where(inside, row * width + column, height * width)
                np.minimum.at(seen, place, z)
        seen[np.isinf(seen)] = np.nan
        return seen[:-1].reshape(height, width)

    def _rays_of(self, shape: tuple[int, ...]) -> NDArray[np.float32]:
        if self._rays is None or self._rays.shape[1:] != shape:
            row, column = np.indices(shape) + 0.5
            pixels = np.stack([column, row, np.ones(shape)]).reshape(3, -1)
            self._rays = (self._to_colour @ pixels).reshape(3, *shape).astype(np.float32)
        return self._rays

    @property
    def _colour_focal(self) -> float:
        return float(max(self.K_colour[0, 0], self.K_colour[1, 1]))
