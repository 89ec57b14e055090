"""A grid of ground on which no static part of the scene can end an episode."""

import math

import numpy as np
import shapely

from flowrep.scenes.layout import Layout

_CELL_M = 0.25


class SafeGround:
    """A fast, conservative test that a vehicle is on the road, clear of boxes and ending zones.

    Where it returns False, exact tests decide. It does not consider people.
    """

    def __init__(self, layout: Layout) -> None:
        """Marks the cells that are safe for any vehicle position and heading in them."""
        vehicle = layout.scene.vehicle
        reach = math.hypot(vehicle.length_m, vehicle.width_m) / 2 + _CELL_M
        ends = [layout.zones[path.end] for path in layout.scene.paths]
        boxes = [*layout.buildings, *layout.obstacles, *layout.closures.values()]
        unsafe = shapely.union_all([*ends, *(box.footprint for box in boxes)]).buffer(reach)
        safe = layout.drivable.buffer(-reach).difference(unsafe)
        self._x0, self._y0, x1, y1 = layout.drivable.bounds
        x = np.arange(self._x0, x1, _CELL_M) + _CELL_M / 2
        y = np.arange(self._y0, y1, _CELL_M) + _CELL_M / 2
        shapely.prepare(safe)
        table = shapely.contains_xy(safe, *np.meshgrid(x, y, indexing="ij"))
        self._columns = [column.astype(np.uint8).tobytes() for column in table]
        self._rows = len(y)

    def __call__(self, x_m: float, y_m: float) -> bool:
        """Returns whether the vehicle's centre is on safe ground."""
        i, j = int((x_m - self._x0) // _CELL_M), int((y_m - self._y0) // _CELL_M)
        is_on_table = 0 <= i < len(self._columns) and 0 <= j < self._rows
        return is_on_table and self._columns[i][j] == 1
