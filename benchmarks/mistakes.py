"""Mistakes as users make them: each takes right shots and returns those of a wrong convention.

None of this is flowrep's: what undoes a mistake is in flowrep/diagnosis, what makes it is here.
Numbers of mistakes are drawn.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from benchmarks.shots import CAMERA, Shots, euler, flow_of, rays_of, rigid

Mistake = Callable[[Shots, np.random.Generator], Shots]


def inverted(poses):
    return np.linalg.inv(poses)


def of(name: str, change: Callable) -> Mistake:
    """Changes depth, poses, K or flow, given random numbers too."""
    return lambda s, r: s.with_(**{name: change(getattr(s, name).copy(), r)})


def of_camera(change: Callable) -> Mistake:
    """Changes K, given the height and the width of pictures and random numbers."""

    def spoilt(s: Shots, r) -> Shots:
        return s.with_(K=np.tile(change(s.K[0].copy(), *s.depth.shape[1:], r), (len(s.K), 1, 1)))

    return spoilt


def of_bodies(change: Callable) -> Mistake:
    """Changes how bodies move in the world `[N, 4, 4]`, given the poses before and now too."""

    def spoilt(s: Shots, r) -> Shots:
        moved = s.moved.copy()
        for t in range(1, len(moved)):
            moved[t, 1:] = change(moved[t, 1:], s.poses[t - 1 : t + 1])
        return s.with_(moved=moved)

    return spoilt


def halved(motion):
    """Returns half of a rigid motion: twice in succession it is the whole."""
    w, *xyz = quaternion(motion[:3, :3])
    turn = rotation_of(*(np.array([w + np.copysign(1.0, w), *xyz]) / np.sqrt(2 + 2 * abs(w))))
    return rigid(turn, np.linalg.solve(np.eye(3) + turn, motion[:3, 3]))


def enlarged(depth, r, by: int = 4):
    """Returns depth that was reduced and enlarged again, bilinearly."""
    frames, height, width = depth.shape
    small = np.nan_to_num(depth, posinf=1e3)[:, : height // by * by, : width // by * by]
    small = small.reshape(frames, height // by, by, width // by, by).mean((2, 4))
    v, u = (np.mgrid[:height, :width] + 0.5) / by
    return np.array([bilinear(each[..., None], u, v)[..., 0] for each in small])


def angles_in_another_order(poses, r):
    for pose in poses:
        m = pose[:3, :3] @ CAMERA.T  # Rz Ry Rx, read as Rx Ry Rz
        roll, pitch, yaw = (
            np.arctan2(m[2, 1], m[2, 2]),
            -np.arcsin(m[2, 0]),
            np.arctan2(m[1, 0], m[0, 0]),
        )
        x, y, z = euler(roll, 0, 0), euler(0, pitch, 0), euler(0, 0, yaw)
        pose[:3, :3] = x @ y @ z @ CAMERA
    return poses


# Each column is the direction of one of the camera's axes among right, down and ahead.
OPENGL = np.diag([1.0, -1, -1, 1])  # right, up, back
NED = np.array([[0.0, 1, 0, 0], [0, 0, 1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # ahead, right, down
FLU = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # ahead, left, up
UNREAL = np.array([[0.0, 1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # ahead, right, up


def unreal(poses):
    """Returns the matrices that a left-handed simulator would give (x ahead, y right, z up)."""
    return np.diag([1.0, -1, 1, 1]) @ poses @ UNREAL


def quaternion(rotation):
    """Returns (w, x, y, z), by the largest of the four to keep away from 0 / 0."""
    m = rotation
    squares = np.array([1 + m[0, 0] + m[1, 1] + m[2, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2],
                        1 - m[0, 0] + m[1, 1] - m[2, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2]])  # fmt: skip
    products = np.array([
        [squares[0], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]],
        [m[2, 1] - m[1, 2], squares[1], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]],
        [m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], squares[2], m[1, 2] + m[2, 1]],
        [m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], squares[3]],
    ])  # fmt: skip
    found = products[squares.argmax()]
    return found / np.linalg.norm(found)


def rotation_of(w, x, y, z):
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def wrong_quaternions(poses, r):
    for pose in poses:
        w, x, y, z = quaternion(pose[:3, :3])
        pose[:3, :3] = rotation_of(z, w, x, y)  # stored w, x, y, z; read as x, y, z, w
    return poses


def transposed(poses, r):
    poses[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    return poses


def late(frames: Callable[..., float]) -> Mistake:
    return lambda s, r: s.with_(poses=s.late(frames(r)))


def ray_length(s: Shots, r) -> Shots:
    length = np.linalg.norm(rays_of(s.K[0], s.depth.shape[1:]), axis=0)
    return s.with_(depth=s.depth * length.reshape(s.depth.shape[1:]))


def z_buffer(depth, r):
    near, far = np.nanmin(depth) * r.uniform(0.1, 0.8), 30 * np.nanmedian(depth)
    return np.where(np.isinf(depth), 1.0, far / (far - near) * (1 - near / depth)).clip(max=1.0)


def to_next(s: Shots, r=None) -> Shots:
    """Flow from each frame to the next, on the frame's own grid and stored under its name."""
    back = s.with_(**{n: getattr(s, n)[::-1] for n in ("depth", "poses", "K")})
    flow = -np.array([flow_of(back, t) for t in range(1, len(s.depth))])[::-1]
    first = np.where(np.arange(len(flow)).reshape(-1, 1, 1, 1), flow, np.nan)
    kept = {n: getattr(s, n)[:-1] for n in ("depth", "poses", "K", "ids", "moved")}
    return s.with_(flow=first, rgb=None, late=None, **kept)


