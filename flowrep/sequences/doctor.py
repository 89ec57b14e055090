"""The convention doctor: detects poses, depth or flow in another convention than assumed.

In most recordings, most of the picture is static, and there raw flow is ego flow, so that the
median of |raw - ego| is small. If it is not, the doctor computes ego flow again under each of the
usual mistakes, with depth times any factor, and with the camera's axes that fit the motion that
flow and depth give by themselves (`flowrep.geometry.camera_motion`). It names the corrections that
explain the flow, as options relative to those in force. If that other motion does not explain the
flow either, nothing can be told of the poses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple, get_args

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flowrep import geometry
from flowrep.sequences.factorization import estimated_motion
from flowrep.sequences.files import Flow
from flowrep.sequences.recording import Frame

# Residuals below these are normal: rounding of pixels, of estimators, of poses.
_SMALL_PX, _SMALL_SHARE = 0.05, 0.05
_SHRINKS = 0.5  # a suspect leaves at most this share of the residual,
_EXPLAINS = 0.25  # and this share of raw flow, or little more than any motion
_AS_GOOD = 1.5  # suspects this close to the best can't be told apart from it
_LEAST_RAW_PX = 0.25  # pairs that hardly move say nothing
_SAMPLED_PIXELS = 6000
_NEARLY = 1.3  # a factor of depth whose residual is this close to the best one's may be right
_KNOWN_UNIT = 3.0  # the unit of depth is known if the factors that may be right span less
_POWERS = np.arange(-4, 4 + 1e-9, 1 / 8)  # of ten, the factors of depth that are tried
_USUAL_FACTORS = (0.001, 0.01, 0.1, 0.2, 0.5, 2.0, 5.0, 10.0, 100.0, 1000.0)
_SAME_AXES_DEG = 15.0

_ASSUMED = {
    "pose_direction": "camera_to_world", "pose_axes": "opencv", "depth_kind": "z",
    "flow_direction": "forward", "flow_channels": "uv",
}  # fmt: skip


class _Pair(NamedTuple):
    """What is kept of a pair of frames: maps on a coarse grid, and the motions."""

    raw: Tensor
    depth: Tensor
    K: Tensor
    known: Tensor
    step: int  # coarse pixels are this many fine ones
    poses: tuple[Tensor, Tensor]
    estimated: Tensor | None = None  # prev_from_curr


@dataclass(frozen=True)
class Mistake:
    """What the data may be instead, completing "if ...", and what makes correct data of them."""

    says: str
    correct: Callable[[_Pair], _Pair]


def mistakes(given: Mapping[str, str], *, flow_is_recorded: bool = True) -> dict[str, Mistake]:
    """Returns the usual mistakes by what would correct them, see `Doctor` for the arguments."""
    given = {**_ASSUMED, **given}
    found: dict[str, Mistake] = {}
    kinds = get_args(geometry.PoseDirection), get_args(geometry.CameraAxes)
    for direction, axes in product(*kinds):
        says = {}
        if direction != given["pose_direction"]:
            says[f"pose_direction={direction}"] = f"the poses are {direction.replace('_', '-')}"
        if axes != given["pose_axes"]:
            says[f"pose_axes={axes}"] = f"the camera's axes are {axes}"
        if says:
            correct = _of_poses(_readapted(given, direction, axes))
            found[" ".join(says)] = Mistake(" and ".join(says.values()), correct)
    if given["depth_kind"] == "z":
        found["depth_kind=ray_length"] = Mistake(
            "depth is the length of the ray, not z",
            lambda pair: pair._replace(depth=geometry.z_from_ray_length(pair.depth, pair.K)),
        )
    elif given["depth_kind"] == "ray_length":
        found["depth_kind=z"] = Mistake("depth is z, not the length of the ray", _ray_from_z)
    if flow_is_recorded:
        to = {"backward": "away from", "forward": "back to"}[given["flow_direction"]]
        other = "forward" if given["flow_direction"] == "backward" else "backward"
        text = f"the flow points {to} the previous frame"
        found[f"flow_direction={other}"] = Mistake(text, lambda p: p._replace(raw=-p.raw))
        other = "row_column" if given["flow_channels"] == "uv" else "uv"
        text = f"the flow's channels are {other}"
        found[f"flow_channels={other}"] = Mistake(text, lambda p: p._replace(raw=p.raw.flip(0)))
    else:
        text = "the poses are in the reverse order of the pictures"
        found["frames in reverse order"] = Mistake(text, lambda p: p._replace(poses=p.poses[::-1]))
    text = "the rotations are stored column by column, or inverted"
    found["rotations transposed"] = Mistake(text, _of_poses(_transposed))
    for factor, size in ((2.0, "twice"), (0.5, "half")):
        text = f"the pictures are {size} as large as those that the intrinsics belong to"
        found[f"intrinsics times {factor:g}"] = Mistake(text, partial(_scaled, factor))
    return found


def _of_poses(change: Callable[[Tensor], Tensor]) -> Callable[[_Pair], _Pair]:
    return lambda pair: pair._replace(poses=(change(pair.poses[0]), change(pair.poses[1])))


def _readapted(given: Mapping[str, str], direction: str, axes: Any) -> Callable[[Tensor], Tensor]:
    """Undoes the options in force and applies others to `world_from_cam`."""
    in_force: Any = given["pose_axes"]
    opencv_from_given = geometry.adapt_pose(torch.eye(4), axes=in_force).mT

    def readapt(pose: Tensor) -> Tensor:
        stored = pose @ opencv_from_given
        if direction != given["pose_direction"]:
            stored = geometry.invert_rigid(stored)
        return geometry.adapt_pose(stored, axes=axes, check=False)

    return readapt


def _transposed(pose: Tensor) -> Tensor:
    turned = pose.clone()
    turned[:3, :3] = pose[:3, :3].mT
    return turned


def _ray_from_z(pair: _Pair) -> _Pair:
    ray = pair.depth.square() / geometry.z_from_ray_length(pair.depth, pair.K)
    return pair._replace(depth=torch.where(pair.depth.isinf(), pair.depth, ray))  # sky stays there


def _scaled(factor: float, pair: _Pair) -> _Pair:
    return pair._replace(K=pair.K * torch.tensor([[factor], [factor], [1.0]]))


def _times(*factors: float) -> Callable[[_Pair], _Pair]:
    return lambda pair: pair._replace(depth=torch.tensor(factors)[:, None, None, None] * pair.depth)


@dataclass(frozen=True)
class Diagnosis:
    """The doctor's findings; numbers of pixels are medians of a pair, their mean over the pairs.

    Attributes:
        pairs: the number of pairs of frames that moved enough to be examined.
        raw_px: of the length of raw flow.
        residual_px: of |raw - ego|.
        estimated_px: the same with the motion that flow and depth give; nan if they give none.
        depth_factors: the least and the most that depth can be multiplied by without explaining the
            flow much worse than the best factor does; far apart, they leave the unit unknown.
        rivals_px: `residual_px` under each mistake, by what would correct it.
        suspects: the mistakes that would explain the flow, the likeliest first.
        words: the diagnosis in a sentence or two.
    """

    pairs: int
    raw_px: float = math.nan
    residual_px: float = math.nan
    estimated_px: float = math.nan
    depth_factors: tuple[float, float] = (0.0, math.inf)
    rivals_px: Mapping[str, float] = field(default_factory=dict)
    suspects: tuple[str, ...] = ()
    words: str = "conventions could not be checked: hardly anything moves"


@dataclass
class Doctor:
    """Examines pairs of frames, one after the other, and gives a diagnosis.

    Args:
        conventions: the options that the data were read with, see `Recording.conventions`.
        flow_is_recorded: whether raw flow belongs to the data. Flow that flowrep estimated has no
            options that may be wrong.
    """

    conventions: Mapping[str, str] = field(default_factory=dict)
    flow_is_recorded: bool = True
    _pairs: list[_Pair] = field(default_factory=list)

    @torch.no_grad()
    def look(self, previous: Frame, current: Frame, raw: Flow) -> bool:
        """Examines a pair of frames and its raw flow; returns whether it moves enough."""
        pair = _sampled(previous, current, raw)
        if not float(_median_px(pair.raw, pair)) >= _LEAST_RAW_PX:  # or nan
            return False
        motion = estimated_motion(previous, current, raw)
        estimated = torch.from_numpy(motion.prev_from_curr) if motion.known else None
        self._pairs.append(pair._replace(estimated=estimated))
        return True

    @torch.no_grad()
    def diagnosis(self) -> Diagnosis:
        """Returns the diagnosis of all pairs so far."""
        if not self._pairs:
            return Diagnosis(0)
        rivals = mistakes(self.conventions, flow_is_recorded=self.flow_is_recorded)
        rivals |= _other_axes(self._pairs)
        best, least, most = self._depth_factors()
        if not least <= 1 <= most:
            correction = f"depth times {best:g}"
            if "depth_unit_m" in self.conventions:
                correction = f"depth_unit_m={best * float(self.conventions['depth_unit_m']):g}"
            says = f"depth in metres is {best:g} times as large"
            rivals[correction] = Mistake(says, _times(best))
        kept, start = self._pairs, torch.eye(4, dtype=torch.float64)
        moved = [p._replace(poses=(start, p.estimated)) for p in kept if p.estimated is not None]
        found = Diagnosis(
            pairs=len(kept),
            raw_px=_mean(_median_px(pair.raw, pair) for pair in kept),
            residual_px=_mean(map(_residual_px, kept)),
            estimated_px=_mean(map(_residual_px, moved)),
            depth_factors=(least, most),
            rivals_px={
                name: _mean(_residual_px(mistake.correct(pair)) for pair in kept)
                for name, mistake in rivals.items()
            },
        )
        found = replace(found, suspects=_suspects(found))
        return replace(found, words=_words(found, rivals, self.conventions))

    def _depth_factors(self) -> tuple[float, float, float]:
        """Returns the factor of depth that explains the flow best, and the range of good ones."""

        def left_px(powers: NDArray[np.float64]) -> NDArray[np.float64]:
            multiply = _times(*(10**powers).tolist())
            left = torch.stack([_residual_px(multiply(pair)) for pair in self._pairs])
            return left.mean(0).numpy()

        coarse = left_px(_POWERS)
        finer = _POWERS[coarse.argmin()] + np.arange(-4, 5) / 40
        fine = left_px(finer)
        best = float(10 ** finer[fine.argmin()])
        usual = min(_USUAL_FACTORS, key=lambda factor: abs(math.log(factor / best)))
        best = usual if abs(math.log10(usual / best)) < 0.04 else float(f"{best:.2g}")
        good = [*_POWERS[coarse <= _NEARLY * fine.min() + _SMALL_PX], finer[fine.argmin()]]
        return best, float(10 ** (min(good) - 1 / 16)), float(10 ** (max(good) + 1 / 16))


def diagnose(
    raw: Tensor,
    depth: Tensor,
    K: Tensor,
    world_from_prev: Tensor,
    world_from_curr: Tensor,
    *,
    static: Tensor | None = None,
) -> Diagnosis:
    """Returns the diagnosis from a single pair of frames, as tensors.

    Args:
        raw: `[2, H, W]`, pixels per step, assumed p_t - p_t' on the current grid; nan unknown.
        depth: `[1, H, W]`, of the current frame, assumed z in metres.
        K: `[3, 3]`, pixels.
        world_from_prev: as `world_from_curr` `[4, 4]`, assumed with OpenCV's axes.
        static: `[1, H, W]`, pixels known to be static; without it most of the picture has to be.

    >>> K = torch.tensor([[20.0, 0.0, 5.0], [0.0, 20.0, 4.0], [0.0, 0.0, 1.0]])
    >>> before, now = torch.eye(4), torch.eye(4)
    >>> now[0, 3] = 0.5  # the camera went to the right: all streams by 20 * 0.5 / 4 to the left
    >>> raw = torch.tensor([2.5, 0.0]).reshape(2, 1, 1).expand(2, 8, 10)  # but this says right
    >>> diagnosis = diagnose(raw, torch.full((1, 8, 10), 4.0), K, before, now)
    >>> "flow_direction=backward" in diagnosis.suspects
    True
    """
    raw = raw if static is None else torch.where(static, raw, torch.nan)
    flow, z = (np.asarray(tensor.float().cpu()) for tensor in (raw, depth[0]))
    camera, *poses = (np.asarray(x.double().cpu()) for x in (K, world_from_prev, world_from_curr))
    previous, current = (Frame("", Path(), pose, camera, z) for pose in poses)
    doctor = Doctor()
    doctor.look(previous, current, flow)
    return doctor.diagnosis()


def _residual_px(pair: _Pair) -> Tensor:
    """Returns the median of |raw - ego|, `[*B]` for depths `[*B, 1, H, W]`."""
    ego, valid = geometry.ego_flow(pair.depth, pair.K, geometry.relative_motion(*pair.poses))
    # A convention does not explain the points that it puts behind the camera.
    return _median_px(torch.where(valid, pair.raw - ego, torch.inf), pair).clamp(max=1e6)


def _median_px(flow: Tensor, pair: _Pair) -> Tensor:
    """Returns the median length of flow `[*B, 2, H, W]` where it is known, in fine pixels."""
    lengths = torch.hypot(*flow.unbind(-3))[..., pair.known[0]]
    if not lengths.shape[-1]:
        return torch.full(flow.shape[:-3], torch.nan)
    return pair.step * lengths.nan_to_num(nan=torch.inf).median(-1).values


def _mean(values: Iterable[Tensor]) -> float:
    numbers = [float(value) for value in values]
    return float(np.mean(numbers)) if numbers else math.nan


def _sampled(previous: Frame, current: Frame, flow: Flow) -> _Pair:
    # Pixel j of the coarser grid is pixel s j + o of the finer one. The centre of the latter,
    # s j + o + 0.5, maps to j + 0.5: u' = (u - o - 0.5) / s + 0.5. Flow is in coarse pixels.
    height, width = current.size
    step = max(1, int((height * width / _SAMPLED_PIXELS) ** 0.5))
    offset = step // 2
    every = (..., slice(offset, None, step), slice(offset, None, step))
    raw = torch.from_numpy(flow[every]) / step
    depth = torch.from_numpy(current.depth[every])[None]
    coarse = torch.from_numpy(current.K.copy())
    coarse[:2, 2] -= offset + 0.5 - step / 2
    coarse[:2] /= step
    known = raw.isfinite().all(0, keepdim=True) & (depth > 0)
    poses = torch.from_numpy(previous.world_from_cam), torch.from_numpy(current.world_from_cam)
    return _Pair(raw, depth, coarse.float(), known, step, poses)


def _other_axes(pairs: list[_Pair]) -> dict[str, Mistake]:
    """Returns the camera's axes by which the recorded motions become the estimated ones."""
    # Kabsch's rotation between rotation vectors and translations, each in units of its spread. It
    # isn't determined if the camera always moves along and turns about one line.
    known = [pair for pair in pairs if pair.estimated is not None]
    recorded = [geometry.relative_motion(*pair.poses, dtype=torch.float64) for pair in known]
    vectors = np.array([(_vectors(r), _vectors(p.estimated)) for r, p in zip(recorded, known)])
    spread = np.sqrt(np.square(vectors).sum(-1).mean(0)) if len(vectors) > 1 else np.zeros(1)
    if not spread.all():
        return {}
    given, seen = (vectors / spread[..., None]).transpose(1, 0, 2, 3).reshape(2, -1, 3)
    left, strengths, right = np.linalg.svd(given.T @ seen)
    if strengths[1] < 0.1 * strengths[0]:
        return {}
    given_from_opencv = torch.eye(4, dtype=torch.float64)
    handed = np.diag([1.0, 1.0, np.linalg.det(left @ right)])
    given_from_opencv[:3, :3] = torch.from_numpy(left @ handed @ right)
    for name in get_args(geometry.CameraAxes):
        off = geometry.adapt_pose(torch.eye(4), axes=name)[:3, :3].mT @ given_from_opencv[:3, :3]
        if off.trace() > 1 + 2 * math.cos(math.radians(_SAME_AXES_DEG)):
            return {}  # one of the usual ones
    columns = given_from_opencv[:3, :3].round(decimals=1).tolist()
    says = f"the camera's right, down and ahead are the columns of {columns} in the poses' axes"
    return {"other axes": Mistake(says, _of_poses(lambda pose: pose @ given_from_opencv))}


