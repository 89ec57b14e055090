"""The camera's motion from flow and depth: the robust inverse of ego flow.

With x the ray of pixel p (z = 1), q the inverse of its depth and `prev_from_curr` = (R, T), the
point that p shows was seen at the projection of R x + q T. The residual is this projection minus
the position p' that raw flow gives, in pixels. Sky has q = 0, so it constrains the rotation alone
and needs no special case.

Moving bodies are outliers, so the motion is estimated in three stages:

1. Many hypotheses, each computed from four pixels (RANSAC), are scored on a few hundred pixels by
   a truncated cost. The best few are refined and scored again (`_best_hypothesis`).
2. A few hundred pixels can't distinguish 49 % from 51 %. A second candidate is therefore the motion
   of the pixels that the best hypothesis doesn't explain, and all pixels choose between the two.
3. Gauss-Newton steps on more pixels refine the choice, with Geman-McClure weights whose scale
   follows the residuals (`_descended`). `_described` computes the covariance of the result.

Pixels are used in a pseudo-random order, which is fixed for a picture size. In a regular order,
such as every tenth column, a body that fills those columns would win.

Shapes: B is the number of frames, N of pixels, M of motions. Values of pixels are `[B, channels,
N]`, so that the sums over pixels in the normal equations are matrix products.
"""

from __future__ import annotations

import functools
import math
import random
from typing import NamedTuple

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
_HYPOTHESIS_STEPS, _STEPS = 3, 4  # Gauss-Newton steps of a hypothesis, and of the final motion

# The pixels of each hypothesis, as shares of the number of known pixels. They are drawn only once,
# so that a frame has the same motion in every batch, process and replay.
_random = random.Random(0)
_DRAWS = [[_random.random() for _ in range(PIXELS_EACH)] for _ in range(HYPOTHESES)]

