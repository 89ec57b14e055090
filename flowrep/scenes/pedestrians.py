"""People walking back and forth along lines; their positions depend on time alone."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrep.scenes.layout import Layout
from flowrep.scenes.scene import PedestrianGroup, Range
from flowrep.scenes.walks import draw_lanes

Array = NDArray[Any]
_TURN_S = 0.6  # about-turn at either end of a walk
_STRIDE_M = 1.4  # one step with each leg
_SWING_RAD = 0.38  # of a leg, either way: feet 0.6 m apart
_OUT_OF_STEP_RAD = 2.4  # offset between neighbours, so that a group does not march in step


class Crowd:
    """All people of one episode."""

    def __init__(self, lines: list[Array], speeds_mps: Array, phases: Array) -> None:
        """Places people on their lines.

        Args:
            lines: each person's walk, points [M, 2].
            speeds_mps: each person's speed [P]; 0 for people standing still.
            phases: positions at time 0 [P], as a fraction of the round trip, in [0, 1).
        """
        most = max((len(line) for line in lines), default=2)
        # Shorter lines are padded with copies of their last point, which add no length.
        padded = [line[np.minimum(np.arange(most), len(line) - 1)] for line in lines]
        self._points = np.array(padded).reshape(len(lines), most, 2)  # [P, M, 2]
        steps = np.diff(self._points, axis=1)
        lengths = np.hypot(steps[..., 0], steps[..., 1])  # [P, M - 1]
        self._headings = np.arctan2(steps[..., 1], steps[..., 0])
        self._directions = steps / np.maximum(lengths, 1e-12)[..., None]
        self._marks = np.cumsum(np.pad(lengths, ((0, 0), (1, 0))), axis=1)
        self._last_piece = np.maximum((lengths > 0).sum(axis=1) - 1, 0)
        self._length = self._marks[:, -1]
        self._there_and_back = 2 * self._length
        self._speeds = np.asarray(speeds_mps, dtype=np.float64)
        self._turn_per_m = 1.0 / np.maximum(_TURN_S * self._speeds, 1e-9)
        self._start = np.asarray(phases, dtype=np.float64) * self._there_and_back
        self._people = np.arange(len(lines))
        self._out_of_step = _OUT_OF_STEP_RAD * self._people

    def __len__(self) -> int:
        """Returns the number of people."""
        return len(self._people)

    def positions(self, time_s: float | Array) -> Array:
        """Returns everyone's position [P, 2] at a time since the episode's start.

        Times [T, 1] give positions [T, P, 2].
        """
        return self._places(self._along(time_s))[0]

    def poses(self, time_s: float | Array) -> Array:
        """Returns everyone's pose [P, 4], as defined in `flowrep.scenes.people`.

        Times [T, 1] give poses [T, P, 4]. Legs swing with the distance walked; people standing
        still have one foot in front of the other.
        """
        along = self._along(time_s)
        positions, headings = self._places(along)
        poses = np.empty((*along.shape, 4))
        poses[..., :2] = positions
        poses[..., 2] = headings + self._facing(along)
        walked = self._start + self._speeds * time_s
        step = walked * (2 * math.pi / _STRIDE_M) + self._out_of_step
        poses[..., 3] = _SWING_RAD * np.where(self._speeds > 0, np.sin(step), 1.0)
        return poses

    def _along(self, time_s: float | Array) -> Array:
        # Metres walked since the near end, in [0, length of the round trip).
        return (self._start + self._speeds * time_s) % self._there_and_back

    def _places(self, along: Array) -> tuple[Array, Array]:
        at = np.minimum(along, self._there_and_back - along)
        if self._points.shape[1] == 2:
            points, marks, directions, headings = (
                array[:, 0]
                for array in (self._points, self._marks, self._directions, self._headings)
            )
        else:
            pieces = (at[..., None] >= self._marks[:, 1:-1]).sum(axis=-1)
            here = self._people, np.minimum(pieces, self._last_piece)
            points, marks = self._points[here], self._marks[here]
            directions, headings = self._directions[here], self._headings[here]
        return points + (at - marks)[..., None] * directions, headings

    def _facing(self, along: Array) -> Array:
        # 0 on the way out, π on the way back, with a uniform turn over _TURN_S at either end.
        past_far_end = along - self._length
        is_back = past_far_end > 0
        past_near_end = along - is_back * self._there_and_back
        is_near_far_end = np.abs(past_far_end) <= np.abs(past_near_end)
        past_end = np.where(is_near_far_end, past_far_end, past_near_end)
        turned = np.minimum(np.maximum(0.5 + past_end * self._turn_per_m, 0.0), 1.0)
        return math.pi * (turned + ~is_near_far_end)


def draw_crowd(
    layout: Layout, groups: tuple[PedestrianGroup, ...], speed_mps: Range, rng: np.random.Generator
) -> Crowd:
    """Returns a crowd with phases, directions, speeds and lanes drawn for one episode."""
    lines: list[Array] = []
    speeds: list[float] = []
    phases: list[float] = []
    for group in groups:
        low, high = speed_mps if group.speed_mps is None else group.speed_mps
        draws = 1 if group.draw == "group" else group.count
        # A uniform phase over the round trip draws the direction too.
        phase = np.resize(rng.uniform(0.0, 1.0, draws), group.count)
        speed = np.resize(rng.uniform(low, high, draws), group.count)
        lateral = draw_lanes(group.count, group.spread_m, rng)
        ahead = rng.uniform(-0.5, 0.5, group.count) * group.spread_m
        for i in range(group.count):
            line = layout.walk_line(group.walk, float(lateral[i]))
            there_and_back = 2 * np.hypot(*np.diff(line, axis=0).T).sum()
            lines.append(line)
            speeds.append(0.0 if i < group.standing else float(speed[i]))
            phases.append(float((phase[i] + ahead[i] / there_and_back) % 1.0))
    return Crowd(lines, np.array(speeds), np.array(phases))
