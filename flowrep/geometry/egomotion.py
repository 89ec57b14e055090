"""The camera's motion from flow and depth: the robust inverse of ego flow.

With x the ray of pixel p (z = 1), q the inverse of its depth and `prev_from_curr` = (R, T), the
point that p shows was seen at the projection of R x + q T. The residual is this projection minus
the position p' that raw flow gives, in pixels. Sky has q = 0, so it constrains the rotation alone
and needs no special case.

Moving bodies are outliers, so the motion is estimated in three stages (`_estimated`):

1. Many hypotheses, each computed from four pixels (RANSAC), are scored on a few hundred pixels by
   a truncated cost. The best few are refined and scored again.
2. A few hundred pixels can't distinguish 49 % from 51 %. A second candidate is therefore the best
   hypothesis for what the first doesn't explain of other pixels. Both are refined on more pixels,
   and all pixels choose between the two.
3. A last step refines the choice in float64. `_described` computes the covariance of the result.

Refining is by Gauss-Newton steps with Geman-McClure weights whose scale follows the residuals
(`_descended`).

For a single frame, the number of PyTorch's calls decides the time. All is therefore in pixels of
the previous picture, relative to its principal point: with F the previous K without that point, a
ray (x, y, 1, q) is multiplied by F and a motion M becomes F M F^-1, and projecting is a division.
Where flow is unknown, the target of the residual is so far away that the pixel has no weight; no
mask is needed.

Pixels are used in a pseudo-random order, which is fixed for a picture size. In a regular order,
such as every tenth column, a body that fills those columns would win.

Shapes: B is the number of frames, M of motions of each frame, N of pixels.
"""

from __future__ import annotations

import functools
import math
import random
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from flowrep.geometry.checks import check_shape, common_batch
from flowrep.geometry.closed_form import LARGEST, LEAST_POSITIVE, MIN_DEPTH_RATIO, known_camera
from flowrep.geometry.pose import without_autocast

VOTERS = 1 << 15  # pixels in the final choice; a share of so many is accurate to 1 %
PIXELS = 1536  # pixels in a Gauss-Newton step; more don't improve the motion
SCORED_PIXELS = 320  # pixels that score a hypothesis
# Four pixels are eight equations for six unknowns. If half of the pixels are on moving bodies, one
# draw in 16 has only static pixels: all 64 draws fail with a probability of 0.94^64 = 2 %.
HYPOTHESES, PIXELS_EACH = 64, 4
MIN_PIXELS = 32  # known pixels below which there is no motion: any motion fits four of them
_HYPOTHESIS_STEPS = 2  # Gauss-Newton steps of a hypothesis, from the expected motion

# The pixels of each hypothesis and those that score, as shares of the number of known pixels. They
# are drawn only once, so that a frame has the same motion in every batch, process and replay.
_random = random.Random(0)
_SHARES = [_random.random() for _ in range(HYPOTHESES * PIXELS_EACH)]
_SHARES += [(i + shift) / SCORED_PIXELS for shift in (0.0, 0.5) for i in range(SCORED_PIXELS)]
_SHARES += [i / PIXELS for i in range(PIXELS)]

# The residual at which a pixel's cost is half of its bound. The least is for exact flow, whose
# residuals are only rounding errors, which can't rank motions.
_SCORE_SCALES = 1.5  # in standard deviations
_LEAST_SCORE_PX = 0.02
_PRIORS_FAVOUR = 1.5  # the prior wins against a body on up to 3/5 of the pixels, 1.5 times the rest
_REFINED = 5  # how many of the best hypotheses are refined
_INLIER_SCALES = 2.5  # in standard deviations; 96 % of normal errors in two channels are within
_STILL_PX = 0.2  # flow with residuals up to this standard deviation may be that of a still camera
_LEAST_STRENGTH = 0.1  # least mean square of a motion's flow, relative to that of the residuals
_LEAST_OVER_CHANCE = 16  # least strength, relative to that of a motion fitted to noise, 3 / N
_LEAST_SCALE_PX = 2e-3  # far above the rounding of exact float32 flow, far below any measured flow
_SCALES = 1.5  # standard deviations at which the weight of a pixel is a quarter
_QUANTILE = 1 / 3  # of residuals, which gives their scale; half of the pixels may be outliers
# The same quantile of the square of a vector with two standard normal components.
_RAYLEIGH_SQUARE = -2 * math.log(1 - _QUANTILE)
_FAR = 1e18  # px, the target of a pixel without known flow; its square is finite in float32

