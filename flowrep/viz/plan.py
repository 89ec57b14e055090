"""A scene from above: roads, zones, obstacles, walks of people, and the tracks of drives."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, PathPatch
from matplotlib.path import Path as Outline
from numpy.typing import NDArray
from shapely.geometry.base import BaseGeometry

from flowrep.scenes.layout import Layout
from flowrep.viz.maps import CLASS_COLOURS, OUTCOME_COLOURS

_WALK_COLOUR = "black"
_ZONE_COLOURS = {"end": "#56b4e9", "start": "#009e73"}  # starts are drawn last, on top
_CLOSED_COLOUR = "#303030"
_LAMP_POST_COLOUR = "#7a7a7a"  # in the semantic map it is a building
_TINT = 0.55  # strength of the class colours on white, so that drives stand out
_MARGIN_M = 4.0
_SMALL_M = 1.0  # thinner objects are drawn with an edge to stay visible
_LABEL_PT = 30  # distance of a zone's name from the middle of the road
_WIDTH_IN = 9.0


class Track(NamedTuple):
    """A vehicle's track, points [T, 2] in metres, and its outcome."""

    points_m: NDArray[np.float64]
    outcome: str


def draw_plan(layout: Layout, tracks: Iterable[Track] = (), *, path: str | None = None) -> Figure:
    """Returns a figure of a scene from above, x to the right, y upwards, metres on both axes.

    The closures of `path` are drawn in full; if it is None, all are drawn faintly.
    """
    # As wide as the scene, and as high as the same scale needs, within the size of a page.
    standing = [box.footprint for box in (*layout.buildings, *layout.obstacles)]
    shown = shapely.union_all([layout.drivable, layout.sidewalks, *standing])
    x0, y0, x1, y1 = shown.buffer(_MARGIN_M).bounds
    height = _WIDTH_IN * (y1 - y0) / (x1 - x0) + 1.6
    figure = Figure(figsize=(_WIDTH_IN, min(max(height, 3.0), 11.0)), layout="constrained")
    labels: Any = {"xlabel": "x (m)", "ylabel": "y (m)"}
    axes = figure.add_subplot(xlim=(x0, x1), ylim=(y0, y1), aspect="equal", **labels)
    seen = _draw_ground(axes, layout) | _draw_solids(axes, layout, path)
    handles: list[Any] = [Patch(color=colour, label=name) for name, colour in seen.items()]
    handles += _draw_zones(axes, layout) + _draw_walks(axes, layout) + _draw_tracks(axes, tracks)
    axes.set_title(_words(layout.scene.name) + (f", path {_words(path)}" if path else ""))
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize="small")
    return figure


def _words(name: str) -> str:
    return name.replace("_", " ")


def _colour(category: str, tint: float = _TINT) -> tuple[float, ...]:
    return tuple(1 - tint * (1 - value / 255) for value in CLASS_COLOURS[category])


def _fill(axes: Axes, ground: BaseGeometry, colour: Any, **style: Any) -> None:
    for part in shapely.get_parts(ground):
        if part.geom_type == "Polygon":
            # One compound path, so that holes stay open.
            rings = [part.exterior, *part.interiors]
            outline = Outline.make_compound_path(*(Outline(ring.coords) for ring in rings))
            axes.add_patch(PathPatch(outline, facecolor=colour, **{"linewidth": 0} | style))


def _draw_ground(axes: Axes, layout: Layout) -> dict[str, Any]:
    crosswalks = shapely.union_all([area.polygon for area in layout.crosswalks])
    grounds = {"terrain": layout.terrain, "sidewalk": layout.sidewalks, "road": layout.drivable}
    grounds["crosswalk"] = crosswalks
    seen = {}
    for name, ground in grounds.items():
        if not ground.is_empty:
            seen[name] = _colour(name)
            _fill(axes, ground, seen[name])
    return seen


