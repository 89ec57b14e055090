"""What every function of the geometry refuses, with the argument's name and what it should be."""

from functools import partial

import pytest
import torch

from flowrep import geometry as g
from tests.geometry.scenes import MOTION, K, depth_map, instance_map, raw_flow

Z, IDS, RAW, M = depth_map(), instance_map(), raw_flow(), MOTION
MOTIONS, POINT = M.expand(3, 4, 4), torch.ones(3)
adapt_flow = partial(g.adapt_flow, RAW, direction="forward", grid="current")
from_fov = partial(g.intrinsics_from_fov, fov_deg=90.0, axis="vertical", height=4, width=6)


def of(count: int, tensor: torch.Tensor) -> torch.Tensor:
    return tensor.expand(count, *tensor.shape)


SHAPES = {
    "points_cam must be [*B, 3], got [4]": lambda: g.project(torch.ones(4), K),
    "depth [2], K [3]": lambda: g.unproject(of(2, Z), of(3, K)),
    "depth must be [*B, 1, H, W], got [2, 5, 7]": lambda: g.ego_flow(RAW, K, M),
    "prev_from_curr must be [*B, 4, 4]": lambda: g.ego_flow(Z, K, M[:3]),
    "depth [2], K [], prev_from_curr [3]": lambda: g.ego_flow(of(2, Z), K, of(3, M)),
    "instance must be [*B, 1, H, W]": lambda: g.rigid_flow(Z, IDS[0], K, MOTIONS),
    "instance and depth must have one": lambda: g.rigid_flow(Z, IDS.mT, K, MOTIONS),
    "by_instance must be [*B, N, 4, 4]": lambda: g.rigid_flow(Z, IDS, K, M),
    "raw must be [*B, 2, H, W]": lambda: g.factorize(RAW[:1], Z, K, M),
    "depth [3], K [], prev_from_curr [], raw [2]": lambda: g.factorize(of(2, RAW), of(3, Z), K, M),
    "world_from_prev [2], world_from_curr [3]": lambda: g.relative_motion(of(2, M), of(3, M)),
    "a_from_b has batch [2], which points_b [3]": lambda: g.transform_points(of(2, M), POINT),
    "the same bodies are needed before and now, got 3 and 2": lambda: g.instance_motion(
        M, M, MOTIONS, MOTIONS[:2]
    ),
    "body_ids must be [N], got [1, 1]": lambda: g.instance_rows(IDS, torch.tensor([[1]])),
    "pose must be [*B, 7], got [4, 4]": lambda: g.adapt_pose(torch.eye(4), layout="xyz_xyzw"),
    "flow, depth and picture must have one": lambda: g.camera_motion(RAW, Z, K, picture=RAW.mT),
    "K [2], prior [3]": lambda: g.camera_motion(RAW, Z, of(2, K), prior=of(3, M)),
}
TYPES = {
    "floating point (metres, pixels), got torch.int32": lambda: g.unproject(Z.int(), K),
    "depth must be a torch.Tensor, got list": lambda: g.unproject([[1.0]], K),
    "instance must hold integer ids, got torch.float64": lambda: g.rigid_flow(Z, Z, K, MOTIONS),
    "depth must be floating point": lambda: g.adapt_depth(Z.short(), "z"),
}
OPTIONS = {
    "finite; got 0": lambda: g.ego_flow(Z, K, M, dt=0),
    "dt must be positive (current": lambda: g.factorize(RAW, Z, K, M, dt=torch.nan),
    "'reversed_z_buffer'], got 'zbuffer'": lambda: g.adapt_depth(Z, "zbuffer"),
    "'ray_length' needs ['K']": lambda: g.adapt_depth(Z, "ray_length"),
    "'z_buffer' needs ['near_m', 'far_m']": lambda: g.adapt_depth(Z, "z_buffer", near_m=1.0),
    "needs none of": lambda: g.adapt_depth(Z, "z", far_m=1.0),
    "near_m=2.0, far_m=1.0": lambda: g.adapt_depth(Z, "z_buffer", near_m=2.0, far_m=1.0),
    "scale_m=0.0": lambda: g.adapt_depth(Z, "z", scale_m=0.0),
    "axis must be one of ['horizontal', 'vertical']": lambda: from_fov(axis="diagonal"),
    "between 0 and 180 degrees": lambda: from_fov(fov_deg=180.0),
    "height must be a whole number": lambda: from_fov(height=0),
    "width must be a whole number": lambda: from_fov(width=6.5),
    "whole number of at least 1, got '6'": lambda: from_fov(width="6"),
    "['forward', 'backward'], got 'back'": lambda: adapt_flow(direction="back"),
    "['current', 'previous'], got 'next'": lambda: adapt_flow(grid="next"),
    "['uv', 'row_column'], got 'vu'": lambda: adapt_flow(channels="vu"),
    "swap the two pictures": lambda: adapt_flow(grid="previous"),
    "layout must be one of": lambda: g.adapt_pose(M, layout="xyzw"),
    "['camera_to_world', 'world_to_camera']": lambda: g.adapt_pose(M, direction="cam2world"),
    "axes must be one of ['opencv',": lambda: g.adapt_pose(M, axes="blender"),
    "layout 'xyz_yaw'": lambda: g.adapt_pose(M[0], layout="xyz_yaw"),
}
MISTAKES = [
    *((ValueError, *each) for each in SHAPES.items()),
    *((TypeError, *each) for each in TYPES.items()),
    *((ValueError, *each) for each in OPTIONS.items()),
]


@pytest.mark.parametrize(("error", "words", "call"), MISTAKES)
def test_a_mistake_is_named(error, words, call):
    with pytest.raises(error) as raised:
        call()
    assert words in str(raised.value)
