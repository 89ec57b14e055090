"""Raw, ego and object flow of a recording's frames, one pair after the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import KW_ONLY, dataclass, field
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from flowrep.geometry import camera_motion, factorize, relative_motion
from flowrep.sequences.files import FlowMap
from flowrep.sequences.recording import Frame, Pose, SequenceError

if TYPE_CHECKING:
    from flowrep.transforms.estimated_flow import Estimator

# A pixel is consistent if the squared error of following both flows is below 0.01 times the sum of
# the squared lengths, plus 0.5 px²: Sundaram, Brox and Keutzer, "Dense point trajectories", 2010.
_CONSISTENT_SHARE, _CONSISTENT_PX2 = 0.01, 0.5


@dataclass(frozen=True)
class Motion:
    """The camera's motion `prev_from_curr` `[4, 4]` between two frames, the identity if unknown.

    Attributes:
        inlier_share: the share of the pixels that agree with an estimate; nan if it is recorded.
    """

    prev_from_curr: Pose = field(default_factory=lambda: np.eye(4))
    known: bool = True
    inlier_share: float = math.nan

    @property
    def is_estimated(self) -> bool:
        """Whether it comes from flow and depth instead of recorded poses."""
        return not math.isnan(self.inlier_share)


@dataclass(frozen=True)
class FactorizedFrame:
    """The flow of a frame since the previous frame.

    Convention: p_t - p_t' on the grid of frame t, pixels, (u right, v down).

    Attributes:
        raw: `[2, H, W]`, nan where unknown.
        ego: `[2, H, W]`, 0 where `ego_valid` is false.
        obj: `[2, H, W]`, raw - ego where both are known and trusted, 0 elsewhere.
        valid: `[H, W]`, where raw and ego are known and trusted.
        ego_valid: `[H, W]`, where ego is known, whatever raw is: depth is known, and the point was
            in front of the previous camera.
    """

    frame: Frame
    previous: Frame
    raw: FlowMap
    ego: FlowMap
    obj: FlowMap
    valid: NDArray[np.bool_]
    ego_valid: NDArray[np.bool_]
    motion: Motion


FlowSource = Callable[[Frame, Frame], FlowMap]  # from t' and t to raw flow, nan where unknown
MotionSource = Callable[[Frame, Frame, FlowMap], Motion]  # from these and raw flow


def recorded_flow(previous: Frame, current: Frame) -> FlowMap:
    """Returns the recorded flow, if it is measured from the previous frame."""
    if current.raw is None:
        raise SequenceError(current.source, "has no flow of its own: use flow=estimated")
    if current.raw_since != previous.name:
        since = current.raw_since or "that is missing"
        cause = f"its flow is measured from frame {since}, but the previous one is {previous.name}"
        remedy = "use flow=estimated, or stride=1 and a recording without gaps"
        raise SequenceError(current.source, f"{cause}: {remedy}")
    return current.raw


@dataclass
class EstimatedFlowSource:
    """Flow estimated from the current picture back to the previous one, negated.

    Args:
        estimator: see `flowrep.transforms.EstimatedFlow`.
        check_consistency: whether flow is also estimated in the opposite direction. Where a pixel
            doesn't return to its position (at occlusions and errors), it is marked as unknown.
    """

    estimator: Estimator
    _: KW_ONLY
    check_consistency: bool = True

    @torch.no_grad()
    def __call__(self, previous: Frame, current: Frame) -> FlowMap:
        """Returns raw flow; all of it is unknown if a picture repeats although the camera moved."""
        if previous.rgb is None or current.rgb is None:
            cause = "has no picture to estimate flow from: use flow=exact"
            raise SequenceError(current.source, cause)
        if np.array_equal(previous.rgb, current.rgb):
            unknown = repeats(previous, current)
            return np.full((2, *current.size), np.nan if unknown else 0.0, dtype=np.float32)
        both = torch.from_numpy(np.stack([current.rgb, previous.rgb])).permute(0, 3, 1, 2)
        ways = 2 if self.check_consistency else 1
        back, *forth = self.estimator(both[:ways], both.flip(0)[:ways]).float().cpu().numpy()
        raw = -back
        if forth:
            raw[:, ~consistent(back, forth[0])] = np.nan
        return raw


def consistent(back: FlowMap, forth: FlowMap) -> NDArray[np.bool_]:
    """Returns where a pixel that follows both flows returns to its position, `[H, W]`.

    Each flow `[2, H, W]` is on the grid of the picture that it starts from.
    """
    height, width = back.shape[1:]
    row, column = np.indices((height, width), dtype=np.float32)
    x, y = column + back[0], row + back[1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    options: Any = {"interpolation": cv2.INTER_LINEAR, "borderMode": cv2.BORDER_REPLICATE}
    returned = np.stack([cv2.remap(plane, x, y, **options) for plane in forth])
    missed = np.square(returned + back).sum(0)
    length = np.square(returned).sum(0) + np.square(back).sum(0)
    return inside & (missed < _CONSISTENT_SHARE * length + _CONSISTENT_PX2)


def repeats(previous: Frame, current: Frame) -> bool:
    """Returns whether a frame only repeats the previous picture although the camera moved."""
    # Kinects repeat a picture when they miss one; 7-Scenes has many such frames.
    if previous.rgb is None or current.rgb is None or current.raw is not None:
        return False
    before, now = previous.world_from_cam, current.world_from_cam
    stood_still = before is not None and now is not None and np.array_equal(before, now)
    return not stood_still and np.array_equal(previous.rgb, current.rgb)


def pairs(frames: Iterable[Frame]) -> Iterator[tuple[Frame | None, Frame]]:
    """Yields each frame with the previous one, or None at the start of a clip."""
    previous: Frame | None = None
    for current in frames:
        if previous is not None and previous.clip != current.clip:
            previous = None
        if previous is not None and previous.size != current.size:
            (height, width), (new_height, new_width) = previous.size, current.size
            cause = f"is {new_width} x {new_height}, the frame before {width} x {height}"
            raise SequenceError(current.source, cause)
        yield previous, current
        # A repeated picture has the pose of the frame in which it first appeared.
        if previous is None or not repeats(previous, current):
            previous = current


def recorded_motion(previous: Frame, current: Frame, raw: FlowMap) -> Motion:
    """Returns the camera's motion from the recorded poses."""
    if previous.world_from_cam is None or current.world_from_cam is None:
        raise SequenceError(current.source, "has no pose: use poses=estimated")
    poses = (torch.from_numpy(frame.world_from_cam) for frame in (previous, current))
    return Motion(relative_motion(*poses, dtype=torch.float64).numpy())


