"""A table of the usual mistakes, each with the change that corrects it."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import product
from typing import Any, Literal, NamedTuple, get_args

import torch
from torch import Tensor

from flowrep import geometry
from flowrep.diagnosis.fit import (
    EYE,
    Pairs,
    homogeneous,
    looked_up,
    motion_vector,
    skew_part,
    small_motion,
)  # fmt: skip

Change = Callable[[Pairs, Tensor], Pairs]  # of pairs, with numbers [P, k]
# Half turns, near which no fit that starts at none gets.
_TURNS = tuple(tuple(3.0 * (i == j) for j in range(6)) for i in range(-1, 3))


class Mistake(NamedTuple):
    """A mistake, and the change that undoes it.

    Attributes:
        subject: what it is a mistake of.
        remedy: the option that corrects it, or what to do; with the fitted numbers in braces.
        description: the mistake in words, likewise.
        change: corrects pairs, given numbers `[P, k]`.
        start: where the fit of the numbers starts; of several, the one that leads to the smallest
            residuals counts.
        usual: numbers of a typical mistake, to see whether it would show.
        spread: standard deviations of the numbers around where they start, of factors those of
            their logarithms.
        per_pair: whether the numbers differ from pair to pair.
        in_pixels: whether the numbers, shares of the width, are rounded to whole pixels after the
            fit. Interpolated depth has less noise, for which alone the mistake would win.
        is_vague: whether it stands for many mistakes, and names none.
        of_time: whether it interpolates between poses.
        reverses: whether it looks at pairs of frames from the earlier one, or backwards.
        changes_poses: whether it changes poses beside its subject.
    """

    subject: Literal["poses", "flow", "camera", "depth"]
    remedy: str
    description: str
    change: Change
    start: tuple[tuple[float, ...], ...] = ((),)
    usual: tuple[float, ...] = ()
    spread: tuple[float, ...] = (1.0,)
    per_pair: bool = False
    in_pixels: bool = False
    is_vague: bool = False
    of_time: bool = False
    reverses: bool = False
    changes_poses: bool = False

    @property
    def name(self) -> str:
        """The remedy without numbers."""
        return re.sub("{.*?}", "...", self.remedy)

    def texts(self, numbers: Tensor, width: int) -> tuple[str, str]:
        """Returns the remedy and the description, with the numbers that were fitted."""
        n, values = [*numbers.tolist(), 0.0, 0.0], {}
        values["inverse"] = f"{1 / n[0] if n[0] else math.inf:.3g}"
        values["far"] = f"{1 / max(n[0] + n[1], 1e-6):.3g}"
        values["fy"] = f"{n[0] * n[1]:.3g}"
        if len(numbers) >= 2:  # the last two of some are shares of the width
            values["px"] = f"({width * n[-4]:+.1f}, {width * n[-3]:+.1f}) px"
        if len(numbers) in (3, 6):
            turned = small_motion(torch.cat([numbers, 0 * numbers])[:6])
            values["degrees"] = f"{math.degrees(motion_vector(turned)[:3].norm()):.1f}"
            values["matrix"] = f"[{','.join(f'{x:.4g}' for x in turned[:3].flatten().tolist())}]"
        return self.remedy.format(*n, **values), self.description.format(*n, **values)


def mistakes_of(
    given: Mapping[str, str], *, by_flow: bool, of_flow: bool, absolute: bool
) -> list[Mistake]:
    """Returns the table, relative to the options in force.

    Args:
        given: these options, see `Recording.conventions`.
        by_flow: whether raw flow is the reference.
        of_flow: whether it belongs to the data, and may be wrong itself.
        absolute: whether poses in the world are known, not the motions alone.
    """
    given = {"pose_direction": "camera_to_world", "pose_axes": "opencv", "depth_kind": "z",
             "flow_direction": "forward", "flow_channels": "uv"} | {**given}  # fmt: skip
    table: list[Mistake] = []
    directions = get_args(geometry.PoseDirection) if absolute else [given["pose_direction"]]
    for direction, axes in product(directions, get_args(geometry.CameraAxes)):
        texts = {}
        if direction != given["pose_direction"]:
            texts[f"pose_direction={direction}"] = f"the poses are {direction.replace('_', '-')}"
        if axes != given["pose_axes"]:
            texts[f"pose_axes={axes}"] = f"the camera's axes are {axes}"
        if texts:
            change = _path(partial(_readapted, given, direction, axes))
            table.append(Mistake("poses", " ".join(texts), " and ".join(texts.values()), change))
    table += [
        # A world that is mirrored in y is Unity's, which is among the axes above.
        Mistake("poses", "mirrored in x", "the world is mirrored in x",
                _path(partial(_mirrored, 0))),
        Mistake("poses", "mirrored in z", "the world is mirrored in z",
                _path(partial(_mirrored, 2))),
        Mistake("poses", "motions inverted", "motions are curr_from_prev (time runs backwards)",
                _path(lambda path: path.flip(1))),
        Mistake("poses", "pose_lag_frames=1", "poses are a frame late",
                _path(lambda path: path[:, [1, 2, 3, 3]])),
        Mistake("poses", "pose_lag_frames=-1", "poses are a frame early",
                _path(lambda path: path[:, [0, 0, 1, 2]])),
        Mistake("poses", "poses {0:.2f} frames later", "the times of poses are {0:.2f} frames late",
                _later, ((0.0,),), (0.5,), of_time=True),
        Mistake("poses", "marker_from_cam={matrix}",
                "the camera is turned on its mount, {degrees} degrees", _on_a_mount,
                tuple(turn[:3] for turn in _TURNS), (0.1,) * 3),
        Mistake("poses", "marker_from_cam={matrix}",
                "poses are a marker's or by angles in another order, {degrees} degrees off",
                _on_a_mount, _TURNS, (0.1,) * 6),
        Mistake("camera", "K's numbers in another order", "K's numbers are fx, cx, fy, cy",
                _camera(lambda fx, cx, fy, cy, w, h, n: (fx, fy, cx, cy))),
        Mistake("camera", "K in pixels", "K is in widths and heights",
                _camera(lambda fx, cx, fy, cy, w, h, n: (w * fx, w * cx, h * fy, h * cy))),
        Mistake("camera", "K times {0:.3g}", "K is of pictures {inverse} times as large",
                _camera(lambda *k: [k[-1][0] * x for x in k[:4]]),
                ((1.0,), (0.4,), (2.5,)), (1.25,)),
        Mistake("camera", "cx and cy moved by {px}", "the pictures were cropped, K was not",
                _camera(lambda fx, cx, fy, cy, w, h, n: (fx, cx + w * n[0], fy, cy + w * n[1])),
                ((0.0, 0.0), (0.5, 0.5)), (0.1, 0.1), (0.2, 0.2)),
        Mistake("camera", "fx times {0:.3g}, fy times {fy}, cx and cy moved by {px}",
                "K is another camera's", _camera(lambda fx, cx, fy, cy, w, h, n: (
                    fx * n[0], cx + w * n[2], fy * n[0] * n[1], cy + w * n[3])),
                ((1.0, 1.0, 0.0, 0.0),), spread=(0.7, 0.2, 0.2, 0.2)),
        Mistake("camera", "a K for each frame", "K changes from frame to frame",
                _zoomed, ((1.0, 1.0),), (1.01, 1.0), per_pair=True),
        Mistake("camera", "distortion=[{0:.2g},0,0,0]", "the lens bends the picture (calibrate it)",
                lambda p, n: p._replace(distortion=n), ((0.0,),), (-0.2,)),
        Mistake("depth", "depth times {inverse}", "depth is {0:.3g} times as long as poses say",
                _depth(lambda z, n: z / n.clamp(1e-6)),
                tuple((n,) for n in (1.0, 0.1, 0.2, 0.35, 0.6, 1.7, 3.0, 5.0, 10.0, 1e-3, 1e3)),
                (2.0,)),
        Mistake("depth", "depth_kind=disparity baseline_m={0:.3g}", "depth is a disparity",
                lambda p, n: _depth(lambda d, by: by.clamp(1e-6) / d)(p, n * p.K[:, :1, 0]),
                ((0.01,), (0.05,), (0.2,), (1.0,))),
        Mistake("depth", "depth_kind=z_buffer near_m={inverse} far_m={far}",
                "depth is a buffer's", _depth(_from_buffer), ((5.0, -5.0),)),
        Mistake("depth", "depth isn't linear", "depth isn't metres times a unit",
                _depth(lambda z, n: n[:, :1].clamp(1e-3) * z.clamp(1e-6) ** n[:, 1:].clamp(-3.0)),
                ((1.0, 1.0), (1.0, 2.0)), is_vague=True),
        Mistake("depth", "depth plus an offset", "depth has an offset", _with_offset, ((0.0, 1.0),),
                is_vague=True),
    ]  # fmt: skip
    is_z = given["depth_kind"] != "ray_length"
    kind, what = ("ray_length", "the ray's length") if is_z else ("z", "z, not the ray's length")
    change = partial(_along_ray, -1 if is_z else 1)
    table.append(Mistake("depth", f"depth_kind={kind}", f"depth is {what}", change))
    if absolute:
        first, last = (_path(partial(_rolled, places)) for places in (-1, 1))
        layout = given.get("pose_layout", "xyz_xyzw")
        # An option can't mend matrices that were made of quaternions.
        option = "pose_layout=xyz_" if "xyzw" in layout or "wxyz" in layout else "quaternions of "
        table += [
            Mistake("poses", f"{option}wxyz", "quaternions have w first", first),
            Mistake("poses", f"{option}xyzw", "quaternions have w last", last),
            Mistake("poses", "rotations transposed", "rotations are by columns",
                    _path(_transposed)),
        ]  # fmt: skip
    table += [
        Mistake("depth", "depth upside down", "depth has its lowest row first",
                partial(_turned, 1)),
        Mistake("depth", "depth mirrored", "depth has its last column first",
                partial(_turned, 0)),
    ]  # fmt: skip
    if by_flow:
        table += [
            Mistake("depth", "depth moved by {px}", "depth isn't registered to the pictures",
                    _moved_depth, ((0.0, 0.0), (0.06, 0.0), (-0.06, 0.0)), (0.05, 0.0),
                    in_pixels=True),
            Mistake("depth", "depth of the next frame", "depth is a frame late", _late_depth,
                    reverses=True, changes_poses=True),
        ]  # fmt: skip
    if of_flow:
        other = {"backward": "forward", "forward": "backward"}[given["flow_direction"]]
        order = {"uv": "row_column", "row_column": "uv"}[given["flow_channels"]]
        direction, channels = f"flow_direction={other}", f"flow_channels={order}"
        table += [
            Mistake("flow", direction, f"flow points {other}", _gain(-1, 0, 0, -1)),
            Mistake("flow", channels, f"flow's channels are {order}", _gain(0, 1, 1, 0)),
            Mistake("flow", f"{direction} {channels}", f"flow is {other}, {order}",
                    _gain(0, -1, -1, 0)),
            Mistake("flow", "u negated", "flow's u points left", _gain(-1, 0, 0, 1)),
            Mistake("flow", "v negated", "flow's v points up", _gain(1, 0, 0, -1)),
            Mistake("flow", "flow times the size", "flow is divided by the size",
                    partial(_in_sizes, 1)),
            Mistake("flow", "flow times half the size", "flow is in half sizes",
                    partial(_in_sizes, 2)),
            Mistake("flow", "flow divided by {0:.3g}", "flow is of pictures {0:.3g} times as large",
                    lambda p, n: p._replace(gain=p.gain * n.unsqueeze(-1)),
                    ((1.0,), (0.4,), (2.5,)), (1.5,)),
            Mistake("flow", "flow_to=next backwards=true", "flow leads to the next frame", _to_next,
                    reverses=True, changes_poses=True),
            Mistake("flow", "flow on this frame's grid", "flow is on the previous one's",
                    _of_previous, reverses=True, changes_poses=True),
        ]  # fmt: skip
    return table


def _path(change: Callable[[Tensor], Tensor]) -> Change:
    return lambda pairs, n: pairs._replace(path=change(pairs.path))


def _readapted(given: Mapping[str, str], direction: Any, axes: Any, path: Tensor) -> Tensor:
    """Returns `world_from_cam` with the options in force undone and others applied."""
    in_force: Any = given["pose_axes"]
    ones = torch.where(torch.arange(4) == 3, 1.0, EYE)
    taken = geometry.adapt_pose(ones, axes=in_force, check=False)
    world = taken[:, 3].diag()  # a left-handed world has an axis negated
    stored = world @ path @ torch.cat([(world @ taken)[:, :3], EYE[:, 3:]], -1).mT
    if direction != given["pose_direction"]:
        stored = geometry.invert_rigid(stored)
    return geometry.adapt_pose(stored, axes=axes, check=False)


def _mirrored(axis: int, path: Tensor) -> Tensor:
    """Returns F @ pose @ F, with F's `axis` negative."""
    sign = torch.where(torch.arange(4) == axis, -1.0, 1.0).double()
    return path * sign * sign.unsqueeze(-1)


