"""Low-polygon meshes of coloured triangles, and rigid bodies as arrays for the rasteriser."""

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from flowrep.scenes.layout import Box
from flowrep.scenes.pedestrians import HIP_M, PARTS
from flowrep.scenes.scene import Kind
from flowrep.simulator.paint import SHIRTS, Painted, Patch, front, painted, swatch, upper_storeys

Array = NDArray[np.float64]
# With smaller chunks there are more bounding spheres to test, with larger ones more triangles that
# are out of view are projected.
_CHUNK_TRIANGLES = 24


class Body(NamedTuple):
    """A rigid body of coloured triangles, with its ids in the maps."""

    corners: Array  # [T, 3, 3], metres, counter-clockwise seen from outside; in the body's
    # coordinates, those of the world if it is static
    paints: NDArray[np.int64]  # [T], see `paint.Patch`
    texels: Array  # [T, 3, 2], the corners' positions on a house front
    semantic: int
    instance: int  # 0 for the static world


class Triangles(NamedTuple):
    """All bodies, in C chunks, as arrays for the rasteriser."""

    points: NDArray[np.float64]  # [V, 3], in the coordinates of their bodies
    corners: NDArray[np.int32]  # [T, 3], indices among the points of the triangle's chunk
    point_bounds: NDArray[np.int32]  # [C + 1], chunk c has points bounds[c] to bounds[c + 1] - 1
    corner_bounds: NDArray[np.int32]  # [C + 1], the same for triangles
    centres: NDArray[np.float64]  # [C, 3], of the chunks' bounding spheres
    radii: NDArray[np.float64]  # [C]
    bodies: NDArray[np.int32]  # [C], the body of each chunk
    poses: NDArray[np.int32]  # [C], index among the moving bodies; -1 for the static world
    semantic: NDArray[np.uint8]  # [B], by body
    instance: NDArray[np.uint8]  # [B]
    look: Painted  # of the T triangles


def gather(bodies: Sequence[Body]) -> Triangles:
    """Returns the triangles of all bodies, numbered in the given order."""
    chunks = []
    movers = iter(range(len(bodies)))
    for number, body in enumerate(bodies):
        pose = next(movers) if body.instance else -1
        for chunk in _chunks(body.corners.mean(axis=1), np.arange(len(body.corners))):
            corners, paints, texels = body.corners[chunk], body.paints[chunk], body.texels[chunk]
            # Corners that triangles share are projected once.
            shared, inverse = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
            within = inverse.reshape(-1, 3).astype(np.int32)
            chunks.append((shared, within, corners, paints, texels, number, pose))
    points, indices, corners_m, paints_of_all, texels_of_all, owners, poses = zip(*chunks)
    semantic = np.array([body.semantic for body in bodies], dtype=np.uint8)
    instance = np.array([body.instance for body in bodies], dtype=np.uint8)
    of_triangle = np.repeat(owners, [len(each) for each in indices])
    # Bounding spheres about the middle of each chunk's box: not the least ones, but nearly.
    centres = [(chunk.min(axis=0) + chunk.max(axis=0)) / 2 for chunk in points]
    reaches = [np.linalg.norm(chunk - centre, axis=1) for chunk, centre in zip(points, centres)]
    look = np.concatenate(corners_m), np.concatenate(paints_of_all), np.concatenate(texels_of_all)
    return Triangles(
        points=np.concatenate(points),
        corners=np.concatenate(indices),
        point_bounds=np.cumsum([0, *map(len, points)], dtype=np.int32),
        corner_bounds=np.cumsum([0, *map(len, indices)], dtype=np.int32),
        centres=np.array(centres),
        radii=np.array([distances.max() for distances in reaches]),
        bodies=np.array(owners, dtype=np.int32),
        poses=np.array(poses, dtype=np.int32),
        semantic=semantic,
        instance=instance,
        look=painted(*look, semantic[of_triangle], instance[of_triangle]),
    )


