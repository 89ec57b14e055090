"""Low-polygon meshes of flat-shaded, coloured triangles, and the markings on the ground."""

import math
from collections.abc import Iterator, Sequence

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString, Polygon
from shapely.geometry.base import BaseGeometry

from flowrep.simulator.paint import Patch, swatch

Array = NDArray[np.float64]
Point3 = tuple[float, float, float]
_CELL_M = 15.0  # cells that the ground is cut into: small triangles are interpolated better
_DASH_M, _DASH_PERIOD_M, _DASH_WIDTH_M = 2.0, 6.0, 0.15
_STRIPE_M = 0.5
_KERB_M = 0.25
_RISE_M = 0.004  # height of markings above the ground


class Mesh:
    """Triangles with normals and texture coordinates, in PyBullet's order."""

    def __init__(self) -> None:
        """Starts without triangles."""
        self.vertices: list[list[float]] = []
        self.normals: list[list[float]] = []
        self.uvs: list[list[float]] = []
        self.indices: list[int] = []

    def polygon(self, corners: Array, uvs: list[list[float]]) -> None:
        """Adds a flat convex polygon [M, 3], counter-clockwise seen from outside."""
        (ax, ay, az), (bx, by, bz) = (corners[1:3] - corners[0]).tolist()
        # numpy.cross would take most of the time to build a street
        normal = np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])
        normal /= np.linalg.norm(normal)
        base = len(self.vertices)
        self.vertices += corners.tolist()
        self.normals += [normal.tolist()] * len(corners)
        self.uvs += uvs
        for i in range(1, len(corners) - 1):
            self.indices += [base, base + i, base + i + 1]

    def quad(self, corners: Array, patch: Patch) -> None:
        """Adds a rectangle: bottom left, bottom right, top right, top left, seen from outside."""
        u0, v0, u1, v1 = patch
        self.polygon(corners, [[u0, v1], [u1, v1], [u1, v0], [u0, v0]])

    def box(self, low: Point3, high: Point3, side: Patch, *, lid: bool = True) -> None:
        """Adds a box without its floor; `lid` adds its top."""
        self.walls(low, high, (side,) * 4)
        if lid:
            (x0, y0, _), (x1, y1, z1) = low, high
            ring = [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)]
            self.quad(np.array(ring), side)

    def walls(self, low: Point3, high: Point3, sides: Sequence[Patch | None]) -> None:
        """Adds the upright faces of a box for which a patch is given: -y, +x, +y, -x."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        for i, patch in enumerate(sides):
            if patch is not None:
                (ax, ay), (bx, by) = ring[i], ring[(i + 1) % 4]
                corners = [(ax, ay, z0), (bx, by, z0), (bx, by, z1), (ax, ay, z1)]
                self.quad(np.array(corners), patch)

    def frustum(
        self,
        bottom: Array,
        bottom_m: float,
        top: Array,
        top_m: float,
        side: Patch,
        lid: Patch,
        *,
        floor: Patch | None = None,
    ) -> None:
        """Adds the sides and top between two level rings [M, 2], counter-clockwise from above."""
        low = np.column_stack([bottom, np.full(len(bottom), bottom_m)])
        high = np.column_stack([top, np.full(len(top), top_m)])
        for i in range(len(low)):
            j = (i + 1) % len(low)
            self.quad(np.array([low[i], low[j], high[j], high[i]]), side)
        self.polygon(high, [list(lid[:2])] * len(high))
        if floor is not None:
            self.polygon(low[::-1], [list(floor[:2])] * len(low))

    def disc(self, centre: Point3, normal: Point3, radius_m: float, patch: Patch) -> None:
        """Adds an upright octagonal disc, visible from the side its normal points to."""
        across = np.array([-normal[1], normal[0], 0.0])
        angles = np.arange(8) * (math.pi / 4)
        rim = np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * np.array([0.0, 0.0, 1.0])
        self.polygon(np.array(centre) + radius_m * rim, [list(patch[:2])] * len(rim))

    def ground(self, area: BaseGeometry, height_m: float, paint: str) -> None:
        """Adds an area of the ground plan as a level surface, cut into cells."""
        if area.is_empty:
            return
        uv = [list(swatch(paint)[:2])] * 3
        x0, y0, x1, y1 = area.bounds
        for x in np.arange(x0, x1, _CELL_M):
            for y in np.arange(y0, y1, _CELL_M):
                cell = shapely.intersection(area, shapely.box(x, y, x + _CELL_M, y + _CELL_M))
                for triangle in shapely.constrained_delaunay_triangles(cell).geoms:
                    ring = shapely.geometry.polygon.orient(triangle).exterior.coords[:3]
                    self.polygon(np.array([(u, v, height_m) for u, v in ring]), uv)

    def parts(self, triangles: int) -> Iterator["Mesh"]:
        """Yields this mesh in parts of up to so many triangles; none may share a vertex."""
        for first in range(0, len(self.vertices), 3 * triangles):
            own = slice(first, first + 3 * triangles)
            part = Mesh()
            part.vertices, part.normals = self.vertices[own], self.normals[own]
            part.uvs, part.indices = self.uvs[own], list(range(len(part.vertices)))
            yield part

    def moved(self, x_m: float, y_m: float, yaw_rad: float) -> "Mesh":
        """Returns this mesh turned and moved on the ground."""
        sine, cosine = math.sin(yaw_rad), math.cos(yaw_rad)
        turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        other = Mesh()
        other.vertices = (np.array(self.vertices) @ turn.T + [x_m, y_m, 0.0]).tolist()
        other.normals = (np.array(self.normals) @ turn.T).tolist()
        other.uvs, other.indices = self.uvs, self.indices
        return other

    def add(self, other: "Mesh") -> None:
        """Adds another mesh's triangles."""
        base = len(self.vertices)
        self.vertices += other.vertices
        self.normals += other.normals
        self.uvs += other.uvs
        self.indices += [base + i for i in other.indices]