def _transposed(path: Tensor) -> Tensor:
    of_rotation = torch.arange(4) < torch.tensor([3, 3, 3, 0]).unsqueeze(-1)
    return torch.where(of_rotation, path.mT, path)


def _rolled(places: int, path: Tensor) -> Tensor:
    """Returns poses with the numbers of their quaternions shifted by some places."""
    known = path.isfinite().flatten(-2).all(-1)[..., None, None]
    R = torch.where(known, path, EYE)[..., :3, :3]
    # A rotation's quaternion, but for its sign, is the last eigenvector of this.
    axis, trace = skew_part(R).unsqueeze(-1), R.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    upper = torch.cat([R + R.mT - trace * EYE[:3, :3], axis], -1)
    of_quaternion = torch.cat([upper, torch.cat([axis.mT, trace], -1)], -2)
    xyzw = torch.linalg.eigh(of_quaternion)[1][..., -1].roll(places, -1)
    pose = torch.cat([path[..., :3, 3].nan_to_num(), xyzw], -1)
    pose = geometry.pose_from_quaternion(pose, "xyz_xyzw", check=False)
    return torch.where(known, pose, math.nan)


def _on_a_mount(pairs: Pairs, n: Tensor) -> Pairs:
    """Turns, and with six numbers moves, the camera on what the poses are of."""
    return pairs._replace(path=pairs.path @ small_motion(torch.cat([n, 0 * n], -1)[:, :6])[:, None])


