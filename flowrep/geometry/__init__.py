"""Cameras, rigid motions and the flow they cause, as pure batched functions on torch tensors."""

from flowrep.geometry.camera import project, unproject
from flowrep.geometry.depth import DepthKind, adapt_depth, z_from_ray_length, z_from_z_buffer
from flowrep.geometry.flow import Factors, Flow, ego_flow, factorize, rigid_flow
from flowrep.geometry.flow_layout import Channels, Direction, Grid, adapt_flow
from flowrep.geometry.instances import instance_rows
from flowrep.geometry.intrinsics import (
    FovAxis,
    check_intrinsics,
    intrinsics_from_fov,
    intrinsics_from_opencv,
)
from flowrep.geometry.poses import (
    CameraAxes,
    PoseDirection,
    PoseLayout,
    adapt_pose,
    pose_from_quaternion,
)
from flowrep.geometry.rigid import (
    check_rigid,
    instance_motion,
    invert_rigid,
    relative_motion,
    transform_points,
)

__all__ = [
    "CameraAxes",
    "Channels",
    "DepthKind",
    "Direction",
    "Factors",
    "Flow",
    "FovAxis",
    "Grid",
    "PoseDirection",
    "PoseLayout",
    "adapt_depth",
    "adapt_flow",
    "adapt_pose",
    "check_intrinsics",
    "check_rigid",
    "ego_flow",
    "factorize",
    "instance_motion",
    "instance_rows",
    "intrinsics_from_fov",
    "intrinsics_from_opencv",
    "invert_rigid",
    "pose_from_quaternion",
    "project",
    "relative_motion",
    "rigid_flow",
    "transform_points",
    "unproject",
    "z_from_ray_length",
    "z_from_z_buffer",
]
