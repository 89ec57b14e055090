"""Residuals of camera motions on pairs of frames, and the motion with the smallest residuals."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from flowrep.geometry.egomotion import structure_tensor
from flowrep.geometry.pose import relative_motion, rotation_from_vector

EYE = torch.eye(4, dtype=torch.float64)
PIXELS = 1000  # that are sampled from each pair
FITTED = 400  # of these: motions and numbers are fitted to fewer pixels, to save time
_LEAST_TEXTURE = 0.25  # of a structure tensor's trace, 0 to 2: with less, flow is a guess
_BEHIND_PX = 1e3  # residual of a point that a motion puts behind the camera
_STEP = 1e-6  # of numeric derivatives in float64, in radians, metres, or a change's numbers
# Interpolated depth is exact on planes only: on round bodies, right data have residuals of 0.02 px.
INTERPOLATED_PX = 0.04
PARTS = 6, 4  # columns and rows of a picture, in which noise averages out and bodies don't
_LOST_PIXEL_WEIGHT = 5.0  # of a pixel that no longer agrees, relative to one that begins to agree
_STEP_TOLERANCE = 0.01  # a fit ends when its step changes the residuals' norm by fewer scales


class Pairs(NamedTuple):
    """P pairs of frames as N pixels each, float64, nan where unknown."""

    pixel: Tensor  # [P, 2, N], centres
    raw: Tensor  # [P, 2, N]
    depth: Tensor  # [P, N], of the current frame
    texture: Tensor  # [P, 3, N], the root of the structure tensor: xx, xy, yy
    coarseness: Tensor  # [P, N], depth's step over depth
    K: Tensor  # [P, 3, 3]
    prev_K: Tensor
    path: Tensor  # [P, 4, 4, 4], world_from_cam at t - 2 to t + 1
    now: Tensor  # [P, H, W], inverse depth of the current frame
    before: Tensor  # the same of the previous one
    by_flow: bool  # whether the reference is raw flow, not the depth of the previous frame
    is_estimated: bool  # whether flow was estimated from pictures
    depth_step: float  # of coarse depth, metres
    scale_px: float  # the least scale of residuals
    focal_px: float  # as recorded: residuals of depth are in it, whatever K a rival tries
    gain: Tensor = torch.eye(2, dtype=torch.float64)  # [(P,) 2, 2], raw is this times flow
    distortion: Tensor = torch.zeros(1, 1, dtype=torch.float64)  # [P, 1], of the radius' square

    def select(self, pairs: Any = slice(None), pixels: Any = slice(None)) -> Pairs:
        """Returns some of the pairs, with some of their pixels."""
        maps = [tensor[pairs][..., pixels] for tensor in self[:5]]
        return Pairs._make([*maps, *(tensor[pairs] for tensor in self[5:10]), *self[10:]])

    @staticmethod
    def joined(parts: Sequence[Pairs]) -> Pairs:
        """Returns the pairs of all parts, with the largest of their depth steps."""
        maps = [torch.cat(tensors) for tensors in zip(*(part[:10] for part in parts))]
        pairs = Pairs._make([*maps, *parts[0][10:]])
        return pairs._replace(depth_step=max(part.depth_step for part in parts))

    @property
    def motion(self) -> Tensor:
        """The recorded one, `prev_from_curr` [P, 4, 4]."""
        return relative_motion(self.path[:, 1], self.path[:, 2], dtype=torch.float64)

    @property
    def has_poses(self) -> bool:
        """Whether the recorded motions are known."""
        return bool(self.path[:, 1:3].isfinite().all())

    @property
    def is_coarse(self) -> bool:
        """Whether depth has steps that hide errors."""
        return self.depth_step > 0.01 * median(self.depth)


def sampled(
    raw: Tensor | None, now: Tensor, before: Tensor, K: Tensor, prev_K: Tensor, path: Tensor,
    picture: Tensor | None = None,
) -> Pairs:  # fmt: skip
    """Returns pairs sampled from maps `[P, ..., H, W]`, at known pixels that are spread evenly.

    With a picture, flow counts as known where there is texture: elsewhere, an estimator gives 0 or
    a guess.
    """
    count, width, size = len(now), now.shape[-1], now.shape[-2] * now.shape[-1]
    # Steps of the golden ratio spread evenly, and visit each pixel once if coprime to the size.
    step = int(size / 1.618033988749895) + 1
    while math.gcd(step, size) > 1:
        step += 1
    index = torch.arange(min(size, 8 * PIXELS)) * step % size
    pixel = torch.stack([index % width, index // width]).double() + 0.5

    def at(maps: Tensor) -> Tensor:
        return maps.flatten(-2)[..., index].double()

    depth = at(now)
    depth = torch.where(depth == 0, math.nan, depth)
    flow = torch.zeros(count, 2, len(index)).double() if raw is None else at(raw)
    known = flow.isfinite().all(1) & (depth.isfinite() if raw is None else ~depth.isnan())
    texture = torch.tensor([[1.0], [0.0], [1.0]]).double().expand(count, 3, len(index))
    if picture is not None:
        xx, xy, yy = at(structure_tensor(picture.float())).unbind(1)
        det = (xx * yy - xy * xy).clamp(min=0).sqrt()
        norm = (xx + yy + 2 * det).clamp(1e-9).sqrt().unsqueeze(1)
        texture = torch.stack([xx + det, xy, yy + det], 1) / norm
        known &= xx + yy > _LEAST_TEXTURE
    order = (~known).long().argsort(dim=-1, stable=True)[:, :PIXELS]

    def first(maps: Tensor) -> Tensor:
        maps = torch.where(known.unsqueeze(1), maps, math.nan)
        return maps.gather(-1, order.unsqueeze(1).expand(-1, maps.shape[1], -1))

    values = depth[depth.isfinite()].unique()  # few, if depth was stored in 8 or 16 bits
    is_coarse = 1 < len(values) < 0.1 * depth.numel()
    depth_step = float(values.diff().median()) if is_coarse else 0.0
    z = first(depth.unsqueeze(1)).squeeze(1)
    maps = [first(pixel.expand(count, -1, -1)), first(flow), z, first(texture), depth_step / z]
    whole = [K.double(), prev_K.double(), path.double()]
    whole += [depths.double().reciprocal() for depths in (now, before)]
    scale_px = 0.5 if raw is None else 1e-4
    focal_px = float(K[:, 0, 0].median())
    numbers = (raw is not None, picture is not None, depth_step, scale_px, focal_px)
    fields: Any = [*maps, *whole, *numbers]
    return Pairs(*fields)


def seen_before(pairs: Pairs, motion: Tensor) -> tuple[Tensor, Tensor]:
    """Returns positions in the previous frame, `[..., P, 2, N]`, and depth there over that now."""
    rays = torch.linalg.inv_ex(pairs.K)[0] @ homogeneous(pairs.pixel)
    is_distorted, k1 = bool(pairs.distortion.any()), pairs.distortion[..., None]
    if is_distorted:
        straight = rays[:, :2]
        for _ in range(6):
            straight = rays[:, :2] / (1 + k1 * straight.square().sum(1, keepdim=True)).clamp(0.2)
        rays = homogeneous(straight)
    q = torch.where(pairs.depth > 0, pairs.depth.reciprocal(), math.nan).unsqueeze(-2)
    moved = motion[..., :3, :3] @ rays + motion[..., :3, 3:] * q
    ratio = torch.where(moved[..., 2, :] > 0.01, moved[..., 2, :], math.nan)
    at = moved[..., :2, :] / ratio.unsqueeze(-2)
    if is_distorted:
        at = at * (1 + k1 * at.square().sum(-2, keepdim=True))
    return pairs.prev_K[:, :2, :2] @ at + pairs.prev_K[:, :2, 2:], ratio


def homogeneous(points: Tensor) -> Tensor:
    """Returns points `[..., 2, N]` with a third coordinate of 1."""
    return functional.pad(points, (0, 0, 0, 1), value=1.0)


def residuals(pairs: Pairs, motion: Tensor, *, plain: bool = False) -> Tensor:
    """Returns the residuals of a motion `[..., P, 4, 4]`, px `[..., P, 2 or 1, N]`, nan if unknown.

    The residual of flow is raw flow minus the motion's flow; of estimated flow, only directions
    with texture count, unless `plain`. The residual of depth is how far a surface at 45 degrees
    would have to move to explain the difference between the two depths, minus the depth's step.
    """
    pixel, ratio = seen_before(pairs, motion)
    known = ~pairs.depth.isnan() & motion.isfinite().flatten(-2).all(-1, keepdim=True)
    if not pairs.by_flow:
        share = looked_up(pairs.before, pixel) * pairs.depth * ratio - 1
        share = share.sign() * (share.abs() - pairs.coarseness).clamp(min=0.0)
        residuals_px = (pairs.focal_px * share).masked_fill(ratio.isnan(), _BEHIND_PX)
        return torch.where(known & pairs.depth.isfinite(), residuals_px, math.nan).unsqueeze(-2)
    residuals_px = (pairs.raw - pairs.gain @ (pairs.pixel - pixel)).nan_to_num(nan=_BEHIND_PX)
    known = known & pairs.raw.isfinite().all(-2)
    if pairs.is_estimated and not plain:  # the texture is the picture's, whatever axes the flow has
        xx, xy, yy = pairs.texture.unbind(1)
        u, v = (torch.linalg.inv(pairs.gain) @ residuals_px).unbind(-2)
        residuals_px = torch.stack([xx * u + xy * v, xy * u + yy * v], -2)
        residuals_px = residuals_px * pairs.gain.det().abs().sqrt()[..., None, None]
    return torch.where(known.unsqueeze(-2), residuals_px, math.nan)


def looked_up(maps: Tensor, pixel: Tensor, mode: str = "bilinear") -> Tensor:
    """Returns maps `[P, H, W]` at positions `[..., P, 2, N]`, nan outside."""
    size = torch.tensor([maps.shape[-1], maps.shape[-2]], dtype=torch.float64).unsqueeze(-1)
    inside = ((pixel >= 0.5) & (pixel <= size - 0.5)).all(-2)
    grid = torch.where(inside.unsqueeze(-2), 2 * pixel / size - 1, 0.0)
    grid = grid.reshape(-1, *grid.shape[-3:]).permute(1, 0, 3, 2)  # [P, ..., N, 2]
    values = functional.grid_sample(maps.unsqueeze(1), grid, mode, align_corners=False)
    return torch.where(inside, values[:, 0].transpose(0, 1).reshape(inside.shape), math.nan)


def quantile_px(vectors_px: Tensor, share: float | None = None) -> Tensor:
    """Returns a quantile of the lengths of each pair's vectors `[..., P, C, N]`.

    With flow, it is the median, since half of the picture may move by itself. With depth, of which
    only static pixels are given, it is the 0.8 quantile: along a road or a wall, most depths stay
    the same wherever the camera is, so the median would be near 0 for wrong motions, too.
    """
    share = share or (0.5 if vectors_px.shape[-2] == 2 else 0.8)
    return vectors_px.square().sum(-2).sqrt().nanquantile(share, -1, interpolation="lower")


def spread_of(residuals_px: Tensor) -> Tensor:
    """Returns the median that residuals of noise alone would have, from their lower third."""
    if residuals_px.shape[-2] == 1:
        return quantile_px(residuals_px)
    return math.sqrt(math.log(2) / math.log(1.5)) * quantile_px(residuals_px, 1 / 3)


def difference_px(pairs: Pairs, one: Tensor, other: Tensor) -> Tensor:
    """Returns the difference between the residuals of two motions, which has no noise, px `[P]`."""
    vectors_px = residuals(pairs, one, plain=True) - residuals(pairs, other, plain=True)
    return quantile_px(vectors_px, None if pairs.by_flow else 0.95)


def median(values: Tensor) -> float:
    """Returns the median of known values, inf if most are not."""
    unknown = int(values.isnan().sum())
    return math.inf if 2 * unknown > values.numel() else float(values.nanmedian())


def small_motion(step: Tensor) -> Tensor:
    """Returns rigid transforms `[..., 4, 4]` of (rotation vector, translation) `[..., 6]`."""
    upper = torch.cat([rotation_from_vector(step[..., :3]), step[..., 3:, None]], -1)
    return torch.cat([upper, EYE[3:].expand(*upper.shape[:-2], 1, 4)], -2)


def motion_vector(motion: Tensor) -> Tensor:
    """Returns (rotation vector, translation) `[..., 6]` of rotations well below 180 degrees."""
    sine = skew_part(motion[..., :3, :3]) / 2
    length, trace = sine.norm(dim=-1, keepdim=True), motion.diagonal(dim1=-2, dim2=-1).sum(-1)
    angle = torch.atan2(length, (trace.unsqueeze(-1) - 2) / 2)
    turn = sine * torch.where(length > 1e-9, angle / length, 1.0)
    return torch.cat([turn, motion[..., :3, 3]], -1)


def skew_part(R: Tensor) -> Tensor:
    """Returns a rotation's axis times twice its sine, `[..., 3]`."""
    off = R - R.mT
    return torch.stack([off[..., 2, 1], off[..., 0, 2], off[..., 1, 0]], -1)


