"""Which scenes are their own mirror image, as far as a driver is concerned.

`Mirror` shows an agent the reflected world. A scene's episodes are distributed as their reflections
are if a reflection takes its ground, paths (with their closed exits), walks and obstacles into
themselves. House fronts differ from side to side everywhere and are left out: nobody reaches them.
"""

import numpy as np
import pytest
import shapely
from shapely import LineString
from shapely.affinity import affine_transform

from flowrep.scenes import load_scene
from flowrep.scenes.layout import Layout

APART_M = 0.01  # what lies closer is at the same place


def pose(state):
    cosine, sine = np.cos(state.yaw_rad), np.sin(state.yaw_rad)
    return np.array([[cosine, -sine, state.x_m], [sine, cosine, state.y_m], [0.0, 0.0, 1.0]])


def reflections(layout):
    """Returns those [3, 3] that take the first path's start to some path's, left to its right."""
    starts = [pose(layout.start_state(path.start)) for path in layout.scene.paths]
    return [there @ np.diag([1.0, -1.0, 1.0]) @ np.linalg.inv(starts[0]) for there in starts]


def parts(layout):
    """Returns, by kind, things as (what has to be equal, shapes that have to be reflected)."""
    scene = layout.scene
    paths, walks = [], []
    for path in scene.paths:
        ahead = [pose(layout.start_state(path.start)) @ (m, 0.0, 1.0) for m in (0.5, 1.0, 2.0)]
        closed = shapely.union_all([layout.closures[name].footprint for name in path.closures])
        # of three points at unequal distances, which way the vehicle heads can be told
        start = [shapely.Point(point[:2]) for point in ahead]
        paths.append((len(path.closures), [*start, layout.zones[path.end], closed]))
    for group in scene.pedestrian_groups:
        # to and fro from a drawn place: the line's direction doesn't matter
        people = (group.count, group.spread_m, group.standing, group.draw, group.speed_mps)
        walks.append((people, [LineString(layout.walk_line(group.walk))]))
    obstacles = [((box.kind, *box.size_m), [box.footprint]) for box in layout.obstacles]
    ground = [((), [layout.drivable])]
    return {"ground": ground, "paths": paths, "walks": walks, "obstacles": obstacles}


def is_image(thing, other, m):
    (what, shapes), (other_what, other_shapes) = thing, other
    matrix = [*m[:2, :2].ravel(), *m[:2, 2]]
    images = [affine_transform(shape, matrix) for shape in shapes]
    return what == other_what and all(
        (a.is_empty and b.is_empty) or a.hausdorff_distance(b) < APART_M
        for a, b in zip(images, other_shapes)
    )


def differences(layout):
    """Returns the kinds of things that the best reflection does not take into themselves."""
    return min(
        (
            {
                kind
                for kind, things in parts(layout).items()
                if not all(any(is_image(a, b, m) for b in things) for a in things)
            }
            for m in reflections(layout)
        ),
        key=len,
    )


@pytest.mark.parametrize(
    ("scene", "different"),
    [
        ("straight_road", set()),
        # from either end it turns left first; its image, a Z, turns right first
        ("s_turn", {"ground", "paths", "walks"}),
        # those who stand on the bar always stand on its southern side
        ("h_shaped_pathways", {"walks"}),
        # along the stem people are first on the left, then on the right; a car and the lamp posts
        # stand on one side
        ("three_way_junction", {"walks", "obstacles"}),
    ],
)
def test_what_differs_between_a_scene_and_its_mirror_image(scene, different):
    layout = Layout(load_scene(scene))
    assert differences(layout) == different
    # where people stand or walk may differ; the roads and the ways may not
    assert layout.scene.symmetric == different.isdisjoint({"ground", "paths"})
