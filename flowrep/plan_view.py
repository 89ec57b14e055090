"""A scene from above: roads, zones, what stands there, where people walk, and how drives went."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from flowrep.envs.layout import Layout
from flowrep.palette import CLASS_COLOURS

OUTCOME_COLOURS = {
    "success": "#0072b2",
    "collision": "#d55e00",
    "out_of_bounds": "#cc79a7",
    "timeout": "#f0c000",
}
"""One colour an outcome in every figure, told apart by colour-blind people too (Okabe and Ito)."""

_WALK_COLOUR = "#de283c"
_ZONE_COLOURS = {"start": "#009e73", "end": "#56b4e9"}
_CLOSED_COLOUR = "#303030"
_WIDTH_IN = 9.0


class Track(NamedTuple):
    """Where a vehicle drove, points [T, 2] in metres, and how that ended."""

    points_m: NDArray[np.float64]
    outcome: str


def draw_plan(layout: Layout, tracks: Iterable[Track] = (), *, path: str | None = None) -> Figure:
    """Returns a figure of a scene from above, x to the right, y upwards, metres on both axes.

    Args:
        layout: of the scene.
        tracks: drives, coloured by their outcome.
        path: whose closures are drawn in full; all are drawn faintly where it is None.
    """
    x0, y0, x1, y1 = shapely.union(layout.drivable, layout.sidewalks).buffer(14.0).bounds
    height = _WIDTH_IN * (y1 - y0) / (x1 - x0) + 1.6
    figure = Figure(figsize=(_WIDTH_IN, min(max(height, 3.0), 11.0)), layout="constrained")
    axes = figure.add_subplot(
        xlim=(x0, x1), ylim=(y0, y1), aspect="equal", xlabel="x (m)", ylabel="y (m)"
    )
    seen = _draw_ground(axes, layout)
    seen |= _draw_solids(axes, layout, path)
    handles: list[Any] = [Patch(color=colour, label=name) for name, colour in seen.items()]
    handles += _draw_zones(axes, layout) + _draw_walks(axes, layout)
    handles += _draw_tracks(axes, tracks)
    axes.set_title(layout.scene.name.replace("_", " ") + (f", path {path}" if path else ""))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize="small")
    return figure


def _colour(category: str) -> tuple[float, ...]:
    return tuple(value / 255 for value in CLASS_COLOURS[category])


def _fill(axes: Axes, ground: BaseGeometry, colour: Any, **style: Any) -> None:
    for part in shapely.get_parts(ground):
        if part.geom_type == "Polygon":
            rings = [part.exterior, *part.interiors]
            outline = Outline.make_compound_path(*(Outline(ring.coords) for ring in rings))
            axes.add_patch(PathPatch(outline, facecolor=colour, **{"linewidth": 0} | style))


def _draw_ground(axes: Axes, layout: Layout) -> dict[str, Any]:
    crosswalks = shapely.union_all([area.polygon for area in layout.crosswalks])
    grounds = {
        "terrain": layout.terrain,
        "sidewalk": layout.sidewalks,
        "road": layout.drivable,
        "crosswalk": crosswalks,
    }
    seen = {}
    for name, ground in grounds.items():
        if not ground.is_empty:
            seen[name] = _colour(name)
            _fill(axes, ground, seen[name])
    return seen


def _draw_solids(axes: Axes, layout: Layout, path: str | None) -> dict[str, Any]:
    seen: dict[str, Any] = {}
    for box in (*layout.buildings, *layout.obstacles):
        seen[box.category] = _colour(box.category)
        # What is thinner than a line on paper is drawn with an edge of its own colour.
        edge = "black" if box.kind == "house" else seen[box.category]
        _fill(axes, box.footprint, seen[box.category], edgecolor=edge, linewidth=0.8)
    drawn = next((p.closures for p in layout.scene.paths if p.name == path), ())
    for name, box in layout.closures.items():
        shown = path is None or name in drawn
        if shown:
            seen["closed exit"] = _CLOSED_COLOUR
            _fill(axes, box.footprint, _CLOSED_COLOUR, alpha=0.5 if path is None else 1.0)
    return seen


def _draw_zones(axes: Axes, layout: Layout) -> list[Any]:
    for kind in _ZONE_COLOURS:
        for name in dict.fromkeys(getattr(path, kind) for path in layout.scene.paths):
            zone = layout.zones[name]
            _fill(axes, zone, _ZONE_COLOURS[kind], alpha=0.7)
            if kind == "start":
                state = layout.start_state(name)
                ahead = np.array([math.cos(state.yaw_rad), math.sin(state.yaw_rad)]) * 8.0
                axes.annotate(
                    "",
                    (state.x_m + ahead[0], state.y_m + ahead[1]),
                    (state.x_m, state.y_m),
                    arrowprops={"arrowstyle": "->", "color": "white", "lw": 1.5},
                )
    return [Patch(color=c, alpha=0.7, label=f"{k} zone") for k, c in _ZONE_COLOURS.items()]


def _draw_walks(axes: Axes, layout: Layout) -> list[Any]:
    for group in layout.scene.pedestrian_groups:
        line = layout.walk_line(group.walk)
        style = ":" if group.standing == group.count else "-"
        axes.plot(*line.T, style, color=_WALK_COLOUR, linewidth=1.6)
    if not layout.scene.pedestrian_groups:
        return []
    return [Line2D([], [], color=_WALK_COLOUR, label="walk (dotted: standing)")]


def _draw_tracks(axes: Axes, tracks: Iterable[Track]) -> list[Any]:
    outcomes = set()
    for points, outcome in tracks:
        outcomes.add(outcome)
        colour = OUTCOME_COLOURS[outcome]
        axes.plot(*points.T, color=colour, linewidth=1.4, alpha=0.8)
        if outcome != "success":
            axes.plot(*points[-1], "x", color=colour, markersize=7, markeredgewidth=2)
    names = [name for name in OUTCOME_COLOURS if name in outcomes]
    return [
        Line2D([], [], color=OUTCOME_COLOURS[name], label=name.replace("_", " ")) for name in names
    ]
