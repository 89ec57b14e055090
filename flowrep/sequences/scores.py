"""What the table says of a frame: medians, shares and the error against known flow."""

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
        index: of the frame in the recording.
        factorized: its flow.
        moving_px: object flow from which a pixel counts as moving by itself.
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
    """Returns the error against the recording's own flow, nan where it has none of this pair."""
    truth, since = factorized.frame.raw, factorized.frame.raw_since
    if truth is None or since != factorized.previous.name:
        return math.nan
    return end_point_error(factorized.raw, truth)


def squared_lengths(flow: Flow, where: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Returns the squared lengths of the vectors at the chosen pixels, `[N]`, square pixels."""
    u, v = flow
    return (u * u + v * v)[where]


def end_point_error(flow: Flow, truth: Flow) -> float:
    """Returns the mean distance from the truth, where both are known, pixels; nan where nowhere."""
    error = np.sqrt(np.square(flow - truth).sum(0))
    known = error[np.isfinite(error)]
    return float(known.mean()) if len(known) else math.nan


def _median_px(squares: NDArray[np.float32]) -> float:
    """Returns the median length, of an even count the lower of the two in the middle."""
    if not len(squares):
        return math.nan
    # The bits of floats from 0 on sort as the floats do. Counting their upper halves leaves few to
    # be sorted, in a third of the time that a partition of all of them takes.
    middle = (len(squares) - 1) // 2
    upper = squares.view(np.uint32) >> 16
    up_to = np.bincount(upper).cumsum()
    of_middle = int(np.searchsorted(up_to, middle, side="right"))
    candidates = squares[upper == of_middle]
    place = middle - (int(up_to[of_middle - 1]) if of_middle else 0)
    candidates.partition(place)
    return math.sqrt(candidates[place])


def _text(value: Any) -> Any:
    """What is unknown is empty in the table, a number has six digits."""
    if not isinstance(value, float):
        return value
    return f"{value:.6g}" if math.isfinite(value) else ""
