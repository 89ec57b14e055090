"""Which convention is wrong: one diagnosis of recordings, environments and replay batches.

A witness tells, for any motion of the camera, how far each pixel is from where the data have it:
raw flow where it was measured, and else the depth of the frame before. The motion that leaves least
is possible with these data; what the recorded one leaves beyond it is the error of a convention,
whether anybody listed that mistake or not. The rivals, a table of the usual mistakes, are then
tried as explanations. What a rival has to learn from the data (a factor, a transform) it learns
from one half of the pairs of frames, and is judged by the other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from itertools import product
from typing import Any, Literal, NamedTuple, get_args

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional

from flowrep import geometry
from flowrep.geometry.egomotion import structure_tensor
from flowrep.geometry.pose import rotation_from_vector

_PIXELS, _FITTED = 1000, 400  # of a pair, and of these, those that numbers are learnt from
_ENV_PAIRS = 8
_LEAST_PIXELS, _LEAST_TEXTURE = 64, 0.25  # of a pair; of a pixel's structure tensor
_LEAST_MOVEMENT_PX = 0.25  # pairs that move less say nothing
_BEHIND_PX = 1e3  # residual of a point that a motion puts behind the camera
# No error: rounding, a share of the noise, and of flow that was estimated, which is too short.
_EXACT_PX, _OF_NOISE, _OF_ESTIMATED = 2e-3, 0.3, 0.03
# An explanation leaves several times less; or clearly less in most pairs, if the error is large.
_SEVERAL, _CLEARLY, _IN_MOST, _MANY_PAIRS, _LARGE = 3.0, 1.5, 0.9, 8, 0.04
# More than noise of poses makes: a share of raw flow and of the width, or many times the noise.
_ROUGH, _ROUGH_WIDTHS, _MANY_TIMES, _LITTLE = 0.25, 1 / 1280, 20.0, 0.02
_SAME_DEPTH = 0.03  # relative
_DOUBTFUL = 0.15  # of raw flow, left by the best motion: the estimator failed
_STEP, _EYE = 1e-6, torch.eye(4, dtype=torch.float64)  # of numeric derivatives


class _Pairs(NamedTuple):
    """P pairs of frames as N pixels each, float64, nan where unknown."""

    place: Tensor  # [P, 2, N], centres
    raw: Tensor  # [P, 2, N]
    depth: Tensor  # [P, N], of the current frame
    texture: Tensor  # [P, 3, N], the root of the structure tensor: xx, xy, yy
    coarseness: Tensor  # [P, N], depth's step over depth
    K: Tensor  # [P, 3, 3]
    prev_K: Tensor
    path: Tensor  # [P, 4, 4, 4], world_from_cam at t - 2 to t + 1
    now: Tensor  # [P, H, W], inverse depth of the current frame
    before: Tensor  # the same of the previous one
    by_flow: bool  # the witness is raw flow, not the depth of the frame before
    is_estimated: bool = False
    depth_step: float = 0.0  # of coarse depth, metres
    scale_px: float = 1e-4  # the least scale of residuals
    gain: Tensor = torch.eye(2, dtype=torch.float64)  # raw is this times flow
    distortion: Tensor = torch.zeros(1, 1, dtype=torch.float64)  # [P, 1], of the radius' square

    def of(self, pairs: Any = slice(None), pixels: Any = slice(None)) -> _Pairs:
        """Returns some pairs, or some of each one's pixels."""
        maps: list[Any] = [tensor[pairs][..., pixels] for tensor in self[:5]]
        others: list[Any] = [tensor[pairs] for tensor in self[5:10]]
        return _Pairs(*maps, *others, *self[10:])  # type: ignore[call-arg]

    @property
    def motion(self) -> Tensor:
        """The recorded one, `prev_from_curr` [P, 4, 4]."""
        return geometry.relative_motion(self.path[:, 1], self.path[:, 2], dtype=torch.float64)


def _seen(pairs: _Pairs, motion: Tensor) -> tuple[Tensor, Tensor]:
    """Returns where pixels were before, `[..., P, 2, N]`, and their depth then over that now."""
    rays = torch.linalg.inv_ex(pairs.K)[0] @ _homogeneous(pairs.place)
    bent, by = bool(pairs.distortion.any()), pairs.distortion[..., None]
    if bent:
        straight = rays[:, :2]
        for _ in range(6):
            straight = rays[:, :2] / (1 + by * straight.square().sum(1, keepdim=True)).clamp(0.2)
        rays = _homogeneous(straight)
    q = torch.where(pairs.depth > 0, pairs.depth.reciprocal(), math.nan).unsqueeze(-2)
    moved = motion[..., :3, :3] @ rays + motion[..., :3, 3:] * q
    ratio = torch.where(moved[..., 2, :] > 0.01, moved[..., 2, :], math.nan)
    at = moved[..., :2, :] / ratio.unsqueeze(-2)
    if bent:
        at = at * (1 + by * at.square().sum(-2, keepdim=True))
    return pairs.prev_K[:, :2, :2] @ at + pairs.prev_K[:, :2, 2:], ratio


def _homogeneous(points: Tensor) -> Tensor:
    return torch.cat([points, torch.ones_like(points[..., :1, :])], -2)


def _residual(pairs: _Pairs, motion: Tensor, *, plain: bool = False) -> Tensor:
    """Returns what a motion `[..., P, 4, 4]` leaves, px `[..., P, 2 or 1, N]`, nan where unknown.

    Of flow, along the directions that have texture unless `plain`. Of depth, how far a surface at
    45 degrees would have to move in the picture to be as near as the frame before shows it.
    """
    place, ratio = _seen(pairs, motion)
    is_motion = motion.isfinite().flatten(-2).all(-1)[..., None, None]
    if not pairs.by_flow:
        left = _looked_up(pairs.before, place) * pairs.depth * ratio - 1
        left = left.sign() * (left.abs() - pairs.coarseness).clamp(min=0.0)
        left = pairs.K[:, 0, :1] * left
        left = left.masked_fill(ratio.isnan() & pairs.depth.isfinite(), _BEHIND_PX).unsqueeze(-2)
        return torch.where(is_motion, left, math.nan)
    left = (pairs.raw - pairs.gain @ (pairs.place - place)).nan_to_num(nan=_BEHIND_PX)
    known = pairs.raw.isfinite() & ~pairs.depth.isnan().unsqueeze(-2) & is_motion
    if not plain:  # the texture is the picture's, whatever axes the flow has
        xx, xy, yy = pairs.texture.unbind(1)
        u, v = (torch.linalg.inv(pairs.gain) @ left).unbind(-2)
        left = torch.stack([xx * u + xy * v, xy * u + yy * v], -2) * pairs.gain.det().abs().sqrt()
    return torch.where(known, left, math.nan)


def _looked_up(maps: Tensor, place: Tensor) -> Tensor:
    """Returns maps `[P, H, W]` at places `[..., P, 2, N]`, bilinear, nan outside."""
    size = torch.tensor([maps.shape[-1], maps.shape[-2]], dtype=torch.float64).unsqueeze(-1)
    inside = ((place >= 0.5) & (place <= size - 0.5)).all(-2)
    grid = torch.where(inside.unsqueeze(-2), 2 * place / size - 1, 0.0)
    grid = grid.reshape(-1, *grid.shape[-3:]).permute(1, 0, 3, 2)  # [P, ..., N, 2]
    found = functional.grid_sample(maps.unsqueeze(1), grid, align_corners=False)
    return torch.where(inside, found[:, 0].transpose(0, 1).reshape(inside.shape), math.nan)


def _px(left: Tensor, share: float | None = None) -> Tensor:
    """Returns a quantile of each pair's lengths of residuals `[..., P, C, N]`.

    Of flow the median, since half of the picture may move by itself. Of depth, of what is known to
    stand still, 0.8: roads and walls along the way are as far wherever the camera is on them.
    """
    lengths = left.square().sum(-2).sqrt().sort(-1).values  # nan comes last
    share = share or (0.5 if left.shape[-2] == 2 else 0.8)
    rank = (share * (~lengths.isnan()).sum(-1, keepdim=True)).long().clamp(max=left.shape[-1] - 1)
    return lengths.gather(-1, rank).squeeze(-1)


def _apart(pairs: _Pairs, one: Tensor, other: Tensor) -> Tensor:
    """Returns the difference between what two motions leave, which has no noise, px `[P]`."""
    left = _residual(pairs, one, plain=True) - _residual(pairs, other, plain=True)
    return _px(left, None if pairs.by_flow else 0.95)


def _median(values: Tensor) -> float:
    """Returns the median of known values, inf if most are not."""
    return math.inf if 2 * int(values.isnan().sum()) > values.numel() else float(values.nanmedian())