def on_previous_grid(shots: Shots, r=None) -> Shots:
    later = to_next(shots)
    flow = later.flow.copy()
    flow[1:], flow[0] = later.flow[:-1], np.nan
    flow[1] = np.nan
    return later.with_(flow=flow)


def resampled(shots: Shots, source: Callable, target: Callable) -> Shots:
    """Returns shots through another lens: `source` says where a new pixel was, `target` the inverse.

    Both take a frame's number and pixels; flow is between new pixels.
    """
    frames, height, width = shots.depth.shape
    v, u = np.mgrid[:height, :width] + 0.5
    out = {name: [] for name in ("depth", "rgb", "flow")}
    for t in range(frames):
        x, y = source(t, u, v)
        i, j = np.floor(y).astype(int), np.floor(x).astype(int)
        inside = (i >= 0) & (i < height) & (j >= 0) & (j < width)
        i, j = i.clip(0, height - 1), j.clip(0, width - 1)
        out["depth"].append(np.where(inside, shots.depth[t][i, j], np.nan))
        if shots.rgb is not None:
            out["rgb"].append(bilinear(shots.rgb[t].astype(float), x, y).round().astype(np.uint8))
        if shots.flow is not None:
            seen = np.stack([x, y]) - bilinear(shots.flow[t].transpose(1, 2, 0), x, y).transpose(
                2, 0, 1
            )
            moved = np.stack([u, v]) - np.stack(target(max(t - 1, 0), *seen))
            out["flow"].append(np.where(inside, moved, np.nan))
    return shots.with_(
        **{name: np.array(maps) for name, maps in out.items() if maps}, ids=None, moved=None
    )


def bilinear(picture, x, y):
    height, width = picture.shape[:2]
    x, y = (x - 0.5).clip(0, width - 1.001), (y - 0.5).clip(0, height - 1.001)
    i, j = y.astype(int), x.astype(int)
    a, b = (y - i)[..., None], (x - j)[..., None]
    top = (1 - b) * picture[i, j] + b * picture[i, j + 1]
    return (1 - a) * top + a * ((1 - b) * picture[i + 1, j] + b * picture[i + 1, j + 1])