def lane_marks(line: LineString, clear_of: BaseGeometry) -> Mesh:
    """Returns dashes along the middle of a road, slightly above it.

    Args:
        line: the road's centreline.
        clear_of: ground without dashes, such as crosswalks and junctions.
    """
    mesh = Mesh()
    for at in np.arange(0.0, line.length - _DASH_M, _DASH_PERIOD_M):
        dash = shapely.ops.substring(line, at, at + _DASH_M)
        if not dash.intersects(clear_of):
            area = dash.buffer(_DASH_WIDTH_M / 2, cap_style="flat")
            mesh.ground(area, _RISE_M, "lane_mark")
    return mesh


def kerb(drivable: BaseGeometry, paved: BaseGeometry) -> Mesh:
    """Returns the kerbstones along the edge of a sidewalk, slightly above it.

    The paving continues below them: the renderer omits thin triangles in the distance, where the
    same category then shows instead.
    """
    mesh = Mesh()
    edge = drivable.buffer(_KERB_M, quad_segs=4, join_style="mitre")
    mesh.ground(paved.intersection(edge), _RISE_M, "kerb")
    return mesh


def crosswalk(area: Polygon, heading_rad: float) -> Mesh:
    """Returns a crosswalk: asphalt with stripes along the heading of the road that it crosses."""
    mesh = Mesh()
    mesh.ground(area, 0.0, "asphalt")
    along = np.array([math.cos(heading_rad), math.sin(heading_rad)])
    left = np.array([-along[1], along[0]])
    corners = np.array(area.exterior.coords) - area.centroid.coords[0]
    reach, depth = np.abs(corners @ left).max(), np.abs(corners @ along).max()
    for at in np.arange(-reach + _STRIPE_M / 2, reach - _STRIPE_M / 2, 2 * _STRIPE_M):
        middle = area.centroid.coords[0] + (at + _STRIPE_M / 2) * left
        ends = [middle - depth * along, middle + depth * along]
        stripe = LineString(ends).buffer(_STRIPE_M / 2, cap_style="flat").intersection(area)
        mesh.ground(stripe, _RISE_M, "lane_mark")
    return mesh
