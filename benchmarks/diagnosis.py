"""How often flowrep's diagnosis is right: data drawn by seed, right and with a mistake in them.

    python benchmarks/diagnosis.py --seeds 0 60

prints rates with Wilson's intervals of 95 %. Seeds below 10,000 are for developing; what is
reported comes from seeds that nobody looked at. Worlds are cast by rays and flow comes from points
moved through the world: nothing of flowrep's geometry takes part in either.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tensordict import TensorDict

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

Array = np.ndarray
CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # right, down, ahead at yaw 0; z is up
SIZES = {(48, 64): 0.15, (64, 64): 0.1, (84, 84): 0.22, (60, 120): 0.1, (120, 160): 0.25,
         (180, 240): 0.1, (240, 320): 0.05, (480, 640): 0.03}  # fmt: skip
SCENES = ("room", "street", "terrain", "floor", "bullet")
PATHS = ("straight", "curve", "hand-held", "hover", "backing", "rotation", "standstill")
STEP_M = {"room": 0.06, "street": 0.35, "terrain": 0.4, "floor": 0.1, "bullet": 0.05}  # a frame


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
    scene, path = rng.choice(SCENES[:4], p=[0.35, 0.3, 0.2, 0.15]), rng.choice(PATHS)
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


# --- what flowrep says of them --------------------------------------------------------------------


@cache
def estimator() -> Any:
    from flowrep.sequences import EstimatedFlowSource
    from flowrep.transforms import DIS

    return EstimatedFlowSource(DIS("fast"))


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
    """Returns DIS's flow of the pictures."""
    first = np.full((2, *shots.depth.shape[1:]), np.nan, np.float32)
    pairs = pairwise(frames_of(shots, has_flow=False))
    return np.array([first, *(estimator()(*both) for both in pairs)])


def examined(
    shots: Shots, conventions: dict[str, str] | None = None, *, of_flow: bool = True
) -> Any:
    """Returns the diagnosis of a recording; its flow is estimated if there are pictures."""
    from flowrep.diagnosis import Examination

    is_recorded = of_flow and shots.rgb is None
    frames, found = (
        frames_of(shots, has_flow=is_recorded),
        Examination(conventions or {}, is_recorded),
    )
    poses = [None, *(frame.world_from_cam for frame in frames), None]
    for t, (previous, current) in enumerate(pairwise(frames)):
        found.add(previous, current, shots.flow[t + 1].astype(np.float32), poses[t], poses[t + 3])
    return found.diagnosis()


def tensordict_of(shots: Shots) -> tuple[TensorDict, torch.Tensor]:
    """Returns shots as an env and flowrep's transforms give them, and K."""
    from flowrep import geometry

    depth = torch.from_numpy(shots.depth.copy()).float().unsqueeze(1)
    ids = torch.from_numpy(shots.ids.copy()).long().unsqueeze(1)
    rows, K = rows_of(shots), torch.from_numpy(shots.K[0]).float()
    motion = torch.from_numpy(rows[:, 0]).float()
    if shots.row_0 is not None:
        rows = np.concatenate([shots.row_0[:, None], rows[:, 1:]], 1)
    rows = torch.from_numpy(rows).float()
    sensor = {"depth": depth, "instance": ids, "prev_from_curr": motion, "instance_motion": rows}
    sensor["world_from_cam"] = torch.from_numpy(shots.poses.copy())
    raw = geometry.rigid_flow(depth, ids, K, rows)
    parts = geometry.factorize(raw, depth, K, motion)
    flows = {"raw": raw.flow, "raw_valid": raw.valid, "ego": parts.ego, "obj": parts.obj}
    return TensorDict({"sensor": sensor, **flows}, [len(depth)]), K


def rows_of(shots: Shots) -> Array:
    """Returns `instance_motion`, [T, 1 + N, 4, 4]."""
    back = np.linalg.inv(np.concatenate([shots.poses[:1], shots.poses[:-1]]))
    return back[:, None] @ shots.moved @ shots.poses[:, None]


def found_of(shots: Shots) -> Any:
    from flowrep import diagnose

    return diagnose(*tensordict_of(shots)) if shots.is_env else examined(shots)


