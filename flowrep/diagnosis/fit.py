"""Pairs of frames as pixels, what camera motions leave of them, and a robust fit.

For pixel p with the ray x (z = 1), the inverse depth q and the motion `prev_from_curr` = (R, T),
the previous frame saw the point at the projection of R x + q T. Beside raw flow, the residual is
raw flow minus the shift to there, px; else it is the relative difference between the depth that was
seen there and that of the moved point, in the values that were stored, times the focal length, px.
"""

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
PIXELS = 500  # that are sampled from each pair
_FITTED = PIXELS // 2  # of these: motions and numbers are fitted to fewer pixels, to save time
_LEAST_TEXTURE = 0.25  # of a structure tensor's trace, 0 to 2: with less, flow is a guess
_BEHIND_PX = 1e3  # residual of a point that a motion puts behind the camera
_STEP = 1e-6  # of numeric derivatives in float64, in radians, metres, or a change's numbers
_BEND = 0.02  # share by which inverse depth may differ from the mean of its neighbours
_NEAREST = 0.15  # share of the pixels whose residuals give a fit's scale: more may move by itself


class Pairs(NamedTuple):
    """P pairs of frames as N pixels each, float64, nan where unknown."""

    pixel: Tensor  # [P, 2, N], centres
    raw: Tensor  # [P, 2, N]
    depth: Tensor  # [P, N], of the current frame
    K: Tensor  # [P, 3, 3]
    prev_K: Tensor
    path: Tensor  # [P, 4, 4, 4], world_from_cam at t - 2 to t + 1
    now: Tensor  # [P, H, W], inverse depth of the current frame, 1 / m
    before: Tensor  # the same of the previous one
    by_flow: bool  # whether the reference is raw flow, not the depth of the previous frame
    is_estimated: bool  # whether flow was estimated from pictures
    focal_px: float  # as recorded: residuals of depth are in it, whatever K a mistake tries
    gain: Tensor = torch.eye(2).double()  # [(P,) 2, 2], raw is this times flow
    distortion: Tensor = torch.zeros(1, 1).double()  # [P, 1], of the radius' square
    stretch: Tensor = torch.ones(1, 1).double()  # [P, N], depth's growth per that stored
    grain: float = 0.0  # noise of inverse depth from pixel to pixel, as a share of it

    def select(self, pairs: Any = slice(None), pixels: Any = slice(None)) -> Pairs:
        """Returns some of the pairs, with some of their pixels."""
        maps = [tensor[pairs][..., pixels] for tensor in self[:3]]
        gain = self.gain[pairs] if self.gain.ndim == 3 else self.gain
        bent = self.distortion[pairs] if len(self.distortion) > 1 else self.distortion
        by = self.stretch[pairs][:, pixels] if self.stretch.numel() > 1 else self.stretch
        whole = [tensor[pairs] for tensor in self[3:8]]
        return Pairs._make([*maps, *whole, *self[8:11], gain, bent, by, self.grain])

    @staticmethod
    def joined(parts: Sequence[Pairs]) -> Pairs:
        """Returns the pairs of all parts."""
        maps = [torch.cat(tensors) for tensors in zip(*(part[:8] for part in parts))]
        return Pairs._make([*maps, *parts[0][8:]])

    @property
    def few(self) -> Pairs:
        """The pairs with the pixels that motions and numbers are fitted to."""
        return self.select(pixels=slice(_FITTED))

    @property
    def motion(self) -> Tensor:
        """The recorded one, `prev_from_curr` [P, 4, 4]."""
        return relative_motion(self.path[:, 1], self.path[:, 2], dtype=torch.float64)

    @property
    def follows(self) -> Tensor:
        """Whether each pair but the last ends where the next one begins, [P - 1]."""
        return (self.path[1:, 1] == self.path[:-1, 2]).flatten(1).all(1)

    @property
    def has_poses(self) -> bool:
        """Whether the recorded motions are known."""
        return bool(self.path[:, 1:3].isfinite().all())


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
    index = torch.arange(min(size, 12 * PIXELS)) * step % size
    pixel = torch.stack([index % width, index // width]).double() + 0.5

    def at(maps: Tensor) -> Tensor:
        return maps.flatten(-2)[..., index].double()

    depth = at(now)
    depth = torch.where(depth == 0, math.nan, depth)
    flow = torch.zeros(count, 2, len(index)).double() if raw is None else at(raw)
    known = flow.isfinite().all(1) & (depth.isfinite() if raw is None else ~depth.isnan())
    if picture is not None:
        known &= at(structure_tensor(picture.float()))[:, ::2].sum(1) > _LEAST_TEXTURE
    order = (~known).long().argsort(dim=-1, stable=True)[:, :PIXELS]

    def first(maps: Tensor) -> Tensor:
        maps = torch.where(known.unsqueeze(1), maps, math.nan)
        return maps.gather(-1, order.unsqueeze(1).expand(-1, maps.shape[1], -1))

    maps = [first(pixel.expand(count, -1, -1)), first(flow), first(depth.unsqueeze(1)).squeeze(1)]
    inverse, grain = [depths.double().reciprocal() for depths in (now, before)], 0.0
    if raw is None:
        inverse[1], grain = _smooth(inverse[1])
    whole = [K.double(), prev_K.double(), path.double(), *inverse]
    fields: Any = [*maps, *whole, raw is not None, picture is not None, float(K[:, 0, 0].median())]
    return Pairs(*fields)._replace(grain=grain)


def _smooth(inverse: Tensor) -> tuple[Tensor, float]:
    """Returns inverse depth `[P, H, W]`, nan where a pixel between two others isn't their mean.

    There, depth that is interpolated between pixels is a guess.
    """
    around = functional.pad(inverse, (1, 1, 1, 1), "replicate")
    sides = [around[:, 1:-1, 2:] + around[:, 1:-1, :-2], around[:, 2:, 1:-1] + around[:, :-2, 1:-1]]
    bend = torch.stack([(both / (2 * inverse) - 1).abs() for both in sides]).amax(0)
    bend = 2 * torch.where((inverse == 0) & (sides[0] + sides[1] == 0), 0.0, bend)  # amid the sky
    is_near = inverse > 0
    noise = torch.where(is_near, bend, math.nan).flatten(1).nanmedian(-1).values[:, None, None]
    is_smooth = bend < (5 * noise).clamp(min=_BEND)
    near = bend[is_smooth & is_near]
    rough = float(near.square().mean().sqrt()) / math.sqrt(6) if len(near) else 0.0
    return torch.where(is_smooth, inverse, math.nan), rough


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


def flow_of(pairs: Pairs, motion: Tensor) -> Tensor:
    """Returns the flow of a static world, `[..., P, 2, N]`, nan behind the camera."""
    return pairs.pixel - seen_before(pairs, motion)[0]


def homogeneous(points: Tensor) -> Tensor:
    """Returns points `[..., 2, N]` with a third coordinate of 1."""
    return functional.pad(points, (0, 0, 0, 1), value=1.0)


def residuals(pairs: Pairs, motion: Tensor) -> Tensor:
    """Returns the residuals of motions `[..., P, 4, 4]`: px, `[..., P, 2 or 1, N]`, nan if unknown.

    By depth, a pixel is unknown where the motion moves it out of the picture.
    """
    pixel, ratio = seen_before(pairs, motion)
    known = ~pairs.depth.isnan() & motion.isfinite().flatten(-2).all(-1, keepdim=True)
    if pairs.by_flow:
        px = (pairs.raw - pairs.gain @ (pairs.pixel - pixel)).nan_to_num(nan=_BEHIND_PX)
        return torch.where((known & pairs.raw.isfinite().all(-2)).unsqueeze(-2), px, math.nan)
    share = looked_up(pairs.before, pixel) * pairs.depth * ratio - 1
    # Interpolation averages noise: between pixels, residuals are smaller whatever the motion.
    part = (pixel - 0.5).frac()
    averaged = (part.square() + (1 - part).square()).prod(-2)
    share = share / ((1 + averaged) / 2).sqrt()
    px = (pairs.focal_px * share / pairs.stretch).masked_fill(ratio.isnan(), _BEHIND_PX)
    return torch.where(known & pairs.depth.isfinite(), px, math.nan).unsqueeze(-2)


def looked_up(maps: Tensor, pixel: Tensor, mode: str = "bilinear") -> Tensor:
    """Returns maps `[P, H, W]` at positions `[..., P, 2, N]`, nan outside."""
    size = torch.tensor([maps.shape[-1], maps.shape[-2]], dtype=torch.float64).unsqueeze(-1)
    inside = ((pixel >= 0.5) & (pixel <= size - 0.5)).all(-2)
    grid = torch.where(inside.unsqueeze(-2), 2 * pixel / size - 1, 0.0)
    grid = grid.reshape(-1, *grid.shape[-3:]).permute(1, 0, 3, 2)  # [P, ..., N, 2]
    values = functional.grid_sample(maps.unsqueeze(1), grid, mode, align_corners=False)
    return torch.where(inside, values[:, 0].transpose(0, 1).reshape(inside.shape), math.nan)


def length(vectors: Tensor) -> Tensor:
    """Returns the lengths of vectors `[..., C, N]`."""
    return vectors.square().sum(-2).sqrt()


def middle(vectors: Tensor) -> Tensor:
    """Returns the median length of vectors `[..., C, N]`, nan if none is known."""
    return length(vectors).nanmedian(-1).values


def median(values: Tensor) -> float:
    """Returns the median of known values, inf if most are not."""
    unknown = int(values.isnan().sum())
    return math.inf if 2 * unknown >= values.numel() else float(values.nanmedian())


def small_motion(step: Tensor) -> Tensor:
    """Returns rigid transforms `[..., 4, 4]` of (rotation vector, translation) `[..., 6]`."""
    upper = torch.cat([rotation_from_vector(step[..., :3]), step[..., 3:, None]], -1)
    return torch.cat([upper, EYE[3:].expand(*upper.shape[:-2], 1, 4)], -2)


def motion_vector(motion: Tensor) -> Tensor:
    """Returns (rotation vector, translation) `[..., 6]` of rotations well below 180 degrees."""
    sine = skew_part(motion[..., :3, :3]) / 2
    size, trace = sine.norm(dim=-1, keepdim=True), motion.diagonal(dim1=-2, dim2=-1).sum(-1)
    angle = torch.atan2(size, (trace.unsqueeze(-1) - 2) / 2)
    turn = sine * torch.where(size > 1e-9, angle / size, 1.0)
    return torch.cat([turn, motion[..., :3, 3]], -1)


def skew_part(R: Tensor) -> Tensor:
    """Returns a rotation's axis times twice its sine, `[..., 3]`."""
    off = R - R.mT
    return torch.stack([off[..., 2, 1], off[..., 0, 2], off[..., 1, 0]], -1)


def gauss_newton(
    residuals_of: Callable[[Tensor], Tensor], n: Tensor, group: Tensor, noise: Tensor, *, steps: int
) -> tuple[Tensor, Tensor]:
    """Returns numbers `[G, k]` with smaller residuals, and their costs `[G]`.

    Residuals r have the cost log(1 + r² / noise²), and weights as Geman and McClure's, whose scale
    is that of the nearest pixels, and at last at most three times the noise.

    Args:
        residuals_of: gives residuals `[..., P, C, N]` of each pair's numbers `[..., P, k]`.
        n: where the fit starts; numbers are about 1 in size.
        group: `[P]`, the row of n that is a pair's.
        noise: standard deviations `[P, N]`, px.
    """
    k, first = n.shape[1], n
    tries = _STEP * torch.cat([torch.zeros(1, k), torch.eye(k)]).double().unsqueeze(1)
    best, least = n, torch.full((len(n),), math.inf, dtype=torch.float64)

    def summed(of_pairs: Tensor) -> Tensor:
        zeros = torch.zeros(len(n), *of_pairs.shape[1:], dtype=torch.float64)
        return zeros.index_add(0, group, of_pairs)

    for step in range(steps + 1):
        r, *columns = residuals_of(n[group] + tries)
        squared = (r / noise.unsqueeze(1)).square().sum(1)
        cost = squared.log1p().nanmean(-1)
        total = summed(cost.nan_to_num(1e3))
        is_better, fell = total < least, least - total
        best = torch.where(is_better.unsqueeze(-1), n, best)
        least = total.minimum(least)
        if step == steps or (step > 1 and bool((fell < 1e-3 * len(cost) / len(n)).all())):
            break
        near = squared.nanquantile(_NEAREST, -1, keepdim=True).nan_to_num(1.0) * 8
        scale = near.clamp(min=1.0) if step < steps - 2 else near.clamp(1.0, 9.0)
        J = (torch.stack(columns, -1) - r.unsqueeze(-1)) / _STEP  # [P, C, N, k]
        known = (r.isfinite() & J.isfinite().all(-1)).all(1)
        weight = 1 / (1 + squared / scale) / noise
        weight = torch.where(known & weight.isfinite(), weight, 0.0).unsqueeze(1)
        r = (r.nan_to_num() * weight).flatten(1).unsqueeze(-1)
        J = (J.nan_to_num() * weight.unsqueeze(-1)).flatten(1, 2)
        # The prior of numbers: normal, about 1 from where they started.
        A = torch.eye(k).double() + summed(J.mT @ J)
        b = n - first + summed((J.mT @ r).squeeze(-1))
        # In units in which all unknowns change the residuals alike; damped where none does.
        unit = A.diagonal(dim1=-2, dim2=-1).clamp(min=1e-12).rsqrt()
        A = A * unit.unsqueeze(-1) * unit.unsqueeze(-2) + 1e-6 * torch.eye(k)
        delta = unit * torch.linalg.solve_ex(A, b * unit)[0].nan_to_num()
        # At most half of a number, or of one, in the same direction.
        most = 0.5 * n.abs().clamp(min=1.0) / delta.abs().clamp(min=1e-12)
        n = n - delta * most.amin(-1, keepdim=True).clamp(max=1.0)
    return best, least


def refined(pairs: Pairs, motions: Tensor, noise: Tensor, steps: int = 6) -> Tensor:
    """Returns the motions `[M, P, 4, 4]` of small residuals that are next to these."""
    few, noise, (M, P) = pairs.few, noise[:, :_FITTED], motions.shape[:2]
    known = motions.isfinite().flatten(-2).all(-1)
    start = torch.where(known[..., None, None], motions, EYE)
    # Translations are in units of the depth, so that all numbers are about as large.
    unit = torch.ones(6).double()
    unit[3:] = few.depth[few.depth.isfinite()].abs().median().clamp(1e-6, 1e6)

    def moved(n: Tensor) -> Tensor:
        return small_motion(n.unflatten(-2, (M, P)) * unit) @ start

    zeros, group = torch.zeros(M * P, 6).double(), torch.arange(M * P)
    n, _ = gauss_newton(
        lambda n: residuals(few, moved(n)).flatten(-4, -3), zeros, group, noise.repeat(M, 1),
        steps=steps,
    )  # fmt: skip
    return torch.where(known[..., None, None], moved(n), motions)