def _later(pairs: Pairs, share: Tensor) -> Pairs:
    """Interpolates poses at times that are a share of a frame later than recorded."""
    poses = [torch.full_like(pairs.path[:, 0], math.nan)] * 4
    for i in (1, 2):
        start, end = (
            torch.where(share[..., None] >= 0, pairs.path[:, i + j], pairs.path[:, i + j - 1])
            for j in (0, 1)
        )
        step = motion_vector(geometry.invert_rigid(start) @ end)
        poses[i] = start @ small_motion(step * torch.where(share >= 0, share, 1 + share))
    return pairs._replace(path=torch.stack(poses, 1))


def _camera(change: Callable[..., Sequence[Tensor]]) -> Change:
    """Changes fx, cx, fy, cy of both frames, given the picture's width, height and the numbers."""

    def changed(pairs: Pairs, n: Tensor) -> Pairs:
        (height, width), both = pairs.now.shape[-2:], []
        for K in (pairs.K, pairs.prev_K):
            numbers = (K[:, 0, 0], K[:, 0, 2], K[:, 1, 1], K[:, 1, 2])
            fx, cx, fy, cy = change(*numbers, width, height, n.unbind(-1))
            rows = torch.stack([fx, K[:, 0, 1], cx, 0 * fx, fy, cy], -1).unflatten(-1, (2, 3))
            both.append(torch.cat([rows, K[:, 2:]], 1))
        return pairs._replace(K=both[0], prev_K=both[1])

    return changed