# For flow that is estimated from pictures.
_WINDOW = 3  # side of the structure tensor's window, pixels
_GRADIENT_NOISE = 12.0  # grey levels (of 255) per pixel above which a gradient counts as texture
_LEAST_TEXTURE = 0.25  # trace of the structure (0 to 2) below which a pixel's flow is unknown
_LEAST_EIGENVALUE = 1e-5  # of the scaled normal matrix; below it no pixel determines the direction


class MotionEstimate(NamedTuple):
    """The camera's motion `prev_from_curr` `[*B, 4, 4]`, and how well the flow determines it.

    `inlier_share` `[*B]` is the share of the known pixels whose flow agrees with the motion, within
    2.5 standard deviations of the residuals, or within 0.2 px if flow is noise. `covariance`
    `[*B, 6, 6]` is that of a small motion of the previous camera after the estimate, as (rotation
    vector in rad, translation in m). A variance is inf if no pixel determines it. `valid` `[*B]` is
    bool.
    """

    prev_from_curr: Tensor
    inlier_share: Tensor
    covariance: Tensor
    valid: Tensor


class _Samples(NamedTuple):
    """N pixels of each of B frames."""

    ray: Tensor  # [B, 4, N], (x, y, 1, q)
    target: Tensor  # [B, 1, 2, N], where flow says that the point was, or `_FAR`
    root: tuple[Tensor, Tensor] | None  # of the structure: diagonal [B, 1, 2, N], rest [B, 1, 1, N]
    twists: Tensor  # [B, 6, 4, 4], derivatives of a motion by a small one after it


