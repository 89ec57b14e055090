"""Shots of drawn worlds, by seed: depth, poses, flow, ids and pictures, with noise, all right.

Worlds are cast by rays and flow comes from points moved through the world: nothing of flowrep's
geometry takes part in either. Flow is also estimated from the pictures, by flowrep's estimator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

Array = np.ndarray
CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # right, down, ahead at yaw 0; z is up
SIZES = {(48, 64): 0.15, (64, 64): 0.1, (84, 84): 0.22, (60, 120): 0.1, (120, 160): 0.25,
         (180, 240): 0.1, (240, 320): 0.05, (480, 640): 0.03}  # fmt: skip
SCENES = ("room", "street", "terrain", "floor")
PATHS = ("straight", "curve", "hand-held", "hover", "backing", "rotation", "standstill")
STEP_M = {"room": 0.06, "street": 0.35, "terrain": 0.4, "floor": 0.1}  # a frame


@dataclass(frozen=True)
class Shots:
    """T frames of a recording or an env; what they don't have is None.

    Convention: CONVENTIONS.md's, float64. `flow[t]` is that since frame t - 1, nan where unknown.
    """

    depth: Array  # [T, H, W]
    poses: Array  # [T, 4, 4], world_from_cam
    K: Array  # [T, 3, 3]
    rgb: Array | None = None  # [T, H, W, 3], uint8
    flow: Array | None = None  # [T, 2, H, W]
    ids: Array | None = None  # [T, H, W]
    moved: Array | None = None  # [T, 1 + N, 4, 4], by id, takes the world's points to before
    late: Callable[[float], Array] | None = None  # poses of some frames earlier
    kind: tuple[str, ...] = ()  # scene, path, route, noise
    moving: float = 0.0  # share of the pixels
    row_0: Array | None = None  # [T, 4, 4], in an env, if it isn't the camera's motion

    def with_(self, **changes: Any) -> Shots:
        return replace(self, **changes)

    @property
    def is_env(self) -> bool:
        return "env" in self.kind


def euler(roll: float, pitch: float, yaw: float) -> Array:
    """Returns Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (roll, pitch, yaw))
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return z @ y @ x


def rigid(rotation: Array, place: Any) -> Array:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, place
    return pose


def centres(height: int, width: int) -> Array:
    v, u = np.mgrid[:height, :width] + 0.5
    return np.stack([u, v])


def rays_of(K: Array, shape: tuple[int, ...]) -> Array:
    """Returns the rays of all pixels at z = 1, [3, N]."""
    return np.linalg.inv(K) @ np.concatenate([centres(*shape), np.ones((1, *shape))]).reshape(3, -1)


def projected(points: Array, K: Array, shape: tuple[int, ...]) -> Array:
    """Returns where a camera sees points [3, N] of its frame, [2, H, W], nan behind it."""
    x, y, z = K @ points
    z = np.where(z > 0.02, z, np.nan)
    return np.stack([x / z, y / z]).reshape(2, *shape)


def flow_of(shots: Shots, t: int, motion: Array | None = None) -> Array:
    """Returns ego flow by depth, K and poses as they are, or the flow of motions by pixel."""
    shape = shots.depth.shape[1:]
    z = np.where(np.isinf(shots.depth[t]), 1e7, shots.depth[t])
    points = rays_of(shots.K[t], shape) * np.where(z > 0, z, np.nan).ravel()
    if motion is None:
        motion = np.linalg.inv(shots.poses[t - 1]) @ shots.poses[t]
        points = motion[:3, :3] @ points + motion[:3, 3:]
    else:
        points = np.einsum("nij,jn->in", motion[:, :3, :3], points) + motion[:, :3, 3].T
    return centres(*shape) - projected(points, shots.K[t - 1], shape)


# --- worlds ---------------------------------------------------------------------------------------