def _zoomed(pairs: Pairs, factors: Tensor) -> Pairs:
    """Multiplies focal lengths, by one factor for the current frame and one for the previous."""
    change = _camera(lambda fx, cx, fy, cy, w, h, n: (fx * n[0], cx, fy * n[0], cy))
    now, before = (change(pairs, by) for by in factors.split(1, -1))
    return pairs._replace(K=now.K, prev_K=before.prev_K)


def _depth(change: Callable[[Tensor, Tensor], Tensor]) -> Change:
    def changed(pairs: Pairs, n: Tensor) -> Pairs:
        before, stretch, depth = pairs.before, pairs.stretch, change(pairs.depth, n)
        if not pairs.by_flow:  # beside flow neither is used
            before = change(before.reciprocal().flatten(1), n).reciprocal().view_as(before)
            stretch = (change(pairs.depth * 1.001, n) / depth - 1).abs().clamp(1e-6) / 1e-3
        return pairs._replace(depth=depth, before=before, stretch=stretch)

    return changed


def _with_offset(pairs: Pairs, n: Tensor) -> Pairs:
    """Adds an offset to a multiple of depth, in units of its median."""
    unit = pairs.now[pairs.now > 0].median().reciprocal()
    return _depth(lambda z, n: (n[:, 1:] * z + unit * n[:, :1]).clamp(min=1e-6 * unit))(pairs, n)


