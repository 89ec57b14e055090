"""Mistakes as users make them: each takes right shots and returns those of a wrong convention.

None of this is flowrep's: what undoes a mistake is in flowrep/diagnosis, what makes it is here.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tests.injected.sources import CAMERA, Shots, euler, rigid

Mistake = Callable[[Shots], Shots]


def inverted(poses):
    return np.linalg.inv(poses)


def of_poses(change: Callable[[np.ndarray], np.ndarray]) -> Mistake:
    return lambda shots: shots.with_(poses=change(shots.poses.copy()))


def of_depth(change: Callable[[np.ndarray], np.ndarray]) -> Mistake:
    return lambda shots: shots.with_(depth=change(shots.depth.copy()))


def of_flow(change: Callable[[np.ndarray], np.ndarray]) -> Mistake:
    return lambda shots: shots.with_(flow=change(shots.flow.copy()))


def of_camera(change: Callable[[np.ndarray, int, int], np.ndarray]) -> Mistake:
    def spoilt(shots: Shots) -> Shots:
        height, width = shots.depth.shape[1:]
        return shots.with_(K=np.array([change(K.copy(), height, width) for K in shots.K]))

    return spoilt


def of_bodies(change: Callable[[np.ndarray, np.ndarray], np.ndarray]) -> Mistake:
    """Changes how bodies move in the world `[N, 4, 4]`, given the poses before and now too."""

    def spoilt(shots: Shots) -> Shots:
        moved = shots.moved.copy()
        for t in range(1, len(moved)):
            moved[t, 1:] = change(moved[t, 1:], shots.poses[t - 1 : t + 1])
        return shots.with_(moved=moved)

    return spoilt


def halved(motion):
    """Returns half of a rigid motion: twice in succession it is the whole."""
    w, *xyz = quaternion(motion[:3, :3])
    turn = rotation_of(*(np.array([w + np.copysign(1.0, w), *xyz]) / np.sqrt(2 + 2 * abs(w))))
    return rigid(turn, np.linalg.solve(np.eye(3) + turn, motion[:3, 3]))


def enlarged(depth, by: int = 4):
    """Returns depth that was reduced and enlarged again, bilinearly."""
    frames, height, width = depth.shape
    small = np.nan_to_num(depth, posinf=1e3)[:, : height // by * by, : width // by * by]
    small = small.reshape(frames, height // by, by, width // by, by).mean((2, 4))
    v, u = (np.mgrid[:height, :width] + 0.5) / by
    return np.array([bilinear(each[..., None], u, v)[..., 0] for each in small])


def angles_in_another_order(poses):
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


def wrong_quaternions(poses):
    for pose in poses:
        w, x, y, z = quaternion(pose[:3, :3])
        pose[:3, :3] = rotation_of(z, w, x, y)  # stored w, x, y, z; read as x, y, z, w
    return poses


def transposed(poses):
    poses[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    return poses


def late(poses, frames: float):
    """Returns poses of an earlier time: those between frames turn evenly from one to the next."""
    out = np.full_like(poses, np.nan)
    for t in range(len(poses)):
        first = int(np.clip(np.floor(t - frames), 0, len(poses) - 2))
        share = np.clip(t - frames, 0, len(poses) - 1) - first
        a, b = poses[first], poses[first + 1]
        w, x, y, z = quaternion(a[:3, :3].T @ b[:3, :3])
        sign, angle = np.sign(w) or 1.0, 2 * np.arccos(min(abs(w), 1.0))
        axis = sign * np.array([x, y, z]) / max(np.linalg.norm([x, y, z]), 1e-12)
        half = share * angle / 2
        turn = rotation_of(np.cos(half), *(np.sin(half) * axis))
        out[t] = rigid(a[:3, :3] @ turn, (1 - share) * a[:3, 3] + share * b[:3, 3])
    return out


def ray_length(shots: Shots) -> Shots:
    _, height, width = shots.depth.shape
    v, u = np.mgrid[:height, :width] + 0.5
    fx, fy, cx, cy = shots.K[0][[0, 1, 0, 1], [0, 1, 2, 2]]
    return shots.with_(depth=shots.depth * np.sqrt(1 + ((u - cx) / fx) ** 2 + ((v - cy) / fy) ** 2))


def z_buffer(depth, near=0.2, far=60.0):
    return np.where(np.isinf(depth), 1.0, far / (far - near) * (1 - near / depth))


def to_next(shots: Shots) -> Shots:
    """Flow from each frame to the next, on the frame's own grid and stored under its name."""
    flow = np.full_like(shots.flow, np.nan)
    v, u = np.mgrid[: flow.shape[2], : flow.shape[3]] + 0.5
    for t in range(len(flow) - 1):
        fx, fy, cx, cy = shots.K[t][[0, 1, 0, 1], [0, 1, 2, 2]]
        z = np.where(np.isinf(shots.depth[t]), 1e9, shots.depth[t])
        points = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z]).reshape(3, -1)
        now, then = shots.poses[t], shots.poses[t + 1]
        seen = then[:3, :3].T @ (now[:3, :3] @ points + (now[:3, 3] - then[:3, 3])[:, None])
        x, y = (shots.K[t + 1] @ seen)[:2] / np.where(seen[2] > 0.02, seen[2], np.nan)
        flow[t] = np.stack([x.reshape(u.shape) - u, y.reshape(u.shape) - v])
    flow[0] = np.nan
    return shots.with_(flow=flow[:-1], **{n: getattr(shots, n)[:-1] for n in ("depth", "poses", "K")},
                       rgb=None, ids=None, moved=None)  # fmt: skip


