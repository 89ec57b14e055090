"""Raw, ego and object flow of a recording's frames, one pair after the other."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from flowrep.geometry import factorize, relative_motion
from flowrep.sequences.files import Flow
from flowrep.sequences.recording import Frame, SequenceError
from flowrep.transforms.estimated_flow import Estimator

# The squared error of going there and back is below a hundredth of the squared lengths plus half a
# square pixel: Sundaram, Brox and Keutzer, "Dense point trajectories", 2010.
_CONSISTENT_SHARE, _CONSISTENT_PX2 = 0.01, 0.5


@dataclass(frozen=True)
class FactorizedFrame:
    """One frame's flow since the frame before.

    Convention: p_t - p_t' on the frame's own grid, pixels, (u right, v down).

    Attributes:
        frame: the current frame, t.
        previous: the frame before, t'.
        raw: `[2, H, W]`, nan where unknown.
        ego: `[2, H, W]`, 0 where `ego_valid` is false.
        obj: `[2, H, W]`, raw - ego where both are known and trusted, 0 elsewhere.
        valid: `[H, W]`, where raw and ego are known and trusted.
        ego_valid: `[H, W]`, where ego is, whatever raw is: depth is known, and the point was in
            front of the previous camera.
    """

    frame: Frame
    previous: Frame
    raw: Flow
    ego: Flow
    obj: Flow
    valid: NDArray[np.bool_]
    ego_valid: NDArray[np.bool_]


# From the previous and the current frame to raw flow on the current grid, nan where unknown.
FlowSource = Callable[[Frame, Frame], Flow]


def recorded_flow(previous: Frame, current: Frame) -> Flow:
    """Returns the recording's own flow.

    Raises:
        SequenceError: it has none for this frame, or it is measured from another frame.
    """
    if current.raw is None:
        raise SequenceError(current.source, "has no flow of its own: use flow=estimated")
    if current.raw_since != previous.name:
        raise SequenceError(
            current.source,
            f"has flow since frame {current.raw_since}, and here follows {previous.name}: use "
            "flow=estimated, or stride=1 and a recording without gaps",
        )
    return current.raw


class EstimatedFlowSource:
    """Flow estimated from the current picture back to the previous one, negated.

    Args:
        estimator: see `flowrep.transforms.EstimatedFlow`.
        check_consistency: whether flow is estimated both ways and marked as unknown where a pixel
            does not return to its place: at occlusions and at errors.
    """

    def __init__(self, estimator: Estimator, *, check_consistency: bool = True) -> None:
        self.estimator, self.check_consistency = estimator, check_consistency

    @torch.no_grad()
    def __call__(self, previous: Frame, current: Frame) -> Flow:
        """Returns raw flow, nan where unknown.

        If the picture repeats the previous one although the pose moved, all flow is unknown.
        """
        if previous.rgb is None or current.rgb is None:
            raise SequenceError(current.source, "has no picture to estimate flow from")
        if np.array_equal(previous.rgb, current.rgb):
            moved = not np.array_equal(previous.world_from_cam, current.world_from_cam)
            return np.full((2, *current.size), np.nan if moved else 0.0, dtype=np.float32)
        ways = [(current.rgb, previous.rgb), (previous.rgb, current.rgb)]
        ways = ways if self.check_consistency else ways[:1]
        first, second = (
            torch.stack([torch.from_numpy(way[side]) for way in ways]).permute(0, 3, 1, 2)
            for side in (0, 1)
        )
        back, *forth = self.estimator(first, second).float().cpu().numpy()
        raw = -back
        if forth:
            raw[:, ~consistent(back, forth[0])] = np.nan
        return raw


def consistent(back: Flow, forth: Flow) -> NDArray[np.bool_]:
    """Returns where a pixel that goes back and then forth returns to its place, `[H, W]`.

    Args:
        back: `[2, H, W]`, from a first picture to a second one, on the first's grid.
        forth: `[2, H, W]`, from the second to the first, on the second's grid.
    """
    height, width = back.shape[1:]
    row, column = np.indices((height, width), dtype=np.float32)
    x, y = column + back[0], row + back[1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    found = np.stack(
        [
            cv2.remap(plane, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            for plane in forth
        ]
    )
    missed = np.square(found + back).sum(0)
    length = np.square(found).sum(0) + np.square(back).sum(0)
    return inside & (missed < _CONSISTENT_SHARE * length + _CONSISTENT_PX2)


def factorize_frames(
    frames: Iterable[Frame], flow_source: FlowSource
) -> Iterator[FactorizedFrame | None]:
    """Yields the factorisation of each frame, None for a frame without a previous one.

    Two frames are held in memory.

    Raises:
        SequenceError: a frame can't be read or lacks what the flow source needs.
    """
    previous: Frame | None = None
    for current in frames:
        if previous is None or current.starts_clip:
            yield None
        else:
            yield factorize_pair(previous, current, flow_source(previous, current))
        previous = current


def factorize_pair(previous: Frame, current: Frame, raw: Flow) -> FactorizedFrame:
    """Returns the factorisation of one frame, given its raw flow."""
    if previous.size != current.size:
        raise SequenceError(current.source, "differs in size from the frame before")
    motion = relative_motion(
        torch.from_numpy(previous.world_from_cam), torch.from_numpy(current.world_from_cam)
    )
    measured = np.isfinite(raw).all(axis=0)
    ego, obj, ego_valid = factorize(
        torch.from_numpy(np.where(measured, raw, np.float32(0))),
        torch.from_numpy(current.depth)[None],
        torch.from_numpy(current.K).float(),
        motion,
    )
    valid = ego_valid[0].numpy() & measured
    known_obj = np.where(valid, obj.numpy(), np.float32(0))
    return FactorizedFrame(
        current, previous, raw, ego.numpy(), known_obj, valid, ego_valid[0].numpy()
    )
