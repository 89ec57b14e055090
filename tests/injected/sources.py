"""Right data of several kinds, to make mistakes in: plain arrays, as a user's files hold them.

The room is cast by rays here and its flow comes from points moved through the world: nothing of
flowrep's geometry takes part in either.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch

from tests.sequences.synthetic import SEVEN_SCENES

Array = np.ndarray


@dataclass(frozen=True)
class Shots:
    """A recording of T frames; what it does not have is None.

    Convention: CONVENTIONS.md's, float64. `flow[t]` is that since frame t - 1, nan where unknown;
    without it, flow is estimated from the pictures.
    """

    depth: Array  # [T, H, W]
    poses: Array  # [T, 4, 4], world_from_cam
    K: Array  # [T, 3, 3]
    rgb: Array | None = None  # [T, H, W, 3], uint8
    flow: Array | None = None  # [T, 2, H, W]
    ids: Array | None = None  # [T, H, W]
    moved: Array | None = None  # [T, 1 + N, 4, 4], by id, takes the world's points to before
    late: Array | None = None  # poses 0.4 frames earlier

    def with_(self, **changes) -> Shots:
        return replace(self, **changes)


def euler(roll: float, pitch: float, yaw: float) -> Array:
    """Returns Rz(yaw) Ry(pitch) Rx(roll)."""
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (roll, pitch, yaw))
    x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return z @ y @ x


def rigid(rotation: Array, place) -> Array:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, place
    return pose


def centres(height: int, width: int) -> tuple[Array, Array]:
    v, u = np.mgrid[:height, :width] + 0.5
    return u, v


def projected(points: Array, K: Array, shape: tuple[int, int]) -> Array:
    """Returns where a camera sees points [3, N] of its frame, [2, H, W], nan behind it."""
    x, y, z = K @ points
    z = np.where(z > 0.02, z, np.nan)
    return np.stack([x / z, y / z]).reshape(2, *shape)


def ego_flow(shots: Shots, t: int) -> Array:
    """Returns the flow of a static world by depth, K and poses as they are, [2, H, W]."""
    shape = shots.depth.shape[1:]
    u, v = centres(*shape)
    z = np.where(np.isinf(shots.depth[t]), 1e7, shots.depth[t])
    z = np.where(z > 0, z, np.nan)
    rays = np.linalg.inv(shots.K[t]) @ np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
    motion = np.linalg.inv(shots.poses[t - 1]) @ shots.poses[t]
    points = motion[:3, :3] @ (rays * z.ravel()) + motion[:3, 3:]
    return np.stack([u, v]) - projected(points, shots.K[t - 1], shape)


# --- a room ---------------------------------------------------------------------------------------

CAMERA = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # right, down, ahead at yaw 0; z is up
SIZE = (120, 160)
K = np.array([[142.0, 0, 84.0], [0, 128.0, 57.0], [0, 0, 1]])
WALLS = np.array([[-3.1, -2.4, 0.0], [3.4, 2.7, 2.8]])  # the corners of the room
BOXES = np.array(
    [
        [[1.5, 0.4, 0.0], [2.2, 1.3, 1.1]], [[1.2, -1.7, 0.0], [1.9, -0.8, 1.9]],
        [[-1.9, 1.2, 0.0], [-1.0, 2.0, 0.9]], [[-2.3, -1.6, 0.0], [-1.4, -0.9, 1.4]],
        [[0.2, -2.2, 0.6], [0.7, -1.7, 1.2]], [[-0.5, 1.9, 0.0], [0.6, 2.4, 1.6]],
    ]
)  # fmt: skip
MOVERS = ((0.22, 0.2, 0.3), (0.2, 0.25, 0.22))  # half sides


def hand_held(seed: int, times: Array) -> Array:
    """Returns the poses of a camera carried through the room, some 7 cm and 2 degrees a frame."""
    random = np.random.default_rng(seed)
    phase, period = random.uniform(0, 2 * np.pi, (6, 2)), random.uniform(14, 26, (6, 2))
    size = np.array([0.26, 0.26, 0.12, 0.05, 0.09, 0.15])[:, None] * [[1.0, 0.15]]
    period[:, 1] /= 2.0
    waves = (size * np.sin(2 * np.pi * times[:, None, None] / period + phase)).sum(-1)
    waves += np.array([0.0, 0.2, 1.4, 0.0, 0.12, random.uniform(0, 2 * np.pi)])
    waves[:, 5] += random.choice([-1, 1]) * 0.012 * times
    return np.array([rigid(euler(*w[3:]) @ CAMERA, w[:3]) for w in waves])


def cast(pose: Array, movers: list[tuple[Array, Array]]) -> tuple[Array, Array, Array]:
    """Returns depth, ids and the points of the world that the pixels see."""
    u, v = centres(*SIZE)
    rays = np.linalg.inv(K) @ np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
    rays, origin = (pose[:3, :3] @ rays).T, pose[:3, 3]  # of a depth of 1
    z, ids = np.max((WALLS[:, None] - origin) / rays, 0).min(-1), np.zeros(len(rays), int)
    solids = [(corners, 0) for corners in BOXES]
    sides = np.array([[-1.0], [1.0]])
    solids += [(place + sides * half, i + 1) for i, (place, half) in enumerate(movers)]
    for corners, number in solids:
        ends = (corners[:, None] - origin) / rays
        near, far = np.min(ends, 0).max(-1), np.max(ends, 0).min(-1)
        hit = (near < far) & (near > 0.05) & (near < z)
        z[hit], ids[hit] = near[hit], number
    return z.reshape(SIZE), ids.reshape(SIZE), origin + z[:, None] * rays


def painted(points: Array, seed: int) -> Array:
    """Returns colours of a texture of many scales without steps."""
    random = np.random.default_rng(seed)
    waves = random.normal(size=(28, 3)) * random.uniform(3.0, 26.0, (28, 1))
    phase, turned = random.uniform(0, 2 * np.pi, (28, 3)), points @ waves.T
    grey = np.stack([np.sin(turned + phase[:, c]).sum(-1) for c in range(3)], -1)
    return np.clip(128 + 17 * grey, 0, 255).astype(np.uint8)


@cache
def room(seed: int = 0, frames: int = 16, movers: int = 0) -> Shots:
    """Returns a room with exact depth, poses and flow, and textured pictures."""
    random, poses = np.random.default_rng(seed + 1), hand_held(seed, np.arange(frames))
    middle, ahead, bodies = poses[frames // 2, :3, 3], poses[frames // 2, :3, 2], []
    for i in range(movers):
        side = np.cross(ahead, [0, 0, 1.0]) * (0.7 if i % 2 else -0.6)
        step = random.uniform(-0.06, 0.06, 3) * [1, 1, 0.3]
        bodies.append((middle + 1.7 * ahead + side, step, np.array(MOVERS[i])))
    return filmed(seed, poses, bodies)


@cache
def crowd(
    seed: int = 0, people: int = 4, noise_px: float = 0.15, is_common: bool = False,
    frames: int = 16, speed: float = 0.4,
) -> Shots:  # fmt: skip
    """Returns a room with people who walk, by default on 43 % of the picture; noise of flow.

    Args:
        is_common: all walk alike; else each in a direction.
        speed: the camera's, 1 is that in `room`.
    """
    random, poses = np.random.default_rng(seed + 50), hand_held(seed, speed * np.arange(frames))
    middle, ahead, bodies = poses[frames // 2, :3, 3], poses[frames // 2, :3, 2], []
    side, walk = np.cross(ahead, [0, 0, 1.0]), random.uniform(0, 2 * np.pi)
    for i in range(people):
        across = 2.4 * (i + random.uniform(0.2, 0.8)) / people - 1.2
        place = middle + random.uniform(1.6, 2.2) * ahead + across * side
        angle = walk if is_common else random.uniform(0, 2 * np.pi)
        step = random.uniform(0.03, 0.05) * np.array([np.cos(angle), np.sin(angle), 0])
        bodies.append((np.array([*place[:2], 0.85]), step, np.array([0.15, 0.15, 0.85])))
    shots = filmed(seed, poses, bodies)
    return shots.with_(flow=shots.flow + noise_px * random.normal(size=shots.flow.shape), rgb=None,
                       late=hand_held(seed, speed * np.arange(frames) - 0.4))  # fmt: skip


def filmed(seed: int, poses: Array, bodies: list[tuple[Array, Array, Array]]) -> Shots:
    """Returns the room with bodies: place in the middle of the film, step a frame, half sides."""
    frames, (u, v) = len(poses), centres(*SIZE)
    moved = np.tile(np.eye(4), (frames, 1 + len(bodies), 1, 1))
    for i, (_, step, _) in enumerate(bodies):
        moved[1:, i + 1, :3, 3] = -step
    maps: dict[str, list[Array]] = {name: [] for name in ("depth", "rgb", "flow", "ids")}
    for t, pose in enumerate(poses):
        places = [place + (t - frames / 2) * step for place, step, _ in bodies]
        z, ids, points = cast(pose, [(p, half) for p, (_, _, half) in zip(places, bodies)])
        before = points + moved[t, ids.ravel(), :3, 3]
        back = poses[max(t - 1, 0)]
        seen = projected(back[:3, :3].T @ (before - back[:3, 3]).T, K, SIZE)
        maps["flow"].append(np.stack([u, v]) - seen if t else np.full((2, *SIZE), np.nan))
        on_body = points - np.array([np.zeros(3), *places])[ids.ravel()]
        maps["rgb"].append(painted(on_body, seed).reshape(*SIZE, 3))
        maps["depth"].append(z)
        maps["ids"].append(ids)
    depth, rgb, flow, ids = (np.array(maps[name]) for name in ("depth", "rgb", "flow", "ids"))
    late = hand_held(seed, np.arange(frames) - 0.4)
    return Shots(depth, poses, np.tile(K, (frames, 1, 1)), rgb, flow, ids, moved, late)


def realsense(seed: int = 0) -> Shots:
    """Returns the room with movers as a RealSense gives it: noise of flow, depth, poses; holes."""
    shots, random = room(seed, 20, movers=1 + seed % 2), np.random.default_rng(seed + 100)
    flow = shots.flow + 0.3 * random.normal(size=shots.flow.shape)
    depth = shots.depth * (1 + 0.005 * shots.depth * random.normal(size=shots.depth.shape))
    depth[random.random(depth.shape) < 0.05] = np.nan
    for z in depth:
        for _ in range(4):
            i, j = random.integers(0, SIZE[0] - 20), random.integers(0, SIZE[1] - 20)
            z[i : i + 18, j : j + 16] = np.nan
    poses, late = shots.poses.copy(), shots.late.copy()
    for pose in (*poses, *late):
        pose[:3, 3] += 0.001 * random.normal(size=3)
        pose[:3, :3] = pose[:3, :3] @ euler(*(0.0007 * random.normal(size=3)))
    return shots.with_(flow=flow, depth=depth, poses=poses, late=late)


# --- other people's worlds ------------------------------------------------------------------------


@cache
def street(
    seed: int = 0, frames: int = 14, size: tuple[int, int] = (120, 160), scene_name: str = "s_turn",
    skipped: int = 40,
) -> Shots:  # fmt: skip
    """Returns a drive of flowrep's planner, by default through a turn among people."""
    from flowrep.baselines import Planner
    from flowrep.envs import StreetEnv
    from flowrep.envs.sensing import SENSORS
    from flowrep.scenes import load_scene

    scene = load_scene(scene_name)
    camera = replace(scene.camera, height_px=size[0], width_px=size[1])
    env, planner = StreetEnv(replace(scene, camera=camera), sensors=SENSORS), Planner()
    names = ("depth", "rgb", "instance", "prev_from_curr", "instance_motion")
    maps: dict[str, list[Array]] = {name: [] for name in names}
    try:
        env.reset(seed=seed)
        for _ in range(skipped):
            env.drive(planner(env))
        for _ in range(frames):
            seen, *_ = env.step(planner(env))
            for name in names:
                maps[name].append(np.array(seen[name]))
        camera_matrix = np.array(env.K, float)
    finally:
        env.close()
    # A world of its own, in which the first camera neither stands at the origin nor upright.
    poses = [rigid(euler(0.1, -0.2, 0.7) @ CAMERA, (12.0, -5.0, 1.5))]
    for motion in maps["prev_from_curr"][1:]:
        poses.append(poses[-1] @ motion.astype(float))
    depth, rgb = np.array(maps["depth"], float)[:, 0], np.array(maps["rgb"]).transpose(0, 2, 3, 1)
    ids, rows = np.array(maps["instance"], int)[:, 0], np.array(maps["instance_motion"], float)
    return of_rows(depth, np.array(poses), camera_matrix, rgb, ids, rows)


