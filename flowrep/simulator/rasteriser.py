"""A rasteriser for depth, class, instance and colour maps, ten times as fast as PyBullet's.

It uses edge functions in homogeneous coordinates (Olano and Greer, 1997). A corner becomes q = z ·
(u, v, 1), pixel coordinates times depth. In these coordinates, an edge of a triangle with corners
a, b, c is a plane through the camera, e_a = q_b × q_c, and the triangle covers the pixel r = (u, v,
1) if e_a · r, e_b · r and e_c · r are all ≥ 0. With d = q_a · e_a, the inverse depth at r is (e_a +
e_b + e_c) · r / d, which is affine in u and v. All of this also holds for corners behind the
camera, so no triangle has to be clipped.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from flowrep.extras import compiled
from flowrep.simulator import paint
from flowrep.simulator.meshes import Triangles
from flowrep.simulator.paint import AMBIENT, DIFFUSE, FRONT_SIZE, GRAIN_SIZE, LIGHT, SKY

_LEAST_AREA_PX = 0.01  # twice the area below which PyBullet's renderer omits triangles
_GRAIN_LEVELS = GRAIN_SIZE.bit_length() - 1
_FRONT_LEVELS = FRONT_SIZE.bit_length()
_NO_TABLES = np.empty((0, 0, 2), np.float32), np.empty((0, 0, 0, 3), np.float32)


# numpy's error model saves a branch at each division, a tenth of the time of large scenes. fastmath
# is used for colours alone: it reorders sums, but maps must not depend on the compiler.
_compiled = compiled(error_model="numpy")
_shading = compiled(error_model="numpy", fastmath=True)
_inlined = compiled(error_model="numpy", fastmath=True, inline="always")


class Rendered(NamedTuple):
    """Maps of N views [N, H, W]; a pixel without a surface has depth inf, class 0, instance 0."""

    depth: NDArray[np.float32]  # metres along z
    semantic: NDArray[np.uint8]
    instance: NDArray[np.uint8]
    rgb: NDArray[np.uint8]  # [N, 3, H, W], or [0, 3, H, W] where none was asked for


class Rasteriser:
    """A camera for depth, ids and colours; triangles are visible only from outside."""

    def __init__(
        self,
        triangles: Triangles,
        K: NDArray[np.float64],  # [3, 3], without skew
        size: tuple[int, int],  # height, width
        range_m: tuple[float, float],  # of the visible depths
    ) -> None:
        # Kernels use pixel indices as coordinates, but column i is sampled at u = i + 0.5.
        K_of_index = K - np.array([[0.0, 0.0, 0.5], [0.0, 0.0, 0.5], [0.0, 0.0, 0.0]])
        shape = triangles[: triangles._fields.index("poses") + 1]
        # A pixel stores its triangle, so classes, instances and poses are looked up by triangle.
        counts = np.diff(triangles.corner_bounds)
        owners, poses = np.repeat(triangles.bodies, counts), np.repeat(triangles.poses, counts)
        ids = triangles.semantic[owners], triangles.instance[owners]
        self._world = (*shape, *ids, K_of_index, *map(float, range_m))
        self._look = poses, *triangles.look
        self._size = size
        moving = int(triangles.poses.max(initial=-1)) + 1
        nothing = np.empty((0, 4, 4)), np.empty((0, moving, 4, 4))
        self(*nothing, np.empty((0, len(triangles.semantic)), dtype=bool))  # compiles or loads

    def __call__(
        self,
        cam_from_world: NDArray[np.float64],  # [N, 4, 4], with OpenCV camera axes
        world_from_body: NDArray[np.float64],  # [N, M, 4, 4], of the M moving bodies
        is_shown: NDArray[np.bool_],  # [N, B]
        *,
        rgb: bool = False,
    ) -> Rendered:
        """Returns N views of the same bodies, each with its own poses."""
        # Tables of 4 MB are made when colours are first drawn.
        look = *self._look, *((paint.grain(), paint.front_levels()) if rgb else _NO_TABLES)
        views = len(cam_from_world)
        depth = np.empty((views, *self._size), np.float32)
        semantic, instance = (np.empty(depth.shape, np.uint8) for _ in range(2))
        colours = np.empty((views if rgb else 0, 3, *self._size), np.uint8)
        maps = Rendered(depth, semantic, instance, colours)
        _draw(*self._world, look, cam_from_world, world_from_body, is_shown, *maps)
        return maps


@_compiled
def _draw(
    points, corners, point_bounds, corner_bounds, centres, radii, bodies, poses, classes, instances,
    K, near_m, far_m, look, cam_from_world, world_from_body, is_shown,
    depth, semantic, instance, rgb,
):  # fmt: skip
    # `Triangles`, `Rasteriser.__call__` and `Rendered` describe the arrays and shapes. `inverse`
    # [H, W] is a z-buffer of inverse depths (larger is nearer), which starts at the far plane.
    # `number` [H, W] is the triangle that a pixel shows, at first -1, the sky. Each triangle takes
    # the pixels where it is nearer. Ids and colours are looked up once, after all triangles.
    views, height, width = depth.shape
    planes = _side_planes(K, height, width)
    most = (point_bounds[1:] - point_bounds[:-1]).max()
    q = np.empty((most, 3))
    inverse = np.empty((height, width))
    number = np.empty((height, width), dtype=np.int32)
    into = np.empty((3, 4))  # cam_from_body of the current chunk
    for n in range(views):
        inverse[:] = 1.0 / far_m
        number[:] = -1
        for c in range(len(bodies)):
            if not is_shown[n, bodies[c]]:
                continue
            _compose(cam_from_world[n], world_from_body[n], poses[c], into)
            # Most chunks (up to 24 triangles) are out of view, which their bounding sphere shows.
            if _is_outside(into, centres[c], radii[c], planes, near_m, far_m):
                continue
            first = point_bounds[c]
            for i in range(first, point_bounds[c + 1]):
                _project(K, into, points[i], q[i - first])
            for t in range(corner_bounds[c], corner_bounds[c + 1]):
                a, b, d = corners[t, 0], corners[t, 1], corners[t, 2]
                _fill(q[a], q[b], q[d], near_m, far_m, t, inverse, number)
        _look_up(inverse, number, classes, instances, depth[n], semantic[n], instance[n])
        if len(rgb):
            _shade(inverse, number, K, cam_from_world[n], world_from_body[n], look, rgb[n])


@_compiled
def _side_planes(K, height, width):
    # Inward unit normals [4, 3] of the planes through the camera and the outermost samples: columns
    # 0 and width - 1 (where x / z is `left` and `right`) and rows 0 and height - 1.
    left, right = -K[0, 2] / K[0, 0], (width - 1 - K[0, 2]) / K[0, 0]
    top, bottom = -K[1, 2] / K[1, 1], (height - 1 - K[1, 2]) / K[1, 1]
    sides = [[1.0, 0.0, -left], [-1.0, 0.0, right], [0.0, 1.0, -top], [0.0, -1.0, bottom]]
    planes = np.array(sides)
    for plane in planes:
        plane /= math.sqrt(plane[0] ** 2 + plane[1] ** 2 + plane[2] ** 2)
    return planes


@_compiled
def _compose(cam_from_world, world_from_body, pose, into):
    # Writes cam_from_body [3, 4]; pose -1 is the static world, whose points are in world axes.
    # Written out, because numba's `@` calls scipy's BLAS, and streets don't need scipy otherwise.
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
    # q = z · (u, v, 1), without a division; K has no skew.
    x, y, z = _moved(cam_from_body, point)
    q[0] = K[0, 0] * x + K[0, 2] * z
    q[1] = K[1, 1] * y + K[1, 2] * z
    q[2] = z


@_compiled
def _cross(p, q):
    return (p[1] * q[2] - p[2] * q[1], p[2] * q[0] - p[0] * q[2], p[0] * q[1] - p[1] * q[0])


@_compiled
def _fill(p, q, r, near_m, far_m, triangle, inverse, number):
    # p, q and r [3] are the corners z · (u, v, 1). e, f and g [3] are the edge functions: the
    # planes through the camera and the edges opposite p, q and r. Seen from outside, corners are
    # counter-clockwise, but v points downwards, so they are clockwise in (u, v). Therefore r × q
    # and not q × r: visible triangles then have det > 0 and positive edge functions inside.
    e, f, g = _cross(r, q), _cross(p, r), _cross(q, p)
    det = p[0] * e[0] + p[1] * e[1] + p[2] * e[2]
    if det <= 0.0:
        return  # the triangle faces away or is seen edge-on
    height, width = inverse.shape
    # The range of pixels to visit: the bounding box of the corners, if all are beyond the near
    # plane. A corner behind the camera has no pixel; then it is the whole picture.
    x0, x1, y0, y1 = 0.0, width - 1.0, 0.0, height - 1.0
    nearest = min(p[2], q[2], r[2])
    if nearest >= near_m:
        # det / (z_p z_q z_r) is twice the area of the triangle in pixels.
        if det <= _LEAST_AREA_PX * (p[2] * q[2] * r[2]):
            return
        i, j, k = 1.0 / p[2], 1.0 / q[2], 1.0 / r[2]
        x0 = max(x0, math.ceil(min(p[0] * i, q[0] * j, r[0] * k)))
        x1 = min(x1, math.floor(max(p[0] * i, q[0] * j, r[0] * k)))
        y0 = max(y0, math.ceil(min(p[1] * i, q[1] * j, r[1] * k)))
        y1 = min(y1, math.floor(max(p[1] * i, q[1] * j, r[1] * k)))
    elif max(p[2], q[2], r[2]) < near_m:
        return  # the whole triangle is nearer than the near plane
    if x0 > x1 or y0 > y1:
        return
    most = 1.0 / near_m
    # Inverse depth at pixel (x, y) is base + dx · x + dy · y.
    dx, dy = (e[0] + f[0] + g[0]) / det, (e[1] + f[1] + g[1]) / det
    base = (e[2] + f[2] + g[2]) / det
    for y in range(int(y0), int(y1) + 1):
        # Find the columns low to high in which all three edge functions e_x · x + rest are >= 0. By
        # the sign of e_x, an edge bounds them on the left or on the right. This way, pixels need no
        # test of their own.
        low, high = x0, x1
        for edge in (e, f, g):
            rest = edge[1] * y + edge[2]
            if edge[0] > 0.0:
                low = max(low, math.ceil(-rest / edge[0]))
            elif edge[0] < 0.0:
                high = min(high, math.floor(-rest / edge[0]))
            elif rest < 0.0:  # the edge is horizontal, and the row lies outside of it
                high = -1.0
        if low > high:
            continue
        row = base + dy * y
        for x in range(int(low), int(high) + 1):
            w = row + dx * x
            # Draw the pixel if it is nearer than the surface there (at first, the far plane), but
            # not nearer than the near plane.
            if inverse[y, x] < w <= most:
                inverse[y, x] = w
                number[y, x] = triangle


@_compiled
def _look_up(inverse, number, classes, instances, depth, semantic, instance):
    height, width = number.shape
    for y in range(height):
        for x in range(width):
            t = number[y, x]
            if t < 0:
                depth[y, x], semantic[y, x], instance[y, x] = np.inf, 0, 0
            else:
                depth[y, x] = 1.0 / inverse[y, x]
                semantic[y, x], instance[y, x] = classes[t], instances[t]


@_shading
def _shade(inverse, number, K, cam_from_world, world_from_body, look, rgb):
    # Colours are paint times grain times light, filtered to the size of a pixel. A row consists of
    # runs of pixels of one triangle. For each run, `_find_texels` first computes all texel
    # positions: in a separate loop, because the look-ups afterwards can't use vector instructions.
    poses, normals, colours, contrast, grain_axes, front_of, front_axes, grain, fronts = look
    height, width = number.shape
    moving = len(world_from_body)
    cam_from_body = np.empty((moving + 1, 3, 4))  # the last one is cam_from_world, for pose -1
    for k in range(-1, moving):
        _compose(cam_from_world, world_from_body, k, cam_from_body[k])
    lx, ly, lz = _turned(cam_from_body, -1, LIGHT[0], LIGHT[1], LIGHT[2])
    axes = np.empty((2, 4))
    texels = np.empty((3, width), dtype=np.float32)
    us, vs, levels = texels[0], texels[1], texels[2]
    last, front = -1, -1
    nx = ny = nz = 0.0
    shade = np.float32(0.0)
    du, dv = 1.0 / K[0, 0], 1.0 / K[1, 1]
    for y in range(height):
        b = (y - K[1, 2]) * dv
        end = 0
        while end < width:
            begin, t = end, number[y, end]
            while end < width and number[y, end] == t:
                end += 1
            if t < 0:
                for x in range(begin, end):
                    rgb[0, y, x], rgb[1, y, x], rgb[2, y, x] = SKY
                continue
            if t != last:
                # What a triangle's pixels share: its normal in camera axes, its shade, and the map
                # from points in camera axes to texels.
                last, k, front = t, poses[t], front_of[t]
                nx, ny, nz = _turned(cam_from_body, k, normals[t, 0], normals[t, 1], normals[t, 2])
                shade = np.float32(AMBIENT + DIFFUSE * max(0.0, nx * lx + ny * ly + nz * lz))
                if front < 0:
                    _seen_from_cam(grain_axes, t, cam_from_body, k, axes)
                else:
                    _seen_from_cam(front_axes, t, cam_from_body, k, axes)
            a = (begin - K[0, 2]) * du
            # The plane n · p = d has inverse depth w = n · r / d on the ray r.
            w = inverse[y, begin]
            per_d = w / (nx * a + ny * b + nz)
            wu, wv = nx * per_d * du, ny * per_d * dv
            _find_texels(end - begin, axes, a, b, du, dv, w, wu, wv, front >= 0, us, vs, levels)
            if front < 0:
                rough = contrast[t]
                for x in range(begin, end):
                    i = x - begin
                    p, q, r, s, right, down, rest = _around(
                        us[i], vs[i], levels[i], np.uint32(GRAIN_SIZE), np.float32(0.0)
                    )
                    fine = _mixed(
                        grain[r, p, 0], grain[r, q, 0], grain[s, p, 0], grain[s, q, 0], right, down
                    )
                    coarse = _mixed(
                        grain[r, p, 1], grain[r, q, 1], grain[s, p, 1], grain[s, q, 1], right, down
                    )
                    light = shade * (np.float32(1.0) + rough * (fine + rest * (coarse - fine)))
                    for c in range(3):
                        rgb[c, y, x] = _byte(colours[t, c] * light)
            else:
                for x in range(begin, end):
                    i = x - begin
                    p, q, r, s, right, down, _ = _around(
                        us[i], vs[i], levels[i], np.uint32(FRONT_SIZE), np.float32(0.5)
                    )
                    for c in range(3):
                        mixed = _mixed(
                            fronts[front, r, p, c], fronts[front, r, q, c],
                            fronts[front, s, p, c], fronts[front, s, q, c], right, down,
                        )  # fmt: skip
                        rgb[c, y, x] = _byte(mixed * shade)


@_inlined
def _turned(m, k, x, y, z):
    return (
        m[k, 0, 0] * x + m[k, 0, 1] * y + m[k, 0, 2] * z,
        m[k, 1, 0] * x + m[k, 1, 1] * y + m[k, 1, 2] * z,
        m[k, 2, 0] * x + m[k, 2, 1] * y + m[k, 2, 2] * z,
    )


@_inlined
def _seen_from_cam(axes, t, cam_from_body, k, into):
    # The map from points to texels in camera axes, [2, 4]: axes · (R, t)⁻¹, for a rotation R.
    for i in range(2):
        x, y, z = _turned(cam_from_body, k, axes[t, i, 0], axes[t, i, 1], axes[t, i, 2])
        into[i, 0], into[i, 1], into[i, 2], into[i, 3] = x, y, z, axes[t, i, 3]
        for j in range(3):
            into[i, 3] -= into[i, j] * cam_from_body[k, j, 3]


@_shading
def _find_texels(count, axes, a, b, du, dv, w, wu, wv, is_front, us, vs, levels):
    """Writes the texels on a run of rays, and the level whose texels have a pixel's size.

    The first ray is (a, b, 1), with inverse depth w. du and dv are the steps of a and b, wu and wv
    those of w, for one pixel to the right and down. Levels are rounded for house fronts, but not
    for the grain, which blends two levels.
    """
    # All values are float32, of which a vector register holds 16. LLVM checks each pair of written
    # arrays for overlaps; with more than these three it gives up and leaves the loop scalar.
    s0 = np.float32(axes[0, 0] * a + axes[0, 1] * b + axes[0, 2])
    t0 = np.float32(axes[1, 0] * a + axes[1, 1] * b + axes[1, 2])
    s_u, t_u = np.float32(axes[0, 0] * du), np.float32(axes[1, 0] * du)
    s_v, t_v = np.float32(axes[0, 1] * dv), np.float32(axes[1, 1] * dv)
    u0, v0 = np.float32(axes[0, 3]), np.float32(axes[1, 3])
    w, wu, wv = np.float32(w), np.float32(wu), np.float32(wv)
    extra = np.float32(0.5 if is_front else 0.0) - np.float32(63.5)
    most = np.float32(_FRONT_LEVELS - 1.0 if is_front else _GRAIN_LEVELS - 1.001)
    for i in range(count):
        step = np.float32(np.int32(i))
        z = np.float32(1.0) / (w + step * wu)
        s, t = s0 + step * s_u, t0 + step * t_u
        # How many texels the point on the surface moves for one pixel to the right or down:
        # d(z r)/du = z (e_x / fx - r w_u / w), and likewise for v. The larger one determines the
        # level.
        su, tu = s_u - s * z * wu, t_u - t * z * wu
        sv, tv = s_v - s * z * wv, t_v - t * z * wv
        square = np.float32(z * z * max(su * su + tu * tu, sv * sv + tv * tv))
        # Half of log2 of the square. A float's bits, read as an integer, are 2^23 times its log2
        # plus the exponent's bias of 127, linear between powers of two; 63.5 is half of the bias.
        level = np.float32(square.view(np.int32)) * np.float32(0.5 / (1 << 23)) + extra
        us[i], vs[i], levels[i] = z * s + u0, z * t + v0, min(max(level, np.float32(0.0)), most)


@_inlined
def _around(u, v, level, size, half):
    """Returns columns and rows of the four texels around (u, v), and the weights between them.

    The last value is the fractional part of `level`, the weight of the next level. The centre of
    texel 0 is at `half`.
    """
    n = np.uint32(level)
    # Unsigned, because numba checks whether signed indices are negative. Sizes are powers of two,
    # so that `& (side - one)` repeats the pattern.
    side, one = size >> n, np.uint32(1)
    scale = np.float32(side) / np.float32(size)
    u, v = u * scale - half, v * scale - half
    i, j = np.floor(u), np.floor(v)
    left, up = np.uint32(np.int32(i)) & (side - one), np.uint32(np.int32(j)) & (side - one)
    first = np.uint32(2) * (size - side)  # levels lie below each other
    right, down = (left + one) & (side - one), first + ((up + one) & (side - one))
    return left, right, first + up, down, u - i, v - j, level - np.float32(n)


@_inlined
def _byte(x):  # a colour from 0 to 255
    return np.uint8(min(np.float32(255.0), max(np.float32(0.0), x)))


@_inlined
def _mixed(a, b, c, d, right, down):  # bilinear: a and b above, c and d below
    top, bottom = a + right * (b - a), c + right * (d - c)
    return top + down * (bottom - top)