def on_previous_grid(shots: Shots) -> Shots:
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


def distorted(shots: Shots, k1: float = -0.12) -> Shots:
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


def zooming(shots: Shots, share: float = 0.008) -> Shots:
    """A focal length that grows and shrinks (an autofocus), while K stays that of the first."""
    cx, cy = shots.K[0][0, 2], shots.K[0][1, 2]
    zoom = 1 + share * np.cumsum(np.where(np.arange(len(shots.depth)) % 4 < 2, 1.0, -0.7))

    def target(t, u, v):
        return cx + (u - cx) * zoom[t], cy + (v - cy) * zoom[t]

    def source(t, u, v):
        return cx + (u - cx) / zoom[t], cy + (v - cy) / zoom[t]

    return resampled(shots, source, target)


def flipped(shots: Shots) -> Shots:
    flow = shots.flow[..., ::-1] * np.array([-1.0, 1])[:, None, None]
    return shots.with_(flow=flow, rgb=shots.rgb[:, :, ::-1].copy())


def flip_y(poses):
    F = np.diag([1.0, -1, 1, 1])
    return F @ poses @ F


def scaled(K, by):
    K[:2] *= by
    return K


def moved_centre(K, du, dv):
    K[:2, 2] += du, dv
    return K


MARKER = rigid(euler(*np.radians([6.0, -7.0, 4.0])), (0.08, -0.05, 0.07))
TILTED = rigid(euler(*np.radians([1.5, 2.2, -1.4])), (0.0, 0.0, 0.0))