def of_rows(depth, poses, camera_matrix, rgb, ids, rows) -> Shots:
    """Returns shots of an env's data, with flow by its rows of motions."""
    frames, shape = len(depth), depth.shape[1:]
    flow = np.full((frames, 2, *shape), np.nan)
    moved = np.tile(np.eye(4), (frames, rows.shape[1], 1, 1))
    u, v = centres(*shape)
    rays = np.linalg.inv(camera_matrix) @ np.stack([u, v, np.ones_like(u)]).reshape(3, -1)
    for t in range(1, frames):
        moved[t] = poses[t - 1] @ rows[t] @ np.linalg.inv(poses[t])
        points = rays * np.where(np.isinf(depth[t]), 1e9, depth[t]).ravel()
        of_row = rows[t][ids[t].ravel()]
        seen = np.einsum("nij,jn->in", of_row[:, :3, :3], points) + of_row[:, :3, 3].T
        flow[t] = np.stack([u, v]) - projected(seen, camera_matrix, shape)
    return Shots(depth, poses, np.tile(camera_matrix, (frames, 1, 1)), rgb, flow, ids, moved)


@cache
def doom(seed: int = 0) -> Shots | None:
    """Returns a walk in ViZDoom, whose depth is a byte, None without it."""
    try:
        from examples.vizdoom_flow import K as camera_matrix
        from examples.vizdoom_flow import make_env
    except ImportError:
        return None
    here = Path.cwd()
    try:
        env = make_env("deadly_corridor")
        env.set_seed(seed)
        with torch.random.fork_rng():
            torch.manual_seed(seed)  # of the actions
            frames = env.rollout(16)["next"]
        env.close()
    finally:
        os.chdir(here)
        (here / "_vizdoom.ini").unlink(missing_ok=True)
    sensor = frames["sensor"]
    depth, ids = (sensor[name][:, 0].numpy() for name in ("depth", "instance"))
    rgb, poses = sensor["rgb"].permute(0, 2, 3, 1).numpy(), sensor["world_from_cam"].numpy()
    rows = sensor["instance_motion"].double().numpy()
    K = camera_matrix.double().numpy()
    return of_rows(depth.astype(float), poses, K, rgb, ids.astype(int), rows)