def _vectors(motion: Any) -> NDArray[np.float64]:
    matrix = motion.numpy()
    return np.stack([cv2.Rodrigues(matrix[:3, :3])[0].ravel(), matrix[:3, 3]])


def _suspects(found: Diagnosis) -> tuple[str, ...]:
    """Returns the mistakes that explain the flow, where it is not explained as it is."""
    if found.residual_px <= max(_SMALL_PX, _SMALL_SHARE * found.raw_px):
        return ()
    # No more is asked than the best motion does, given the errors of flow and depth.
    possible_px = min(_AS_GOOD * found.estimated_px, _SHRINKS * found.raw_px)
    of_depth = max(_SMALL_PX, _EXPLAINS * found.raw_px, possible_px)
    # Another factor of depth has to do better; all other corrections, better by far.
    most = min(_SHRINKS * found.residual_px, of_depth)
    able = {
        name: px
        for name, px in sorted(found.rivals_px.items(), key=lambda item: item[1])
        if px <= (of_depth if name.startswith(("depth times", "depth_unit_m")) else most)
    }
    least = min(able.values(), default=0.0)
    return tuple(name for name, px in able.items() if px <= _AS_GOOD * least + 0.01)


def _words(found: Diagnosis, rivals: Mapping[str, Mistake], conventions: Mapping[str, str]) -> str:
    sizes = f"|raw - ego| is {found.residual_px:.2f} px, raw flow {found.raw_px:.2f} px"
    medians = f"{sizes} (medians of {found.pairs} pairs)"
    if found.suspects:
        told = "; or ".join(
            f"{found.rivals_px[name]:.2f} px if {rivals[name].says}{_remedy(name, conventions)}"
            for name in found.suspects
        )
        apart = "" if len(found.suspects) == 1 else ". This recording can't tell them apart"
        return f"a convention looks wrong: {medians}. It would be {told}{apart}"
    if found.residual_px > _SHRINKS * found.raw_px:
        why = "no motion of the camera explains this flow: is there texture, and is most static?"
        if found.estimated_px <= _SHRINKS * found.raw_px:
            left = f"another motion of the camera would leave {found.estimated_px:.2f} px"
            why = f"{left}: are poses, pictures and depth of one recording and one clock?"
        return f"can't tell whether the conventions are right: {medians}; {why}"
    least, most = found.depth_factors
    unit = "; the unit of depth can't be told, for the camera hardly moves from its place"
    return f"conventions look right: {medians}{unit if most > _KNOWN_UNIT * least else ''}"


def _remedy(name: str, conventions: Mapping[str, str]) -> str:
    if "=" not in name:
        return ""
    typed = " ".join(f"format.{option}" for option in name.split())
    in_force = all(option.split("=")[0] in conventions for option in name.split())
    return f" ({typed})" if in_force else f" (frames: {typed})"