def _small(step: Tensor) -> Tensor:
    """Returns rigid transforms `[..., 4, 4]` of (rotation vector, translation) `[..., 6]`."""
    upper = torch.cat([rotation_from_vector(step[..., :3]), step[..., 3:, None]], -1)
    return torch.cat([upper, _EYE[3:].expand(*upper.shape[:-2], 1, 4)], -2)


def _vector(motion: Tensor) -> Tensor:
    """Returns (rotation vector, translation) `[..., 6]` of turns well below half of one."""
    sine = _skew(motion[..., :3, :3]) / 2
    length, trace = sine.norm(dim=-1, keepdim=True), motion.diagonal(dim1=-2, dim2=-1).sum(-1)
    angle = torch.atan2(length, (trace.unsqueeze(-1) - 2) / 2)
    turn = sine * torch.where(length > 1e-9, angle / length, 1.0)
    return torch.cat([turn, motion[..., :3, 3]], -1)


def _skew(R: Tensor) -> Tensor:
    """Returns a rotation's axis times twice its sine, `[..., 3]`."""
    off = R - R.mT
    return torch.stack([off[..., 2, 1], off[..., 0, 2], off[..., 1, 0]], -1)


Change = Callable[[_Pairs, Tensor], _Pairs]


def _descended(
    pairs: _Pairs, motion: Tensor | None, change: Change, n: Tensor, *, steps: int, each: bool
) -> tuple[Tensor | None, Tensor]:
    """Returns motions, and the numbers n [P, k] of a change, that leave less: Gauss-Newton steps.

    Weights are Geman and McClure's. Without `motion` the recorded ones are kept. The numbers are
    the same for all pairs unless `each`.
    """
    tries = _small(_STEP * torch.cat([torch.zeros(1, 6), torch.eye(6)]).double()).unsqueeze(1)
    for _ in range(steps):
        changed = change(pairs, n)
        moved = changed.motion.unsqueeze(0) if motion is None else tries @ motion
        left, *columns = _residual(changed, moved)
        for one in _STEP * torch.eye(n.shape[-1], dtype=torch.float64):
            changed = change(pairs, n + one)
            columns.append(_residual(changed, changed.motion if motion is None else motion))
        J = (torch.stack(columns, -1) - left.unsqueeze(-1)) / _STEP  # [P, C, N, 6 + k]
        known = (left.isfinite() & J.isfinite().all(-1)).all(-2)
        squared = torch.where(known, left.square().sum(-2), math.inf)
        scale = _scale(squared, pairs).square().unsqueeze(-1)
        root = (scale.rsqrt() / (1 + squared / scale)).unsqueeze(1)
        left = torch.where(known.unsqueeze(1), left * root, 0.0).flatten(1)
        J = torch.where(known[:, None, :, None], J * root.unsqueeze(-1), 0.0).flatten(1, 2)
        A, b = J.mT @ J, (J.mT @ left.unsqueeze(-1)).squeeze(-1)
        # In units of what each parameter moves, and damped where the pixels tell nothing.
        unit = A.diagonal(dim1=-2, dim2=-1).clamp(min=1e-12).rsqrt()
        A = A * unit.unsqueeze(-1) * unit.unsqueeze(-2) + 1e-6 * torch.eye(A.shape[-1])
        d, b = A.shape[-1] - n.shape[-1], (b * unit).unsqueeze(-1)
        solved = torch.linalg.solve_ex(A[:, :d, :d], torch.cat([b[:, :d], A[:, :d, d:]], -1))[0]
        step, across = solved[..., :1], solved[..., 1:]
        if n.shape[-1]:
            # Schur's complement: the equations of the numbers alone, for all pairs together.
            S, g = A[:, d:, d:] - A[:, d:, :d] @ across, b[:, d:] - A[:, d:, :d] @ step
            back = unit[:, d:].reciprocal().unsqueeze(-1)
            S, g = S * back * back.mT, g * back
            S, g = (S, g) if each else (S.sum(0, keepdim=True), g.sum(0, keepdim=True))
            S = S + torch.diag_embed(1e-6 * S.diagonal(dim1=-2, dim2=-1) + 1e-12)
            further = torch.linalg.solve_ex(S, g)[0]
            n, step = n - further.squeeze(-1), step - across @ (further * back)
        if motion is not None:
            step = (unit[:, :d] * step.squeeze(-1)).nan_to_num()
            motion = _small(-step.clamp(-0.5, 0.5)) @ motion
    return motion, n


def _scale(squared: Tensor, pairs: _Pairs) -> Tensor:
    """Returns 1.5 standard deviations of residuals by their lower third, inf where unknown."""
    rank = squared.isfinite().sum(-1, keepdim=True) // 3
    third = squared.sort(-1).values.gather(-1, rank.clamp(max=squared.shape[-1] - 1)).squeeze(-1)
    scale = 1.5 * (third / (-2 * math.log(2 / 3))).sqrt()
    return scale.nan_to_num(1.0, 1.0).clamp(pairs.scale_px, 1e4)


def _best(pairs: _Pairs, *starts: Tensor, steps: int = 5) -> Tensor:
    """Returns the motions that leave least, from whichever start each is reached."""
    few, none = pairs.of(pixels=slice(_FITTED)), pairs.depth[:, :0]
    options: Any = {"steps": steps, "each": False}
    motions = [*starts]
    for start in starts:
        end, _ = _descended(few, start, lambda p, n: p, none, **options)
        if not pairs.by_flow and end is not None:  # where edges of depth don't count any more
            end, _ = _descended(few._replace(scale_px=1e-3), end, lambda p, n: p, none, **options)
        motions += [] if end is None else [end]
    return _least_costly(few, torch.stack(motions))


def _least_costly(few: _Pairs, motions: Tensor) -> Tensor:
    """Returns that of motions `[M, P, 4, 4]` with which most pixels of each pair agree."""
    squared = _residual(few, motions).square().sum(-2).nan_to_num(math.inf)
    scale = torch.stack([_scale(each, few) for each in squared]).amin(0).square().unsqueeze(-1)
    # A motion that isn't known, as beyond the ends of a path, is the worst.
    agreement = (1 / (1 + squared / scale)).mean(-1)
    if not few.by_flow:  # interpolated edges of depth are no reason to leave the first
        agreement[0] += 0.01
    return motions[agreement.argmax(0), torch.arange(squared.shape[1])]


class _Rival(NamedTuple):
    """A mistake: what the data are instead, and what makes right data of them.

    `typed` is the option that mends it, or what to do; both texts may hold the numbers that are
    learnt, by Gauss-Newton steps from each `start`. `each` pair may have its own. `usual` are the
    numbers of a mistake that should show.
    """

    of: Literal["poses", "flow", "camera", "depth"]
    typed: str
    says: str
    change: Change
    start: tuple[tuple[float, ...], ...] = ((),)
    usual: tuple[float, ...] = ()
    each: bool = False