Change = Callable[[Pairs, Tensor], Pairs]  # of pairs, with numbers [P, k]


def gauss_newton(
    pairs: Pairs, motion: Tensor | None, change: Change, n: Tensor, group: Tensor, *, steps: int
) -> tuple[Tensor, Tensor]:
    """Returns motions, and the numbers `[G, k]` of a change, with smaller residuals.

    The residuals are weighted as Geman and McClure do.

    Args:
        motion: where the fit of motions starts; None keeps the recorded ones and fits n alone.
        group: `[P]`, the row of n that is a pair's.
    """
    count, (_, k) = len(group), n.shape
    free = 0 if motion is None else 6
    # The unknowns are six of each motion, then the numbers; `index` has those of each pair.
    of_motion, of_group = torch.arange(free * count).view(count, free), k * group.unsqueeze(1)
    index = torch.cat([of_motion, free * count + of_group + torch.arange(k)], 1)
    size = free * count + n.numel()
    tries = small_motion(_STEP * torch.cat([torch.zeros(1, 6), torch.eye(6)]).double()).unsqueeze(1)
    for _ in range(steps):
        changed = change(pairs, n[group])
        moved = changed.motion.unsqueeze(0) if motion is None else tries @ motion
        residuals_px, *columns = residuals(changed, moved)
        for delta in _STEP * torch.eye(k, dtype=torch.float64):
            changed = change(pairs, n[group] + delta)
            columns.append(residuals(changed, changed.motion if motion is None else motion))
        J = (torch.stack(columns, -1) - residuals_px.unsqueeze(-1)) / _STEP  # [P, C, N, free + k]
        known = (residuals_px.isfinite() & J.isfinite().all(-1)).all(-2)
        squared = torch.where(known, residuals_px.square().sum(-2), math.nan)
        scale = scale_of(squared, pairs).square().unsqueeze(-1)
        root = (scale.rsqrt() / (1 + squared / scale)).unsqueeze(1)
        residuals_px = torch.where(known.unsqueeze(1), residuals_px * root, 0.0).flatten(1)
        J = torch.where(known[:, None, :, None], J * root.unsqueeze(-1), 0.0).flatten(1, 2)
        A, b = torch.zeros(size, size).double(), torch.zeros(size).double()
        A.index_put_((index.unsqueeze(2), index.unsqueeze(1)), J.mT @ J, accumulate=True)
        b.index_put_((index,), (J.mT @ residuals_px.unsqueeze(-1)).squeeze(-1), accumulate=True)
        # In units in which all unknowns change the residuals alike; damped where none does.
        unit = A.diagonal().clamp(min=1e-12).rsqrt()
        A = A * unit * unit.unsqueeze(-1) + 1e-6 * torch.eye(size)
        in_units = torch.linalg.solve_ex(A, b * unit)[0].nan_to_num()
        step = unit * in_units
        n = n - step[free * count :].view_as(n)
        if motion is not None:
            motion = small_motion(-step[: free * count].view(count, 6).clamp(-0.5, 0.5)) @ motion
        if in_units.abs().amax() < _STEP_TOLERANCE:
            break
    return change(pairs, n[group]).motion if motion is None else motion, n