def effect_px(right: Shots, wrong: Shots) -> tuple[float, float]:
    """Returns how far a mistake moves ego or object flow, and the median length of flow, px."""
    moved, lengths = [], []
    rows = (
        [rows_of(each) for each in (right, wrong)] if right.is_env and right.ids is not None else []
    )
    for t in range(1, min(len(right.depth), len(wrong.depth))):
        both = [flow_of(each, t) for each in (right, wrong)]
        raw = right.flow[t]
        lengths.append(np.linalg.norm(raw, axis=0))
        change = [np.linalg.norm(both[1] - both[0], axis=0)]
        if rows:
            bodies = [flow_of(s, t, r[t][s.ids[t].ravel()]) for s, r in zip((right, wrong), rows)]
            on = right.ids[t] > 0
            change.append(np.where(on, np.linalg.norm(bodies[1] - bodies[0], axis=0), np.nan))
        else:
            change.append(np.linalg.norm((wrong.flow[t] - both[1]) - (raw - both[0]), axis=0))
        moved.append(change)
    known = [np.concatenate([x.ravel() for x in each]) for each in zip(*moved)]
    known = [np.where(np.isnan(x), np.inf if i == 0 else np.nan, x) for i, x in enumerate(known)]
    px = [float(np.nanmedian(x)) if np.isfinite(x).any() else 0.0 for x in known]
    return max(min(x, 1e4) for x in px), float(
        np.nanmedian(np.concatenate([x.ravel() for x in lengths]))
    )


def outcome(
    right: Shots, name: str, wanted: tuple[str, ...], wrong: Shots
) -> tuple[str, Any, float]:
    """Returns what came out, the diagnosis, and what the mistake changes, px."""
    found = found_of(wrong)
    if not name:
        return "called wrong" if found.is_wrong else found.verdict, found, 0.0
    px, flow_px = effect_px(right, wrong)
    if px <= max(0.05, 0.05 * flow_px):
        return "no effect", found, px
    if found.is_wrong:
        names = " ".join(found.suspects)
        if wanted and any(part in names for part in wanted):
            return "named", found, px
        return "misnamed" if found.verdict == "wrong" and names and wanted else "noticed", found, px
    if found.verdict == "can't tell":
        return "can't tell", found, px
    said = " ".join([*found.unseen, *found.notes])
    if px <= 1.05 * found.error_px or any(part in said for part in wanted):
        return "within", found, px
    return "passed", found, px


def wilson(count: int, total: int) -> str:
    if not total:
        return "none"
    p, z = count / total, 1.96
    middle, half = p + z * z / 2 / total, z * np.sqrt(p * (1 - p) / total + z * z / 4 / total**2)
    low, high = ((middle + sign * half) / (1 + z * z / total) for sign in (-1, 1))
    return f"{count:4d} of {total:4d} = {p:6.1%} ({max(low, 0):.1%} to {high:.1%})"


def cells(
    seeds: range, what: str = "both"
) -> Iterator[tuple[int, str, Shots, str, Any, float, float]]:
    """Yields seed, mistake ("" if right), shots, outcome, diagnosis, effect and seconds."""
    from benchmarks.mistakes import drawn

    for seed in seeds:
        right, start = draw(seed), time.process_time()
        if what != "mistakes":
            kind, found, px = outcome(right, "", (), right)
            yield seed, "", right, kind, found, px, time.process_time() - start
        if what != "right":
            name, wanted, wrong = drawn(right, seed)
            start = time.process_time()
            kind, found, px = outcome(right, name, wanted, wrong)
            yield seed, name, right, kind, found, px, time.process_time() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 10))
    parser.add_argument("--what", choices=["both", "right", "mistakes"], default="both")
    parser.add_argument("--quiet", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rights, mistakes, kinds, seconds = Counter(), Counter(), Counter(), []
    for seed, name, shots, kind, found, px, spent in cells(range(*args.seeds), args.what):
        seconds.append(spent)
        route, share = shots.kind[2], "< 50 % moving" if shots.moving < 0.5 else ">= 50 %"
        if name:
            mistakes[kind] += 1
            kinds[f"{name:32}", kind] += 1
        else:
            noise = "noisy poses" if "poses" in shots.kind else "exact poses"
            for group in ("all " + share, f"{route}, {shots.kind[3]}, {share}", f"{route}, {noise}, {share}",
                          f"{shots.kind[1]}, {share}"):  # fmt: skip
                rights[group, kind] += 1
        if not args.quiet:
            print(seed, f"{spent:.1f}s", ",".join(shots.kind), f"{shots.depth.shape[1:]} {shots.moving:.0%} |",
                  name or "right", "|", kind, f"| {px:.3g} px |", str(found).splitlines()[0][:230], flush=True)  # fmt: skip
    for group in sorted({group for group, _ in rights}):
        total = sum(n for (g, _), n in rights.items() if g == group)
        line = [
            f"{kind}: {wilson(rights[group, kind], total)}"
            for kind in ("called wrong", "can't tell")
        ]
        print(f"{group:44}", "; ".join(line))
    total = sum(n for kind, n in mistakes.items() if kind != "no effect")
    for kind in ("named", "noticed", "misnamed", "can't tell", "within", "passed"):
        print(f"mistakes {kind:12} {wilson(mistakes[kind], total)}")
    for name in sorted({name for name, _ in kinds}):
        print("  ", name, {kind: n for (m, kind), n in kinds.items() if m == name})
    print(
        f"{len(seconds)} diagnoses, {np.mean(seconds):.2f} s each (process time), at most {max(seconds):.2f}"
    )


if __name__ == "__main__":
    main()
