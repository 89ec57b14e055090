"""What stands in a street keeps to its box where it can be hit, and shows what it is."""

import numpy as np
import pytest

from flowrep.scenes.layout import Box
from flowrep.scenes.scene import LEAST_HEIGHT_M
from flowrep.simulator.meshes import mesh_of
from flowrep.simulator.paint import swatch

SIZES = {
    "car": (4.2, 1.8, 1.45),
    "tree": (0.4, 0.4, 5.5),
    "fence": (3.0, 0.1, 1.1),
    "traffic_light": (0.2, 0.2, 3.6),
    "lamp_post": (0.2, 0.2, 5.0),
    "house": (8.0, 6.0, 7.0),
}
OVERHANG = {"car": 0.03, "tree": 1.5, "fence": 0.0, "traffic_light": 0.1, "lamp_post": 1.4}


def corners(kind, variant=0, size=None, at=(0.0, 0.0, 0.0)):
    """Returns the triangles' corners [T, 3, 3] and paints [T]."""
    return mesh_of(Box(kind, *at, size or SIZES[kind], variant)).triangles[:2]


def normals(corners):
    """Returns the triangles' normals [T, 3], as long as twice their areas."""
    a, b, c = corners.swapaxes(0, 1)
    return np.cross(b - a, c - a)


@pytest.mark.parametrize("variant", range(4))
@pytest.mark.parametrize("kind", SIZES)
def test_a_shape_fills_its_box_and_hangs_over_it_only_above_heads(kind, variant):
    points, size = corners(kind, variant)[0].reshape(-1, 3), np.array(SIZES[kind])
    assert points[:, 2].min() == pytest.approx(0.0)
    assert points[:, 2].max() == pytest.approx(size[2])
    beyond = (np.abs(points[:, :2]) - size[:2] / 2).max(axis=-1)
    assert beyond.max() <= OVERHANG.get(kind, 0.0) + 1e-9
    # A person of 1.75 m walks below whatever hangs over; a fir's lowest branches are at 1.5 m.
    low = points[:, 2] < (1.5 if kind == "tree" else 1.8)
    assert beyond[low].max() <= 0.03
    # So does the lowest of its kind, no face of which is without area.
    height = LEAST_HEIGHT_M.get(kind, 0.01)
    lowest, _ = corners(kind, variant, (*size[:2], height))
    assert np.abs(normals(lowest)).max(axis=-1).min() > 0
    assert lowest[..., 2].min() == 0.0
    assert lowest[..., 2].max() == pytest.approx(height)


def test_a_shape_stands_where_its_box_does_and_faces_its_way():
    # At (10, 3) looking along +y: 4.2 m along y, 1.8 m along x, and its white lamps are ahead.
    car, paints = corners("car", at=(10.0, 3.0, np.pi / 2))
    assert car[..., 1].min() == pytest.approx(3.0 - 2.1, abs=0.02)
    assert car[..., 0].max() == pytest.approx(10.0 + 0.9, abs=0.03)
    white = car[paints == swatch("lamp_white").paint]
    np.testing.assert_allclose(white[..., 1], 3.0 + 2.11)
    # Every normal points away from the inside.
    assert ((car.mean(axis=1) - [10.0, 3.0, 0.7]) * normals(car)).sum(axis=-1).min() > 0


def test_one_lamp_of_a_traffic_light_is_lit_for_those_who_drive_its_way():
    post, paints = corners("traffic_light")
    facing = normals(post)[paints == swatch("lamp_green").paint]
    assert len(facing) == 6  # the triangles of one octagon
    assert (facing[:, 0] < 0).all()
    assert np.abs(facing[:, 1:]).max() < 1e-12
    for other in ("lamp_red", "lamp_white"):
        assert swatch(other).paint not in paints