def _rivals(given: Mapping[str, str], *, of_flow: bool, absolute: bool) -> list[_Rival]:
    """Returns the table of mistakes, relative to the options in force."""
    given = {"pose_direction": "camera_to_world", "pose_axes": "opencv", "depth_kind": "z",
             "flow_direction": "forward", "flow_channels": "uv"} | {**given}  # fmt: skip
    table, of = [], _Rival
    directions = get_args(geometry.PoseDirection) if absolute else [given["pose_direction"]]
    for direction, axes in product(directions, get_args(geometry.CameraAxes)):
        says = {f"pose_direction={direction}": f"the poses are {direction.replace('_', '-')}",
                f"pose_axes={axes}": f"the camera's axes are {axes}"}  # fmt: skip
        says = {
            typed: text
            for typed, text in says.items()
            if typed.split("=")[1] != given[typed.split("=")[0]]
        }
        if says:
            change = _path(partial(_readapted, given, direction, axes))
            table.append(of("poses", " ".join(says), " and ".join(says.values()), change))
    for axis in (0, 2):  # and y by the axes of Unity
        text = f"the world is mirrored: poses are F @ pose @ F, F's {'xyz'[axis]} negative"
        table.append(
            of("poses", f"mirrored in {'xyz'[axis]}", text, _path(partial(_mirrored, axis)))
        )
    if absolute:
        table += [
            of(
                "poses",
                "pose_layout=xyz_wxyz",
                "quaternions have w first",
                _path(partial(_rolled, -1)),
            ),
            of(
                "poses",
                "pose_layout=xyz_xyzw",
                "quaternions have w last",
                _path(partial(_rolled, 1)),
            ),
            of(
                "poses",
                "rotations transposed",
                "rotations are stored by columns",
                _path(_transposed),
            ),
        ]
    table += [
        of("poses", "motions inverted", "frames or poses run backwards (curr_from_prev)",
           _path(lambda path: path.flip(1))),
        of("poses", "pose_lag_frames=1", "poses are a frame late",
           _path(lambda path: path[:, [1, 2, 3, 3]])),
        of("poses", "pose_lag_frames=-1", "poses are a frame early",
           _path(lambda path: path[:, [0, 0, 1, 2]])),
        of("poses", "poses {0:.2f} frames later", "the times of poses are {0:.2f} frames late",
           _later, ((0.0,),), (0.5,)),
        of("poses", "marker_from_cam={matrix}", "poses are a marker's, {degrees:.1f} degrees off",
           lambda p, n: p._replace(path=p.path @ _small(n)[:, None]), ((0.0,) * 6,), (0.1,) * 6),
        of("camera", "K's numbers in another order", "K's numbers are fx, cx, fy, cy",
           _camera(lambda fx, cx, fy, cy, w, h, n: (fx, fy, cx, cy))),
        of("camera", "K in pixels", "K is in widths and heights",
           _camera(lambda fx, cx, fy, cy, w, h, n: (w * fx, w * cx, h * fy, h * cy))),
        of("camera", "K times {0:.3g}", "K is of pictures {inverse:.3g} times as large",
           _camera(lambda *k: [k[-1][0] * x for x in k[:4]]), ((1.0,), (0.5,), (2.0,)), (1.25,)),
        of("camera", "cx and cy moved by {px}", "the pictures were cropped, K was not",
           _camera(lambda fx, cx, fy, cy, w, h, n: (fx, cx + w * n[0], fy, cy + w * n[1])),
           ((0.0, 0.0),), (0.1, 0.1)),
        of("camera", "fx times {0:.3g}, fy times {1:.3g}, cx and cy moved by {px}",
           "K is another camera's", _camera(lambda fx, cx, fy, cy, w, h, n: (
               fx * n[0].clamp(0.01), cx + w * n[2], fy * n[1].clamp(0.01), cy + w * n[3])),
           ((1.0, 1.0, 0.0, 0.0),)),
        of("camera", "a K for each frame", "K changes from frame to frame",
           _zoomed, ((1.0, 1.0),), (1.01, 1.0), each=True),
        of("camera", "distortion=[{0:.2g},0,0,0]", "the lens bends the picture (calibrate it)",
           lambda p, n: p._replace(distortion=n), ((0.0,),), (-0.2,)),
        of("depth", "depth times {0:.3g}", "depth, or the poses' unit, is {inverse:.3g} as large",
           _depth(lambda z, n: z / n.clamp(1e-6)), ((1.0,), (1e-3,), (1e3,)), (2.0,)),
        of("depth", "{0:.3g} / depth", "depth is {0:.3g} / z, a disparity",
           _depth(lambda d, n: n.clamp(1e-6) / d), ((1.0,), (100.0,))),
        of("depth", "depth_kind=z_buffer", "it is a buffer: near_m={inverse:.3g} far_m={far:.3g}",
           _depth(_from_buffer), ((5.0, -5.0),)),
        of("depth", "depth_kind=ray_length", "it is the length of the ray", partial(_along_ray, -1))
        if given["depth_kind"] != "ray_length" else
        of("depth", "depth_kind=z", "it is z, not the length of the ray", partial(_along_ray, 1)),
    ]  # fmt: skip
    if of_flow:
        other = {"backward": "forward", "forward": "backward"}[given["flow_direction"]]
        order = {"uv": "row_column", "row_column": "uv"}[given["flow_channels"]]
        direction, channels = f"flow_direction={other}", f"flow_channels={order}"
        table += [
            of("flow", direction, f"flow points {other}", _gain(-1, 0, 0, -1)),
            of("flow", channels, f"flow's channels are {order}", _gain(0, 1, 1, 0)),
            of("flow", f"{direction} {channels}", f"it is {other}, {order}", _gain(0, -1, -1, 0)),
            of("flow", "u negated", "flow's u points left", _gain(-1, 0, 0, 1)),
            of("flow", "v negated", "flow's v points up", _gain(1, 0, 0, -1)),
            of("flow", "flow times the size", "it is in widths and heights", partial(_in_sizes, 1)),
            of("flow", "flow times half the size", "flow is in half widths", partial(_in_sizes, 2)),
            of("flow", "flow divided by {0:.3g}", "flow is of pictures {0:.3g} times as large",
               lambda p, n: p._replace(gain=p.gain * n.median()), ((1.0,),), (1.5,)),
            of("flow", "flow_to=next backwards=true", "flow leads to the next frame", _to_next),
            of("flow", "flow_grid=previous", "flow is on the previous frame's grid", _of_previous),
            of("depth", "depth moved by {px}", "depth isn't registered to the pictures",
               _moved_depth, ((0.0, 0.0), (0.06, 0.0), (-0.06, 0.0)), (0.05, 0.0)),
            of("depth", "depth of the next frame", "depth is a frame late", _late_depth),
        ]  # fmt: skip
    return table


def _path(change: Callable[[Tensor], Tensor]) -> Change:
    return lambda pairs, n: pairs._replace(path=change(pairs.path))


def _gain(uu: float, uv: float, vu: float, vv: float) -> Change:
    gain = torch.tensor([[uu, uv], [vu, vv]], dtype=torch.float64)
    return lambda pairs, n: pairs._replace(gain=gain @ pairs.gain)


def _camera(change: Callable[..., Sequence[Tensor]]) -> Change:
    """Changes fx, cx, fy, cy of both frames, given the picture's width, height and the numbers."""

    def changed(pairs: _Pairs, n: Tensor) -> _Pairs:
        height, width = pairs.now.shape[-2:]
        both = []
        for K in (pairs.K, pairs.prev_K):
            numbers = (K[:, 0, 0], K[:, 0, 2], K[:, 1, 1], K[:, 1, 2])
            fx, cx, fy, cy = change(*numbers, width, height, n.unbind(-1))
            rows = [fx, K[:, 0, 1], cx, 0 * fx, fy, cy]
            both.append(torch.cat([torch.stack(rows, -1).unflatten(-1, (2, 3)), K[:, 2:]], 1))
        return pairs._replace(K=both[0], prev_K=both[1])

    return changed


def _zoomed(pairs: _Pairs, factors: Tensor) -> _Pairs:
    now, before = (
        _camera(lambda fx, cx, fy, cy, w, h, n: (fx * n[0], cx, fy * n[0], cy))(pairs, by)
        for by in factors.split(1, -1)
    )
    return pairs._replace(K=now.K, prev_K=before.prev_K)


def _readapted(given: Mapping[str, str], direction: Any, axes: Any, path: Tensor) -> Tensor:
    """Undoes the options in force and applies others to `world_from_cam`."""
    in_force: Any = given["pose_axes"]
    ones = torch.where(torch.arange(4) == 3, 1.0, _EYE)
    taken = geometry.adapt_pose(ones, axes=in_force, check=False)
    world = taken[:, 3].diag()  # left-handed worlds have an axis turned over
    stored = world @ path @ torch.cat([(world @ taken)[:, :3], _EYE[:, 3:]], -1).mT
    if direction != given["pose_direction"]:
        stored = geometry.invert_rigid(stored)
    return geometry.adapt_pose(stored, axes=axes, check=False)


def _mirrored(axis: int, path: Tensor) -> Tensor:
    sign = torch.where(torch.arange(4) == axis, -1.0, 1.0).double()
    return path * sign * sign.unsqueeze(-1)


def _transposed(path: Tensor) -> Tensor:
    of_rotation = torch.arange(4) < torch.tensor([3, 3, 3, 0]).unsqueeze(-1)
    return torch.where(of_rotation, path.mT, path)


def _rolled(places: int, path: Tensor) -> Tensor:
    """Returns poses whose quaternion's numbers are moved by one place."""
    known = path.isfinite().flatten(-2).all(-1)[..., None, None]
    R = torch.where(known, path, _EYE)[..., :3, :3]
    # A rotation's quaternion, but for its sign, is the first eigenvector of this.
    axis, trace = _skew(R).unsqueeze(-1), R.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    upper = torch.cat([R + R.mT - trace * _EYE[:3, :3], axis], -1)
    of_quaternion = torch.cat([upper, torch.cat([axis.mT, trace], -1)], -2)
    xyzw = torch.linalg.eigh(of_quaternion)[1][..., -1].roll(places, -1)
    pose = torch.cat([path[..., :3, 3].nan_to_num(), xyzw], -1)
    pose = geometry.pose_from_quaternion(pose, "xyz_xyzw", check=False)
    return torch.where(known, pose, math.nan)


