"""Distance to the ending zone from anywhere on the road, around corners and closures."""

import heapq
import math

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from flowrep.scenes.layout import Layout
from flowrep.scenes.scene import Path

Array = NDArray[np.float64]
_CELL_M = 0.5
_NEIGHBOURS = [(i, j, math.hypot(i, j)) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]


def free_ground(layout: Layout, path: Path) -> BaseGeometry:
    """Returns the road minus the buildings, obstacles and closures of a path's episodes."""
    boxes = [*layout.buildings, *layout.obstacles]
    boxes += [layout.closures[name] for name in path.closures]
    free = layout.drivable.difference(shapely.union_all([box.footprint for box in boxes]))
    shapely.prepare(free)
    return free


class GoalDistance:
    """A grid of shortest distances from the free ground to the ending zone."""

    def __init__(self, free: BaseGeometry, goal: BaseGeometry) -> None:
        """Fills the grid outwards from the ending zone (Dijkstra, eight neighbours)."""
        x0, y0, x1, y1 = free.bounds
        self._origin = np.array([x0, y0])
        columns, rows = (math.ceil(size / _CELL_M) for size in (x1 - x0, y1 - y0))
        x = x0 + (np.arange(columns) + 0.5) * _CELL_M
        y = y0 + (np.arange(rows) + 0.5) * _CELL_M
        grid_x, grid_y = np.meshgrid(x, y, indexing="ij")
        is_free = shapely.contains_xy(free, grid_x, grid_y)
        is_goal = is_free & shapely.contains_xy(goal, grid_x, grid_y)
        # A margin of cells at infinity represents everything outside the grid.
        self._way = np.full((columns + 2, rows + 2), np.inf)
        is_open = np.pad(is_free, 1)
        queue = [(0.0, int(i) + 1, int(j) + 1) for i, j in np.argwhere(is_goal)]
        for _, i, j in queue:
            self._way[i, j] = 0.0
        while queue:
            way, i, j = heapq.heappop(queue)
            if way > self._way[i, j]:
                continue
            for di, dj, step in _NEIGHBOURS:
                longer = way + step * _CELL_M
                if is_open[i + di, j + dj] and longer < self._way[i + di, j + dj]:
                    self._way[i + di, j + dj] = longer
                    heapq.heappush(queue, (longer, i + di, j + dj))

    def __call__(self, x_m: Array, y_m: Array) -> Array:
        """Returns the distance to the ending zone in metres, inf off the free ground.

        `x_m` and `y_m` have the same shape, as has the result.
        """
        cell = np.floor((np.stack([x_m, y_m], -1) - self._origin) / _CELL_M).astype(np.int64) + 1
        limit = np.array(self._way.shape) - 1
        cell = np.clip(cell, 0, limit)
        return self._way[cell[..., 0], cell[..., 1]]