def scale_of(squared: Tensor, pairs: Pairs) -> Tensor:
    """Returns 1.5 standard deviations of residuals, from the lower third of their squares."""
    third = squared.nanquantile(1 / 3, -1, interpolation="lower")
    scale = 1.5 * (third / (-2 * math.log(2 / 3))).sqrt()
    return scale.nan_to_num(1.0, 1.0).clamp(pairs.scale_px, 1e4)


def best_motion(pairs: Pairs, *starts: Tensor, steps: int = 5) -> Tensor:
    """Returns each pair's motion with the smallest residuals, from whichever start leads to it."""
    few, motions = pairs.select(pixels=slice(FITTED)), [*starts]
    no_numbers, group = torch.zeros(1, 0).double(), torch.zeros(len(few.K), dtype=torch.long)
    # Edges of depth show the direction in the first round; interpolated, they don't count later.
    rounds = [few] if pairs.by_flow else [few, few._replace(scale_px=INTERPOLATED_PX)]
    for end in starts:
        for each in rounds:
            end, _ = gauss_newton(each, end, lambda p, n: p, no_numbers, group, steps=steps)
        motions.append(end)
    return least_costly(rounds[-1], torch.stack(motions))


def least_costly(pairs: Pairs, motions: Tensor) -> Tensor:
    """Returns that of motions `[M, P, 4, 4]` with which most pixels of each pair agree."""
    agree = agreement(pairs, residuals(pairs, motions)).mean(-1)
    return motions[agree.argmax(0), torch.arange(agree.shape[1])]