def _chunks(middles: NDArray[np.float64], triangles: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Returns groups of neighbouring triangles; `middles` [T, 3] are the triangles' centres."""
    if len(triangles) <= _CHUNK_TRIANGLES:
        return [triangles]
    # Halved across the longest side, as a k-d tree is, so that bounding spheres stay small.
    extent = middles[triangles]
    order = np.argsort(extent[:, int(np.ptp(extent, axis=0).argmax())], kind="stable")
    half = len(order) // 2
    return [*_chunks(middles, triangles[order[:half]]), *_chunks(middles, triangles[order[half:]])]


Point3 = tuple[float, float, float]
_CELL_M = 15.0  # the ground is cut into cells, because small triangles are interpolated better
_DASH_M, _DASH_PERIOD_M, _DASH_WIDTH_M = 2.0, 6.0, 0.15  # of lane marks
_STRIPE_M = 0.5  # width of a crosswalk's stripes, and of the gaps between them
_KERB_M = 0.25  # width of kerbstones
_RISE_M = 0.004  # height of markings above the ground; at the same height the two would flicker


class Mesh:
    """Coloured triangles, counter-clockwise seen from outside."""

    def __init__(self) -> None:
        nothing = np.empty((0, 3, 3)), np.empty(0, dtype=np.int64), np.empty((0, 3, 2))
        self._parts: list[tuple[Array, NDArray[np.int64], Array]] = [nothing]

    @property
    def triangles(self) -> tuple[Array, NDArray[np.int64], Array]:
        """Corners [T, 3, 3] in metres, paints [T] and texels [T, 3, 2], see `Body`."""
        corners, paints, texels = map(np.concatenate, zip(*self._parts))
        return corners, paints, texels

    def scaled(self, factor: float) -> "Mesh":
        """Returns the mesh at `factor` times its size about the origin."""
        mesh = Mesh()
        mesh._parts = [
            (factor * corners, paints, texels) for corners, paints, texels in self._parts
        ]
        return mesh

    def polygon(self, corners: Array, patch: Patch, texels: Any = None) -> None:
        """Adds a flat convex polygon [M, 3], counter-clockwise seen from outside."""
        # A fan of triangles from the first corner, which is only right for convex polygons.
        fan = [(0, i, i + 1) for i in range(1, len(corners) - 1)]
        texels = np.zeros((len(corners), 2)) if texels is None else np.array(texels)
        self._parts.append((corners[fan], np.full(len(fan), patch.paint), texels[fan]))

    def quad(self, corners: Array, patch: Patch) -> None:
        """Adds a rectangle: bottom left, bottom right, top right, top left, seen from outside."""
        _, u0, v0, u1, v1 = patch
        self.polygon(corners, patch, [[u0, v1], [u1, v1], [u1, v0], [u0, v0]])

    def box(self, low: Point3, high: Point3, side: Patch, *, lid: bool = True) -> None:
        """Adds a box without its floor, and without its top unless `lid`."""
        self.walls(low, high, (side,) * 4)
        if lid:
            (x0, y0, _), (x1, y1, z) = low, high
            self.quad(np.array([(x0, y0, z), (x1, y0, z), (x1, y1, z), (x0, y1, z)]), side)

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
        self, low: Array, high: Array, side: Patch, lid: Patch, *, floor: Patch | None = None
    ) -> None:
        """Adds the sides and top between two level rings [M, 3], counter-clockwise from above."""
        for corners in zip(low, np.roll(low, -1, axis=0), np.roll(high, -1, axis=0), high):
            self.quad(np.array(corners), side)
        self.polygon(high, lid)
        if floor is not None:
            self.polygon(low[::-1], floor)

    def disc(self, centre: Point3, normal: Point3, radius_m: float, patch: Patch) -> None:
        """Adds an upright octagonal disc, visible from the side its normal points to."""
        across = np.array([-normal[1], normal[0], 0.0])
        angles = np.arange(8) * (math.pi / 4)
        rim = np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * np.array([0.0, 0.0, 1.0])
        self.polygon(np.array(centre) + radius_m * rim, patch)

    def ground(self, area: shapely.Geometry, height_m: float, paint: str) -> None:
        """Adds an area of the ground plan as a level surface, cut into cells."""
        if area.is_empty:
            return
        x0, y0, x1, y1 = area.bounds
        # A constrained triangulation, so that holes and inward corners of the area stay open.
        for x in np.arange(x0, x1, _CELL_M):
            for y in np.arange(y0, y1, _CELL_M):
                cell = shapely.intersection(area, shapely.box(x, y, x + _CELL_M, y + _CELL_M))
                for triangle in shapely.constrained_delaunay_triangles(cell).geoms:
                    ring = shapely.geometry.polygon.orient(triangle).exterior.coords[:3]
                    self.polygon(np.array([(u, v, height_m) for u, v in ring]), swatch(paint))

    def move(self, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Turns the mesh and moves it on the ground."""
        sine, cosine = math.sin(yaw_rad), math.cos(yaw_rad)
        turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
        corners, *look = self.triangles
        self._parts = [(corners @ turn.T + [x_m, y_m, 0.0], *look)]

    def add(self, other: "Mesh") -> None:
        """Adds another mesh's triangles."""
        self._parts += other._parts


def lane_marks(line: shapely.LineString, clear_of: shapely.Geometry) -> Mesh:
    """Returns dashes along a centreline, except where they would touch `clear_of`."""
    mesh = Mesh()
    for at in np.arange(0.0, line.length - _DASH_M, _DASH_PERIOD_M):
        dash = shapely.ops.substring(line, at, at + _DASH_M)
        if not dash.intersects(clear_of):
            area = dash.buffer(_DASH_WIDTH_M / 2, cap_style="flat")
            mesh.ground(area, _RISE_M, "lane_mark")
    return mesh


def kerb(drivable: shapely.Geometry, paved: shapely.Geometry) -> Mesh:
    """Returns the kerbstones along the edge of a sidewalk."""
    # The paving continues below them. The renderer omits thin triangles in the distance, and the
    # paving, which has the same category, shows instead.
    mesh = Mesh()
    edge = drivable.buffer(_KERB_M, quad_segs=4, join_style="mitre")
    mesh.ground(paved.intersection(edge), _RISE_M, "kerb")
    return mesh


def crosswalk(area: shapely.Polygon, heading_rad: float) -> Mesh:
    """Returns asphalt with stripes along the heading of the road that is crossed."""
    mesh = Mesh()
    mesh.ground(area, 0.0, "asphalt")
    along = np.array([math.cos(heading_rad), math.sin(heading_rad)])
    left = np.array([-along[1], along[0]])
    # Half the crosswalk's width across the road, and half its depth along it.
    corners = np.array(area.exterior.coords) - area.centroid.coords[0]
    reach, depth = np.abs(corners @ left).max(), np.abs(corners @ along).max()
    for at in np.arange(-reach + _STRIPE_M / 2, reach - _STRIPE_M / 2, 2 * _STRIPE_M):
        middle = area.centroid.coords[0] + (at + _STRIPE_M / 2) * left
        ends = [middle - depth * along, middle + depth * along]
        stripe = shapely.LineString(ends).buffer(_STRIPE_M / 2, cap_style="flat").intersection(area)
        mesh.ground(stripe, _RISE_M, "lane_mark")
    return mesh


_CAR_PAINTS = ("car_body", "car_red", "car_white", "car_grey")
_CROWN_SIDES = 6


def mesh_of(box: Box, *, both_sides: bool = False) -> Mesh:
    """Returns the mesh for a box; with `both_sides` a house has a front on its left too."""
    mesh, (length, width, height) = Mesh(), box.size_m
    if box.kind == "house":
        # What a street shows of a house: the front, on the box's right, and the sides. Never the
        # roof.
        windows, side = front(box.variant), upper_storeys(box.variant)
        sides = (windows, side, windows if both_sides else None, side)
        mesh.walls((-length / 2, -width / 2, 0.0), (length / 2, width / 2, height), sides)
    else:
        _SHAPES[box.kind](mesh, length / 2, width / 2, height, box.variant)
    mesh.move(box.x_m, box.y_m, box.yaw_rad)
    return mesh


# Shapes of the kinds of obstacles, facing along x. `x` and `y` are half of the length and width of
# the box that a vehicle can hit. Other numbers are proportions or metres, chosen by eye. Crowns,
# arms and lamps may extend beyond the box, because nothing on the ground can touch them.


def _car(mesh: Mesh, x: float, y: float, height: float, variant: int) -> None:
    paint, belt = swatch(_CAR_PAINTS[variant % 4]), 0.6 * height
    mesh.box((-x, -y, 0.28), (x, y, belt), paint)
    # The underside, between the wheels, in the colour of shade.
    mesh.box((-0.9 * x, -0.8 * y, 0.0), (0.9 * x, 0.8 * y, 0.28), swatch("tyre"), lid=False)
    sill = _rectangle(-0.68 * x, 0.46 * x, 0.94 * y, belt)
    roof = _rectangle(-0.52 * x, 0.14 * x, 0.76 * y, height)
    mesh.frustum(sill, roof, swatch("glass"), paint)
    for side in (-1, 1):
        for axle in (-0.62 * x, 0.62 * x):
            mesh.disc((axle, side * (y + 0.01), 0.33), (0.0, side, 0.0), 0.33, swatch("tyre"))
            mesh.disc((axle, side * (y + 0.02), 0.33), (0.0, side, 0.0), 0.16, swatch("metal"))
        for name, at, ahead in (("lamp_white", x + 0.01, 1.0), ("lamp_red", -x - 0.01, -1.0)):
            mesh.disc((at, side * 0.72 * y, 0.5 * height), (ahead, 0.0, 0.0), 0.12, swatch(name))


def _tree(mesh: Mesh, x: float, y: float, height: float, variant: int) -> None:
    is_fir = variant % 3 == 2
    below = 0.28 * height if is_fir else 0.42 * height
    mesh.box((-x, -y, 0.0), (x, y, below), swatch("wood"), lid=False)
    leaf = swatch("leaf" if is_fir or variant % 2 else "leaf_light")
    reach = (0.2 if is_fir else 0.27) * height
    # Frustums: lower and upper end as shares of the height, radii as shares of `reach`.
    if is_fir:
        tiers = ((0.28, 0.6, 1.0, 0.4), (0.5, 0.82, 0.75, 0.25), (0.72, 1.0, 0.5, 0.0))
    else:
        tiers = ((0.38, 0.56, 0.55, 1.0), (0.56, 0.8, 1.0, 0.85), (0.8, 1.0, 0.85, 0.3))
    for low, high, bottom, top in tiers:
        lower = _ring(_CROWN_SIDES, reach * bottom, low * height)
        upper = _ring(_CROWN_SIDES, reach * max(top, 0.02), high * height)
        mesh.frustum(lower, upper, leaf, leaf, floor=leaf)


def _fence(mesh: Mesh, x: float, y: float, height: float, variant: int) -> None:
    wood = swatch("wood")
    for at in (-x + 0.06, x - 0.06):
        mesh.box((at - 0.06, -y, 0.0), (at + 0.06, y, height), wood)
    for low, high in ((0.3, 0.5), (0.72, 0.92)):
        rail = (-x, -y / 2, low * height), (x, y / 2, high * height)
        mesh.walls(*rail, (wood, None, wood, None))


def _traffic_light(mesh: Mesh, x: float, y: float, height: float, variant: int) -> None:
    head_m, reach = 0.95, 0.17
    mesh.box((-x, -y, 0.0), (x, y, height - head_m), swatch("metal"), lid=False)
    mesh.box((-reach, -reach, height - head_m), (reach, reach, height), swatch("tyre"))
    # The lowest lamp is lit; those who drive along x see it.
    for name, share in (("lamp_off", 0.83), ("lamp_off", 0.5), ("lamp_green", 0.17)):
        centre = (-reach - 0.01, 0.0, height - head_m * (1 - share))
        mesh.disc(centre, (-1.0, 0.0, 0.0), 0.12, swatch(name))


def _lamp_post(mesh: Mesh, x: float, y: float, height: float, variant: int) -> None:
    metal = swatch("metal")
    mesh.box((-x, -y, 0.0), (x, y, height), metal, lid=False)
    # An arm to the left, over the road.
    mesh.box((-0.05, 0.0, height - 0.12), (0.05, 1.2, height), metal)
    mesh.box((-0.14, 0.8, height - 0.24), (0.14, 1.5, height - 0.12), swatch("lamp_white"))


_SHAPES: dict[Kind, Callable[[Mesh, float, float, float, int], None]] = {
    "tree": _tree,
    "fence": _fence,
    "car": _car,
    "traffic_light": _traffic_light,
    "lamp_post": _lamp_post,
}


def _rectangle(x0: float, x1: float, y: float, z: float) -> Array:
    return np.array([(x0, -y, z), (x1, -y, z), (x1, y, z), (x0, y, z)])


def _ring(sides: int, radius_m: float, z: float) -> Array:
    angles = np.arange(sides) * (2 * math.pi / sides)
    x, y = radius_m * np.cos(angles), radius_m * np.sin(angles)
    return np.stack([x, y, np.full(sides, z)], axis=-1)


def person_meshes(variant: int, size: float) -> tuple[Mesh, ...]:
    """Returns the meshes of a person's `PARTS`, facing along x; the origin of a leg is its hip.

    They stand in the cylinder that collides, whose size is in `flowrep.scenes.pedestrians`.
    """
    shirt, skin = swatch(SHIRTS[variant % len(SHIRTS)]), swatch("skin")
    body = Mesh()
    # One arm swings forward, one back. Seen from the side, as people who cross the street are, the
    # arms span 0.6 m, the diameter of the collision cylinder.
    for y, arm in ((-0.26, 0.19), (0.26, -0.19)):
        body.box((arm - 0.11, y - 0.05, 0.95), (arm + 0.11, y + 0.05, 1.35), shirt)
        body.box((arm - 0.05, y - 0.05, 0.85), (arm + 0.11, y + 0.05, 0.95), skin, lid=False)
    body.box((-0.14, -0.21, 0.8), (0.14, 0.21, 1.47), shirt)
    body.box((-0.11, -0.1, 1.47), (0.12, 0.1, 1.68), skin, lid=False)
    body.box((-0.13, -0.11, 1.62), (0.12, 0.11, 1.75), swatch("hair"))
    legs = []
    for _ in PARTS[1:]:
        leg = Mesh()
        leg.box((-0.1, -0.08, -HIP_M + 0.1), (0.1, 0.08, 0.02), swatch("trousers"), lid=False)
        leg.box((-0.1, -0.08, -HIP_M), (0.2, 0.08, -HIP_M + 0.1), swatch("shoe"))
        legs.append(leg)
    return tuple(mesh.scaled(size) for mesh in (body, *legs))