def solids_of(scene: str, rng: np.random.Generator) -> list[Array]:
    """Returns boxes as their lowest and highest corners; the camera starts at the origin."""
    if scene == "room":
        low, high = np.array([-3.0, -2.5, 0]), np.array([3.5, 2.7, 2.8])
        walls = [np.array([low, high]) + np.array([[-1.0], [1.0]]) for _ in range(6)]
        for i in range(6):  # each side of the room is a slab
            walls[i][1 - i % 2, i // 2] = (high if i % 2 else low)[i // 2]
        boxes = []
        while len(boxes) < 7:
            at, half = rng.uniform([-2.5, -2, 0.2], [3, 2.3, 1.6]), rng.uniform(0.15, 0.5, 3)
            if np.linalg.norm(at[:2]) > 1.2:
                boxes.append(np.array([at - half, at + half]))
        return walls + boxes
    ground = np.array([[-400.0, -400, -1], [400, 400, 0]])
    boxes = [ground]
    if scene == "street":
        for side in (-1, 1):
            x = -15.0
            while x < 90:
                long, deep, high = rng.uniform(4, 16), rng.uniform(5, 10), rng.uniform(3, 14)
                near = rng.uniform(5, 9)
                y = sorted((side * near, side * (near + deep)))
                boxes.append(np.array([[x, y[0], 0], [x + long, y[1], high]]))
                x += long + rng.uniform(0, 5)
        for x in rng.uniform(-5, 50, 6):
            y = rng.choice([-1, 1]) * rng.uniform(2.6, 3.6)
            boxes.append(np.array([[x - 2, y - 0.8, 0], [x + 2, y + 0.8, 1.5]]))
    return boxes


def cast(pose: Array, rays: Array, solids: list[Array], hills: Array | None) -> tuple[Array, Array]:
    """Returns depth [N], inf where there is nothing, and the number of the solid hit, -1 if none."""
    ahead, origin = (pose[:3, :3] @ rays).T, pose[:3, 3]
    z, hit = np.full(len(ahead), np.inf), np.full(len(ahead), -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        for i, corners in enumerate(solids):
            ends = (corners[:, None] - origin) / ahead
            near, far = np.min(ends, 0).max(-1), np.max(ends, 0).min(-1)
            is_hit = (near < far) & (near > 0.05) & (near < z)
            z[is_hit], hit[is_hit] = near[is_hit], i
    if hills is not None:  # above the ground: march along the ray, then bisect
        height = lambda p: sum(a * np.sin(p[:, 0] * x + p[:, 1] * y + b) for a, x, y, b in hills)
        low, high, done = np.zeros(len(z)), np.full(len(z), 150.0), np.zeros(len(z), bool)
        last = np.zeros(len(z))
        for far in np.geomspace(0.5, 150.0, 48):
            below = origin[2] + far * ahead[:, 2] < height(origin + far * ahead)
            new = below & ~done
            low[new], high[new] = last[new], far
            done |= below
            last[:] = far
        for _ in range(26):
            mid = (low + high) / 2
            below = origin[2] + mid * ahead[:, 2] < height(origin + mid[:, None] * ahead)
            low, high = np.where(below, low, mid), np.where(below, mid, high)
        is_hit = done & (low < z)
        z[is_hit], hit[is_hit] = low[is_hit], 0
    return z, hit


def path_of(name: str, step: float, high: float, pitch: float, roll: float, rng: Any) -> Any:
    """Returns a function of times `[T]`, in frames, that gives poses `[T, 4, 4]`."""
    phase, period = rng.uniform(0, 2 * np.pi, (6, 2)), rng.uniform(12, 26, (6, 2)) / [1, 2]
    size = (
        np.array([3.5, 3.5, 1.5, 0, 0, 0])[:, None] * step
        + np.array([0, 0, 0, 0.05, 0.09, 0.15])[:, None]
    )
    size = size * [1, 0.15] * {"hand-held": 1.0, "hover": 0.25, "rotation": 0.0}.get(name, 0.06)
    size = size * (name != "standstill")
    rate = rng.choice([-1, 1]) * rng.uniform(0.015, 0.04) * (name in ("curve", "rotation"))
    speed = step * {"straight": 1, "curve": 1, "backing": -1}.get(name, 0) * rng.uniform(0.7, 1.4)
    if name in ("straight", "backing") and rng.random() < 0.5:
        size = size * 0.0

    def poses(times: Array) -> Array:
        waves = (size * np.sin(2 * np.pi * times[:, None, None] / period + phase)).sum(-1)
        waves += np.array([0, 0, high, roll, pitch, 0.0])
        waves[:, 5] += rate * times
        around = speed * times if not rate else speed / rate * np.sin(rate * times)
        waves[:, 0] += around
        waves[:, 1] += 0 if not rate else speed / rate * (1 - np.cos(rate * times))
        return np.array([rigid(euler(*w[3:]) @ CAMERA, w[:3]) for w in waves])

    return poses


def bodies_of(share: float, poses: Array, K: Array, size: tuple[int, int], step: float, room: bool,
              rng: Any) -> list[tuple[Array, Array, Array]]:  # fmt: skip
    """Returns bodies that fill about a share of the picture: place, step a frame, half sides."""
    if not share:
        return []
    (height, width), middle = size, poses[len(poses) // 2]
    ahead = middle[:3, 2] * [1, 1, 0] / np.linalg.norm(middle[:2, 2])
    side, bodies = np.cross(ahead, [0, 0, 1.0]), []
    near = rng.uniform(1.1, 1.7) if room else rng.uniform(8, 20) * step + 1.5
    per_px, kind = near / K[0, 0], rng.choice(["bodies", "crowd", "crowd, common", "vehicle"])
    number = {"bodies": rng.integers(1, 4), "vehicle": 1}.get(kind, rng.integers(4, 8))
    common = rng.uniform(0.3, 1.2) * step * np.array([*rng.normal(size=2), 0.0])
    for i in range(number):
        tall = 0.8 if kind.startswith("crowd") else np.sqrt(share / number) * rng.uniform(0.8, 1.2)
        across = share * width / (number * min(tall, 1.0)) * per_px / 2
        spread = (
            (i + rng.uniform(0.35, 0.65)) / number - 0.5 if number > 1 else rng.uniform(-0.1, 0.1)
        )
        far = near * rng.uniform(1.0, 1.15) + (across if kind == "vehicle" else 0)
        place = middle[:3, 3] + far * ahead + spread * width * per_px * side
        place[2] += far * np.tan(np.arcsin(np.clip(middle[2, 2], -0.9, 0.9))) * 0.8
        walk = (
            common
            if kind == "crowd, common"
            else rng.uniform(0.3, 1.2) * step * np.array([*rng.normal(size=2), 0])
        )
        if kind == "vehicle":
            walk = (poses[-1, :3, 3] - poses[0, :3, 3]) / (len(poses) - 1) * rng.uniform(
                0.8, 1.1
            ) + 0.1 * common
        half = np.array([across, across, tall * height * per_px / 2])
        bodies.append((place, walk, np.maximum(half, 0.02)))
    return bodies


def painted(points: Array, hit: Array, waves: Array, cell_m: float) -> Array:
    """Returns grey levels [N, 3]; with a cell the surface is a chessboard, which aliases."""
    if cell_m:
        dark = np.floor(points / cell_m + 0.01).astype(int).sum(-1) % 2
        return np.repeat((60 + 130 * dark + 7 * (hit % 5))[:, None], 3, 1).clip(0, 255)
    grey = np.sin(points @ waves[:, :3].T + waves[:, 3]).sum(-1)
    return np.repeat((128 + 20 * grey)[:, None], 3, 1).clip(0, 255)


def draw(seed: int, *, route: str | None = None, moving: float | None = None) -> Shots:
    """Returns right shots of a seed; with its noise, but without a mistake."""
    rng = np.random.default_rng([70, seed])
    np.seterr(invalid="ignore")
    scene, path = rng.choice(SCENES, p=[0.35, 0.3, 0.2, 0.15]), rng.choice(PATHS)
    size = [*SIZES][rng.choice(len(SIZES), p=[*SIZES.values()])]
    route = route or rng.choice(["recording", "env"], p=[0.62, 0.38])
    share = rng.choice([0.0, rng.uniform(0.03, 0.48), rng.uniform(0.52, 0.75)], p=[0.4, 0.42, 0.18])
    share = share if moving is None else moving
    step, frames = STEP_M[scene] * rng.uniform(0.6, 1.5), int(rng.integers(9, 16))
    high = {"room": 1.4, "street": 1.5, "terrain": rng.uniform(3, 9)}.get(
        scene, rng.uniform(0.6, 2)
    )
    pitch = {"room": 0.1, "street": 0.05, "terrain": 0.35}.get(scene, rng.uniform(0.3, 0.7))
    roll = 0.0 if scene == "floor" or rng.random() < 0.4 else rng.normal(0, 0.04)
    place = path_of(path, step, high, pitch, roll, rng)
    times = np.arange(frames)
    poses, (height, width) = place(times), size
    focal = width / 2 / np.tan(np.radians(rng.uniform(50, 95)) / 2)
    K = np.array([[focal, 0, width / 2 + rng.normal(0, 0.03) * width],
                  [0, focal * rng.uniform(0.94, 1.06), height / 2 + rng.normal(0, 0.03) * height], [0, 0, 1]])  # fmt: skip
    solids = solids_of(scene, rng)
    hills = None
    if scene == "terrain":
        hills = np.stack(
            [rng.uniform(0.2, 0.8, 5), *rng.normal(0, 0.25, (2, 5)), rng.uniform(0, 6, 5)], 1
        )
        solids = [np.array([[-400.0, -400, -60], [400, 400, -50]])]
    bodies = bodies_of(share, poses, K, size, step, scene == "room", rng)
    source = rng.choice(["exact", "noisy", "estimated"], p=[0.25, 0.45, 0.3])
    needs_rgb = route == "recording" and source == "estimated"
    cell_m, scale = rng.choice([0.0, 2.5 * STEP_M[scene]], p=[0.7, 0.3]), high / focal
    waves = np.concatenate([rng.normal(size=(24, 3)) * (2 * np.pi / scale / np.geomspace(6, 60, 24))[:, None] / 1.7,
                            rng.uniform(0, 6.28, (24, 1))], 1)  # fmt: skip
    moved = np.tile(np.eye(4), (frames, 1 + len(bodies), 1, 1))
    for i, (_, walk, _) in enumerate(bodies):
        moved[1:, i + 1, :3, 3] = -walk
    maps: dict[str, list[Array]] = {name: [] for name in ("depth", "flow", "ids", "rgb")}
    rays = rays_of(K, size)
    for t, pose in enumerate(poses):
        now = [at + (t - frames // 2) * walk for at, walk, _ in bodies]
        boxes = [np.array([at - half, at + half]) for at, (_, _, half) in zip(now, bodies)]
        z, hit = cast(pose, rays, solids + boxes, hills)
        ids = np.clip(hit - len(solids) + 1, 0, None)
        points = pose[:3, 3] + np.where(np.isinf(z), 1e7, z)[:, None] * (pose[:3, :3] @ rays).T
        before = points + moved[t, ids, :3, 3]
        back = poses[max(t - 1, 0)]
        seen = projected(back[:3, :3].T @ (before - back[:3, 3]).T, K, size)
        maps["flow"].append(centres(*size) - seen if t else np.full((2, *size), np.nan))
        maps["depth"].append(z.reshape(size))
        maps["ids"].append(ids.reshape(size))
        if needs_rgb:
            on_body = points - np.array([np.zeros(3), *now])[ids]
            maps["rgb"].append(
                painted(on_body, hit, waves, cell_m).reshape(*size, 3).astype(np.uint8)
            )
    depth, flow, ids = (np.array(maps[name]) for name in ("depth", "flow", "ids"))
    said = []
    if rng.random() < 0.5:  # noise of depth
        a = 10 ** rng.uniform(-3.3, -2.1) * {"room": 1, "floor": 1}.get(scene, 0.15)
        depth, said = depth + a * depth**2 * rng.normal(size=depth.shape), [*said, "depth"]
        depth = np.where(depth > 0.01, depth, np.nan)
    if rng.random() < 0.25:  # steps
        unit = rng.choice([0.001, 0.005, 0.02]) * (1 if scene in ("room", "floor") else 5)
        depth, said = np.round(depth / unit) * unit, [*said, "steps"]
    if rng.random() < 0.3 and route == "recording":  # holes
        depth[rng.random(depth.shape) < rng.uniform(0, 0.2)] = np.nan
        y, x = (int(rng.integers(0, n * 2 // 3)) for n in size)
        depth[:, y : y + height // 4, x : x + width // 4] = np.nan
    if route == "env":
        depth = np.where(np.isfinite(depth), depth, np.inf)
    late = place
    if rng.random() < 0.5:
        big = 10 ** rng.uniform(-1, 0)
        shift, turn = (
            0.003 * big * rng.normal(size=(frames, 3)),
            np.radians(0.1) * big * rng.normal(size=(frames, 3)),
        )
        off = np.array([rigid(euler(*w), x) for w, x in zip(turn, shift)])
        poses, said, late = poses @ off, [*said, "poses"], lambda times: place(times) @ off
    rgb = np.array(maps["rgb"]) if needs_rgb else None
    if source == "noisy" and route == "recording":
        flow = flow + 10 ** rng.uniform(-1.3, -0.3) * rng.normal(size=flow.shape)
    kind = (scene, path, route, source if route == "recording" else "", *said)
    shots = Shots(depth, poses, np.tile(K, (frames, 1, 1)), rgb, flow, ids, moved,
                  lambda share: late(times - share), kind, float((ids[1:] > 0).mean()))  # fmt: skip
    return shots.with_(flow=estimated_flow(shots)) if needs_rgb else shots


@cache
def estimator(preset: str) -> Any:
    from flowrep.sequences import EstimatedFlowSource
    from flowrep.transforms import DIS

    return EstimatedFlowSource(DIS(preset))


def frames_of(shots: Shots, *, has_flow: bool = True) -> list[Any]:
    from flowrep.sequences import Frame

    frames = []
    for t, depth in enumerate(shots.depth):
        flow = shots.flow[t].astype(np.float32) if has_flow and shots.flow is not None else None
        rgb = None if shots.rgb is None else shots.rgb[t]
        maps = shots.poses[t].copy(), shots.K[t].copy(), depth.astype(np.float32), rgb
        frames.append(Frame(f"{t}", Path(f"{t}"), *maps, t / 30, flow, f"{t - 1}" if t else None))
    return frames


def estimated_flow(shots: Shots) -> Array:
    """Returns DIS's flow of the pictures, with the preset that its documentation gives the size."""
    estimate = estimator("fine" if shots.depth.shape[-1] < 320 else "fast")
    first = np.full((2, *shots.depth.shape[1:]), np.nan, np.float32)
    pairs = pairwise(frames_of(shots, has_flow=False))
    return np.array([first, *(estimate(*both) for both in pairs)])