# The residual at which a pixel's cost is half of its bound. The least is for exact flow, whose
# residuals are only rounding errors, which can't rank motions.
_SCORE_SCALES = 1.5  # in standard deviations
_LEAST_SCORE_PX = 0.02
_PRIORS_FAVOUR = 1.5  # the prior wins against a body on up to 3/5 of the pixels, 1.5 times the rest
_REFINED = 6  # how many of the best hypotheses are refined
_REFINING_STEPS = 2  # Gauss-Newton steps of each of them
_RIVAL_STEPS = 3  # Gauss-Newton steps of the second candidate
_INLIER_SCALES = 2.5  # in standard deviations; 96 % of normal errors in two channels are within
_STILL_PX = 0.2  # flow with residuals up to this standard deviation may be that of a still camera
_LEAST_STRENGTH = 0.1  # least mean square of a motion's flow, relative to that of the residuals
_LEAST_OVER_CHANCE = 16  # least strength, relative to that of a motion fitted to noise, 3 / N
_LEAST_SCALE_PX = 2e-3  # far above the rounding of exact float32 flow, far below any measured flow
_SCALES = 1.5  # standard deviations at which the weight of a pixel is a quarter
_QUANTILE = 1 / 3  # of residuals, which gives their scale; half of the pixels may be outliers
# The same quantile of the length of a vector with two standard normal components.
_RAYLEIGH = math.sqrt(-2 * math.log(1 - _QUANTILE))

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
    """N pixels of each of B frames; `number` of them are known."""

    focal: Tensor  # fx, skew, fy of the previous camera: [B, 3]
    values: Tensor  # [B, 6 or 9, N]: ray (x, y, 1) and q; flow (u, v); structure (xx, xy, yy)
    known: Tensor  # [B, N], bool
    number: Tensor  # [B], of known pixels

    def part(self, index: Tensor) -> _Samples:
        """Returns the pixels at `index` `[B, M, N]` as samples of B * M frames."""
        at = index.flatten(1)
        values = self.values.gather(-1, at.unsqueeze(1).expand(-1, self.values.shape[1], -1))
        values = values.unflatten(-1, index.shape[1:]).movedim(-2, 1).flatten(0, 1)
        known = self.known.gather(-1, at).reshape(-1, index.shape[-1])
        focal, number = (x.repeat_interleave(index.shape[1], 0) for x in (self.focal, self.number))
        return _Samples(focal, values, known, number)

    def every_few(self, count: int, shift: float) -> _Samples:
        """Returns `count` known pixels of each frame, evenly spaced in their (random) order."""
        shares = (torch.arange(count, device=self.number.device) + shift) / count
        return self.part((shares * self.number.unsqueeze(-1)).long().unsqueeze(1))

    def in_pixels(self, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Converts shifts of rays at z = 1, `[B, ..., N]`, to pixels in the picture."""
        fx, skew, fy = self.focal.to(x.dtype).reshape(-1, 3, *[1] * (x.ndim - 1)).unbind(1)
        return fx * x + skew * y, fy * y


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
    K_before = K_now
    if prev_K is not None:
        K_before, _, known_before = known_camera(flat(prev_K, 2, torch.float64), 1.0)
        known = known & known_before
    expected = flat(torch.eye(4, device=depth.device), 2, torch.float64)
    if prior is not None:
        prior = flat(prior, 2, torch.float64)
        has_prior = (prior.abs() <= LARGEST).flatten(1).all(-1)  # nan compares False
        expected, known = torch.where(has_prior[:, None, None], prior, expected), known & has_prior
    structure = None if picture is None else structure_tensor(flat(picture, 3))
    voters = _voters(flat(flow, 3), flat(depth, 3), K_now, K_before, structure, known)
    samples = _samples(voters)
    motion = _best_hypothesis(voters, samples, expected, has_prior=prior is not None)
    motion = _descended(samples, motion, _STEPS)
    share, covariance, valid = _described(samples, motion)
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
    order = (~known).long().argsort(dim=-1, stable=True)
    values = torch.cat([rays, inverse_depth.unsqueeze(1), flow], 1).double()
    values = torch.where(known.unsqueeze(1), values, 1.0)
    values = values.gather(-1, order.unsqueeze(1).expand_as(values))
    samples = _Samples(
        K[:, [0, 0, 1], [0, 1, 1]].double(), values, known.gather(-1, order), known.sum(-1)
    )
    start = torch.eye(4, dtype=torch.float64, device=K.device).expand(len(K), 4, 4)
    motion = _best_hypothesis(samples, samples, start, has_prior=False)
    return _descended(samples, motion, _STEPS)


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
    """Returns the indices of up to `VOTERS` pixels in random order, and their centres `[2, N]`."""
    bits = (1 << 32) - 1
    key = torch.arange(height * width, device=device)
    for _ in range(2):  # a hash that is one to one on 32 bits: keys differ, so the order is fixed
        key = ((key ^ (key >> 16)) * 0x45D9F3B) & bits
    pixel = (key ^ (key >> 16)).argsort()[:VOTERS]
    return pixel, torch.stack([pixel % width, pixel // width]) + 0.5


def _voters(
    flow: Tensor,
    depth: Tensor,
    K: Tensor,
    prev_K: Tensor,
    structure: Tensor | None,
    known_frame: Tensor,
) -> _Samples:
    """Returns up to `VOTERS` pixels of each frame in random order.

    The part of their flow that a change of K causes is removed. Where `known_frame` `[B]` is False,
    no pixel is known.
    """
    shuffled = _shuffled.__wrapped__ if torch.compiler.is_compiling() else _shuffled
    pixel, centres = shuffled(*flow.shape[-2:], flow.device)
    column, row = centres.to(flow.dtype)
    maps = [flow, depth] if structure is None else [flow, depth, structure]
    # gather, because indexing takes five times as long.
    each = (m.flatten(-2).gather(-1, pixel.expand(*m.shape[:2], -1)) for m in maps)
    values = torch.cat([*each], 1)  # [B, 3 or 6, N]
    u, v, z = values[:, :3].unbind(1)
    known = u.isfinite() & v.isfinite() & (z >= LEAST_POSITIVE)  # nan compares False
    known &= known_frame.unsqueeze(-1)
    if structure is not None:
        known &= values[:, 3] + values[:, 5] > _LEAST_TEXTURE
    (fx, skew, cx), (_, fy, cy), _ = _entries(K, values.dtype)
    y = (row - cy) / fy
    x = (column - cx - skew * y) / fx
    # If the previous K was different, a pixel moves although its ray does not; add that part back.
    (fx, skew, cx), (_, fy, cy), _ = _entries(prev_K - K, values.dtype)
    moved = values[:, :2] + torch.stack([fx * x + skew * y + cx, fy * y + cy], 1)
    ray = torch.stack([x, y, torch.ones_like(x), values[:, 2].reciprocal()], 1)
    focal = prev_K[:, [0, 0, 1], [0, 1, 1]]
    values = torch.cat([ray, moved, values[:, 3:]], 1)
    return _Samples(focal, values, known, known.sum(-1))


def _samples(voters: _Samples) -> _Samples:
    """Returns the first `PIXELS` known pixels of each frame, filled up with unknown ones."""
    batch, looked_at = voters.known.shape
    # Compact without a loop or a sort: write each known pixel to the slot of its rank among the
    # known ones, and all others to a slot beyond the end, which is cut off.
    rank = voters.known.long().cumsum(-1) - 1
    slot = torch.where(voters.known & (rank < PIXELS), rank, PIXELS)
    order = torch.zeros(batch, PIXELS + 1, dtype=torch.long, device=slot.device)
    order.scatter_(1, slot, torch.arange(looked_at, device=slot.device).expand(batch, -1))
    number = voters.number.clamp(max=PIXELS)
    known = torch.arange(PIXELS, device=slot.device) < number.unsqueeze(-1)
    chosen = voters.part(order[:, None, :PIXELS])
    values = torch.where(known.unsqueeze(1), chosen.values, 1.0)  # nan · 0 would stay nan
    return chosen._replace(values=values, known=known, number=number)


def _entries(K: Tensor, dtype: torch.dtype) -> list[list[Tensor]]:
    """Returns the rows of K `[B, 3, 3]`, `[B, 1]` each."""
    return [list(row.unbind(-1)) for row in K.to(dtype).unsqueeze(1).unbind(-2)]


def _best_hypothesis(
    voters: _Samples, samples: _Samples, expected: Tensor, *, has_prior: bool
) -> Tensor:
    """Returns the best of the expected motion and the hypotheses from four pixels, `[B, 4, 4]`."""
    batch = len(expected)
    # All H hypotheses of all frames at once, as B * H frames of four pixels. In float64, because
    # the normal equations of four pixels in a row are nearly singular.
    draws = torch.tensor(_DRAWS, dtype=torch.float64, device=expected.device)
    drawn = samples.part((draws * samples.number[:, None, None]).long())  # [B, H, 4]
    each = _Samples(drawn.focal, drawn.values.double(), drawn.known, drawn.number)
    motion = expected.repeat_interleave(HYPOTHESES, 0)
    for _ in range(_HYPOTHESIS_STEPS):
        at = _linearised(each, motion)
        normal, right = _normal_equations(each, at, at.in_front.double())
        # Damped relative to each diagonal element and to the largest one, so that the motion
        # doesn't change in a direction that the four pixels don't determine.
        diagonal = normal.diagonal(dim1=-2, dim2=-1)
        damping = 1e-9 * diagonal + 1e-12 * diagonal.amax(-1, keepdim=True) + 1e-30
        step = torch.linalg.solve_ex(normal + torch.diag_embed(damping), right)[0]
        step = torch.where(step.isfinite().all(-1, keepdim=True), step, 0.0).clamp(-10.0, 10.0)
        motion = _after(motion, -step)
    scored, others = (samples.every_few(SCORED_PIXELS, shift) for shift in (0.0, 0.5))
    first = _descended(scored, expected, _STEPS) if has_prior else expected
    motions = torch.cat([first.unsqueeze(1), motion.unflatten(0, (batch, HYPOTHESES))], 1)
    # Factors on the (negative) costs: the expected motion wins exact ties, a prior also near ties.
    favour = torch.ones(1 + HYPOTHESES, device=expected.device)
    favour[0] = _PRIORS_FAVOUR if has_prior else 1 + 1e-6
    # Similar costs may lead to different optima, so the best hypotheses are refined and scored
    # again.
    best = (_costs(scored, motions)[0] * favour).topk(_REFINED, largest=False).indices
    motions = motions.gather(1, best[..., None, None].expand(-1, -1, 4, 4)).flatten(0, 1)
    repeated = _Samples(*(part.repeat_interleave(_REFINED, 0) for part in scored))
    motions = _descended(repeated, motions, _REFINING_STEPS).unflatten(0, (batch, _REFINED))
    costs, scale = _costs(scored, motions, final=True)
    choice = (costs * favour[best]).argmin(-1, keepdim=True)
    motion = motions.gather(1, choice[..., None, None].expand(-1, -1, 4, 4)).squeeze(1)
    # The pixels that it doesn't explain may be the static world, which happened to have too few of
    # the scored pixels. The second candidate therefore comes from other pixels.
    ru, rv, in_front, *_ = _residuals(others, motion)
    is_rest = _squared(others, ru, rv) > (_INLIER_SCALES * scale).square().unsqueeze(-1)
    unexplained = others._replace(known=others.known & in_front & is_rest)
    rival = _descended(unexplained, motion, _RIVAL_STEPS)
    finalists = torch.stack([motion, rival, *([first] if has_prior else [])], 1)
    costs, _ = _costs(voters, finalists, final=True)
    if has_prior:
        costs[:, 2] *= _PRIORS_FAVOUR
    return finalists[torch.arange(batch, device=expected.device), costs.argmin(-1)]


def _costs(samples: _Samples, motions: Tensor, *, final: bool = False) -> tuple[Tensor, Tensor]:
    """Returns costs per pixel `[B, M]`, -1 to 0, of motions `[B, M, 4, 4]`, and the scale `[B]`.

    The final choice is between optimised motions. A compromise between the motions of two bodies,
    which explains both by half, must not win against the motion of one; squaring prevents that.
    """
    ru, rv, in_front, *_ = _residuals(samples, motions)
    known = in_front & samples.known.unsqueeze(1)
    squared = torch.where(known, _squared(samples, ru, rv), torch.inf)
    number = samples.known.sum(-1, keepdim=True)
    # The scale is that of the residuals of the motion that fits best.
    scale = _scale(squared, number).amin(-1) * (1.0 if final else _SCORE_SCALES)
    scale = scale.clamp(min=_LEAST_SCORE_PX)
    # Geman-McClure's 1 - r² / (s² + r²): 1 if a pixel has no residual, and 0 if it is not
    # explained.
    kept = (1 + squared / scale.square()[:, None, None]).reciprocal()
    return -(kept.square() if final else kept).sum(-1) / number.clamp(min=1), scale


def _residuals(samples: _Samples, motion: Tensor) -> tuple[Tensor, ...]:
    """Returns residuals in px, whether points were in front of the camera, and how they moved.

    `motion` is `[B, 4, 4]`, or `[B, M, 4, 4]` for M motions of each frame. The results are
    `[B, (M,) N]`: residuals u and v, in front, the shifts of x / z and y / z, and the ratio of the
    current z to the previous z.
    """
    ray = samples.values[:, :4]
    # The motion minus the identity, as in `closed_form`: shifts are exactly 0 without motion, and
    # rounding errors are smaller.
    still = torch.eye(3, 4, dtype=motion.dtype, device=motion.device)
    moved = (motion[..., :3, :] - still).to(ray.dtype)
    moved = (moved.flatten(1, -2) @ ray).unflatten(1, moved.shape[1:-1])  # [B, (M,) 3, N]
    dx, dy, dz = moved.unbind(-2)
    z_ratio = 1 + dz
    in_front = z_ratio > MIN_DEPTH_RATIO
    per_z = torch.where(in_front, z_ratio, 1.0).reciprocal()
    per_frame = samples.values if motion.ndim == 3 else samples.values.unsqueeze(2)
    x, y, u, v = (per_frame[:, channel] for channel in (0, 1, 4, 5))
    dn, dm = (dx - x * dz) * per_z, (dy - y * dz) * per_z
    du, dv = samples.in_pixels(dn, dm)
    return du + u, dv + v, in_front, dn, dm, per_z


def _squared(samples: _Samples, ru: Tensor, rv: Tensor) -> Tensor:
    """Returns the squared lengths of residuals, weighted by the structure (r^T S r)."""
    structure = samples.values[:, 6:].unbind(1)
    if not structure:
        return ru * ru + rv * rv
    xx, xy, yy = (s if ru.ndim == 2 else s.unsqueeze(1) for s in structure)
    return (xx * ru * ru + 2 * xy * ru * rv + yy * rv * rv).clamp(min=0.0)


def _scale(squared: Tensor, number: Tensor) -> Tensor:
    """Returns a robust standard deviation per channel, px, from squared residuals `[..., N]`."""
    every = max(4, squared.shape[-1] // 384)  # 384 values give a good quantile and are sorted fast
    squared = squared[..., ::every]  # unknown ones are inf, so they are sorted to the end
    rank = (number * (_QUANTILE / every)).long().unsqueeze(-1).expand(*squared.shape[:-1], 1)
    return squared.sort(-1).values.gather(-1, rank).squeeze(-1).sqrt() / _RAYLEIGH


class _Linear(NamedTuple):
    """The residuals of a motion `[B, N]`, px, and their derivatives by a small motion after it."""

    ru: Tensor
    rv: Tensor
    in_front: Tensor
    Ju: Tensor  # [B, 6, N], by rotation vector and translation
    Jv: Tensor


def _linearised(samples: _Samples, motion: Tensor) -> _Linear:
    # In the previous camera's coordinates, a small rotation w and translation t after the motion
    # shift the point P = (n, m, 1) / q by w × P + t. The rows are the derivatives of n = x / z and
    # m = y / z by the three components of w, then by those of t.
    ru, rv, in_front, dn, dm, per_z = _residuals(samples, motion)
    n, m = samples.values[:, 0] + dn, samples.values[:, 1] + dm
    q = samples.values[:, 3] * per_z
    zero, nm = torch.zeros_like(n), n * m
    dn = torch.stack([-nm, 1 + n * n, -m, q, zero, -n * q], 1)
    dm = torch.stack([-1 - m * m, nm, n, zero, q, -m * q], 1)
    return _Linear(ru, rv, in_front, *samples.in_pixels(dn, dm))


def _normal_equations(samples: _Samples, at: _Linear, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Returns J^T W J `[B, 6, 6]` and J^T W r `[B, 6]`, float64, for weights `[B, N]`."""
    weight, structure = weight.unsqueeze(1), samples.values[:, 6:]
    if structure.shape[1] == 0:
        Wu, Wv = weight * at.Ju, weight * at.Jv
    else:
        xx, xy, yy = (weight * structure).unsqueeze(2).unbind(1)
        Wu, Wv = xx * at.Ju + xy * at.Jv, xy * at.Ju + yy * at.Jv
    normal = Wu @ at.Ju.mT + Wv @ at.Jv.mT
    right = Wu @ at.ru.unsqueeze(-1) + Wv @ at.rv.unsqueeze(-1)
    return normal.double(), right.squeeze(-1).double()


def _after(motion: Tensor, step: Tensor) -> Tensor:
    """Returns the motion followed by a small one, (rotation vector, translation) `[..., 6]`."""
    turn, shift = step.unsqueeze(-1).split([3, 3], -2)
    # Rodrigues' formula, as in `rotation_from_vector`. Building its matrix would take half of the
    # time of a step for a single frame.
    turns = turn.norm(dim=-2, keepdim=True) / math.pi
    rows = motion[..., :3, :]
    crossed = torch.linalg.cross(turn, rows, dim=-2)
    twice = torch.linalg.cross(turn, crossed, dim=-2)
    moved = rows + torch.sinc(turns) * crossed + 0.5 * torch.sinc(turns / 2).square() * twice
    moved = moved + functional.pad(shift, (3, 0))
    return torch.cat([moved, motion[..., 3:, :]], -2)


class _Weighted(NamedTuple):
    """A motion's residuals, their Geman-McClure weights, and the directions that pixels determine.

    To make radians and metres comparable, each parameter has a unit: a change by one unit moves all
    pixels together by one pixel (root of the sum of squares). A parameter that moves no pixel has
    the unit 0. Eigenvalues and eigenvectors are those of the normal matrix in these units. The
    eigenvalue of a motion that the structure hides is near 0.
    """

    at: _Linear
    squared: Tensor  # [B, N], px²
    scale: Tensor  # [B], px, `_SCALES` standard deviations
    ratio: Tensor  # [B, N], squared / scale²
    weight: Tensor  # [B, N]
    right: Tensor  # [B, 6], J^T W r
    unit: Tensor  # [B, 6]
    values: Tensor  # [B, 6], ascending
    vectors: Tensor  # [B, 6, 6], in columns
    seen: Tensor  # [B, 6], bool: whether pixels determine the direction of an eigenvector


def _weighted(samples: _Samples, motion: Tensor) -> _Weighted:
    at = _linearised(samples, motion)
    usable = samples.known & at.in_front
    squared = torch.where(usable, _squared(samples, at.ru, at.rv), torch.inf)
    scale = _SCALES * _scale(squared, samples.known.sum(-1))
    scale = scale.clamp(min=_LEAST_SCALE_PX, max=1e4)
    ratio = squared / scale.square().unsqueeze(-1)
    weight = (1 + ratio).square().reciprocal()
    normal, right = _normal_equations(samples, at, weight)
    moves = (weight.unsqueeze(1) * (at.Ju.square() + at.Jv.square())).sum(-1).double()
    unit = torch.where(moves > 1e-12, moves, torch.inf).rsqrt()
    scaled = (unit.unsqueeze(-1) * normal * unit.unsqueeze(-2)).nan_to_num(0.0, 0.0, 0.0)
    values, vectors = torch.linalg.eigh(scaled)  # raises for the whole batch if one holds nan
    seen = values > _LEAST_EIGENVALUE
    return _Weighted(at, squared, scale, ratio, weight, right, unit, values, vectors, seen)


def _descended(samples: _Samples, motion: Tensor, steps: int) -> Tensor:
    """Returns the motion after Gauss-Newton steps, in the directions that pixels determine."""
    for _ in range(steps):
        now = _weighted(samples, motion)
        # Take the step in the eigenbasis and only in the determined directions. In the others, a
        # solver would divide by nearly 0.
        along = (now.vectors.mT @ (now.unit * now.right).unsqueeze(-1)).squeeze(-1)
        along = torch.where(now.seen, along / now.values, 0.0)
        motion = _after(motion, -now.unit * (now.vectors @ along.unsqueeze(-1)).squeeze(-1))
    return motion


def _described(samples: _Samples, motion: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Returns a motion's inlier share `[B]`, covariance `[B, 6, 6]` and validity `[B]`."""
    now = _weighted(samples, motion)
    # The covariance of an M-estimator is the sandwich A^-1 B A^-1. A is the derivative of its
    # equations: the normal matrix times the mean slope of w(r^2) r, which, averaged over the
    # directions of r, is w (1 - 2 ratio / (1 + ratio)). B is the covariance of the noise in them.
    weight, ratio, seen = now.weight, now.ratio, now.seen
    slope = torch.where(weight > 0, weight * (1 - 2 * ratio / (1 + ratio)), 0.0).sum(-1)
    slope = (slope / weight.sum(-1).clamp(min=1e-12)).clamp(min=0.1).double()
    spread = torch.where(weight > 0, weight.square() * now.squared / 2, 0.0)
    middle, _ = _normal_equations(samples, now.at, spread)
    scaled = now.unit[..., None] * now.vectors * torch.where(seen, now.values.rsqrt(), 0.0)[:, None]
    inverse = scaled @ scaled.mT
    covariance = inverse @ middle @ inverse / slope.square()[:, None, None]
    # A parameter with a component in an undetermined direction is not determined at all.
    is_open = (now.vectors.square() * ~seen.unsqueeze(-2)).sum(-1) > 1e-6  # [B, 6]
    covariance = torch.where(is_open.unsqueeze(-1) | is_open.unsqueeze(-2), 0.0, covariance)
    variance = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0)  # rounding may make it negative
    variance = torch.where(is_open, torch.inf, variance)
    diagonal = torch.eye(6, dtype=torch.bool, device=motion.device)
    covariance = torch.where(diagonal, variance.unsqueeze(-1), covariance)
    is_motion = _is_motion(samples, now)
    within = torch.where(is_motion, _INLIER_SCALES / _SCALES * now.scale, _STILL_PX)
    share = (now.squared < within.square().unsqueeze(-1)).sum(-1) / samples.number.clamp(min=1)
    enough = (samples.number >= MIN_PIXELS) & seen.all(-1) & motion.flatten(1).isfinite().all(-1)
    return share, covariance, enough & is_motion


def _is_motion(samples: _Samples, now: _Weighted) -> Tensor:
    """Returns whether the flow isn't just noise `[B]`: the camera rests, or its motion is visible.

    A motion can be fitted to noise, too. By chance, the mean square of its flow is 6 / 2N of that
    of the noise, for six parameters and N pixels with two channels, and somewhat more because it is
    the best of many hypotheses. Noise up to `_STILL_PX` can't be distinguished from a camera at
    rest.
    """
    ego = _squared(samples, samples.values[:, 4] - now.at.ru, samples.values[:, 5] - now.at.rv)
    ego = (now.weight * ego).sum(-1) / now.weight.sum(-1).clamp(min=1e-12)
    deviation = now.scale / _SCALES
    strength = ego / (2 * deviation.square())
    by_chance = 3 / (samples.number - MIN_PIXELS).clamp(min=1)
    is_shown = (strength > _LEAST_STRENGTH) & (strength > _LEAST_OVER_CHANCE * by_chance)
    return (deviation <= _STILL_PX) | is_shown
