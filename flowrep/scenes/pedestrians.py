"""People who walk back and forth on their lines: where each stands is a function of time alone."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flowrep.scenes.layout import Layout
from flowrep.scenes.scene import PedestrianGroup, Range
from flowrep.scenes.walks import draw_lanes

Array = NDArray[Any]
_TURN_S = 0.6  # about-turn at either end of a walk
_STRIDE_M = 1.4  # a step with either leg
_SWING_RAD = 0.38  # of a leg, either way: feet 0.6 m apart
_OUT_OF_STEP_RAD = 2.4  # from person to person, so that a group does not march


class Crowd:
    """All people of one episode."""

    def __init__(self, lines: list[Array], speeds_mps: Array, phases: Array) -> None:
        """Sets out the crowd.

        Args:
            lines: the walk of each person, points [M, 2].
            speeds_mps: speed of each [P]; 0 for one who stands.
            phases: where each is at time 0 [P]: a share of the way there and back, in [0, 1).
        """
        most = max((len(line) for line in lines), default=2)
        # Short lines end in copies of their last point, which have no length.
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
        """How many people there are."""
        return len(self._people)

    def positions(self, time_s: float | Array) -> Array:
        """Returns where everyone is [P, 2] at a time since the episode's start.

        Times [T, 1] give places [T, P, 2].
        """
        return self._places(self._along(time_s))[0]

    def poses(self, time_s: float | Array) -> Array:
        """Returns where everyone is, looks and steps: poses [P, 4] of `flowrep.scenes.people`.

        Times [T, 1] give poses [T, P, 4]. Legs swing with the distance walked; who stands has one
        foot before the other.
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
        # Metres walked since the near end, in [0, there and back).
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
        # 0 on the way there, π on the way back, turned evenly over _TURN_S around either end.
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
    """Returns a crowd with phases, directions, speeds and places drawn for one episode."""
    lines: list[Array] = []
    speeds: list[float] = []
    phases: list[float] = []
    for group in groups:
        low, high = speed_mps if group.speed_mps is None else group.speed_mps
        draws = 1 if group.draw == "group" else group.count
        # A uniform phase over the way there and back draws the direction too.
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
