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


def vertices(kind, variant):
    return mesh_of(Box(kind, 0.0, 0.0, 0.0, SIZES[kind], variant)).corners.reshape(-1, 3)


def normals(mesh):
    """Returns the triangles' normals [T, 3], as long as twice their areas."""
    a, b, c = mesh.corners.swapaxes(0, 1)
    return np.cross(b - a, c - a)


@pytest.mark.parametrize("variant", range(4))
@pytest.mark.parametrize("kind", SIZES)
def test_a_shape_fills_its_box_and_hangs_over_it_only_above_heads(kind, variant):
    points, size = vertices(kind, variant), np.array(SIZES[kind])
    assert points[:, 2].min() == pytest.approx(0.0)
    assert points[:, 2].max() == pytest.approx(size[2])
    beyond = (np.abs(points[:, :2]) - size[:2] / 2).max(axis=-1)
    assert beyond.max() <= OVERHANG.get(kind, 0.0) + 1e-9
    # A person of 1.75 m walks below whatever hangs over; a fir's lowest branches are at 1.5 m.
    low = points[:, 2] < (1.5 if kind == "tree" else 1.8)
    assert beyond[low].max() <= 0.03


@pytest.mark.parametrize("variant", range(4))
@pytest.mark.parametrize("kind", SIZES)
def test_the_lowest_of_its_kind_stands_on_the_ground_and_has_no_face_without_area(kind, variant):
    length, width, _ = SIZES[kind]
    size = (length, width, LEAST_HEIGHT_M.get(kind, 0.01))
    mesh = mesh_of(Box(kind, 0.0, 0.0, 0.0, size, variant))
    assert np.abs(normals(mesh)).max(axis=-1).min() > 0
    assert mesh.corners[..., 2].min() == 0.0
    assert mesh.corners[..., 2].max() == pytest.approx(size[2])


def test_a_shape_stands_where_its_box_does_and_faces_its_way():
    # At (10, 3) looking along +y: 4.2 m along y, 1.8 m along x, and its white lamps are ahead.
    mesh = mesh_of(Box("car", 10.0, 3.0, np.pi / 2, SIZES["car"]))
    points = mesh.corners.reshape(-1, 3)
    assert points[:, 1].min() == pytest.approx(3.0 - 2.1, abs=0.02)
    assert points[:, 0].max() == pytest.approx(10.0 + 0.9, abs=0.03)
    white = np.isclose(mesh.uvs, swatch("lamp_white")[:2]).all(axis=-1)
    np.testing.assert_allclose(mesh.corners[white][:, 1], 3.0 + 2.11)


def test_one_lamp_of_a_traffic_light_is_lit_for_those_who_drive_its_way():
    mesh = mesh_of(Box("traffic_light", 0.0, 0.0, 0.0, SIZES["traffic_light"]))
    lit = np.isclose(mesh.uvs, swatch("lamp_green")[:2]).all(axis=(1, 2))
    assert lit.sum() == 6  # the triangles of one octagon
    facing = normals(mesh)[lit]
    assert (facing[:, 0] < 0).all()
    assert np.abs(facing[:, 1:]).max() < 1e-12
    for other in ("lamp_red", "lamp_white"):
        assert not np.isclose(mesh.uvs, swatch(other)[:2]).all(axis=-1).any()


def test_every_normal_points_away_from_the_inside_of_a_car():
    mesh = mesh_of(Box("car", 0.0, 0.0, 0.0, SIZES["car"]))
    middles = mesh.corners.mean(axis=1)
    assert ((middles - [0.0, 0.0, 0.7]) * normals(mesh)).sum(axis=-1).min() > 0
