"""A fast rasteriser for depth, class and instance maps, in place of PyBullet's renderer.

Numba compiles it at the first call and caches the machine code. The module is imported only when
something is drawn.

A vertex becomes q = z · (u, v, 1): pixel coordinates times depth. In this frame the edges of a
triangle are planes through the camera, e_a = q_b × q_c, and pixel r = (u, v, 1) lies inside if
e_a · r ≥ 0 for all three. With d = q_a · e_a the inverse depth is (e_a + e_b + e_c) · r / d, affine
in u and v. This also holds for corners behind the camera, so nothing needs to be clipped.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrep.jit import compiled
from flowrep.simulator.meshes import Triangles

_LEAST_AREA_PX = 0.01  # twice the area below which PyBullet's renderer omits triangles

_compiled = compiled()


class Maps(NamedTuple):
    """Maps of N views, all [N, H, W]: inf, class 0 and instance 0 for pixels without a surface."""

    depth: NDArray[np.float32]  # metres along z
    semantic: NDArray[np.uint8]
    instance: NDArray[np.uint8]


class Rasteriser:
    """A camera for depth and ids; triangles are visible only from outside.

    Args:
        triangles: the bodies.
        K: intrinsics [3, 3] without skew; pixel (0, 0)'s centre is (0.5, 0.5).
        size: height and width in pixels.
        range_m: the nearest and the farthest visible depth.
    """

    def __init__(
        self,
        triangles: Triangles,
        K: NDArray[np.float64],
        size: tuple[int, int],
        range_m: tuple[float, float],
    ) -> None:
        """Compiles the drawing functions unless they are in the cache."""
        # Column i is sampled at u = i + 0.5.
        K_of_index = K - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
        self._world = (*triangles, K_of_index, *map(float, range_m))
        self._size = size
        moving = int(triangles.poses.max(initial=-1)) + 1
        nothing = np.empty((0, 4, 4)), np.empty((0, moving, 4, 4))
        self(*nothing, np.empty((0, len(triangles.semantic)), dtype=bool))

    def __call__(
        self,
        cam_from_world: NDArray[np.float64],
        world_from_body: NDArray[np.float64],
        is_shown: NDArray[np.bool_],
    ) -> Maps:
        """Returns N views of the same bodies at poses of their own.

        Args:
            cam_from_world: [N, 4, 4], with OpenCV camera axes.
            world_from_body: poses [N, M, 4, 4] of the M moving bodies.
            is_shown: which bodies are present, [N, B].
        """
        shape = (len(cam_from_world), *self._size)
        maps = Maps(*(np.empty(shape, kind) for kind in (np.float32, np.uint8, np.uint8)))
        _draw(*self._world, cam_from_world, world_from_body, is_shown, *maps)
        return maps


@_compiled
def _draw(
    points, corners, point_bounds, corner_bounds, centres, radii, bodies, poses, classes, instances,
    K, near_m, far_m, cam_from_world, world_from_body, is_shown, depth, semantic, instance,
):  # fmt: skip
    views, height, width = depth.shape
    planes = _side_planes(K, height, width)
    most = (point_bounds[1:] - point_bounds[:-1]).max() if len(bodies) else 0
    q = np.empty((most, 3))
    inverse = np.empty((height, width))
    body = np.empty((height, width), dtype=np.int32)
    into = np.empty((3, 4))
    for n in range(views):
        inverse[:] = 1.0 / far_m
        body[:] = -1
        for c in range(len(bodies)):
            if not is_shown[n, bodies[c]]:
                continue
            _compose(cam_from_world[n], world_from_body[n], poses[c], into)
            if _is_outside(into, centres[c], radii[c], planes, near_m, far_m):
                continue
            first = point_bounds[c]
            for i in range(first, point_bounds[c + 1]):
                _project(K, into, points[i], q[i - first])
            for t in range(corner_bounds[c], corner_bounds[c + 1]):
                a, b, d = corners[t, 0], corners[t, 1], corners[t, 2]
                _fill(q[a], q[b], q[d], near_m, far_m, bodies[c], inverse, body)
        _look_up(inverse, body, classes, instances, depth[n], semantic[n], instance[n])


@_compiled
def _side_planes(K, height, width):
    # Inward unit normals of the four planes through the outermost samples.
    planes = np.empty((4, 3))
    left, right = -K[0, 2] / K[0, 0], (width - 1 - K[0, 2]) / K[0, 0]
    top, bottom = -K[1, 2] / K[1, 1], (height - 1 - K[1, 2]) / K[1, 1]
    planes[0] = (1.0, 0.0, -left)
    planes[1] = (-1.0, 0.0, right)
    planes[2] = (0.0, 1.0, -top)
    planes[3] = (0.0, -1.0, bottom)
    for plane in planes:
        plane /= math.sqrt(plane[0] ** 2 + plane[1] ** 2 + plane[2] ** 2)
    return planes


@_compiled
def _compose(cam_from_world, world_from_body, pose, into):
    for i in range(3):
        for j in range(4):
            if pose < 0:
                into[i, j] = cam_from_world[i, j]
            else:
                into[i, j] = cam_from_world[i, 3] if j == 3 else 0.0
                for k in range(3):
                    into[i, j] += cam_from_world[i, k] * world_from_body[pose, k, j]


@_compiled
def _is_outside(cam_from_body, centre, radius, planes, near_m, far_m):
    x, y, z = _moved(cam_from_body, centre)
    is_outside = z + radius < near_m or z - radius > far_m
    for i in range(4):
        is_outside |= planes[i, 0] * x + planes[i, 1] * y + planes[i, 2] * z < -radius
    return is_outside


@_compiled
def _moved(m, p):
    return (
        m[0, 0] * p[0] + m[0, 1] * p[1] + m[0, 2] * p[2] + m[0, 3],
        m[1, 0] * p[0] + m[1, 1] * p[1] + m[1, 2] * p[2] + m[1, 3],
        m[2, 0] * p[0] + m[2, 1] * p[1] + m[2, 2] * p[2] + m[2, 3],
    )


@_compiled
def _project(K, cam_from_body, point, q):
    x, y, z = _moved(cam_from_body, point)
    q[0] = K[0, 0] * x + K[0, 2] * z
    q[1] = K[1, 1] * y + K[1, 2] * z
    q[2] = z


@_compiled
def _cross(p, q):
    return (p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0])


@_compiled
def _fill(p, q, r, near_m, far_m, number, inverse, body):
    """Draws the triangle with corners p, q, r, clockwise in an image whose y points down."""
    e, f, g = _cross(r, q), _cross(p, r), _cross(q, p)
    det = p[0] * e[0] + p[1] * e[1] + p[2] * e[2]
    if det <= 0.0:
        return  # facing away, or edge-on
    height, width = inverse.shape
    x0, x1, y0, y1 = 0.0, width - 1.0, 0.0, height - 1.0
    nearest = min(p[2], q[2], r[2])
    if nearest >= near_m:
        if det <= _LEAST_AREA_PX * (p[2] * q[2] * r[2]):
            return
        i, j, k = 1.0 / p[2], 1.0 / q[2], 1.0 / r[2]
        x0 = max(x0, math.ceil(min(p[0] * i, q[0] * j, r[0] * k)))
        x1 = min(x1, math.floor(max(p[0] * i, q[0] * j, r[0] * k)))
        y0 = max(y0, math.ceil(min(p[1] * i, q[1] * j, r[1] * k)))
        y1 = min(y1, math.floor(max(p[1] * i, q[1] * j, r[1] * k)))
    elif max(p[2], q[2], r[2]) < near_m:
        return
    if x0 > x1 or y0 > y1:
        return
    most = 1.0 / near_m
    dx, dy = (e[0] + f[0] + g[0]) / det, (e[1] + f[1] + g[1]) / det
    base = (e[2] + f[2] + g[2]) / det
    for y in range(int(y0), int(y1) + 1):
        low, high = x0, x1
        for edge in (e, f, g):
            rest = edge[1] * y + edge[2]
            if edge[0] > 0.0:
                low = max(low, math.ceil(-rest / edge[0]))
            elif edge[0] < 0.0:
                high = min(high, math.floor(-rest / edge[0]))
            elif rest < 0.0:
                high = -1.0
        if low > high:
            continue
        row = base + dy * y
        for x in range(int(low), int(high) + 1):
            w = row + dx * x
            if inverse[y, x] < w <= most:
                inverse[y, x] = w
                body[y, x] = number


@_compiled
def _look_up(inverse, body, classes, instances, depth, semantic, instance):
    height, width = body.shape
    for y in range(height):
        for x in range(width):
            number = body[y, x]
            if number < 0:
                depth[y, x], semantic[y, x], instance[y, x] = np.inf, 0, 0
            else:
                depth[y, x] = 1.0 / inverse[y, x]
                semantic[y, x], instance[y, x] = classes[number], instances[number]
