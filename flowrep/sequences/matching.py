"""Which rows belong to which frames: by order, name, number or time; and poses between two rows."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from flowrep.sequences.recording import SequenceError

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]
LeftOut = dict[str, NDArray[np.bool_]]  # frames by why they are left out
_ROUNDED_S = 0.0005  # times are often rounded to milliseconds


def match_times(
    times_s: Floats, wanted_s: Floats, tolerance_s: float, *, interpolate: bool = False
) -> tuple[Indices, Floats]:
    """Returns the rows around each wanted time, `[2, frames]`, and the share of the way between.

    Without `interpolate` both rows are the nearest, which belongs to the nearest of the times that
    share it. With it, a row at the wanted time, up to rounding, is enough. They are -1 if they are
    farther away than a format's `tolerance_s`, another time's, or missing on one of two sides.
    """
    after = np.searchsorted(times_s, wanted_s).clip(0, len(times_s) - 1)
    before = np.where(times_s[after] <= wanted_s, after, after - 1).clip(0)
    rows = np.stack([before, after])
    gaps_s = np.abs(times_s[rows] - wanted_s)
    nearest = np.where(gaps_s[0] <= gaps_s[1], before, after)
    if interpolate:
        near = (before != after) & (gaps_s.max(0) <= tolerance_s)
        own = np.where(gaps_s.min(0) <= _ROUNDED_S, nearest, -1)
        return np.where(near, rows, own), gaps_s[0] / np.maximum(gaps_s.sum(0), 1e-9)
    nearest_first = np.argsort(gaps_s.min(0), kind="stable")
    _, owners = np.unique(nearest[nearest_first], return_index=True)
    near = (gaps_s.min(0) <= tolerance_s) & np.isin(range(len(nearest)), nearest_first[owners])
    return np.where(near, [nearest, nearest], -1), np.zeros(len(nearest))


def poses_between(poses: Floats, rows: Indices, share: Floats) -> Floats:
    """Returns the poses at a share of the way, for constant velocity and angular velocity."""
    moved = poses[rows[0]]
    for i in np.flatnonzero(share):
        pose, after = moved[i], poses[rows[1, i]]
        turn, _ = cv2.Rodrigues(pose[:3, :3].T @ after[:3, :3])
        pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(share[i] * turn)[0]
        pose[:3, 3] = (1 - share[i]) * pose[:3, 3] + share[i] * after[:3, 3]
    return moved


def positions(values: Floats) -> Indices:
    """Returns the number that each frame would have if none were missing, from times or numbers."""
    steps = np.diff(values)
    usual = np.median(steps[steps > 0]) if (steps > 0).any() else np.inf
    return np.append(0, np.rint(steps / usual).clip(1).cumsum()).astype(int)


def keep(
    names: Sequence[str], left_out: LeftOut, source: object, remedy: str
) -> tuple[Indices, list[str]]:
    """Returns which frames remain, and a note for each reason why others don't."""
    notes, kept = [], ~np.any([*left_out.values()], axis=0)
    for why, frames in left_out.items():
        if frames.any():
            first = ", ".join(np.array(names)[frames][:3])
            notes.append(f"{frames.sum()} of {len(kept)} frames are left out, {why}: {first}")
    if not kept.any():
        raise SequenceError(source, f"{'; '.join(notes)}; none is left: {remedy}")
    return np.flatnonzero(kept), notes
