"""A person's parts against places worked out by hand."""

import math

import numpy as np
import pytest

from flowrep.scenes.pedestrians import PARTS, place_parts, world_from_parts
from flowrep.simulator.meshes import person_meshes

# At (5, 2), looking along +y: its left is -x. The left leg swings back by 30°.
POSE = np.array([[5.0, 2.0, math.pi / 2, math.radians(30.0)]])
HIP_M, LEG_M = 0.82, 0.82


def test_hips_are_to_the_left_and_right_of_where_one_looks():
    _, left, right = world_from_parts(POSE)
    np.testing.assert_allclose(left[:3, 3], [4.9, 2.0, HIP_M], atol=1e-12)
    np.testing.assert_allclose(right[:3, 3], [5.1, 2.0, HIP_M], atol=1e-12)


def test_a_leg_swings_back_while_the_other_swings_forward():
    _, left, right = world_from_parts(POSE)
    foot = np.array([0.0, 0.0, -LEG_M, 1.0])
    # sin 30° = 0.5: the foot is 0.41 m behind or before the hip and at 0.82·(1 - cos 30°) m.
    height = HIP_M - LEG_M * math.cos(math.radians(30.0))
    np.testing.assert_allclose((left @ foot)[:3], [4.9, 2.0 - 0.41, height], atol=1e-12)
    np.testing.assert_allclose((right @ foot)[:3], [5.1, 2.0 + 0.41, height], atol=1e-12)


def test_the_upper_body_turns_with_the_person_alone():
    body, _, _ = world_from_parts(POSE)
    np.testing.assert_allclose(body @ [1.0, 0.0, 1.2, 1.0], [5.0, 3.0, 1.2, 1.0], atol=1e-12)


def test_quaternions_are_the_matrices():
    poses = np.array([*POSE, [1.0, -3.0, -2.0, -0.3]])
    transforms = world_from_parts(poses)
    parts = place_parts(poses)
    np.testing.assert_allclose(parts.positions.reshape(-1, 3), transforms[:, :3, 3], atol=1e-12)
    for (x, y, z, w), transform in zip(parts.quaternions_xyzw.reshape(-1, 4), transforms):
        # Of a unit quaternion's matrix, the columns for x and z.
        first = [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)]
        third = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
        np.testing.assert_allclose(transform[:3, 0], first, atol=1e-12)
        np.testing.assert_allclose(transform[:3, 2], third, atol=1e-12)


@pytest.mark.parametrize("swing", [0.0, 0.38, -0.38])
def test_nobody_sinks_into_the_ground_or_outgrows_the_cylinder(swing):
    poses = np.array([[0.0, 0.0, 0.0, swing]])
    points = np.concatenate(
        [
            np.column_stack([mesh.vertices, np.ones(len(mesh.vertices))]) @ transform.T
            for mesh, transform in zip(person_meshes(0), world_from_parts(poses), strict=True)
        ]
    )
    assert len(PARTS) == 3
    assert points[:, 2].min() > -0.05
    assert points[:, 2].max() == pytest.approx(1.75)
    assert np.abs(points[:, 1]).max() < 0.35


def test_one_is_wide_enough_to_be_seen_from_the_side():
    body, *_ = person_meshes(3)
    assert np.ptp(np.array(body.vertices)[:, 0]) == pytest.approx(0.6)
