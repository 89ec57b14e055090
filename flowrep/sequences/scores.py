"""The scores of a frame: medians, shares and the error against known flow."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.factorization import FactorizedFrame
from flowrep.sequences.flow_files import Flow

COLUMNS = (
    "index",
    "name",
    "timestamp_s",
    "raw_median_px",
    "ego_median_px",
    "obj_median_px",
    "valid_share",
    "moving_share",
    "epe_px",
)


def score(index: int, factorized: FactorizedFrame, *, moving_px: float) -> dict[str, Any]:
    """Returns a row of frames.csv: medians over valid pixels, shares in [0, 1].

    Args:
        index: the frame's index in the recording.
        factorized: its flow.
        moving_px: the object flow from which a pixel counts as moving by itself, pixels.
    """
    valid, frame = factorized.valid, factorized.frame
    obj = squared_lengths(factorized.obj, valid)
    row: dict[str, Any] = {
        "index": index,
        "name": frame.name,
        "timestamp_s": "" if frame.timestamp_s is None else f"{frame.timestamp_s:.6f}",
        "raw_median_px": _median_px(squared_lengths(factorized.raw, valid)),
        "ego_median_px": _median_px(squared_lengths(factorized.ego, valid)),
        "obj_median_px": _median_px(obj),
        "valid_share": float(valid.mean()),
        "moving_share": float((obj > moving_px**2).mean()) if len(obj) else math.nan,
        "epe_px": _error_px(factorized),
    }
    return {key: _text(value) for key, value in row.items()}


def _error_px(factorized: FactorizedFrame) -> float:
    """Returns the error against the recording's own flow, nan if it has none for this pair."""
    truth, since = factorized.frame.raw, factorized.frame.raw_since
    if truth is None or since != factorized.previous.name:
        return math.nan
    return end_point_error(factorized.raw, truth)


def squared_lengths(flow: Flow, where: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Returns the squared lengths of the vectors at chosen pixels, `[N]`, square pixels."""
    u, v = flow
    return (u * u + v * v)[where]


def end_point_error(flow: Flow, truth: Flow) -> float:
    """Returns the mean distance in pixels from the truth where both are known; nan if nowhere."""
    error = np.sqrt(np.square(flow - truth).sum(0))
    known = error[np.isfinite(error)]
    return float(known.mean()) if len(known) else math.nan


def _median_px(squares: NDArray[np.float32]) -> float:
    """Returns the median length, for an even count the lower of the two in the middle."""
    if not len(squares):
        return math.nan
    # Non-negative floats sort like their bits. Counting the upper halves of the bits leaves few to
    # sort, in a third of the time of a partition of all of them.
    middle = (len(squares) - 1) // 2
    upper = squares.view(np.uint32) >> 16
    up_to = np.bincount(upper).cumsum()
    of_middle = int(np.searchsorted(up_to, middle, side="right"))
    candidates = squares[upper == of_middle]
    place = middle - (int(up_to[of_middle - 1]) if of_middle else 0)
    candidates.partition(place)
    return math.sqrt(candidates[place])


def _text(value: Any) -> Any:
    """Returns a table cell: empty for an unknown value, six digits for a number."""
    if not isinstance(value, float):
        return value
    return f"{value:.6g}" if math.isfinite(value) else ""