def seven_scenes(seed: int = 0) -> Shots | None:
    """Returns the frames of 7-Scenes beside the checkout, None without them."""
    if SEVEN_SCENES is None or seed:
        return None
    from flowrep.sequences import open_recording

    frames = [*open_recording(SEVEN_SCENES, "sevenscenes")]
    depth, rgb = np.array([f.depth for f in frames], float), np.array([f.rgb for f in frames])
    poses, cameras = np.array([f.world_from_cam for f in frames]), np.array([f.K for f in frames])
    return Shots(depth, poses, cameras, rgb)


def estimated(make: Callable[[int], Shots | None]) -> Callable[[int], Shots | None]:
    return lambda seed: None if (shots := make(seed)) is None else shots.with_(flow=None)


# By their name in the docs; a seed gives another recording, None where there is none.
RECORDINGS: dict[str, Callable[[int], Shots | None]] = {
    "room": room,
    "room, noisy": realsense,
    "room, DIS": estimated(room),
    "street": street,
    "street, DIS": estimated(street),
    "7-Scenes, DIS": seven_scenes,
}
ENVS: dict[str, Callable[[int], Shots | None]] = {
    "room, env": lambda seed: room(seed, movers=2),
    "street, env": lambda seed: street(seed, 14, (84, 84)),
    "ViZDoom, env": doom,
}