def distorted(shots: Shots, r) -> Shots:
    k1 = r.choice([-1, 1]) * r.uniform(0.06, 0.2)
    fx, fy, cx, cy = shots.K[0][[0, 1, 0, 1], [0, 1, 2, 2]]
    size = max(shots.depth.shape[2] / fx, shots.depth.shape[1] / fy) / 2
    k1 = k1 / size**2 * 0.6  # about as strong in every camera

    def target(t, u, v):
        x, y = (u - cx) / fx, (v - cy) / fy
        by = 1 + k1 * (x * x + y * y)
        return cx + fx * x * by, cy + fy * y * by

    def source(t, u, v):
        x, y = (u - cx) / fx, (v - cy) / fy
        a, b = x, y
        for _ in range(30):
            by = 1 + k1 * (a * a + b * b)
            a, b = x / by, y / by
        return cx + fx * a, cy + fy * b

    return resampled(shots, source, target)


def zooming(shots: Shots, r) -> Shots:
    """A focal length that grows and shrinks (an autofocus), while K stays that of the first."""
    cx, cy, share = shots.K[0][0, 2], shots.K[0][1, 2], r.uniform(0.005, 0.03)
    zoom = 1 + share * np.cumsum(np.where(np.arange(len(shots.depth)) % 4 < 2, 1.0, -0.7))

    def target(t, u, v):
        return cx + (u - cx) * zoom[t], cy + (v - cy) * zoom[t]

    def source(t, u, v):
        return cx + (u - cx) / zoom[t], cy + (v - cy) / zoom[t]

    return resampled(shots, source, target)


def flipped(shots: Shots, r) -> Shots:
    return shots.with_(flow=shots.flow[..., ::-1] * np.array([-1.0, 1])[:, None, None])


def flip_y(poses, r=None):
    F = np.diag([1.0, -1, 1, 1])
    return F @ poses @ F


def scaled(K, by):
    K[:2] *= by
    return K


def moved_centre(K, du, dv):
    K[:2, 2] += du, dv
    return K


def turned(most_deg: float, least_deg: float = 0.0) -> Mistake:
    """A camera that is turned on its mount, whose pose is recorded, about any axis."""

    def spoilt(s: Shots, r) -> Shots:
        axis, angle = r.normal(size=3), np.radians(r.uniform(least_deg, most_deg))
        w, *xyz = np.cos(angle / 2), *(np.sin(angle / 2) * axis / np.linalg.norm(axis))
        return s.with_(poses=s.poses @ rigid(rotation_of(w, *xyz), r.normal(0, 0.05, 3)))

    return spoilt


def scale(r, least=1.2, most=3.0):
    """Returns a factor, or its inverse."""
    return r.uniform(least, most) ** r.choice([-1, 1])


def half_floats(depth, r):
    return np.minimum(depth, 6e4).astype(np.float16).view(np.uint16) / 4096.0


def of_row_0(s: Shots, r) -> Shots:
    """Bodies are given the motion of the static world."""
    return s.with_(moved=np.tile(np.eye(4), (*s.moved.shape[:2], 1, 1)))


def both(*two: str) -> Mistake:
    def spoilt(s: Shots, r) -> Shots:
        for name in two:
            s = LISTED[name][0](s, r)
        return s

    return spoilt


def stretched(poses, by):
    return np.concatenate([poses[..., :3], poses[..., 3:] * np.array([*by, 1])[:, None]], -1)


def negated(u, v):
    return lambda f, r: f * np.array([u, v])[:, None, None]


