"""The plan of a scene: what is drawn where."""

import numpy as np
import pytest
from matplotlib.colors import to_hex

pytest.importorskip("shapely", reason="plans are drawn of scenes")

from shapely.geometry import Point

from flowrep.envs import Outcome
from flowrep.scenes import load_scene
from flowrep.scenes.layout import Layout
from flowrep.viz.plan import OUTCOME_COLOURS, Track, draw_plan


@pytest.fixture(scope="module")
def layout():
    return Layout(load_scene("three_way_junction"))


@pytest.fixture(scope="module")
def plan(layout):
    return draw_plan(layout)


def labels(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_every_outcome_has_another_colour():
    assert list(OUTCOME_COLOURS) == [outcome.label for outcome in Outcome if outcome]
    assert len(set(OUTCOME_COLOURS.values())) == len(OUTCOME_COLOURS)


def test_a_track_is_drawn_in_its_outcomes_colour_where_it_was_driven(layout):
    points = np.array([[7.0, 0.0], [30.0, 0.5], [60.0, -1.0]])
    figure = draw_plan(layout, [Track(points, "collision")])
    (axes,) = figure.axes
    lines = [line for line in axes.lines if len(line.get_xdata()) == 3]
    (drawn,) = [x for x in lines if to_hex(x.get_color()) == OUTCOME_COLOURS["collision"]]
    np.testing.assert_array_equal(np.stack(drawn.get_data(), -1), points)
    assert "collision" in labels(figure)
    assert "success" not in labels(figure)
    # x to the right, y upwards, one metre as long on either axis.
    assert axes.get_aspect() == 1.0
    assert not axes.xaxis_inverted()
    assert not axes.yaxis_inverted()
    assert "x (m)" in axes.get_xlabel()


def test_the_legend_names_only_what_the_scene_has(plan):
    has = {"road", "crosswalk", "terrain", "tree", "fence", "car", "traffic light"}
    assert has <= {*labels(plan)}
    straight = labels(draw_plan(Layout(load_scene("straight_road"))))
    assert "tree" not in straight
    assert "pedestrians who stand" not in straight  # everyone there walks
    assert not any("exit" in name for name in straight)


def test_buildings_and_obstacles_lie_wholly_within_a_plan(layout, plan):
    (axes,) = plan.axes
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    for box in (*layout.buildings, *layout.obstacles):
        left, lower, right, upper = box.footprint.bounds
        assert x0 < left < right < x1
        assert y0 < lower < upper < y1


def test_every_zone_of_a_path_has_its_name_at_its_place(layout, plan):
    (axes,) = plan.axes
    named = {text.get_text(): text.xy for text in axes.texts if text.get_text()}
    assert set(named) == {"entry", "left end", "right end"}
    # The start lies about the first road's 7th metre, which runs along x from the origin.
    assert named["entry"] == pytest.approx((7.0, 0.0))
    for name, place in named.items():
        assert layout.zones[name.replace(" ", "_")].contains(Point(place))


def test_a_plan_of_a_path_shows_only_the_closures_of_that_path(layout, plan):
    def closed(figure):
        patches = figure.axes[0].patches
        dark = [patch for patch in patches if to_hex(patch.get_facecolor()) == "#303030"]
        return [patch.get_path().vertices.mean(axis=0) for patch in dark]

    assert len(closed(plan)) == 2
    assert "exit, closed on some paths" in labels(plan)
    left = draw_plan(layout, path="left")
    assert "closed exit" in labels(left)
    (only,) = closed(left)  # drives to the left, +y, with the right arm closed
    assert only[1] < 0