def _later(pairs: _Pairs, share: Tensor) -> _Pairs:
    """Poses at times between those recorded, some share of a frame later."""
    poses = [torch.full_like(pairs.path[:, 0], math.nan)] * 4
    for i in (1, 2):
        start, end = (
            torch.where(share[..., None] >= 0, pairs.path[:, i + j], pairs.path[:, i + j - 1])
            for j in (0, 1)
        )
        step = _vector(geometry.invert_rigid(start) @ end)
        poses[i] = start @ _small(step * torch.where(share >= 0, share, 1 + share))
    return pairs._replace(path=torch.stack(poses, 1))


def _depth(change: Callable[[Tensor, Tensor], Tensor]) -> Change:
    def changed(pairs: _Pairs, n: Tensor) -> _Pairs:
        before = pairs.before  # large, and seldom of use beside flow
        if not pairs.by_flow:
            before = change(before.reciprocal(), n.unsqueeze(-1)).reciprocal()
        return pairs._replace(depth=change(pairs.depth, n), before=before)

    return changed


def _from_buffer(buffer: Tensor, line: Tensor) -> Tensor:
    """Inverse depth falls along a line over the buffer's values, which are none beyond 1."""
    near, far = (line.movedim(1, 0)[i].unsqueeze(1) for i in (0, 1))
    inverse = near + far.clamp(max=0.0) * buffer
    depth = torch.where(inverse > 1e-4, inverse.reciprocal(), math.inf)
    return torch.where(buffer <= 1, depth, -buffer)


def _along_ray(power: int, pairs: _Pairs, n: Tensor) -> _Pairs:
    """Depth times the length of the ray per metre of z, or divided by it."""

    def per_z(K: Tensor, place: Tensor) -> Tensor:
        return (torch.linalg.inv_ex(K)[0] @ _homogeneous(place)).norm(dim=1) ** power

    before, (height, width) = pairs.before, pairs.now.shape[-2:]
    if not pairs.by_flow:
        v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        everywhere = torch.stack([u, v]).double().flatten(1)
        before = before / per_z(pairs.prev_K, everywhere).unflatten(-1, (height, width))
    return pairs._replace(depth=pairs.depth * per_z(pairs.K, pairs.place), before=before)


def _in_sizes(parts: float, pairs: _Pairs, n: Tensor) -> _Pairs:
    size = torch.tensor(pairs.now.shape[:0:-1], dtype=torch.float64)
    return pairs._replace(gain=torch.diag(parts / size) @ pairs.gain)


def _to_next(pairs: _Pairs, n: Tensor) -> _Pairs:
    return pairs._replace(path=pairs.path[:, [3, 3, 2, 1]], gain=-pairs.gain)


def _reversed(pairs: _Pairs, place: Tensor, maps: Tensor) -> _Pairs:
    """Flow from the frame before to this one, at places there, as if time ran back."""
    other: dict[str, Any] = {
        "path": pairs.path.flip(1),
        "K": pairs.prev_K,
        "prev_K": pairs.K,
        "gain": -pairs.gain,
    }
    return pairs._replace(place=place, depth=_looked_up(maps, place).reciprocal(), **other)


def _of_previous(pairs: _Pairs, n: Tensor) -> _Pairs:
    return _reversed(pairs, pairs.place, pairs.before)


def _late_depth(pairs: _Pairs, n: Tensor) -> _Pairs:
    return _reversed(pairs, pairs.place - torch.linalg.solve(pairs.gain, pairs.raw), pairs.now)


def _moved_depth(pairs: _Pairs, shares: Tensor) -> _Pairs:
    place = pairs.place + (shares * pairs.now.shape[-1]).unsqueeze(-1)
    return pairs._replace(depth=_looked_up(pairs.now, place).reciprocal())


class _Found(NamedTuple):
    """What the data leave, as they are or as a rival corrects them, px `[P]`.

    `error` is what the recorded motion leaves beyond the best one, `spread` what that leaves.
    """

    rival: _Rival | None
    n: Tensor  # [k]
    pairs: _Pairs
    motion: Tensor  # the best
    error: Tensor
    spread: Tensor

    def beyond(self, noise: Tensor) -> Tensor:
        """Returns what is left beyond noise."""
        return (self.error.square() + (self.spread.square() - noise.square()).clamp(min=0)).sqrt()

    @property
    def left(self) -> float:
        """The median of all that is left."""
        return _median(self.beyond(torch.zeros_like(self.spread)))

    @property
    def least(self) -> float:
        """The error below which there is none: how far two halves of the picture differ, and more.

        The halves are every other block of it, since neighbouring pixels err alike.
        """
        pairs, (height, width) = self.pairs, self.pairs.now.shape[-2:]
        block = pairs.place.nan_to_num() / torch.tensor([[width / 6], [height / 4]])
        is_even = block.floor().sum(1) % 2 == 0
        halves = [
            _best(pairs._replace(depth=pairs.depth.masked_fill(half, math.nan)), self.motion)
            for half in (is_even, ~is_even)
        ]
        floor = _SEVERAL * _median(_apart(pairs, *halves)) / 2
        bias = _OF_ESTIMATED * _median(_px(pairs.raw)) if pairs.is_estimated else 0.0
        return max(_EXACT_PX, floor, _OF_NOISE * _median(self.spread), bias)

    @property
    def is_unexplained(self) -> bool:
        """Whether what is left can be predicted, and so is no noise."""
        least, smooth = self.least, _smoothed(self.pairs, self.motion)
        structure = (self.spread.square() - smooth.square()).clamp(min=0).sqrt()
        # Of estimated flow, some structure is its own.
        large = _median(structure) > 0.1 * _median(_px(self.pairs.raw)) and _is_better(
            smooth, self.spread
        )
        if _median(structure) > least and (
            large or _median(smooth) < _median(self.spread) / _SEVERAL
        ):
            return True
        if len(smooth) < _MANY_PAIRS or not _median(self.error) > least:
            return False
        return _is_better(_mapped(self.pairs, self.motion), self.error)


def _is_better(after: Tensor, before: Tensor) -> bool:
    """Whether errors `[P]` are several times less than others, or clearly less in most pairs."""
    share, improved = _median(after) / _median(before), (after < before / 1.1).double().mean()
    clearly = share < 1 / _CLEARLY and improved >= _IN_MOST and len(after) >= _MANY_PAIRS
    return share < 1 / _SEVERAL or bool(clearly)


def _explanations(
    pairs: _Pairs, starts: Sequence[Tensor], rivals: Sequence[_Rival]
) -> tuple[_Found, list[_Found]]:
    """Returns what the data leave, as they are and as each rival that may help corrects them."""
    few, none, still = pairs.of(pixels=slice(_FITTED)), pairs.depth[:, :0], torch.arange(0)
    still, has_poses = _EYE.expand(len(none), 4, 4), bool(pairs.motion.isfinite().all())
    starts = [*starts, still]
    if has_poses:
        known = [r.change(pairs, none).motion for r in rivals if r.of == "poses" and not r.start[0]]
        motions = torch.stack([pairs.motion, *known])
        starts = [pairs.motion, _least_costly(few, motions), *starts]

    def found(rival: _Rival | None, n: Tensor, changed: _Pairs, motion: Tensor) -> _Found:
        error = _apart(changed, changed.motion, motion) if has_poses else torch.zeros(len(none))
        spread = _px(_residual(changed, motion))
        return _Found(rival, n.nanmedian(0).values, changed, motion, error.double(), spread)

    recorded = found(None, none, pairs, _best(pairs, *starts, steps=8))
    others: list[_Found] = []
    if has_poses and recorded.left < _EXACT_PX:
        return recorded, others
    left = _median(_px(_residual(few, pairs.motion if has_poses else recorded.motion)))
    halves = [(few.of(half), half) for half in _halves(len(none))]
    for rival in rivals:
        n = _learnt(few, halves, rival, recorded.motion, has_poses=has_poses)
        if n is None or (rival.of == "poses" and not has_poses):
            continue
        if rival.of != "flow" and (n * torch.tensor(rival.start[0]) < 0).any():
            continue  # no camera has a negative focal length
        changed, motion = rival.change(pairs, n), recorded.motion
        if rival.of != "poses":
            start = changed.motion if has_poses else still
            # What leaves more than the data do is no explanation.
            if (
                has_poses
                and not _median(_px(_residual(changed.of(pixels=slice(_FITTED)), start))) <= left
            ):
                continue
            motion = _best(changed, start, motion)
        others.append(found(rival, n, changed, motion))
    return recorded, others


def _halves(count: int) -> list[Tensor]:
    """Returns every other of the pairs, and the rest; all of them twice if there are few."""
    every = torch.arange(count)
    return [every[::2], every[1::2]] if count >= 4 else [every, every]


