"""What every function of the geometry refuses, with the argument's name and what it should be."""

import pytest
import torch

from flowrep import geometry as g
from tests.geometry.scenes import MOTION, K, depth_map, instance_map, raw_flow

Z, IDS, RAW, MOTIONS = depth_map(), instance_map(), raw_flow(), MOTION.expand(3, 4, 4)
POINT = torch.ones(3)
FORWARD = {"direction": "forward", "grid": "current"}
FOV = {"fov_deg": 90.0, "axis": "vertical", "height": 4, "width": 6}


def batch(count: int, tensor: torch.Tensor) -> torch.Tensor:
    return tensor.expand(count, *tensor.shape)


SHAPES = {
    "points_cam must be [*B, 3], got [4]": lambda: g.project(torch.ones(4), K),
    "depth [2], K [3]": lambda: g.unproject(batch(2, Z), batch(3, K)),
    "depth must be [*B, 1, H, W], got [2, 5, 7]": lambda: g.ego_flow(RAW, K, MOTION),
    "prev_from_curr must be [*B, 4, 4]": lambda: g.ego_flow(Z, K, MOTION[:3]),
    "depth [2], K [], prev_from_curr [3]": lambda: g.ego_flow(batch(2, Z), K, batch(3, MOTION)),
    "instance must be [*B, 1, H, W]": lambda: g.rigid_flow(Z, IDS[0], K, MOTIONS),
    "instance and depth must have one": lambda: g.rigid_flow(Z, IDS.mT, K, MOTIONS),
    "by_instance must be [*B, N, 4, 4]": lambda: g.rigid_flow(Z, IDS, K, MOTION),
    "raw must be [*B, 2, H, W]": lambda: g.factorize(RAW[:1], Z, K, MOTION),
    "depth [3], K [], prev_from_curr [], raw [2]": lambda: g.factorize(
        batch(2, RAW), batch(3, Z), K, MOTION
    ),
    "world_from_prev [2], world_from_curr [3]": lambda: g.relative_motion(
        batch(2, MOTION), batch(3, MOTION)
    ),
    "a_from_b has batch [2], which points_b [3]": lambda: g.transform_points(
        batch(2, MOTION), POINT
    ),
    "the same bodies are needed before and now, got 3 and 2": lambda: g.instance_motion(
        MOTION, MOTION, MOTIONS, MOTIONS[:2]
    ),
    "body_ids must be [N], got [1, 1]": lambda: g.instance_rows(IDS, torch.tensor([[1]])),
    "pose must be [*B, 7], got [4, 4]": lambda: g.adapt_pose(torch.eye(4), layout="xyz_xyzw"),
    "flow, depth and picture must have one": lambda: g.camera_motion(RAW, Z, K, picture=RAW.mT),
    "K [2], prior [3]": lambda: g.camera_motion(RAW, Z, batch(2, K), prior=batch(3, MOTION)),
}
TYPES = {
    "depth must be floating point (metres, pixels), got torch.int32": lambda: g.unproject(
        Z.int(), K
    ),
    "depth must be a torch.Tensor, got list": lambda: g.unproject([[1.0]], K),
    "instance must hold integer ids, got torch.float64": lambda: g.rigid_flow(Z, Z, K, MOTIONS),
    "depth must be floating point": lambda: g.adapt_depth(Z.short(), "z"),
}
OPTIONS = {
    "finite; got 0": lambda: g.ego_flow(Z, K, MOTION, dt=0),
    "dt must be positive (current time minus previous time)": lambda: g.factorize(
        RAW, Z, K, MOTION, dt=torch.nan
    ),
    "['z', 'ray_length', 'z_buffer'], got 'zbuffer'": lambda: g.adapt_depth(Z, "zbuffer"),
    "'ray_length' needs K": lambda: g.adapt_depth(Z, "ray_length"),
    "other kinds do not read it; kind is 'z'": lambda: g.adapt_depth(Z, "z", K=K),
    "needs near_m and far_m": lambda: g.adapt_depth(Z, "z_buffer", near_m=1.0),
    "do not read them; kind is 'z'": lambda: g.adapt_depth(Z, "z", far_m=1.0),
    "near_m=2.0, far_m=1.0": lambda: g.adapt_depth(Z, "z_buffer", near_m=2.0, far_m=1.0),
    "scale_m=0.0": lambda: g.adapt_depth(Z, "z", scale_m=0.0),
    "axis must be one of ['horizontal', 'vertical']": lambda: g.intrinsics_from_fov(
        **FOV | {"axis": "diagonal"}
    ),
    "between 0 and 180 degrees": lambda: g.intrinsics_from_fov(**FOV | {"fov_deg": 180.0}),
    "at least 1 pixel, got 0 and 6": lambda: g.intrinsics_from_fov(**FOV | {"height": 0}),
    "['forward', 'backward'], got 'back'": lambda: g.adapt_flow(
        RAW, **FORWARD | {"direction": "back"}
    ),
    "['current', 'previous'], got 'next'": lambda: g.adapt_flow(RAW, **FORWARD | {"grid": "next"}),
    "['uv', 'row_column'], got 'vu'": lambda: g.adapt_flow(RAW, **FORWARD, channels="vu"),
    "swap the two pictures": lambda: g.adapt_flow(RAW, **FORWARD | {"grid": "previous"}),
    "layout must be one of": lambda: g.adapt_pose(MOTION, layout="xyzw"),
    "['camera_to_world', 'world_to_camera']": lambda: g.adapt_pose(MOTION, direction="cam2world"),
    "axes must be one of ['opencv',": lambda: g.adapt_pose(MOTION, axes="blender"),
    "'xyz_yaw' is of a camera that looks": lambda: g.adapt_pose(MOTION[0], layout="xyz_yaw"),
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