def _from_buffer(buffer: Tensor, line: Tensor) -> Tensor:
    """Returns depth from the values of a buffer, 0 to 1, in which inverse depth is linear."""
    near, slope = line.split(1, -1)
    inverse = near + slope.clamp(max=0.0) * buffer
    depth = torch.where(inverse > 1e-4, inverse.reciprocal(), math.inf)
    return torch.where(buffer <= 1, depth, -buffer)


def _along_ray(power: int, pairs: Pairs, n: Tensor) -> Pairs:
    """Multiplies depth by the ray's length per metre of z (power 1), or divides by it (-1)."""

    def per_z(K: Tensor, pixel: Tensor) -> Tensor:
        return (torch.linalg.inv_ex(K)[0] @ homogeneous(pixel)).norm(dim=1) ** power

    before, (height, width) = pairs.before, pairs.now.shape[-2:]
    if not pairs.by_flow:
        v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        everywhere = torch.stack([u, v]).double().flatten(1)
        before = before / per_z(pairs.prev_K, everywhere).unflatten(-1, (height, width))
    return pairs._replace(depth=pairs.depth * per_z(pairs.K, pairs.pixel), before=before)


def _moved_depth(pairs: Pairs, shares: Tensor) -> Pairs:
    pixel = pairs.pixel + (shares * pairs.now.shape[-1]).unsqueeze(-1)
    return pairs._replace(depth=looked_up(pairs.now, pixel).reciprocal())


def _turned(axis: int, pairs: Pairs, n: Tensor) -> Pairs:
    """Mirrors depth along x (0) or y (1) of the picture."""
    if not pairs.by_flow:  # depth of both frames: as if the focal length was negative
        turn = torch.eye(3, dtype=torch.float64)
        turn[axis, axis], turn[axis, 2] = -1.0, pairs.now.shape[2 - axis]
        return pairs._replace(K=turn @ pairs.K, prev_K=turn @ pairs.prev_K)
    pixel = pairs.pixel.clone()
    pixel[:, axis] = pairs.now.shape[2 - axis] - pixel[:, axis]
    return pairs._replace(depth=looked_up(pairs.now, pixel, "nearest").reciprocal())


def _gain(uu: float, uv: float, vu: float, vv: float) -> Change:
    gain = torch.tensor([[uu, uv], [vu, vv]], dtype=torch.float64)
    return lambda pairs, n: pairs._replace(gain=gain @ pairs.gain)


def _in_sizes(parts: float, pairs: Pairs, n: Tensor) -> Pairs:
    size = torch.tensor(pairs.now.shape[:0:-1], dtype=torch.float64)
    return pairs._replace(gain=torch.diag(parts / size) @ pairs.gain)


def _to_next(pairs: Pairs, n: Tensor) -> Pairs:
    return pairs._replace(path=pairs.path[:, [3, 3, 2, 1]], gain=-pairs.gain)


def _reversed(pairs: Pairs, pixel: Tensor, maps: Tensor) -> Pairs:
    """Returns pairs with the frames exchanged, at positions in the previous one."""
    other: Any = {"path": pairs.path.flip(1), "K": pairs.prev_K, "prev_K": pairs.K}
    other["gain"] = -pairs.gain
    depth = looked_up(maps, pixel, "nearest").reciprocal()
    return pairs._replace(pixel=pixel, depth=depth, **other)


def _of_previous(pairs: Pairs, n: Tensor) -> Pairs:
    return _reversed(pairs, pairs.pixel, pairs.before)


def _late_depth(pairs: Pairs, n: Tensor) -> Pairs:
    return _reversed(pairs, pairs.pixel - torch.linalg.solve(pairs.gain, pairs.raw), pairs.now)


# No mistakes, but what explains data that show nothing of what a mistake needs.
NO_MISTAKE = Mistake("poses", "", "", lambda pairs, n: pairs)
STILL = Mistake("poses", "", "", lambda pairs, n: pairs._replace(path=EYE.expand_as(pairs.path)))
OF_NOISE = Mistake("flow", "", "", lambda pairs, n: pairs._replace(gain=1e-3 * pairs.gain))
FAR = Mistake("depth", "", "", _depth(lambda z, n: 1e4 * z))