def fits_a_crowd(pairs: Pairs, residuals_px: Tensor) -> Tensor:
    """Returns in which pairs `[P]` a motion with these residuals fits a crowd, not the world.

    Where much of the picture moves, another motion may fit more pixels than the right one. It loses
    those that the right one fits, in whole parts of the picture. A correction of a wrong motion
    loses next to none: noise averages out over a part.
    """
    first = residuals(pairs, pairs.motion)
    known_px = torch.where(residuals_px.isnan(), first, residuals_px)
    agree = agreement(pairs, torch.stack([first, known_px]))
    column, row = parts(pairs, *PARTS)
    gained = torch.zeros(agree.shape[1], math.prod(PARTS), dtype=torch.float64)
    gained.scatter_add_(-1, column + PARTS[0] * row, agree[1] - agree[0])
    return (gained - _LOST_PIXEL_WEIGHT * (-gained).clamp(min=0)).sum(-1) < 0


def agreement(pairs: Pairs, residuals_px: Tensor) -> Tensor:
    """Returns the agreement `[M, P, N]`, 0 to 1, with M motions of residuals `[M, P, C, N]`.

    By depth alone, neither an interpolated edge nor a pixel that the first motion moves out of the
    picture is a reason to prefer another motion.
    """
    squared = residuals_px.square().sum(-2)
    scale = torch.stack([scale_of(each, pairs) for each in squared]).amin(0).square().unsqueeze(-1)
    agree = (1 / (1 + squared / scale)).nan_to_num(0.0)
    if not pairs.by_flow:
        agree = agree.masked_fill(squared[0].isnan(), 0.0)
        agree[0] += 0.02
    return agree


def parts(pairs: Pairs, across: int, down: int) -> tuple[Tensor, Tensor]:
    """Returns the column and the row `[P, N]` of the part of the picture that pixels are in."""
    height, width = pairs.now.shape[-2:]
    part = pairs.pixel.nan_to_num() / torch.tensor([[width / across], [height / down]])
    column, row = part.long().unbind(1)
    return column.clamp(0, across - 1), row.clamp(0, down - 1)