@torch.no_grad()
@without_autocast
def camera_motion(
    flow: Tensor,
    depth: Tensor,
    K: Tensor,
    *,
    prev_K: Tensor | None = None,
    picture: Tensor | None = None,
    prior: Tensor | None = None,
) -> MotionEstimate:
    """Returns the camera's motion between two frames of a mostly static world.

    Convention: `flow` is p_t - p_t' per step on the current frame's grid, that of `rigid_flow` or
    an estimator's, and `prev_from_curr` transforms a point from the current camera's coordinates to
    the previous camera's, so that `ego_flow(depth, K, prev_from_curr)` is the flow of the static
    world. The result depends on the frame alone (random draws are fixed) and has no gradient.

    Flow estimated on plain surfaces is a guess, or 0. With `picture`, each residual is weighted by
    the local structure tensor: it has no weight without texture, and at an edge only its component
    across the edge counts.

    `valid` is False, and the motion is the prior, if fewer than 32 pixels are known, if they don't
    determine all directions (sky alone, for instance, determines only rotation), if flow is noise
    (no motion fits it to 0.2 px, or better than chance allows), or if a K is invalid (see
    `ego_flow`). If the prior isn't finite, `valid` is False and the motion is the identity.

    Two failures don't show in the result. If more than half of the known pixels move as one body,
    the motion is relative to that body; a prior helps. And the covariance assumes independent
    errors: if neighbouring pixels share errors, as in estimated flow, it is several times too
    small, and errors that look like a motion may be taken for one.

    Args:
        flow: `[*B, 2, H, W]`, pixels per step, nan where it is unknown.
        depth: `[*B, 1, H, W]`, metres along the optical axis.
        K: `[*B, 3, 3]`, pixels.
        prev_K: K of the previous frame, `[*B, 3, 3]`, if it was different.
        picture: the current picture `[*B, C, H, W]`, 0 to 255; give it if flow is estimated.
        prior: the expected motion `[*B, 4, 4]`, such as the previous one or odometry; the identity
            by default.

    Raises:
        ValueError: flow, depth and picture differ in size.

    >>> from flowrep.geometry import ego_flow
    >>> K = torch.tensor([[40.0, 0.0, 10.0], [0.0, 50.0, 8.0], [0.0, 0.0, 1.0]])
    >>> depth = torch.linspace(2.0, 9.0, 320).reshape(1, 16, 20)
    >>> prev_from_curr = torch.eye(4)
    >>> prev_from_curr[:3, 3] = torch.tensor([0.1, 0.0, 0.5])  # half a metre ahead
    >>> flow = ego_flow(depth, K, prev_from_curr).flow
    >>> flow[:, :6, :8] += 3.0  # something moves by itself
    >>> motion = camera_motion(flow, depth, K)
    >>> motion.prev_from_curr[[0, 2], 3], motion.valid
    (tensor([0.1000, 0.5000]), tensor(True))
    """
    given: dict[str, tuple[Tensor, tuple[int | str, ...]]]
    given = {"flow": (flow, (2, "H", "W")), "depth": (depth, (1, "H", "W")), "K": (K, (3, 3))}
    if prev_K is not None:
        given["prev_K"] = prev_K, (3, 3)
    if prior is not None:
        given["prior"] = prior, (4, 4)
    if picture is not None:
        given["picture"] = picture.float(), ("C", "H", "W")
    for name, (tensor, trailing) in given.items():
        check_shape(name, tensor, trailing)
    sizes = {tuple(image.shape[-2:]) for image in (flow, depth, picture) if image is not None}
    if len(sizes) > 1:
        raise ValueError(f"flow, depth and picture must have one (height, width), got {sizes}")
    batch = common_batch(
        **{name: tensor.shape[: -len(trailing)] for name, (tensor, trailing) in given.items()}
    )
    dtype = torch.promote_types(torch.promote_types(flow.dtype, depth.dtype), torch.float32)
    if 0 in flow.shape[-2:]:  # treat a picture without pixels as one unknown pixel
        flow, depth = (x.new_full((*x.shape[:-2], 1, 1), math.nan) for x in (flow, depth))
        picture = None

    def flat(tensor: Tensor, dims: int, to: torch.dtype = dtype) -> Tensor:
        size = tensor.shape[-dims:]
        return tensor.to(to).expand(*batch, *size).reshape(-1, *size)

    K_now, _, known = known_camera(flat(K, 2, torch.float64), 1.0)
    K_before = None
    if prev_K is not None:
        K_before, _, known_before = known_camera(flat(prev_K, 2, torch.float64), 1.0)
        known = known & known_before
    expected = flat(torch.eye(4, device=depth.device), 2, torch.float64)
    if prior is not None:
        prior = flat(prior, 2, torch.float64)
        has_prior = (prior.abs() <= LARGEST).flatten(1).all(-1)  # nan compares False
        expected, known = torch.where(has_prior[:, None, None], prior, expected), known & has_prior
    structure = None if picture is None else structure_tensor(flat(picture, 3))
    values, is_known = _voters(flat(flow, 3), flat(depth, 3), K_now, K_before, structure, known)
    K_before = K_now if K_before is None else K_before
    samples, in_pixels, motion, number = _estimated(
        values, is_known, K_before, None if prior is None else expected
    )
    share, covariance, valid = _described(samples, in_pixels, number)
    motion = torch.where(valid[:, None, None], motion, expected)
    motion, share, covariance, valid = (
        part.reshape((*batch, *part.shape[1:])) for part in (motion, share, covariance, valid)
    )
    return MotionEstimate(motion.to(dtype), share.to(dtype), covariance.to(dtype), valid)


@torch.no_grad()
def motion_of_points(
    rays: Tensor, inverse_depth: Tensor, flow: Tensor, K: Tensor, known: Tensor
) -> Tensor:
    """Returns the motion of the most of some points, `prev_from_curr` `[B, 4, 4]`, float64.

    As `camera_motion`, for points that the caller chose: rays `[B, 3, N]` with z = 1, their inverse
    depth `[B, N]`, flow `[B, 2, N]` in pixels, K of the previous frame, and which are known
    `[B, N]`.
    """
    known = known & flow.isfinite().all(1) & inverse_depth.isfinite()
    K = K.double()
    xy = torch.bmm(K[:, :2, :2], rays[:, :2].double())
    rest = torch.stack([torch.ones_like(inverse_depth), inverse_depth], 1)
    values = torch.cat([xy, rest, xy - flow], 1)
    # One more point, which is unknown, for where there are none.
    return _estimated(functional.pad(values, (0, 1)), functional.pad(known, (0, 1)), K, None)[2]


