"""Which scenes are their own mirror image, as far as their roads and paths are concerned.

`Mirror` shows an agent the reflected world. `symmetric` says that a reflection takes the ground and
the paths, with their closed exits, into themselves.
"""

import math

import pytest
import shapely
from shapely.affinity import affine_transform

from flowrep.scenes import load_scene, scene_names
from flowrep.scenes.layout import Layout

APART_M = 0.01  # what lies closer is at the same place
REFLECTED = [1, 0, 0, -1, 0, 0]  # x and -y


def shapes_of(layout, path):
    x, y, yaw, _ = layout.start_state(path.start)
    ahead = shapely.Point(x + math.cos(yaw), y + math.sin(yaw))
    closed = shapely.union_all([layout.closures[name].footprint for name in path.closures])
    return [shapely.Point(x, y), ahead, layout.zones[path.end], closed]


def are_images(shapes, others):
    return all(
        (a.is_empty and b.is_empty)
        or affine_transform(a, REFLECTED).hausdorff_distance(b) < APART_M
        for a, b in zip(shapes, others)
    )


@pytest.mark.parametrize("name", scene_names())
def test_a_scene_says_whether_its_mirror_image_is_the_same_street(name):
    layout = Layout(load_scene(name))
    ground, paths = layout.drivable, [shapes_of(layout, path) for path in layout.scene.paths]
    is_symmetric = all(any(are_images(a, b) for b in paths) for a in paths)
    assert layout.scene.symmetric == (is_symmetric and are_images([ground], [ground]))
    # From either end the S turns left first; its image, a Z, turns right first.
    assert layout.scene.symmetric == (name != "s_turn")
