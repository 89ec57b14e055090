"""Ego flow on recorded frames of a static room: what it says agrees with the frame before."""

from pathlib import Path

import numpy as np
import pytest
import torch

from flowrep.geometry import ego_flow, factorize, relative_motion, transform_points, unproject

FOLDER = Path(__file__).resolve().parents[3] / "shared" / "data" / "7scenes"
pytestmark = pytest.mark.skipif(
    not FOLDER.is_dir(),
    reason=f"no 7-Scenes frames at {FOLDER}",
)


def read(frame: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Returns depth `[1, 480, 640]` in metres, nan where missing, and the camera-in-world pose."""
    pillow = pytest.importorskip("PIL.Image")
    stem = FOLDER / f"frame-{frame:06d}"
    millimetres = np.asarray(pillow.open(f"{stem}.depth.png")).astype(np.float32)
    metres = np.where((millimetres == 0) | (millimetres == 65535), np.nan, millimetres / 1000)
    world_from_cam = torch.from_numpy(np.loadtxt(f"{stem}.pose.txt"))
    return torch.from_numpy(metres).float()[None], world_from_cam


def intrinsics() -> torch.Tensor:
    return torch.from_numpy(np.loadtxt(FOLDER / "camera-intrinsics.txt")).float()


def depth_disagreement(prev: int, curr: int, flow_sign: float = 1.0, swap_poses: bool = False):
    """Returns the median of |z found - z predicted| / z in the previous frame."""
    (prev_depth, world_from_prev), (depth, world_from_curr) = read(prev), read(curr)
    poses = (world_from_curr, world_from_prev) if swap_poses else (world_from_prev, world_from_curr)
    prev_from_curr = relative_motion(*poses)
    flow, valid = ego_flow(depth, intrinsics(), prev_from_curr)
    predicted = transform_points(prev_from_curr, unproject(depth, intrinsics()))[..., 2]
    height, width = predicted.shape
    row, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    # p' = p - flow; its pixel is the floor of u and v, since centres lie at halves.
    u, v = (column + 0.5 - flow_sign * flow[0]).floor(), (row + 0.5 - flow_sign * flow[1]).floor()
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    found = prev_depth[0, v.clamp(0, height - 1).long(), u.clamp(0, width - 1).long()]
    known = valid[0] & inside & found.isfinite()
    assert known.float().mean() > 0.5
    return ((found - predicted).abs() / predicted)[known].median().item()


@pytest.mark.parametrize(("prev", "curr"), [(100, 101), (101, 102), (100, 110)])
def test_depth_found_along_the_flow_is_the_depth_predicted(prev, curr):
    right = depth_disagreement(prev, curr)
    assert right < 0.01
    # The rivals: curr_from_prev for prev_from_curr, and flow with its sign turned.
    assert depth_disagreement(prev, curr, swap_poses=True) > 3 * right
    assert depth_disagreement(prev, curr, flow_sign=-1.0) > 3 * right


def test_holes_are_masked_and_a_static_room_has_no_object_flow():
    (_, world_from_prev), (depth, world_from_curr) = read(100), read(110)
    prev_from_curr = relative_motion(world_from_prev, world_from_curr)
    ego, valid = ego_flow(depth, intrinsics(), prev_from_curr)
    hole = depth.isnan()
    assert hole.any()
    assert not valid[hole].any()
    assert valid[~hole].all()
    assert factorize(ego, depth, intrinsics(), prev_from_curr).obj.abs().max() == 0
