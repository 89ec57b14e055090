"""Low-polygon meshes of roadside objects: cars, trees, fences, lights, lamp posts, houses.

A box covers only the part that can be hit; crowns, arms and lamp heads may extend above it.
"""

import math
from collections.abc import Callable

import numpy as np

from flowrep.scenes.layout import Box
from flowrep.scenes.scene import Kind
from flowrep.simulator.meshes import Mesh
from flowrep.simulator.paint import front, swatch, upper_storeys

_CAR_PAINTS = ("car_body", "car_red", "car_white", "car_grey")
_CROWN_SIDES = 6


def mesh_of(box: Box, *, both_sides: bool = False) -> Mesh:
    """Returns the mesh for a box; with `both_sides` a house has two fronts."""
    mesh = house(box, both_sides=both_sides) if box.kind == "house" else _SHAPES[box.kind](box)
    return mesh.moved(box.x_m, box.y_m, box.yaw_rad)


def house(box: Box, *, both_sides: bool = False) -> Mesh:
    """Returns the walls of a house visible from a street: a front on its right, and the sides.

    With `both_sides` it has a front on its left too. Roofs are never visible and are left out.
    """
    length, width, height = box.size_m
    windows, side = front(box.variant), upper_storeys(box.variant)
    sides = (windows, side, windows if both_sides else None, side)
    mesh = Mesh()
    mesh.walls((-length / 2, -width / 2, 0.0), (length / 2, width / 2, height), sides)
    return mesh


def car(box: Box) -> Mesh:
    """Returns a car facing along x: body, windows all around, roof, wheels, lights."""
    (length, width, height), paint = box.size_m, swatch(_CAR_PAINTS[box.variant % 4])
    x, y = length / 2, width / 2
    belt = 0.6 * height
    mesh = Mesh()
    mesh.box((-x, -y, 0.28), (x, y, belt), paint)
    # The underside, in the shade.
    mesh.walls((-0.9 * x, -0.8 * y, 0.0), (0.9 * x, 0.8 * y, 0.28), (swatch("tyre"),) * 4)
    sill = _rectangle(-0.68 * x, 0.46 * x, 0.94 * y)
    roof = _rectangle(-0.52 * x, 0.14 * x, 0.76 * y)
    mesh.frustum(sill, belt, roof, height, swatch("glass"), paint)
    for side in (-1, 1):
        for axle in (-0.62 * x, 0.62 * x):
            mesh.disc((axle, side * (y + 0.01), 0.33), (0.0, side, 0.0), 0.33, swatch("tyre"))
            mesh.disc((axle, side * (y + 0.02), 0.33), (0.0, side, 0.0), 0.16, swatch("metal"))
        lamps = (("lamp_white", x + 0.01, 1.0), ("lamp_red", -x - 0.01, -1.0))
        for name, at, ahead in lamps:
            mesh.disc((at, side * 0.72 * y, 0.5 * height), (ahead, 0.0, 0.0), 0.12, swatch(name))
    return mesh


def tree(box: Box) -> Mesh:
    """Returns a trunk with a crown in proportion to its height, either broad or a fir's."""
    length, width, height = box.size_m
    mesh = Mesh()
    is_fir = box.variant % 3 == 2
    below = 0.28 * height if is_fir else 0.42 * height
    sides = (swatch("wood"),) * 4
    mesh.walls((-length / 2, -width / 2, 0.0), (length / 2, width / 2, below), sides)
    leaf = swatch("leaf" if is_fir or box.variant % 2 else "leaf_light")
    reach = (0.2 if is_fir else 0.27) * height
    if is_fir:
        tiers = ((0.28, 0.6, 1.0, 0.4), (0.5, 0.82, 0.75, 0.25), (0.72, 1.0, 0.5, 0.0))
    else:
        tiers = ((0.38, 0.56, 0.55, 1.0), (0.56, 0.8, 1.0, 0.85), (0.8, 1.0, 0.85, 0.3))
    for low, high, bottom, top in tiers:
        ring, upper = (_ring(_CROWN_SIDES, reach * share) for share in (bottom, max(top, 0.02)))
        mesh.frustum(ring, low * height, upper, high * height, leaf, leaf, floor=leaf)
    return mesh


def fence(box: Box) -> Mesh:
    """Returns a stretch of fence along x: a post at either end and two rails."""
    length, width, height = box.size_m
    paint, x, y = swatch("wood"), length / 2, width / 2
    mesh = Mesh()
    for at in (-x + 0.06, x - 0.06):
        mesh.box((at - 0.06, -y, 0.0), (at + 0.06, y, height), paint)
    for low, high in ((0.3, 0.5), (0.72, 0.92)):
        mesh.walls(
            (-x, -y / 2, low * height), (x, y / 2, high * height), (paint, None, paint, None)
        )
    return mesh


def traffic_light(box: Box) -> Mesh:
    """Returns a post with a head of three lamps, the lowest lit, facing traffic along x."""
    length, width, height = box.size_m
    head_m, reach = 0.95, 0.17
    mesh = Mesh()
    post = (swatch("metal"),) * 4
    mesh.walls((-length / 2, -width / 2, 0.0), (length / 2, width / 2, height - head_m), post)
    mesh.box((-reach, -reach, height - head_m), (reach, reach, height), swatch("tyre"))
    for name, share in (("lamp_off", 0.83), ("lamp_off", 0.5), ("lamp_green", 0.17)):
        centre = (-reach - 0.01, 0.0, height - head_m * (1 - share))
        mesh.disc(centre, (-1.0, 0.0, 0.0), 0.12, swatch(name))
    return mesh


def lamp_post(box: Box) -> Mesh:
    """Returns a post with a lamp on an arm to its left, over the road."""
    length, width, height = box.size_m
    metal = swatch("metal")
    mesh = Mesh()
    mesh.walls((-length / 2, -width / 2, 0.0), (length / 2, width / 2, height), (metal,) * 4)
    mesh.box((-0.05, 0.0, height - 0.12), (0.05, 1.2, height), metal)
    mesh.box((-0.14, 0.8, height - 0.24), (0.14, 1.5, height - 0.12), swatch("lamp_white"))
    return mesh


_SHAPES: dict[Kind, Callable[[Box], Mesh]] = {
    "tree": tree,
    "fence": fence,
    "car": car,
    "traffic_light": traffic_light,
    "lamp_post": lamp_post,
}


def _rectangle(x0: float, x1: float, y: float) -> np.ndarray:
    return np.array([(x0, -y), (x1, -y), (x1, y), (x0, y)])


def _ring(sides: int, radius_m: float) -> np.ndarray:
    angles = np.arange(sides) * (2 * math.pi / sides)
    return radius_m * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