def estimated_motion(previous: Frame, current: Frame, raw: FlowMap) -> Motion:
    """Returns the camera's motion that fits the flow and depth of most pixels."""
    depth, K = torch.from_numpy(current.depth)[None], torch.from_numpy(current.K).float()
    picture = None
    # The picture shows which estimated flow can be trusted: without texture, flow is 0.
    if current.rgb is not None and raw is not current.raw:
        picture = torch.from_numpy(current.rgb).permute(2, 0, 1)
    prev_K = _previous_K(previous, current)
    estimate = camera_motion(torch.from_numpy(raw), depth, K, prev_K=prev_K, picture=picture)
    if not estimate.valid:
        return Motion(known=False, inlier_share=0.0)
    inlier_share = float(estimate.inlier_share)
    return Motion(estimate.prev_from_curr.double().numpy(), inlier_share=inlier_share)


def _previous_K(previous: Frame, current: Frame) -> Tensor | None:
    """Returns the previous frame's K if it differs from the current one's (zoom, autofocus)."""
    return None if (previous.K == current.K).all() else torch.from_numpy(previous.K).float()


def factorize_frames(
    frames: Iterable[Frame], flow_source: FlowSource, motion_source: MotionSource = recorded_motion
) -> Iterator[FactorizedFrame | None]:
    """Yields the factorisation of each frame, None for a frame without a previous one.

    Args:
        frames: a `Recording` or any other frames in order.
        flow_source: `recorded_flow` or an `EstimatedFlowSource`.
        motion_source: `recorded_motion` or `estimated_motion`.
    """
    for previous, current in pairs(frames):
        if previous is None:
            yield None
        else:
            raw = flow_source(previous, current)
            yield factorize_pair(previous, current, raw, motion_source(previous, current, raw))


def factorize_pair(
    previous: Frame, current: Frame, raw: FlowMap, motion: Motion | None = None
) -> FactorizedFrame:
    """Returns the factorisation of one frame, by default with the recorded motion."""
    motion = recorded_motion(previous, current, raw) if motion is None else motion
    measured = np.isfinite(raw).all(axis=0)
    ego, obj, ego_valid = factorize(
        torch.from_numpy(np.where(measured, raw, np.float32(0))),
        torch.from_numpy(current.depth)[None],
        torch.from_numpy(current.K).float(),
        torch.from_numpy(motion.prev_from_curr).float(),
        prev_K=_previous_K(previous, current),
    )
    is_known = ego_valid[0].numpy() & motion.known
    valid = is_known & measured
    obj_flow = np.where(valid, obj.numpy(), np.float32(0))
    return FactorizedFrame(current, previous, raw, ego.numpy(), obj_flow, valid, is_known, motion)