# Mistakes that flowrep's table knows; the value after each is what has to be named.
LISTED: dict[str, tuple[Mistake, tuple[str, ...]]] = {
    "poses world-to-camera": (of("poses", lambda p, r: inverted(p)), ("world_to_camera", "motions inverted")),
    "poses OpenGL": (of("poses", lambda p, r: p @ OPENGL), ("opengl", "marker", "motions inverted")),
    "poses NED": (of("poses", lambda p, r: p @ NED), ("ned",)),
    "poses x forward": (of("poses", lambda p, r: p @ FLU), ("x_forward_z_up",)),
    "poses OpenGL, world-to-camera": (of("poses", lambda p, r: inverted(p @ OPENGL)), ("world_to_camera pose_axes=opengl",)),
    "mirrored world": (of("poses", flip_y), ("unity",)),
    "left-handed, read as NED": (of("poses", lambda p, r: unreal(p) @ NED.T), ("unity",)),
    "left-handed, read as x forward": (of("poses", lambda p, r: unreal(p) @ FLU.T), ("mirrored in x",)),
    "quaternion order": (of("poses", wrong_quaternions), ("pose_layout=xyz_wxyz",)),
    "rotations transposed": (of("poses", transposed), ("transposed",)),
    "poses a frame late": (late(lambda r: 1.0), ("pose_lag_frames=1",)),
    "poses a frame early": (late(lambda r: -1.0), ("pose_lag_frames=-1",)),
    "poses partly late": (late(lambda r: r.choice([-1, 1]) * r.uniform(0.2, 0.8)), ("frames later",)),
    "poses of a marker": (turned(25.0, 3.0), ("marker_from_cam",)),
    "camera turned on its mount": (turned(180.0), ("marker_from_cam", "pose_axes")),
    "depth in mm": (of("depth", lambda z, r: 1000 * z), ("depth times",)),
    "depth of another scale": (of("depth", lambda z, r: z * scale(r, 1.1, 5)), ("depth times",)),
    "depth along the ray": (ray_length, ("ray_length",)),
    "depth buffer": (of("depth", z_buffer), ("z_buffer", "disparity")),
    "depth not registered": (of("depth", lambda z, r: np.roll(z, z.shape[2] // int(r.integers(8, 20)), 2)), ("depth moved by", "cx and cy moved")),
    "depth upside down": (of("depth", lambda z, r: z[:, ::-1].copy()), ("upside down",)),
    "depth mirrored": (of("depth", lambda z, r: z[..., ::-1].copy()), ("depth mirrored",)),
    "disparity": (of("depth", lambda z, r: 10 ** r.uniform(0, 2) / z), ("disparity",)),
    "depth of the frame before": (of("depth", lambda z, r: np.concatenate([z[:1], z[:-1]])), ("depth of the next frame", "pose_lag_frames=-1")),
    "flow backward": (of("flow", lambda f, r: -f), ("flow_direction", "motions inverted")),
    "flow rows first": (of("flow", lambda f, r: f[:, ::-1]), ("row_column",)),
    "flow u negated": (of("flow", negated(-1.0, 1)), ("u negated",)),
    "flow v negated": (of("flow", negated(1.0, -1)), ("v negated",)),
    "flow over the size": (lambda s, r: s.with_(flow=s.flow / np.array(s.depth.shape[:0:-1])[:, None, None]), ("flow times the size",)),
    "flow of another size": (of("flow", lambda f, r: f * scale(r)), ("flow divided by",)),
    "flow to the next frame": (to_next, ("flow_to=next",)),
    "flow on the previous grid": (on_previous_grid, ("this frame's grid",)),
    "K of another size": (of_camera(lambda K, h, w, r: scaled(K, scale(r))), ("K times", "fx times")),
    "K before a crop": (of_camera(lambda K, h, w, r: moved_centre(K, *(r.uniform(-0.2, 0.2, 2) * (w, h)))), ("cx and cy moved", "fx times")),
    "K as fx, cx, fy, cy": (of_camera(lambda K, h, w, r: np.array([[K[0, 0], 0, K[1, 1]], [0, K[0, 2], K[1, 2]], [0, 0, 1]])), ("another order", "fx times")),
    "K without a centre": (of_camera(lambda K, h, w, r: moved_centre(K, -K[0, 2], -K[1, 2])), ("cx and cy moved", "fx times")),
    "K over the size": (of_camera(lambda K, h, w, r: K / np.array([[w], [h], [1.0]])), ("K in pixels",)),
    "fx and fy off": (of_camera(lambda K, h, w, r: K * np.array([[scale(r, 1.05, 1.4), 1, 1], [1, scale(r, 1.05, 1.4), 1], [1, 1, 1]])), ("fx times", "K times")),
    "K that changes": (zooming, ("a K for each frame",)),
    "lens distortion": (distorted, ("distortion",)),
}  # fmt: skip

# And those that it doesn't.
UNLISTED: dict[str, Mistake] = {
    "poses of the reversed recording": of("poses", lambda p, r: p[::-1].copy()),
    "poses that roll": of("poses", lambda p, r: np.array([x @ rigid(euler(0, 0, 0.025 * t), np.zeros(3)) for t, x in enumerate(p)])),
    "poses' height halved": of("poses", lambda p, r: stretched(p, (1, 1, 0.5))),
    "poses late from the middle on": of("poses", lambda p, r: np.concatenate([p[: len(p) * 6 // 10], p[len(p) * 6 // 10 - 1 : -1]])),
    "rotations camera-to-world, translations not": of("poses", lambda p, r: np.concatenate([p[..., :3], inverted(p)[..., 3:]], -1)),
    "poses of another time": of("poses", lambda p, r: np.roll(p, 5, 0)),
    "poses' yaw times 1.2": of("poses", lambda p, r: np.array([rigid(euler(0, 0, 0.2 * np.arctan2(x[1, 2], x[0, 2])) @ x[:3, :3], x[:3, 3]) for x in p])),
    "poses that freeze": of("poses", lambda p, r: np.concatenate([p[: len(p) * 2 // 5], np.repeat(p[None, len(p) * 2 // 5], len(p) - len(p) * 2 // 5, 0)])),
    "poses by angles in another order": of("poses", angles_in_another_order),
    "depth some cm off": of("depth", lambda z, r: z + np.nanmedian(z) * r.uniform(0.05, 0.3)),
    "depth of later frames": of("depth", lambda z, r: np.roll(z, -5, 0)),
    "depth of another scale in each frame": of("depth", lambda z, r: z * np.exp(0.25 * r.normal(size=(len(z), 1, 1)))),
    "depth as half floats' bits": of("depth", half_floats),
    "depth's root": of("depth", lambda z, r: np.sqrt(np.minimum(z, 1e6))),
    "depth affine": of("depth", lambda z, r: np.where(np.isinf(z), z, scale(r) * z + np.nanmedian(z) * r.uniform(0.2, 1))),
    "depth wrapped": of("depth", lambda z, r: np.where(np.isinf(z), z, np.fmod(z, np.nanquantile(z[np.isfinite(z)], r.uniform(0.3, 0.8))))),
    "depth enlarged 4 times": of("depth", enlarged),
    "flow of a flipped picture": flipped,
    "flow shuffled": of("flow", lambda f, r: np.concatenate([f[:1], f[1:][r.permutation(len(f) - 1)]])),
    "bodies at rest": of_row_0,
    "bodies' motions halved": of_bodies(lambda m, _: np.array([halved(x) for x in m])),
    "bodies' motions doubled": of_bodies(lambda m, _: m @ m),
    "bodies' motions inverted": of_bodies(lambda m, _: inverted(m)),
    "bodies' motions in the world": of_bodies(lambda m, p: p[0] @ m @ inverted(p[1])),
    "bodies' motions off by a row": of_bodies(lambda m, _: np.roll(m, 1, 0)),
    "depth in mm along the ray": both("depth in mm", "depth along the ray"),
}  # fmt: skip
TWO = {"depth in mm along the ray": ("depth times", "ray_length")}
OF_PICTURES = (
    "lens distortion",
    "K that changes",
)  # that flow which flowrep computes or estimates can't have


def drawn(right: Shots, seed: int) -> tuple[str, tuple[str, ...], Shots]:
    """Returns the name of a mistake, how it may be named, and shots with it."""
    r = np.random.default_rng([71, seed])
    names = [name for name in [*LISTED, *UNLISTED]
             if not ((right.is_env or right.rgb is not None) and ("flow" in name or name in OF_PICTURES))
             and not (name.startswith("bodies") and not (right.is_env and (right.ids[1:] > 0).any()))]  # fmt: skip
    name = str(r.choice(names))
    mistake, wanted = LISTED[name] if name in LISTED else (UNLISTED[name], TWO.get(name, ()))

    return name, wanted, mistake(right, r)
