"""Motions in numpy are those of `flowrep.geometry`, whose tests work them by hand."""

import numpy as np
import pytest
import torch

from flowrep import geometry
from flowrep.scenes.scene import CameraConfig
from flowrep.simulator.motion import instance_motion, planar, relative_motion, rigid_inverse

MOUNT = CameraConfig(48, 60, 70.0, 1.5, 0.4, -10.0, 0.2, 100.0).vehicle_from_cam
BODIES_BEFORE = np.stack([planar(10.0, 2.0, 0.1), planar(12.0, -3.0, 1.0), planar(8.0, 0.0, 3.0)])
BODIES = np.stack([planar(10.1, 2.2, 0.4), planar(12.0, -3.0, 1.0), planar(7.9, 0.0, 3.0)])


@pytest.mark.parametrize("far_m", [0.0, 10_000.0])
def test_numpy_motions_equal_those_of_geometry(far_m):
    away = planar(far_m, -far_m, 0.0)
    before, now = (away @ planar(*at) @ MOUNT for at in ((3.0, -1.0, 0.3), (3.8, -0.7, 0.42)))
    given = before, now, away @ BODIES_BEFORE, away @ BODIES
    tensors = [torch.from_numpy(poses) for poses in given]
    # 10 km out, float64 holds 2e-12 m.
    same = {"rtol": 0, "atol": 1e-12 if far_m == 0.0 else 1e-10}
    expected = geometry.instance_motion(*tensors, dtype=torch.float64).numpy()
    np.testing.assert_allclose(instance_motion(*given), expected, **same)
    expected = geometry.relative_motion(*tensors[:2], dtype=torch.float64).numpy()
    np.testing.assert_allclose(relative_motion(before, now), expected, **same)
    np.testing.assert_allclose(rigid_inverse(now) @ now, np.eye(4), **same)