def _learnt(
    few: _Pairs, halves: Sequence[tuple[_Pairs, Tensor]], rival: _Rival, best: Tensor, *,
    has_poses: bool,
) -> Tensor | None:  # fmt: skip
    """Returns a rival's numbers [P, k], learnt from the other half of pairs, None if too few."""
    n = torch.zeros(len(best), len(rival.start[0]), dtype=torch.float64)
    if not n.shape[1]:
        return n
    if len(best) < 4 and n.shape[1] > 2:
        return None
    if rival.each:
        halves = [(few, torch.arange(len(best)))] * 2
    options: Any = {"steps": 7, "each": rival.each}
    for (part, learns), (_, is_judged) in (halves, halves[::-1]):
        tries = []
        for start in rival.start:
            begin = torch.tensor(start, dtype=torch.float64).expand(len(learns), -1)
            motion = None if has_poses else best[learns]
            motion, end = _descended(part, motion, rival.change, begin, **options)
            changed = rival.change(part, end)
            left = _px(_residual(changed, changed.motion if motion is None else motion))
            tries.append((_median(left.nan_to_num(math.inf)), end))
        n[is_judged] = min(tries, key=lambda tried: tried[0])[1][: None if rival.each else 1]
    if rival.each:  # (of the frame, of the one before): each from the other pair that it is in
        follows = (few.path[1:, 1] == few.path[:-1, 2]).flatten(1).all(1)
        own = n.clone()
        n[:-1, 0] = torch.where(follows, own[1:, 1], own[:-1, 0])
        n[1:, 1] = torch.where(follows, own[:-1, 0], own[1:, 1])
        return n if follows.any() else None
    return n


def _mapped(pairs: _Pairs, best: Tensor) -> Tensor:
    """Returns the errors of poses that are corrected as the other pairs tell, px `[P]`.

    Each motion is corrected by a linear function of it. Whatever distorts poses in one and the same
    way, a convention that nobody listed too, is mended by it; noise of poses isn't.
    """
    recorded, wanted = _vector(pairs.motion), _vector(best)
    focal, inverse = pairs.K[:, 0, 0].median(), pairs.depth.reciprocal().nanmedian()
    unit = torch.cat([focal.expand(3), (focal * inverse).expand(3)])  # all in pixels
    x, y = recorded * unit, (wanted - recorded) * unit
    x = torch.cat([x, x.norm(dim=-1).median().expand(len(x), 1) / 2.4], 1)
    # The normal equations of all pairs but one, for each.
    A = x.mT @ x - x.unsqueeze(-1) * x.unsqueeze(-2)
    b = x.mT @ y - x.unsqueeze(-1) * y.unsqueeze(-2)
    size, errors = A.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None] / len(x), []
    for damping in (0.03, 0.3, 3.0):
        told = torch.linalg.solve_ex(A + damping * size * torch.eye(7), b)[0]
        correction = (x.unsqueeze(-2) @ told).squeeze(-2) / unit
        errors.append(_apart(pairs, _small(recorded + correction), best))
    return min(errors, key=_median)


def _smoothed(pairs: _Pairs, best: Tensor) -> Tensor:
    """Returns what the best motion leaves without its structure over picture and depth, px `[P]`.

    A polynomial of the pixel's place and inverse depth, fitted to every other block of the picture,
    is subtracted in the others. Where K, depth and flow fit each other, noise alone is left.
    """
    left, (height, width) = _residual(pairs, best), pairs.now.shape[-2:]
    x, y = (pairs.place.nan_to_num() / torch.tensor([[width], [height]])).unbind(1)
    q = pairs.depth.reciprocal().nan_to_num(0.0, 0.0, 0.0).clamp(min=0.0)
    q = (q / q.median(-1, keepdim=True).values.clamp(min=1e-9)).clamp(max=3.0) - 1
    powers = [(a, b, c) for a in range(4) for b in range(4 - a) for c in range(3)]
    terms = torch.stack([(2 * x - 1) ** a * (2 * y - 1) ** b * q**c for a, b, c in powers], -1)
    is_even, out = ((5 * x).floor() + (4 * y).floor()) % 2 == 0, left
    for half in (is_even, ~is_even):
        known = half & left.isfinite().all(1)
        weight = known.double()
        for _ in range(4):
            weighted = terms * weight.unsqueeze(-1)
            A, b = weighted.mT @ terms, weighted.mT @ left.nan_to_num().mT
            A = A + torch.diag_embed(1e-3 * A.diagonal(dim1=-2, dim2=-1) + 1e-9)
            rest = left - (terms @ torch.linalg.solve_ex(A, b)[0]).mT
            squared = torch.where(known, rest.square().sum(1), math.inf)
            weight = known / (1 + squared / _scale(squared, pairs).square().unsqueeze(-1)).square()
        out = torch.where(half.unsqueeze(1), out, rest)
    return _px(out)


@dataclass(frozen=True)
class Diagnosis:
    """A verdict on the conventions of some data; printed, it is a sentence and a table.

    Attributes:
        verdict: "wrong" if listed mistakes explain the data, "something is wrong" if none does.
        words: the reason, in a sentence.
        pairs: the number of pairs of frames that were examined.
        raw_px: median length of flow.
        left_px: median of what the recorded data leave, |raw - ego| where flow is the witness.
        best_px: median of what the best motion would leave.
        error_px: how far the data are from the best explanation, without the noise: right data are
            right to this many pixels.
        rivals_px: what the data would leave, by what mends each mistake.
        suspects: what mends the data, the likeliest first; none if they are right.
        unseen: the mistakes that would not show in these data.
        notes: further sentences: frames that stand out, and what could not be tested.
    """

    verdict: Literal["right", "wrong", "something is wrong", "can't tell"]
    words: str
    pairs: int = 0
    raw_px: float = math.nan
    left_px: float = math.nan
    best_px: float = math.nan
    error_px: float = math.nan
    rivals_px: Mapping[str, float] = field(default_factory=dict)
    suspects: tuple[str, ...] = ()
    unseen: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    @property
    def is_right(self) -> bool:
        """Whether nothing is wrong, as far as can be told."""
        return self.verdict == "right"

    @property
    def is_wrong(self) -> bool:
        """Whether something is, named or not."""
        return self.verdict in ("wrong", "something is wrong")

    def __str__(self) -> str:
        lines = [f"{self.verdict}: {self.words}"]
        if self.pairs:
            rows = {"as recorded": self.left_px, "the best motion": self.best_px}
            ranked = sorted(self.rivals_px.items(), key=lambda row: row[1])
            rows |= {name.partition("=[")[0]: px for name, px in ranked[:5] if self.is_wrong}
            lines += [f"  {name:60} {px:9.3f} px" for name, px in rows.items()]
            lines.append(f"  median flow {self.raw_px:.2f} px, {self.pairs} pairs of frames")
        if self.unseen:
            lines.append(f"  would not show here: {', '.join(self.unseen)}")
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])