def structure_tensor(picture: Tensor) -> Tensor:
    """Returns how well a pixel's surroundings determine its flow: xx, xy, yy, `[B, 3, H, W]`.

    The result is S (S + n I)^-1 for pictures `[B, C, H, W]`. S is the mean of the products of
    gradients around the pixel, n the square of a gradient that is noise. The eigenvalues are 0
    without texture, and close to 1 across a strong contrast.
    """
    grey = picture.mean(-3)
    dx, dy = torch.zeros_like(grey), torch.zeros_like(grey)
    dx[..., 1:-1] = (grey[..., 2:] - grey[..., :-2]) / 2
    dy[..., 1:-1, :] = (grey[..., 2:, :] - grey[..., :-2, :]) / 2
    products = torch.stack([dx * dx, dx * dy, dy * dy], -3)
    xx, xy, yy = functional.avg_pool2d(products, _WINDOW, 1, _WINDOW // 2).unbind(-3)
    noise = _GRADIENT_NOISE**2
    det = (xx + noise) * (yy + noise) - xy * xy
    # S (S + n I)^-1, written out for 2 x 2: the inverse is the adjugate over the determinant.
    det_S = xx * yy - xy * xy
    rows = [det_S + noise * xx, noise * xy, det_S + noise * yy]
    return torch.stack(rows, -3) / det.unsqueeze(-3)


@functools.lru_cache(maxsize=16)
def _shuffled(height: int, width: int, device: torch.device) -> tuple[Tensor, Tensor]:
    """Returns the indices of up to `VOTERS` pixels in random order, and centres `[2, N + 1]`."""
    bits = (1 << 32) - 1
    key = torch.arange(height * width, device=device)
    for _ in range(2):  # a hash that is one to one on 32 bits: keys differ, so the order is fixed
        key = ((key ^ (key >> 16)) * 0x45D9F3B) & bits
    pixel = (key ^ (key >> 16)).argsort()[:VOTERS]
    return pixel, functional.pad(torch.stack([pixel % width, pixel // width]) + 0.5, (0, 1))


@functools.lru_cache(maxsize=16)
def _constants(device: torch.device) -> tuple[Tensor, ...]:
    """Returns shares of drawn pixels, six twists `[4, 24]`, an unknown pixel, two 4 x 4 matrices.

    A twist is the derivative of a motion by one of its rotations or translations; the matrices have
    ones where F has its focal lengths, and on the diagonal.
    """
    twists = torch.zeros(4, 6, 4, dtype=torch.float64)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        twists[k, i, j], twists[j, i, k], twists[i, 3 + i, 3] = 1.0, -1.0, 1.0
    unknown = torch.tensor([0.0, 0.0, 1.0, 0.0, _FAR, _FAR, 1.0, 1.0, 0.0]).unsqueeze(-1)
    shares = torch.tensor(_SHARES, dtype=torch.float64)
    of_focal = torch.tensor([[1.0, 1, 0, 0], [0, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]])
    still = torch.eye(4, dtype=torch.float64)
    constants = (shares, twists.flatten(1), unknown, of_focal.double(), still)
    return tuple(constant.to(device) for constant in constants)


@functools.lru_cache(maxsize=16)
def _damping(device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Returns a factor and a summand of normal matrices `[6, 6]`, and the identity `[4, 4]`.

    They raise the diagonal a little above rounding errors, so that no step is taken in a direction
    that pixels don't determine.
    """
    each = torch.eye(6, dtype=dtype)
    share = 1e-6 if dtype is torch.float32 else 1e-9
    still = torch.eye(4, dtype=dtype)
    return (1 + share * each).to(device), (1e-30 * each).to(device), still.to(device)


def _cached(function: Any, *args: Any) -> Any:
    """Returns a cached function's result, computed anew within a graph that is compiled."""
    return (function.__wrapped__ if torch.compiler.is_compiling() else function)(*args)


def _voters(
    flow: Tensor,
    depth: Tensor,
    K: Tensor,
    prev_K: Tensor | None,
    structure: Tensor | None,
    known_frame: Tensor,
) -> tuple[Tensor, Tensor]:
    """Returns the values of up to `VOTERS` pixels of each frame, and which are known.

    Values are `[B, 6 or 9, 1 + N]`: ray, target and, with a structure, its root; the last pixel
    is unknown. Where `known_frame` `[B]` is False, no pixel is known.
    """
    pixel, centres = _cached(_shuffled, *flow.shape[-2:], flow.device)
    maps = torch.cat([flow, depth, *([] if structure is None else [structure])], 1)
    # gather, because indexing takes five times as long.
    maps = maps.flatten(2).gather(2, pixel.expand(*maps.shape[:2], -1))
    maps = functional.pad(maps, (0, 1), value=math.nan)
    flow, depth, structure = maps[:, :2], maps[:, 2:3], maps[:, 3:]
    known = (flow.abs().amax(1) <= LARGEST) & (depth[:, 0] >= LEAST_POSITIVE)  # not where nan
    known &= known_frame.unsqueeze(-1)
    xy = before = (centres - K[:, :2, 2:]).to(flow.dtype)
    if prev_K is not None:  # a pixel moves although its ray does not
        change = torch.bmm(prev_K - K, torch.linalg.inv_ex(K)[0])[:, :2, :2]
        before = (centres - prev_K[:, :2, 2:]).to(flow.dtype)
        xy = xy + torch.bmm(change.to(flow.dtype), xy)
    values = [xy, torch.ones_like(depth), depth.reciprocal(), before - flow]
    if structure.shape[1]:
        xx, xy, yy = structure.unbind(1)
        known &= xx + yy > _LEAST_TEXTURE
        # The root of a symmetric 2 x 2 matrix: (S + sqrt(det S)) / sqrt(trace S + 2 sqrt(det S)).
        root = (xx * yy - xy * xy).clamp(min=0.0).sqrt()
        rows = torch.stack([xx + root, yy + root, xy], 1)
        values.append(rows * (xx + yy + 2 * root).rsqrt().unsqueeze(1))
    return torch.cat(values, 1), known


def _samples_of(values: Tensor, twists: Tensor) -> _Samples:
    """Returns samples from their values, see `_voters`."""
    ray, target, *root = values.split([4, 2, 2, 1] if values.shape[1] > 6 else [4, 2], 1)
    pair = (root[0].unsqueeze(1), root[1].unsqueeze(1)) if root else None
    return _Samples(ray, target.unsqueeze(1), pair, twists)


def _structured(samples: _Samples, shifts: Tensor) -> Tensor:
    """Returns shifts in the picture `[B, ..., 2, N]` times the root of the structure, if given.

    The squared length of a residual r is then r^T S r.
    """
    if samples.root is None:
        return shifts
    diagonal, rest = samples.root
    return torch.addcmul(diagonal * shifts, rest, shifts.flip(-2))


def _estimated(
    values: Tensor, known: Tensor, K: Tensor, expected: Tensor | None
) -> tuple[_Samples, Tensor, Tensor, Tensor]:
    """Returns samples, their motion in pixels and in metres, and the number of known pixels.

    Args:
        values: `[B, 6 or 9, 1 + N]`, see `_voters`.
        known: `[B, 1 + N]`, bool.
        K: of the previous frame, `[B, 3, 3]`, float64.
        expected: the prior `[B, 4, 4]`; the identity by default.
    """
    batch = len(values)
    shares, twists, unknown, of_focal, still = _cached(_constants, values.device)
    F = torch.where(of_focal > 0, functional.pad(K, (0, 1, 0, 1)), still)
    inverse = torch.linalg.inv_ex(F)[0]
    twists = torch.bmm(torch.bmm(F, twists.expand(batch, 4, 24)).view(batch, 24, 4), inverse)
    twists = twists.view(batch, 4, 6, 4).movedim(2, 1).contiguous()
    values = torch.where(known.unsqueeze(1), values, unknown[: values.shape[1]].to(values.dtype))
    # The k-th known pixel is the first with k known ones up to it. Fewer known ones than are needed
    # are repeated; if there is none, it is the last pixel, which is unknown.
    count = known.cumsum(-1)
    number = count[:, -1:]
    index = torch.searchsorted(count, (shares * number.clamp(max=PIXELS)).long() + 1)
    index = index.clamp(max=known.shape[-1] - 1).unsqueeze(1).expand(-1, values.shape[1], -1)
    sizes = [HYPOTHESES * PIXELS_EACH, SCORED_PIXELS, SCORED_PIXELS, PIXELS]
    drawn, scored, others, samples = values.gather(-1, index).split(sizes, -1)
    # All H hypotheses of all frames at once, as B * H frames of four pixels. In float64, because
    # the normal equations of four pixels in a row are nearly singular.
    drawn = drawn.double().unflatten(-1, (HYPOTHESES, -1)).movedim(2, 1).flatten(0, 1)
    start = still.expand(batch, 4, 4)
    if expected is not None:
        start = still + torch.bmm(torch.bmm(F, expected - still), inverse)
    each = _samples_of(drawn, twists.repeat_interleave(HYPOTHESES, 0))
    motions = _descended(
        each, start.repeat_interleave(HYPOTHESES, 0).unsqueeze(1), _HYPOTHESIS_STEPS, robust=False
    )
    single = twists.to(values.dtype)
    scored, others = _samples_of(scored, single), _samples_of(others, single)
    motions = motions.view(batch, HYPOTHESES, 4, 4).to(values.dtype)
    *_, squared = _residuals(scored, motions, HYPOTHESES)
    # The scale is that of the residuals of the motion that fits best.
    scale = _variance(squared, _SCORE_SCALES).amin(1, keepdim=True).clamp(min=_LEAST_SCORE_PX**2)
    # Similar costs may lead to different optima, so the best hypotheses are refined and scored
    # again, beside the expected motion, which wins exact ties (argmax returns the first) and, as a
    # prior, near ties.
    frames = torch.arange(batch, device=F.device).unsqueeze(-1)
    best = _kept(squared, scale).sum(-1).topk(_REFINED).indices
    refined = torch.cat([start.to(values.dtype).unsqueeze(1), motions[frames, best]], 1)
    refined = _descended(scored, refined, 1)
    *_, squared = _residuals(scored, refined, 1 + _REFINED)
    final_scale = _variance(squared).amin(1, keepdim=True).clamp(min=_LEAST_SCORE_PX**2)
    favour = 1.0 if expected is None else _PRIORS_FAVOUR
    choice = _votes(squared, final_scale, favour).argmax(-1, keepdim=True)
    # What it doesn't explain may be the static world, which happened to have too few of the scored
    # pixels. The second candidate is the best hypothesis for that, of other pixels.
    motions = torch.cat([refined[frames, choice], motions], 1)
    *_, squared = _residuals(others, motions, 1 + HYPOTHESES)
    left = squared[:, :1] > _INLIER_SCALES**2 * final_scale
    rival = torch.bmm(_kept(squared, scale), left.to(squared.dtype).mT).argmax(1)
    finalists = torch.cat([motions[:, :1], motions[frames, rival]], 1)
    if expected is not None:
        finalists = torch.cat([refined[:, :1], finalists], 1)
    finalists = _descended(_samples_of(samples, single), finalists, 1, fast_steps=1)
    *_, squared = _residuals(_samples_of(values, single), finalists, finalists.shape[1])
    motion = finalists[frames, _votes(squared, final_scale, favour).argmax(-1, keepdim=True)]
    # In float64: exact flow then leads to a motion that is exact in float32.
    samples = _samples_of(samples.double(), twists)
    motion = _descended(samples, motion.double(), 0, fast_steps=1).squeeze(1)
    metric = still + torch.bmm(torch.bmm(inverse, motion - still), F)
    return samples, motion, metric, number.squeeze(-1)


def _kept(squared: Tensor, scale: Tensor) -> Tensor:
    """Returns Geman-McClure's 1 - r² / (s² + r²): 1 without a residual, 0 if far from explained."""
    return (scale / (scale + squared)).nan_to_num(0.0)


def _votes(squared: Tensor, scale: Tensor, favour: float) -> Tensor:
    """Returns how much of the pixels motions explain `[B, M]`; the first's times `favour`.

    The choice is between optimised motions. A compromise between the motions of two bodies, which
    explains both by half, must not win against the motion of one; squaring prevents that.
    """
    votes = _kept(squared, scale).square().sum(-1)
    if favour != 1.0:
        votes[:, 0] *= favour
    return votes


def _residuals(
    samples: _Samples, motion: Tensor, count: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Returns points and residuals of `count` = M motions, `[B, M, 4, 4]` or `[B M, 4, 4]`.

    The points are (x, y, 1, q) in the previous camera, `[B, M, 4, N]`. After them come their first
    two components, the residuals `[B, M, 2, N]`, px, and the squares of these `[B, M, N]`. A point
    behind the camera is projected as if it were just before it, and so far away.
    """
    rows = motion.reshape(len(samples.ray), 4 * count, 4)
    points = torch.bmm(rows, samples.ray).unflatten(1, (count, 4))
    points = points / points[:, :, 2:3].clamp(min=MIN_DEPTH_RATIO)
    seen_at = points[:, :, :2]
    residual = _structured(samples, seen_at - samples.target)
    return points, seen_at, residual, (residual * residual).sum(2)


def _variance(squared: Tensor, scales: float = 1.0) -> Tensor:
    """Returns the square of `scales` robust standard deviations per channel, `[B, M, 1]`, px²."""
    few = squared[..., :: max(4, squared.shape[-1] // 384)]  # 384 values give a good quantile
    rank = 1 + int(few.shape[-1] * _QUANTILE)
    return few.kthvalue(rank, -1, keepdim=True).values * (scales**2 / _RAYLEIGH_SQUARE)


class _Linear(NamedTuple):
    """Motions' residuals and their derivatives by a small motion after each of them."""

    residual: Tensor  # [B, M, 2, N], px
    squared: Tensor  # [B, M, N], px²
    J: Tensor  # [B M, 6, 2, N], by rotation vector and translation
    plain: Tensor  # the same without the structure


def _linearised(samples: _Samples, motion: Tensor, count: int = 1) -> _Linear:
    """Returns the residuals of `count` = M motions of each frame, with twists of all B M."""
    points, seen_at, residual, squared = _residuals(samples, motion, count)
    # A small motion X shifts the point P = (n, m, 1, q) by X P, and n by the first row of X P minus
    # n times the third.
    moved = torch.bmm(samples.twists.flatten(1, 2), points.flatten(0, 1)).unflatten(1, (6, 4))
    across, along, _ = moved.split([2, 1, 1], 2)
    seen_at = seen_at.reshape(len(moved), 1, *seen_at.shape[2:])
    J = plain = torch.addcmul(across, along, seen_at, value=-1.0)
    if samples.root is not None:
        J = _structured(samples, J.view(len(residual), 6 * count, *J.shape[2:])).view(J.shape)
    return _Linear(residual, squared, J, plain)


def _weights(squared: Tensor) -> tuple[Tensor, Tensor]:
    """Returns the scale `[B, M, 1]`, px², and the roots of Geman-McClure's weights `[B, M, N]`."""
    scale = _variance(squared, _SCALES).clamp(_LEAST_SCALE_PX**2, 1e8)
    return scale, scale / (scale + squared)


def _descended(
    samples: _Samples, motion: Tensor, steps: int, fast_steps: int = 0, *, robust: bool = True
) -> Tensor:
    """Returns motions `[B, M, 4, 4]` after Gauss-Newton steps and fast ones.

    Among residuals of noise, the equations' slope is only half of the weights w, so that a step
    leaves half of the way to go. Their squares are close to the slope, also without noise, where
    both are 1. But far from the optimum such fast steps may go astray.
    """
    batch, count = motion.shape[:2]
    if count > 1:
        samples = samples._replace(twists=samples.twists.repeat_interleave(count, 0))
    turns, motion = samples.twists.flatten(2).mT, motion.flatten(0, 1)
    factor, summand, still = _cached(_damping, motion.device, motion.dtype)
    for step in range(steps + fast_steps):
        residual, squared, J, _ = _linearised(samples, motion, count)
        WJ = J
        if robust:
            _, kept = _weights(squared)
            WJ = J * (kept * kept).view(len(J), 1, 1, J.shape[-1])
        J, WJ = J.flatten(2), WJ.flatten(2)
        normal = torch.bmm(WJ, (J if step < steps else WJ).mT)
        right = torch.bmm(WJ, residual.reshape(len(J), J.shape[-1], 1))
        normal = torch.addcmul(summand, normal, factor)
        twist = torch.bmm(turns, torch.linalg.solve_ex(normal, right)[0]).view(-1, 4, 4)
        # Cayley's (1 + X / 2)^-1 (1 - X / 2), which is rigid.
        before = torch.bmm(torch.sub(still, twist, alpha=0.5), motion)
        motion = torch.linalg.solve_ex(torch.add(still, twist, alpha=0.5), before)[0]
    return motion.view(batch, count, 4, 4)


def _described(samples: _Samples, motion: Tensor, number: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns a motion's inlier share `[B]`, covariance `[B, 6, 6]` and validity `[B]`."""
    _, squared, each, plain = _linearised(samples, motion)
    scale, kept = _weights(squared)
    weight = kept.square()
    total = weight.sum((1, 2)).clamp(min=1e-12)
    J = each.flatten(2)
    normal = torch.bmm((each * weight.unsqueeze(1)).flatten(2), J.mT).nan_to_num(0.0, 0.0, 0.0)
    # To make radians and metres comparable, each parameter has a unit: a change by one unit moves
    # all pixels together by one pixel (root of the sum of squares). A parameter that moves no pixel
    # has the unit 0. The eigenvalue of a motion that the structure hides is near 0.
    moves = normal.diagonal(dim1=-2, dim2=-1)
    if samples.root is not None:
        moves = (weight.unsqueeze(1) * plain.square()).sum((2, 3)).nan_to_num(0.0, 0.0, 0.0)
    unit = torch.where(moves > 1e-12, moves, torch.inf).rsqrt()
    # eigh raises for the whole batch if one matrix holds nan.
    values, vectors = torch.linalg.eigh(unit.unsqueeze(-1) * normal * unit.unsqueeze(-2))
    seen = values > _LEAST_EIGENVALUE
    # The covariance of an M-estimator is the sandwich A^-1 B A^-1. A is the derivative of its
    # equations: the normal matrix times the mean slope of w(r^2) r, which, averaged over the
    # directions of r, is w (2 sqrt(w) - 1). B is the covariance of the noise in them.
    slope = (2 * (weight * kept).sum((1, 2)) / total - 1).clamp(min=0.1)
    spread = weight.square() * squared / 2
    middle = torch.bmm((each * spread.unsqueeze(1)).flatten(2), J.mT).nan_to_num(0.0, 0.0, 0.0)
    scaled = unit[..., None] * vectors * torch.where(seen, values.rsqrt(), 0.0)[:, None]
    inverse = torch.bmm(scaled, scaled.mT) / slope[:, None, None]
    # Fewer known pixels than samples are repeated, but tell no more.
    number = number.clamp(max=PIXELS)
    repeats = PIXELS / number.clamp(min=1)
    covariance = torch.bmm(torch.bmm(inverse, middle), inverse) * repeats[:, None, None]
    # A parameter with a component in an undetermined direction is not determined at all.
    is_open = (vectors.square() * ~seen.unsqueeze(-2)).sum(-1) > 1e-6  # [B, 6]
    covariance = covariance.masked_fill(is_open.unsqueeze(-1) | is_open.unsqueeze(-2), 0.0)
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    variance.clamp_(min=0.0).masked_fill_(is_open, torch.inf)  # rounding may make it negative
    # A motion can be fitted to noise, too. By chance, the mean square of its flow is 6 / 2N of that
    # of the noise, for six parameters and N pixels with two channels, and somewhat more because it
    # is the best of many hypotheses. Noise up to `_STILL_PX` can't be distinguished from a camera
    # at rest.
    *_, ego = _residuals(samples._replace(target=samples.ray[:, None, :2]), motion, 1)
    noise = scale[:, 0, 0] / _SCALES**2
    strength = (weight * ego).sum((1, 2)) / total / (2 * noise)
    by_chance = _LEAST_OVER_CHANCE * 3 / (number - MIN_PIXELS).clamp(min=1)
    is_shown = strength > by_chance.clamp(min=_LEAST_STRENGTH)  # not where nan
    is_motion = (noise <= _STILL_PX**2) | is_shown
    within = torch.where(is_motion, _INLIER_SCALES**2 * noise, _STILL_PX**2)
    share = (squared[:, 0] < within.unsqueeze(-1)).sum(-1) / PIXELS
    is_known = (number >= MIN_PIXELS) & seen.all(-1)
    return share, covariance, is_known & is_motion