def _draw_solids(axes: Axes, layout: Layout, path: str | None) -> dict[str, Any]:
    seen: dict[str, Any] = {}
    for box in (*layout.buildings, *layout.obstacles):
        name = "building" if box.kind == "house" else _words(box.kind)
        is_small = min(box.size_m[:2]) < _SMALL_M
        seen[name] = _colour(box.category, 1.0 if is_small else _TINT)
        if box.kind == "lamp_post":
            seen[name] = _LAMP_POST_COLOUR
        edge, width = (seen[name], 3.0) if is_small else ("black", 0.5)
        style = {"edgecolor": edge, "linewidth": width, "joinstyle": "round", "snap": False}
        _fill(axes, box.footprint, seen[name], **style)
    drawn = next((p.closures for p in layout.scene.paths if p.name == path), ())
    label, alpha = ("exit, closed on some paths", 0.4) if path is None else ("closed exit", 1.0)
    for name, box in layout.closures.items():
        if path is None or name in drawn:
            seen[label] = to_rgba(_CLOSED_COLOUR, alpha)
            _fill(axes, box.footprint, seen[label])
    return seen


def _draw_zones(axes: Axes, layout: Layout) -> list[Any]:
    # Each zone has its name next to the road; starts have an arrow in the direction of travel.
    scene, named = layout.scene, set[str]()
    starts = {path.start for path in scene.paths}
    for kind, colour in _ZONE_COLOURS.items():
        for name in dict.fromkeys(getattr(path, kind) for path in scene.paths):
            _fill(axes, layout.zones[name], colour)
            if kind == "start":
                x, y, yaw, _ = layout.start_state(name)
                ahead = x + 8.0 * math.cos(yaw), y + 8.0 * math.sin(yaw)
                arrow = {"arrowstyle": "->", "color": "black", "lw": 1.5}
                axes.annotate("", ahead, (x, y), arrowprops=arrow, zorder=5)
            if name in named:
                continue
            named.add(name)
            zone = layout.zone_of[name]
            x, y, heading = layout.pose_at(zone.road, (zone.from_m + zone.to_m) / 2)
            # Starts are named to the left of the road and ends to its right, because a zone may be
            # both.
            reach = _LABEL_PT if name in starts else -_LABEL_PT
            aside = -reach * math.sin(heading), reach * math.cos(heading)
            box = {"boxstyle": "round,pad=0.2", "facecolor": "white", "alpha": 0.85, "lw": 0}
            style: Any = {"ha": "center", "va": "center", "textcoords": "offset points"}
            axes.annotate(
                _words(name), (x, y), aside, fontsize="small", bbox=box, zorder=6, **style
            )
    return [Patch(color=c, label=f"{k} zone") for k, c in reversed(_ZONE_COLOURS.items())]


def _draw_walks(axes: Axes, layout: Layout) -> list[Any]:
    drawn: dict[str, Any] = {}
    for group in layout.scene.pedestrian_groups:
        stands = group.standing == group.count
        label = "pedestrians who stand" if stands else "pedestrians' walk"
        style: Any = {"linestyle": ":" if stands else "--", "color": _WALK_COLOUR}
        axes.plot(*layout.walk_line(group.walk).T, linewidth=1.2, **style)
        drawn[label] = Line2D([], [], label=label, **style)
    return list(drawn.values())


def _draw_tracks(axes: Axes, tracks: Iterable[Track]) -> list[Any]:
    outcomes = set()
    for points, outcome in tracks:
        outcomes.add(outcome)
        colour = OUTCOME_COLOURS[outcome]
        axes.plot(*points.T, color=colour, linewidth=1.4, alpha=0.8)
        if outcome != "success":
            axes.plot(*points[-1], "x", color=colour, markersize=7, markeredgewidth=2)
    shown = {name: colour for name, colour in OUTCOME_COLOURS.items() if name in outcomes}
    return [Line2D([], [], color=colour, label=_words(name)) for name, colour in shown.items()]