def _diagnosed(
    pairs: _Pairs, starts: Sequence[Tensor], rivals: Sequence[_Rival], names: Sequence[str],
    remedy: Callable[[str], str],
) -> Diagnosis:  # fmt: skip
    """Returns the verdict on pairs that move."""
    recorded, others = _explanations(pairs, starts, rivals)
    has_poses, width = bool(pairs.motion.isfinite().all()), pairs.now.shape[-1]
    motion = pairs.motion if has_poses else recorded.motion
    ego = pairs.place - _seen(pairs, motion)[0]
    raw_px = _median(_px(pairs.raw if pairs.by_flow else ego))
    noise = torch.stack([each.spread for each in (recorded, *others)]).nan_to_num(math.inf).amin(0)
    before, least = recorded.beyond(noise), recorded.least
    error = _median(before)

    def after(each: _Found) -> float:
        return _median(each.beyond(noise))

    able = [each for each in others if error > least and after(each) < raw_px / 4]
    able = [each for each in able if _is_better(each.beyond(noise), before)]
    able = [each for each in able if error > _LARGE * raw_px or after(each) < error / _SEVERAL]
    able.sort(key=after)
    is_named = False
    if able:
        enough = able[0].least
        able = [each for each in able if after(each) <= _CLEARLY * after(able[0]) + enough]
        # One that learns more numbers than another of its kind says the same with more words.
        kinds = [each.rival.of for each in able if each.rival is not None]
        ranked = sorted(zip(kinds, able), key=lambda pair: -len(pair[1].n))
        fewest = {kind: len(each.n) for kind, each in ranked}
        able = [each for kind, each in zip(kinds, able) if len(each.n) == fewest[kind]]
        is_small = after(able[0]) < max(2 * enough, error / _SEVERAL)
        is_named = is_small and not able[0].is_unexplained
    texts = {each: _texts(each, width) for each in others}
    left = _px(_residual(pairs, motion, plain=True))
    numbers: dict[str, Any] = {
        "pairs": len(left), "raw_px": raw_px, "left_px": _median(left), "error_px": error,
        "best_px": _median(_px(_residual(pairs, recorded.motion, plain=True))),
        "rivals_px": {texts[each][0]: each.left for each in others},
        "suspects": tuple(texts[each][0] for each in able),
    }  # fmt: skip
    ways = " or ".join(
        f"{says} ({remedy(typed)} would leave {after(each):.2g} px)"
        for each in able for typed, says in [texts[each]]
    )  # fmt: skip
    size = f"{error:.2g} px of {max(raw_px, float(ego.abs().median())):.2g} px"
    is_doubtful = pairs.is_estimated and numbers["best_px"] > _DOUBTFUL * raw_px + 0.15
    if is_doubtful and not (able and not len(able[0].n)):
        best_px = numbers["best_px"]
        why = f"flow estimated from pictures fits no motion: {best_px:.2g} of {size[-7:]} are left"
        return Diagnosis("can't tell", why, **numbers)
    if is_named:
        return Diagnosis("wrong", f"{ways}; now {size} are left", **numbers)
    is_rough = error > _ROUGH * raw_px + _ROUGH_WIDTHS * width
    is_rough |= error > max(_MANY_TIMES * _median(recorded.spread), _LITTLE * raw_px)
    if able or recorded.is_unexplained or is_rough:
        why = f"{size} are left, which none of {len(rivals)} known mistakes explains"
        why += (
            f"; a motion exists that would leave {numbers['best_px']:.2g} px" if has_poses else ""
        )
        return Diagnosis(
            "something is wrong", why + (f"; nearest: {ways}" if able else ""), **numbers
        )
    if not pairs.by_flow:  # what depth's steps hide
        error = max(error, _median(pairs.K[:, 0, 0] * _px(pairs.coarseness.unsqueeze(1), 0.5)))
        size, numbers["error_px"] = f"{error:.2g} px of {raw_px:.2g} px", error
        if error > 0.5 * raw_px:
            step = f"{pairs.depth_step:.2g} m"
            why = f"depth's steps of {step} hide errors of {size}; keep pictures (rgb)"
            return Diagnosis("can't tell", why, **numbers)
    parts = ["raw flow"] * pairs.by_flow + ["depth", "K"] + ["the camera's motion"] * has_poses
    notes = []
    if _is_coarse(pairs):
        notes.append(f"depth has steps of {pairs.depth_step:.2g} m, which hide smaller errors")
    stray = [n for n, px in zip(names, before.tolist()) if px > max(6 * error, raw_px / 4)]
    if stray:
        notes.append(f"poses of these frames don't fit the others': {', '.join(stray)}")
    if not has_poses:
        notes.append("there are no poses, so theirs and the unit of depth could not be tested")
    elif numbers["best_px"] < numbers["left_px"] / 2 and error > 0.1 * raw_px:
        notes.append("the poses are rough: motion estimated from flow and depth leaves less")
    unseen = []
    for rival in rivals if has_poses else []:
        if len(rival.usual) == len(rival.start[0]):
            usual = torch.tensor(rival.usual, dtype=torch.float64).expand(len(left), -1)
            other = rival.change(pairs, usual)
            apart = _residual(other, other.motion, plain=True) - _residual(
                pairs, motion, plain=True
            )
            if _median(_px(apart)) <= max(least, error):
                unseen.append(rival.typed.partition("=[")[0].partition("={")[0].partition(" {")[0])
    agree = f"{', '.join(parts)} agree to {size}, beside noise of {numbers['best_px']:.2g} px"
    return Diagnosis("right", agree, **numbers,
                     unseen=tuple(unseen), notes=tuple(notes))  # fmt: skip


def _texts(found: _Found, width: int) -> tuple[str, str]:
    """Returns what mends a mistake, and what it is, with the numbers that were learnt."""
    n = [*found.n.tolist(), 0.0, 0.0]
    values = {
        "px": f"({width * n[-4]:+.1f}, {width * n[-3]:+.1f}) px" if len(n) > 3 else "",
        "inverse": 1 / n[0] if n[0] else math.inf, "far": 1 / max(n[0] + n[1], 1e-6),
        "degrees": math.degrees(math.hypot(*n[:3])), "matrix": "",
    }  # fmt: skip
    if len(found.n) == 6:
        values["matrix"] = str(
            [round(x, 4) for x in _small(found.n)[:3].flatten().tolist()]
        ).replace(" ", "")
    assert found.rival is not None
    return found.rival.typed.format(*n, **values), found.rival.says.format(*n, **values)


