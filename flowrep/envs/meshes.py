"""Low-polygon shapes as flat-shaded triangles with a colour each, and the scene's own shapes."""

import math
from collections.abc import Sequence

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely.geometry import LineString
from shapely.geometry.base import BaseGeometry

from flowrep.envs.layout import Box
from flowrep.envs.paint import SHIRTS, Patch, front, swatch, wall

Array = NDArray[np.float64]
Point3 = tuple[float, float, float]
PEDESTRIAN_RADIUS_M = 0.3
PEDESTRIAN_HEIGHT_M = 1.75
_CELL_M = 15.0  # ground is cut into cells: the renderer interpolates short triangles better
_DASH_M, _DASH_PERIOD_M, _DASH_WIDTH_M, _DASH_RISE_M = 2.0, 6.0, 0.15, 0.004


class Mesh:
    """Triangles with normals and texture coordinates, in the order that PyBullet wants them."""

    def __init__(self) -> None:
        """Starts without triangles."""
        self.vertices: list[list[float]] = []
        self.normals: list[list[float]] = []
        self.uvs: list[list[float]] = []
        self.indices: list[int] = []

    def polygon(self, corners: Array, uvs: list[list[float]]) -> None:
        """Adds a flat convex polygon [M, 3], counter-clockwise seen from outside."""
        normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
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
        """Adds a box without its floor, and without its lid unless asked for."""
        self.walls(low, high, (side,) * 4)
        if lid:
            (x0, y0, _), (x1, y1, z1) = low, high
            ring = [(x0, y0, z1), (x1, y0, z1), (x1, y1, z1), (x0, y1, z1)]
            self.quad(np.array(ring), side)

    def walls(self, low: Point3, high: Point3, sides: Sequence[Patch | None]) -> None:
        """Adds the upright faces of a box that have a patch: -y, +x, +y, -x."""
        (x0, y0, z0), (x1, y1, z1) = low, high
        ring = [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
        for i, patch in enumerate(sides):
            if patch is not None:
                (ax, ay), (bx, by) = ring[i], ring[(i + 1) % 4]
                corners = [(ax, ay, z0), (bx, by, z0), (bx, by, z1), (ax, ay, z1)]
                self.quad(np.array(corners), patch)

    def ground(self, area: BaseGeometry, height_m: float, paint: str) -> None:
        """Adds an area of the plan, level, cut into cells."""
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


def pedestrian_mesh(variant: int) -> Mesh:
    """Returns a person in mid-stride along x; `variant` chooses the shirt.

    Seen from the side, as the vehicle sees who crosses, stride and swinging arms are what there is
    to see: a person is some 0.6 m wide from there.
    """
    mesh = Mesh()
    shirt = swatch(SHIRTS[variant % len(SHIRTS)])
    for side, step in ((-1, 1), (1, -1)):
        leg, arm = 0.15 * step, -0.19 * step
        y = 0.1 * side
        low, high = (leg - 0.13, y - 0.08, 0.0), (leg + 0.13, y + 0.08, 0.82)
        mesh.box(low, high, swatch("trousers"), lid=False)
        y = 0.26 * side
        mesh.box((arm - 0.11, y - 0.05, 0.85), (arm + 0.11, y + 0.05, 1.35), shirt)
    mesh.box((-0.16, -0.21, 0.8), (0.16, 0.21, 1.47), shirt)
    mesh.box((-0.11, -0.1, 1.47), (0.12, 0.1, 1.75), swatch("skin"))
    return mesh


def house_mesh(box: Box, *, both_sides: bool = False) -> Mesh:
    """Returns what a street shows of a house: a front of windows to its right, its side walls.

    With `both_sides` there is a front to its left too. No one looks at its roof.
    """
    length, width, height = box.size_m
    windows, plain = front(box.variant), wall(box.variant)
    sides = (windows, plain, windows if both_sides else None, plain)
    mesh = Mesh()
    mesh.walls((-length / 2, -width / 2, 0.0), (length / 2, width / 2, height), sides)
    return mesh.moved(box.x_m, box.y_m, box.yaw_rad)


def obstacle_mesh(box: Box) -> Mesh:
    """Returns a plain box painted as its category is."""
    paints = {
        "house": "roof",
        "tree": "leaf",
        "fence": "wood",
        "car": "car_body",
        "traffic_light": "metal",
    }
    length, width, height = box.size_m
    mesh = Mesh()
    low, high = (-length / 2, -width / 2, 0.0), (length / 2, width / 2, height)
    mesh.box(low, high, swatch(paints.get(box.kind, "metal")))
    return mesh.moved(box.x_m, box.y_m, box.yaw_rad)


def lane_marks(line: LineString) -> Mesh:
    """Returns dashes along the middle of a road, a hair above it."""
    mesh = Mesh()
    for at in np.arange(0.0, line.length - _DASH_M, _DASH_PERIOD_M):
        dash = shapely.ops.substring(line, at, at + _DASH_M)
        mesh.ground(dash.buffer(_DASH_WIDTH_M / 2, cap_style="flat"), _DASH_RISE_M, "lane_mark")
    return mesh