# Mistakes that flowrep's table knows; the value after each is what has to be named.
LISTED: dict[str, tuple[Mistake, tuple[str, ...]]] = {
    "poses world-to-camera": (of_poses(inverted), ("world_to_camera",)),
    "poses OpenGL": (of_poses(lambda p: p @ OPENGL), ("opengl",)),
    "poses NED": (of_poses(lambda p: p @ NED), ("ned",)),
    "poses x forward": (of_poses(lambda p: p @ FLU), ("x_forward_z_up",)),
    "poses OpenGL, world-to-camera": (of_poses(lambda p: inverted(p @ OPENGL)), ("world_to_camera pose_axes=opengl",)),
    "mirrored world": (of_poses(flip_y), ("unity",)),
    "left-handed, read as NED": (of_poses(lambda p: unreal(p) @ NED.T), ("unity",)),
    "left-handed, read as x forward": (of_poses(lambda p: unreal(p) @ FLU.T), ("mirrored in x",)),
    "quaternion order": (of_poses(wrong_quaternions), ("pose_layout=xyz_wxyz",)),
    "rotations transposed": (of_poses(transposed), ("transposed",)),
    "poses a frame late": (of_poses(lambda p: late(p, 1.0)), ("pose_lag_frames=1",)),
    "poses a frame early": (of_poses(lambda p: late(p, -1.0)), ("pose_lag_frames=-1",)),
    "poses 0.4 frames late": (lambda s: s.with_(poses=late(s.poses, 0.4) if s.late is None else s.late), ("frames later", "poses")),
    "poses of a marker": (of_poses(lambda p: p @ MARKER), ("marker_from_cam",)),
    "depth in mm": (of_depth(lambda z: 1000 * z), ("depth times",)),
    "depth a fifth": (of_depth(lambda z: z / 5), ("depth times",)),
    "depth in feet": (of_depth(lambda z: z / 0.3048), ("depth times",)),
    "depth along the ray": (ray_length, ("ray_length",)),
    "depth buffer": (of_depth(z_buffer), ("z_buffer",)),
    "depth not registered": (of_depth(lambda z: np.roll(z, z.shape[2] // 14, 2)), ("depth moved by", "cx and cy moved")),
    "depth upside down": (of_depth(lambda z: z[:, ::-1].copy()), ("upside down",)),
    "depth mirrored": (of_depth(lambda z: z[..., ::-1].copy()), ("depth mirrored",)),
    "depth inverted": (of_depth(lambda z: 1 / z), ("/ depth",)),
    "depth of the frame before": (of_depth(lambda z: np.concatenate([z[:1], z[:-1]])), ("depth of the next frame", "pose_lag_frames=-1")),
    "flow backward": (of_flow(lambda f: -f), ("flow_direction",)),
    "flow rows first": (of_flow(lambda f: f[:, ::-1]), ("row_column",)),
    "flow u negated": (of_flow(lambda f: f * np.array([-1.0, 1])[:, None, None]), ("u negated",)),
    "flow v negated": (of_flow(lambda f: f * np.array([1.0, -1])[:, None, None]), ("v negated",)),
    "flow over the size": (lambda s: s.with_(flow=s.flow / np.array(s.depth.shape[:0:-1])[:, None, None]), ("flow times the size",)),
    "flow of twice the size": (of_flow(lambda f: 2 * f), ("flow divided by",)),
    "flow times 0.7": (of_flow(lambda f: 0.7 * f), ("flow divided by",)),
    "flow to the next frame": (to_next, ("flow_to=next",)),
    "flow on the previous grid": (on_previous_grid, ("this frame's grid",)),
    "K of twice the size": (of_camera(lambda K, h, w: scaled(K, 2.0)), ("K times",)),
    "K of half the size": (of_camera(lambda K, h, w: scaled(K, 0.5)), ("K times",)),
    "K before a resize": (of_camera(lambda K, h, w: scaled(K, 4 / 3)), ("K times",)),
    "K before a crop": (of_camera(lambda K, h, w: moved_centre(K, 0.15 * w, 0.12 * h)), ("cx and cy moved",)),
    "K as fx, cx, fy, cy": (of_camera(lambda K, h, w: np.array([[K[0, 0], 0, K[1, 1]], [0, K[0, 2], K[1, 2]], [0, 0, 1]])), ("another order",)),
    "K without a centre": (of_camera(lambda K, h, w: moved_centre(K, -K[0, 2], -K[1, 2])), ("cx and cy moved",)),
    "K over the size": (of_camera(lambda K, h, w: K / np.array([[w], [h], [1.0]])), ("K in pixels",)),
    "K that changes": (zooming, ("a K for each frame",)),
    "lens distortion": (distorted, ("distortion",)),
}  # fmt: skip

# And those that it doesn't.
UNLISTED: dict[str, Mistake] = {
    "poses of the reversed recording": of_poses(lambda p: p[::-1].copy()),
    "poses that roll": of_poses(lambda p: np.array([x @ rigid(euler(0, 0, 0.025 * t), np.zeros(3)) for t, x in enumerate(p)])),
    "poses tilted by 3 degrees": of_poses(lambda p: p @ TILTED),
    "poses' height halved": of_poses(lambda p: np.concatenate([p[..., :3], p[..., 3:] * np.array([1, 1, 0.5, 1])[:, None]], -1)),
    "poses late from the middle on": of_poses(lambda p: np.concatenate([p[: len(p) * 6 // 10], p[len(p) * 6 // 10 - 1 : -1]])),
    "rotations camera-to-world, translations not": of_poses(lambda p: np.concatenate([p[..., :3], inverted(p)[..., 3:]], -1)),
    "poses of another time": of_poses(lambda p: np.roll(p, 5, 0)),
    "poses' yaw times 1.2": of_poses(lambda p: np.array([rigid(euler(0, 0, 0.2 * np.arctan2(x[1, 2], x[0, 2])) @ x[:3, :3], x[:3, 3]) for x in p])),
    "poses that freeze": of_poses(lambda p: np.concatenate([p[: len(p) * 2 // 5], np.repeat(p[None, len(p) * 2 // 5], len(p) - len(p) * 2 // 5, 0)])),
    "poses by angles in another order": of_poses(angles_in_another_order),
    "fx and fy swapped": of_camera(lambda K, h, w: np.array([[K[1, 1], 0, K[0, 2]], [0, K[0, 0], K[1, 2]], [0, 0, 1]])),
    "fx 10 % off": of_camera(lambda K, h, w: K * np.array([[1.1, 1, 1], [1, 1, 1], [1, 1, 1]])),
    "cx 8 % off": of_camera(lambda K, h, w: moved_centre(K, 0.08 * w, 0.0)),
    "depth 10 cm off": of_depth(lambda z: z + 0.1),
    "depth of later frames": of_depth(lambda z: np.roll(z, -5, 0)),
    "depth of another scale in each frame": of_depth(lambda z: z * np.exp(0.25 * np.random.default_rng(1).normal(size=(len(z), 1, 1)))),
    "depth in steps of 25 cm": of_depth(lambda z: np.maximum(np.round(z / 0.25) * 0.25, 0.25)),
    "depth beyond 3 m wrapped": of_depth(lambda z: np.where(np.isinf(z), z, z % 3.0)),
    "depth enlarged 4 times": of_depth(enlarged),
    "flow of a flipped picture": flipped,
    "flow shuffled": of_flow(lambda f: np.concatenate([f[:1], f[1:][np.random.default_rng(5).permutation(len(f) - 1)]])),
    "bodies at rest": of_bodies(lambda m, _: np.tile(np.eye(4), (len(m), 1, 1))),
    "bodies' motions halved": of_bodies(lambda m, _: np.array([halved(x) for x in m])),
    "bodies' motions doubled": of_bodies(lambda m, _: m @ m),
    "bodies' motions inverted": of_bodies(lambda m, _: inverted(m)),
    "bodies' motions in the world": of_bodies(lambda m, p: p[0] @ m @ inverted(p[1])),
    "bodies' motions off by a row": of_bodies(lambda m, _: np.roll(m, 1, 0)),
}  # fmt: skip
