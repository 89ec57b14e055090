"""Which scenes are their own mirror image, as far as their roads and paths are concerned.

`Mirror` shows an agent the reflected world. `symmetric` says that a reflection takes the ground and
the paths, with their closed exits, into themselves.
"""

import numpy as np
import pytest
import shapely
from shapely.affinity import affine_transform

from flowrep.scenes import load_scene, scene_names
from flowrep.scenes.layout import Layout

APART_M = 0.01  # what lies closer is at the same place


def pose(state):
    cosine, sine = np.cos(state.yaw_rad), np.sin(state.yaw_rad)
    return np.array([[cosine, -sine, state.x_m], [sine, cosine, state.y_m], [0.0, 0.0, 1.0]])


def shapes_of(layout, path):
    # Of three points at unequal distances, which way the vehicle heads can be told.
    ahead = [pose(layout.start_state(path.start)) @ (m, 0.0, 1.0) for m in (0.5, 1.0, 2.0)]
    closed = shapely.union_all([layout.closures[name].footprint for name in path.closures])
    return [*(shapely.Point(point[:2]) for point in ahead), layout.zones[path.end], closed]


def are_images(shapes, others, reflection):
    matrix = [*reflection[:2, :2].ravel(), *reflection[:2, 2]]
    return all(
        (a.is_empty and b.is_empty) or affine_transform(a, matrix).hausdorff_distance(b) < APART_M
        for a, b in zip(shapes, others)
    )


def is_symmetric(layout):
    """Returns whether a reflection that takes the first path's start to some path's fits all."""
    starts = [pose(layout.start_state(path.start)) for path in layout.scene.paths]
    paths, ground = [shapes_of(layout, path) for path in layout.scene.paths], [layout.drivable]
    reflections = [there @ np.diag([1.0, -1.0, 1.0]) @ np.linalg.inv(starts[0]) for there in starts]
    return any(
        are_images(ground, ground, m)
        and all(any(are_images(a, b, m) for b in paths) for a in paths)
        for m in reflections
    )


@pytest.mark.parametrize("name", scene_names())
def test_a_scene_says_whether_its_mirror_image_is_the_same_street(name):
    scene = load_scene(name)
    assert scene.symmetric == is_symmetric(Layout(scene))
    # From either end the S turns left first; its image, a Z, turns right first.
    assert scene.symmetric == (name != "s_turn")