def _sampled(
    raw: Tensor | None, now: Tensor, before: Tensor, K: Tensor, prev_K: Tensor, path: Tensor,
    picture: Tensor | None = None,
) -> _Pairs:  # fmt: skip
    """Returns pairs of maps `[P, ..., H, W]`: pixels that are known, spread evenly."""
    (count, _, width), size = now.shape, now.shape[-2] * now.shape[-1]
    step = int(size / 1.618033988749895) + 1  # coprime steps of the golden ratio meet each once
    while math.gcd(step, size) > 1:
        step += 1
    index = torch.arange(min(size, 8 * _PIXELS)) * step % size
    place = torch.stack([index % width, index // width]).double() + 0.5

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
        texture = torch.stack([xx + det, xy, yy + det], 1)
        texture = texture / (xx + yy + 2 * det).clamp(1e-9).sqrt().unsqueeze(1)
        known &= xx + yy > _LEAST_TEXTURE
    order = (~known).long().argsort(dim=-1, stable=True)[:, :_PIXELS]

    def first(maps: Tensor) -> Tensor:
        maps = torch.where(known.unsqueeze(1), maps, math.nan)
        return maps.gather(-1, order.unsqueeze(1).expand(-1, maps.shape[1], -1))

    values = depth[depth.isfinite()].unique()  # of depth in 8 or 16 bits there are few
    is_coarse = 1 < len(values) < 0.1 * depth.numel()
    depth_step = float(values.diff().median()) if is_coarse else 0.0
    z = first(depth.unsqueeze(1)).squeeze(1)
    maps: list[Any] = [first(place.expand(count, -1, -1)), first(flow), z, first(texture)]
    maps.append(depth_step / z)
    inverses: list[Any] = [depths.double().reciprocal() for depths in (now, before)]
    cameras: list[Any] = [tensor.double() for tensor in (K, prev_K, path)]
    given: Any = (raw is not None, picture is not None, depth_step, 0.5 if raw is None else 1e-4)
    return _Pairs(*maps, *cameras, *inverses, *given)


def _why_not(pairs: _Pairs) -> list[str]:
    """Returns why each pair tells nothing, "" if it does."""
    ego = _px(pairs.place - _seen(pairs, pairs.motion)[0]).nan_to_num(0.0)
    moves = torch.maximum(_px(pairs.raw).nan_to_num(0.0), ego) >= _LEAST_MOVEMENT_PX
    number, has_depth = (~pairs.depth.isnan()).sum(-1), (pairs.now.isfinite()).flatten(1).any(1)
    return [
        "depth is nowhere known" if not d else "too few pixels are known" if n < _LEAST_PIXELS else
        "" if m else "hardly anything moves"
        for d, n, m in zip(has_depth.tolist(), number.tolist(), moves.tolist())
    ]  # fmt: skip


def _nothing(reasons: Sequence[str]) -> Diagnosis:
    why = max(reasons, key=reasons.count) if reasons else "there are no two successive frames"
    return Diagnosis("can't tell", f"{why}; record frames in which the camera moves and turns")


@dataclass
class Examination:
    """Collects pairs of a recording's frames, and gives their diagnosis.

    Args:
        conventions: the options that the data were read with, see `Recording.conventions`.
        flow_is_recorded: whether raw flow belongs to the data. Flow that flowrep estimated has no
            options that may be wrong.
    """

    conventions: Mapping[str, str] = field(default_factory=dict)
    flow_is_recorded: bool = True
    _parts: list[_Pairs] = field(default_factory=list)
    _starts: list[Tensor] = field(default_factory=list)
    _names: list[str] = field(default_factory=list)
    _reasons: list[str] = field(default_factory=list)
    _intervals_s: list[float] = field(default_factory=list)

    @torch.no_grad()
    def add(
        self, previous: Any, current: Any, raw: Any, earlier: Any = None, later: Any = None
    ) -> bool:
        """Takes two `Frame`s and the raw flow between them; returns whether they tell something.

        Args:
            raw: `[2, H, W]`, pixels, nan where unknown.
            earlier: world_from_cam `[4, 4]` of the frame before `previous`; as `later`, of that
                after `current`, it tells whether poses are late.
        """
        flow, now, before = (torch.as_tensor(x)[None] for x in (raw, current.depth, previous.depth))
        K, prev_K = (torch.as_tensor(frame.K)[None] for frame in (current, previous))
        poses = (earlier, previous.world_from_cam, current.world_from_cam, later)
        path = torch.stack(
            [torch.full_like(_EYE, math.nan) if p is None else torch.as_tensor(p) for p in poses]
        )
        picture = None
        # Where there is no texture, estimated flow is 0 or a guess.
        if current.rgb is not None and raw is not current.raw:
            picture = torch.as_tensor(current.rgb).movedim(-1, 0)[None]
        pairs = _sampled(flow, now, before, K, prev_K, path[None], picture)
        (why,) = _why_not(pairs)
        if why:
            self._reasons.append(why)
            return False
        options: Any = {"prev_K": prev_K.float(), "picture": picture}
        motion = geometry.camera_motion(flow, now[:, None], K.float(), **options).prev_from_curr
        self._parts.append(pairs)
        self._starts.append(motion.double())
        self._names.append(current.name)
        if previous.timestamp_s is not None and current.timestamp_s is not None:
            self._intervals_s.append(current.timestamp_s - previous.timestamp_s)
        return True

    @torch.no_grad()
    def diagnosis(self) -> Diagnosis:
        """Returns the diagnosis of all pairs so far."""
        if not self._parts:
            return _nothing(self._reasons)
        tensors: list[Any] = [torch.cat(parts) for parts in zip(*(p[:10] for p in self._parts))]
        pairs = _Pairs(*tensors, *self._parts[0][10:])  # type: ignore[call-arg]
        rivals = _rivals(self.conventions, of_flow=self.flow_is_recorded, absolute=True)
        return _diagnosed(pairs, [torch.cat(self._starts)], rivals, self._names, self._remedy)

    def _remedy(self, typed: str) -> str:
        words = typed.split(" ")
        if typed.startswith("depth times ") and "depth_unit_m" in self.conventions:
            typed = f"depth_unit_m={float(words[-1]) * float(self.conventions['depth_unit_m']):.3g}"
        elif typed.endswith(" frames later") and self._intervals_s:
            interval_s = sorted(self._intervals_s)[len(self._intervals_s) // 2]
            typed = f"pose_offset_s={-float(words[1]) * interval_s:.3g}"
        options = [f"format.{option}" for option in typed.split(" ") if "=" in option]
        return (
            " ".join(options if self.conventions else ["format=frames", *options])
            if options
            else typed
        )


@torch.no_grad()
def diagnose(
    frames: TensorDictBase, intrinsics: Any = None, *, raw_key: str = "raw", ego_key: str = "ego",
    obj_key: str = "obj",
) -> Diagnosis:  # fmt: skip
    """Returns the diagnosis of an env's rollout or of a replay batch.

    The depth of the frame before is the witness, since raw flow that comes from recorded motions
    agrees with them whatever they are; raw flow itself, where it was measured. What transforms
    wrote is computed again from what they read.

    Args:
        frames: successive frames `[*B, T]`, or steps `[*B]` in any order with their "next". Holds
            `("sensor", "depth")` and `("sensor", "prev_from_curr")`, and, where the env has them,
            instance, instance_motion, world_from_cam, rgb, and raw, ego and obj in px per step.
        intrinsics: K `[3, 3]` of the maps; None takes each frame's, `("sensor", "K")`.
        raw_key: the key of raw flow, as `ego_key` and `obj_key` of its parts.

    Raises:
        ValueError: there are no successive frames, no depth or no motions, or K is no camera's.

    >>> from tensordict import TensorDict
    >>> K = torch.tensor([[50.0, 0.0, 30.0], [0.0, 50.0, 20.0], [0.0, 0.0, 1.0]])
    >>> slope, prev_from_curr = 1 + (torch.arange(60) + 0.5 - 30) / 100, torch.eye(4)
    >>> prev_from_curr[2, 3] = 0.1  # the camera moves ahead, to a wall that is oblique
    >>> depth = torch.stack([(2 - 0.1 * t) / slope.expand(1, 40, 60) for t in range(4)])
    >>> sensor = {"depth": depth, "prev_from_curr": prev_from_curr.repeat(4, 1, 1)}
    >>> diagnose(TensorDict({"sensor": sensor}, [4]), K).verdict
    'right'
    """
    now, before, earlier, later = _successive(frames)
    K, prev_K = (
        torch.as_tensor(x["sensor", "K"] if intrinsics is None else intrinsics).float()
        for x in (now, before)
    )
    geometry.check_intrinsics("K", K)
    kept = _motion(now).isfinite().flatten(1).all(1).nonzero()[:, 0]
    kept = kept[_spread(len(kept), 3 * _ENV_PAIRS)]
    seen = _Seen(
        now[kept], before[kept], K.expand(len(now), 3, 3)[kept],
        prev_K.expand(len(now), 3, 3)[kept], raw_key,
    )  # fmt: skip
    if bool((seen.depth < 0).double().mean() > 0.5):
        return Diagnosis(
            "wrong", "depth is negative: give its opposite", suspects=("depth times -1",)
        )
    first, second = _EYE.expand_as(seen.motion), seen.motion
    absolute = "world_from_cam" in now["sensor"].keys()
    if absolute:
        first, second = (x["sensor", "world_from_cam"].double() for x in (seen.previous, seen.now))
    path = [first @ torch.linalg.inv_ex(earlier[kept])[0], first, second, second @ later[kept]]
    static = torch.where(seen.ids == 0, seen.depth, math.nan).squeeze(1)
    given = (static, seen.before, seen.K, seen.prev_K, torch.stack(path, 1))
    raw, picture = None if seen.is_derived else seen.raw, None
    pairs = _sampled(raw, *given)
    if raw is None and _is_coarse(pairs) and (pictures := _pictures(seen)):
        raw, picture = _estimated_flow(*pictures), pictures[0]
        pairs = _sampled(raw, *given, picture)
    reasons = _why_not(pairs)
    able = torch.tensor([i for i, why in enumerate(reasons) if not why], dtype=torch.long)
    if not len(able):
        return _nothing(reasons)
    able = able[_spread(len(able), _ENV_PAIRS)]
    rivals = _rivals({}, of_flow=raw is not None and picture is None, absolute=absolute)
    names = [str(index) for index in kept[able].tolist()]
    found = _diagnosed(pairs.of(able), [], rivals, names, _of_env)
    faults, notes = _recomputed(seen, ego_key, obj_key)
    more, further, unknown = _bodies(seen, pairs.depth_step)
    faults, notes = [*faults, *more], [*found.notes, *notes, *further]
    if unknown and found.is_right:
        found = replace(found, verdict="can't tell", words=f"{unknown}; else {found.words}")
    if not faults:
        return replace(found, notes=tuple(notes))
    words = "; ".join([found.words, *faults] if found.is_wrong else faults)
    verdict = found.verdict if found.is_wrong else "wrong"
    return replace(found, verdict=verdict, words=words, notes=tuple(notes))


def _is_coarse(pairs: _Pairs) -> bool:
    return pairs.depth_step > 0.01 * _median(pairs.depth)


def _pictures(seen: _Seen) -> list[Tensor]:
    found = [x["sensor"].get("rgb", None) for x in (seen.now, seen.previous)]
    return found if found[0] is not None and find_spec("cv2") else []


def _estimated_flow(now: Tensor, before: Tensor) -> Tensor:
    """Returns flow `[P, 2, H, W]` by the pictures, nan where there and back differ."""
    from flowrep.transforms.estimated_flow import DIS

    back, forth = (
        flow.double()
        for flow in DIS("medium")(torch.cat([now, before]), torch.cat([before, now])).chunk(2)
    )
    height, width = back.shape[-2:]
    v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    place = (torch.stack([u, v]) + back).flatten(-2)
    found = torch.stack([_looked_up(plane, place) for plane in forth.unbind(1)], 1).view_as(back)
    missed = (found + back).square().sum(1, keepdim=True)
    length = (found.square() + back.square()).sum(1, keepdim=True)
    known = missed < 0.01 * length + 0.5
    known &= known.double().mean((1, 2, 3), keepdim=True) > 0.5  # or the movement was too large
    return torch.where(known, -back, math.nan)


def _spread(count: int, most: int) -> Tensor:
    return torch.linspace(0, count - 1, min(count, most)).long()


def _motion(frames: TensorDictBase) -> Tensor:
    sensor = frames["sensor"]
    if "prev_from_curr" in sensor.keys():
        return sensor["prev_from_curr"].double()
    if "instance_motion" in sensor.keys():
        return sensor["instance_motion"][..., 0, :, :].double()
    raise ValueError('frames lack ("sensor", "prev_from_curr")')


def _successive(frames: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase, Tensor, Tensor]:
    """Returns frames, those before them, and the motions before and after, nan where unknown."""
    if "sensor" not in frames.keys() or "depth" not in frames["sensor"].keys():
        raise ValueError('frames lack ("sensor", "depth")')
    if "next" in frames.keys():
        frames = frames if frames.ndim else frames.unsqueeze(0)
        before, now = frames.exclude("next"), frames["next"]
        one, other = (
            before["sensor", "depth"].flatten(now.ndim),
            now["sensor", "depth"].flatten(now.ndim),
        )
        one, other = one[..., 1:, :], other[..., :-1, :]
        goes_on = ((one == other) | (one.isnan() & other.isnan())).all(-1)
        kept = torch.ones(now.shape, dtype=torch.bool)
    else:
        if frames.ndim == 0 or frames.shape[-1] < 2:
            raise ValueError(f"frames have to be successive, [*B, T]; got {list(frames.shape)}")
        before, now = frames[..., :-1], frames[..., 1:]
        ended = frames.get("done", None)
        ended = torch.zeros(frames.shape, dtype=torch.bool) if ended is None else ended.squeeze(-1)
        kept, goes_on = ~ended[..., :-1], ~ended[..., 1:-1]
    motion, later = _motion(now), torch.full_like(_motion(now), math.nan)
    later[..., :-1, :, :] = torch.where(goes_on[..., None, None], motion[..., 1:, :, :], math.nan)
    kept = kept.flatten()
    both = [x.reshape(-1)[kept] for x in (now, before)]
    return both[0], both[1], *(x.reshape(-1, 4, 4)[kept] for x in (_motion(before), later))


class _Seen:
    """What an env recorded of P frames and of those before them, and the flow that follows."""

    def __init__(self, now: Any, previous: Any, K: Tensor, prev_K: Tensor, raw_key: str) -> None:
        self.now, self.previous, self.K, self.prev_K = now, previous, K.double(), prev_K.double()
        sensor, self.motion = now["sensor"], _motion(now)
        self.depth, self.before = (
            sensor["depth"].double(),
            previous["sensor", "depth"][:, 0].double(),
        )
        nobody = torch.zeros_like(self.depth, dtype=torch.long)
        self.ids, self.ids_before = (
            x["sensor"].get("instance", nobody).long() for x in (now, previous)
        )
        self.rows = sensor.get("instance_motion", self.motion.unsqueeze(1)).double()
        rows = self.ids.clamp(0, self.rows.shape[1] - 1)
        self.flow = geometry.rigid_flow(self.depth, rows, self.K, self.rows, prev_K=self.prev_K)
        self.ego = self.flow_of(self.motion)
        self.raw, self.is_derived = now.get(raw_key, None), True
        if self.raw is not None:
            valid = now.get(f"{raw_key}_valid", torch.ones_like(self.flow.valid))
            self.raw = torch.where(valid, self.raw.double(), math.nan)
            px = _px((self.raw - torch.where(self.flow.valid, self.flow.flow, math.nan)).flatten(2))
            self.is_derived = not _median(px) > 0.01

    def flow_of(self, motion: Tensor) -> geometry.Flow:
        """Returns the flow of a static world."""
        return geometry.ego_flow(self.depth, self.K, motion.double(), prev_K=self.prev_K)


def _recomputed(seen: _Seen, ego_key: str, obj_key: str) -> tuple[list[str], list[str]]:
    """Returns what is wrong with what an env or its transforms computed, and what is odd."""
    faults, notes, ego = [], [], torch.where(seen.ego.valid, seen.ego.flow, math.nan)
    poses = [x["sensor"].get("world_from_cam", None) for x in (seen.previous, seen.now)]
    of_poses = (
        seen.ego.flow
        if poses[0] is None
        else seen.flow_of(geometry.relative_motion(*poses, dtype=torch.float64)).flow
    )
    raw = seen.flow.flow if seen.raw is None else seen.raw
    for says, found, right in (
        ("row 0 of instance_motion isn't prev_from_curr", seen.flow_of(seen.rows[:, 0]).flow, ego),
        ("prev_from_curr isn't the motion of world_from_cam", ego, of_poses),
        (
            f"{ego_key} isn't the flow of depth, K and prev_from_curr",
            seen.now.get(ego_key, None),
            ego,
        ),
        (f"{obj_key} isn't raw flow without ego flow", seen.now.get(obj_key, None), raw - ego),
    ):
        if found is None:
            continue
        right, found = (x.double().movedim(1, -1).flatten(0, -2) for x in (right, found))
        counts = (right.norm(dim=-1) > 0.05) & right.isfinite().all(-1) & found.isfinite().all(-1)
        right, found = right[counts], found[counts]
        if not len(right):
            continue
        factor = float((found * right).sum() / right.square().sum())
        px, at_best, size = (
            float(x.norm(dim=-1).median()) for x in (found - right, found - factor * right, right)
        )
        if px > 0.02 + 0.01 * size and not (factor > 0 and at_best < 0.05 * px):
            faults.append(f"{says} ({px:.2g} px off)")
        elif px > 0.02 + 0.01 * size:
            notes.append(f"{says}: it is {factor:.3g} times that (a scale, or px/s)")
    return faults, notes


def _bodies(seen: _Seen, depth_step: float) -> tuple[list[str], list[str], str]:
    """Returns what is wrong with ids and bodies' motions, what is odd, and what can't be told."""
    count, ids = seen.rows.shape[1], seen.ids[:, 0]
    if int(ids.min()) < 0 or int(ids.max()) >= count:
        listing = f"{int(ids.min())} to {int(ids.max())}, instance_motion rows 0 to {count - 1}"
        return [f"instance has ids {listing}"], [], ""
    apart = (seen.rows - seen.motion.unsqueeze(1)).abs().flatten(2).amax(-1)
    moving = (apart > 1e-4).any(0).nonzero()[:, 0].tolist()  # nan compares False
    if moving and not (ids > 0).any():
        return (
            [],
            [],
            f"bodies {moving[0]} to {moving[-1]} move, but no pixel of instance has their ids",
        )
    of_ego, flow = seen.ego.flow, seen.flow
    moves = (flow.flow - of_ego).norm(dim=1) > _LEAST_MOVEMENT_PX
    of = ((ids > 0) & moves & (flow.valid & seen.ego.valid & seen.depth.isfinite())[:, 0]).nonzero()
    if len(of) < _LEAST_PIXELS // 4:
        return [], ["no moving body is seen: its id and motion could not be tested"], ""
    own, points = ids[*of.T], geometry.unproject(seen.depth, seen.K)[*of.T].unsqueeze(-1)
    rows, size = seen.rows[of[:, 0], own], torch.tensor(seen.before.shape[:0:-1])
    near = _SAME_DEPTH + 1.5 * depth_step / seen.depth[:, 0][*of.T]
    tries = {
        "now": rows,
        "inverted": geometry.invert_rigid(rows),
        "if they stand still": seen.motion[of[:, 0]],
    }
    shares = {}
    for says, motions in tries.items():  # of pixels whose body was there, at the depth that follows
        then = (motions[:, :3, :3] @ points).squeeze(-1) + motions[:, :3, 3]
        place = (seen.prev_K[of[:, 0]] @ (then / then[:, 2:].clamp(1e-6)).unsqueeze(-1))[:, :2, 0]
        column, line = place.nan_to_num(-1.0).long().minimum(size - 1).clamp(min=0).unbind(-1)
        fits = (then[:, 2] / seen.before[of[:, 0], line, column] - 1).abs() < near
        shares[says] = float(
            (fits & (seen.ids_before[of[:, 0], 0, line, column] == own)).double().mean()
        )
    listing = ", ".join(f"{share:.0%} {says}" for says, share in shares.items())
    if shares["now"] >= 0.5 and max(shares.values()) <= shares["now"] + 0.03:
        return [], [], ""
    return [f"instance_motion doesn't fit the bodies: {listing} are where they were seen"], [], ""


def _of_env(typed: str) -> str:
    transforms = {"pose": "AdaptPose", "depth": "AdaptDepth", "flow": "AdaptFlow"}
    keys = {"direction", "axes", "layout", "kind", "channels", "grid"}
    options = [option.replace("=", "_").split("_", 2) for option in typed.split(" ")]
    calls = [
        f'{transforms[o[0]]}({o[1]}="{o[2]}")' for o in options if len(o) == 3 and o[1] in keys
    ]
    return " ".join(calls) or typed
