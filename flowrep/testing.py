"""Checks flow from outside: each frame, warped by its flow, must give the frame before it.

Conventions of depth, poses and cameras fail silently: every sign and unit gives numbers, and most
wrong ones look plausible. `check_flow` needs nothing but recorded frames, and tells.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional

from flowrep import geometry

_OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))
_TWICE = torch.diag(torch.tensor([2.0, 2.0, 1.0]))  # K of a picture twice as large: _TWICE @ K
# (depth, K, motions) under another convention, by what the user's data would then be.
_SUSPECTS: dict[str, Callable[[Tensor, Tensor, Tensor], tuple[Tensor, Tensor, Tensor]]] = {
    "depth is the ray's length": lambda z, K, m: (geometry.z_from_ray_length(z, K), K, m),
    "motions are curr_from_prev": lambda z, K, m: (z, K, geometry.invert_rigid(m)),
    "poses have OpenGL's axes": lambda z, K, m: (z, K, _OPENGL.to(m) @ m @ _OPENGL.to(m)),
    "K is of a picture twice this size": lambda z, K, m: (z, _TWICE.inverse().to(K) @ K, m),
    "K is of a picture half this size": lambda z, K, m: (z, _TWICE.to(K) @ K, m),
}


@dataclass(frozen=True)
class FlowCheck:
    """What `check_flow` found; printed, it is a table.

    Args:
        agreement: share of the visible pixels whose flow points to a place where the previous frame
            shows the same body at the right depth.
        hidden: share of the pixels that can't be compared: unknown flow, outside the previous
            picture, or behind something nearer there.
        flows: agreement of other flows on the same data; each should be lower.
        suspects: agreement if the data were in another convention; each should be lower.
        movement_px: median length of raw flow. Below a pixel, nothing can be told.
    """

    agreement: float
    hidden: float
    movement_px: float
    flows: dict[str, float]
    suspects: dict[str, float]

    @property
    def is_right(self) -> bool:
        """Whether nothing else explains the frames as well, and hardly a pixel contradicts them."""
        rivals = max([*self.flows.values(), *self.suspects.values()])
        return self.movement_px >= 1.0 and self.agreement > 0.95 and self.agreement > rivals

    def __str__(self) -> str:
        rows = {"raw flow as given": self.agreement} | self.flows | self.suspects
        lines = [f"{name:36} {100 * share:6.2f} % agree" for name, share in rows.items()]
        lines.append(f"{'not comparable':36} {100 * self.hidden:6.2f} %")
        lines.append(f"median raw flow {self.movement_px:.1f} px")
        if self.movement_px < 1.0:
            lines.append("can't tell: record frames in which the camera moves and turns more")
        elif self.is_right:
            lines.append("right")
        else:
            name = max(rows, key=lambda row: rows[row])
            lines.append("wrong" if name == "raw flow as given" else f"wrong; perhaps: {name}")
        return "\n".join(lines)


def check_flow(
    frames: TensorDictBase, intrinsics: Any, *, raw_key: str = "raw", tolerance: float = 0.03
) -> FlowCheck:
    """Returns how well raw flow warps each frame into the one before it.

    The same is tried for flows and conventions that are wrong on purpose; right data beat them all.

    Convention: a pixel p of frame t shows a point that was at p − raw in frame t − 1, in the depth
    that `instance_motion` says. Inverse depth is interpolated, since it is linear on a plane.

    Args:
        frames: successive frames `[*B, T]` of a drive that turns, without a reset in between, for
            example `env.rollout(50)["next"]`. Holds raw flow in px per step, `("sensor", "depth")`,
            `("sensor", "instance")` and `("sensor", "instance_motion")`; without the latter two,
            `("sensor", "prev_from_curr")` and a static world.
        intrinsics: K `[3, 3]` of the maps.
        raw_key: the key of raw flow.
        tolerance: relative error of depth that still agrees.

    Raises:
        ValueError: there are fewer than two frames.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> motion = torch.eye(4)
        >>> motion[0, 3] = 0.1  # the camera moves to the right past a wall, 5 px per step
        >>> depth = torch.ones(3, 1, 8, 60)
        >>> sensor = {"depth": depth, "prev_from_curr": motion.repeat(3, 1, 1)}
        >>> raw = torch.tensor([-5.0, 0.0]).reshape(1, 2, 1, 1).expand(3, 2, 8, 60)
        >>> frames = TensorDict({"sensor": sensor, "raw": raw}, [3])
        >>> check_flow(frames, [[50.0, 0, 30], [0, 50.0, 4], [0, 0, 1]]).agreement
        1.0
    """
    if frames.ndim == 0 or frames.shape[-1] < 2:
        raise ValueError(f"check_flow compares successive frames; got a batch of {frames.shape}")
    K = torch.as_tensor(intrinsics, dtype=torch.float32)
    sensor = frames["sensor"]
    depth = sensor["depth"].float()
    if "instance_motion" in sensor:
        motions, ids = sensor["instance_motion"].float(), sensor["instance"]
    else:
        motions = sensor["prev_from_curr"].float().unsqueeze(-3)
        ids = torch.zeros_like(depth, dtype=torch.uint8)
    raw = frames[raw_key].float()
    if (known := frames.get(f"{raw_key}_valid", None)) is not None:
        raw = torch.where(known, raw, torch.nan)

    before = _depth_before(depth, ids, K, motions)
    share, hidden = _agreement(raw, depth, ids, before, tolerance)
    ego = geometry.ego_flow(depth, K, motions[..., 0, :, :]).flow
    flows = {"no flow": torch.zeros_like(raw), "-raw": -raw, "ego flow alone": ego}
    if not (ids > 0).any():
        del flows["ego flow alone"]  # the same in a static world
    suspects = {}
    for name, change in _SUSPECTS.items():
        z, k, m = change(depth, K, motions)
        flow = geometry.rigid_flow(z, ids, k, m).flow
        suspects[name], _ = _agreement(flow, z, ids, _depth_before(z, ids, k, m), tolerance)
    moving = raw[..., 1:, :, :, :].norm(dim=-3)
    moving = moving[moving.isfinite() & depth[..., 1:, 0, :, :].isfinite()]
    return FlowCheck(
        share,
        hidden,
        moving.median().item() if len(moving) else 0.0,
        {n: _agreement(flow, depth, ids, before, tolerance)[0] for n, flow in flows.items()},
        suspects,
    )


def _depth_before(depth: Tensor, ids: Tensor, K: Tensor, motions: Tensor) -> Tensor:
    """Returns the depth `[*B, T, 1, H, W]` of each pixel's point in the previous camera's frame."""
    rows = ids.long().flatten(-3)
    row = motions[..., 2, :].gather(-2, rows.unsqueeze(-1).expand(*rows.shape, 4))
    points = geometry.unproject(depth, K).reshape(*depth.shape[:-3], -1, 3)
    return (row[..., :3] * points).sum(-1).add(row[..., 3]).unflatten(-1, depth.shape[-3:])


def _agreement(
    flow: Tensor, depth: Tensor, ids: Tensor, expected: Tensor, tolerance: float
) -> tuple[float, float]:
    """Returns the shares of pixels that agree, of the visible ones, and that can't be compared."""
    height, width = depth.shape[-2:]
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    before = torch.stack([u, v]).to(flow) - flow[..., 1:, :, :, :]
    inside = (before > 0).all(-3) & (before[..., 0, :, :] < width) & (before[..., 1, :, :] < height)
    grid = 2 * before / torch.tensor([width, height]).to(flow).reshape(2, 1, 1) - 1
    grid = grid.nan_to_num(2.0).movedim(-3, -1).flatten(0, -4)

    def looked_up(maps: Tensor, mode: str) -> Tensor:
        maps = maps[..., :-1, :, :, :]
        out = functional.grid_sample(
            maps.flatten(0, -4).float(), grid, mode, padding_mode="border", align_corners=False
        )
        return out.reshape(maps.shape).squeeze(-3)

    seen = looked_up(1 / depth, "bilinear")  # sky is 0, missing depth nan
    now = expected[..., 1:, 0, :, :]
    measured = flow[..., 1:, :, :, :].isfinite().all(-3)
    known = inside & measured & seen.isfinite() & now.isfinite() & (now > 0)
    ratio = seen * now  # above 1, something nearer stood there
    visible = known & (ratio < 1 + tolerance)
    same = looked_up(ids, "nearest") == ids[..., 1:, 0, :, :]
    # At an edge the interpolated depth is a mixture; the nearest pixel is then the better witness.
    nearest = looked_up(1 / depth, "nearest") * now
    agree = visible & same & ((ratio > 1 - tolerance) | ((nearest - 1).abs() < tolerance))
    return (
        (agree.sum() / visible.sum().clamp(min=1)).item(),
        1 - (visible.sum() / visible.numel()).item(),
    )
