"""Cameras, rigid motions and the flow they cause, as pure batched functions on torch tensors.

`*B` is any leading batch; the batches of several arguments broadcast. Every function raises
ValueError for a wrong shape, name or number, and TypeError for an argument that holds no floats (or
no integers, where ids are expected). The message names the argument.

The paper is Yang et al., "Investigation of Factorized Optical Flows as Mid-Level Representations"
(IROS 2022); equations are numbered as there.
"""

from flowrep.geometry.camera import (
    FovAxis,
    check_intrinsics,
    intrinsics_from_fov,
    intrinsics_from_opencv,
    project,
    unproject,
)
from flowrep.geometry.depth import DepthKind, adapt_depth, z_from_ray_length, z_from_z_buffer
from flowrep.geometry.egomotion import MotionEstimate, camera_motion
from flowrep.geometry.flow import (
    Channels,
    Direction,
    Factors,
    Flow,
    Grid,
    adapt_flow,
    ego_flow,
    factorize,
    rigid_flow,
)
from flowrep.geometry.pose import (
    CameraAxes,
    PoseDirection,
    PoseLayout,
    adapt_pose,
    check_rigid,
    instance_motion,
    instance_rows,
    invert_rigid,
    pose_from_quaternion,
    relative_motion,
    transform_points,
)

__all__ = [
    "CameraAxes", "Channels", "DepthKind", "Direction", "Factors", "Flow", "FovAxis", "Grid",
    "MotionEstimate", "PoseDirection", "PoseLayout", "adapt_depth", "adapt_flow", "adapt_pose",
    "camera_motion", "check_intrinsics", "check_rigid", "ego_flow", "factorize", "instance_motion",
    "instance_rows", "intrinsics_from_fov", "intrinsics_from_opencv", "invert_rigid",
    "pose_from_quaternion", "project", "relative_motion", "rigid_flow", "transform_points",
    "unproject", "z_from_ray_length", "z_from_z_buffer",
]  # fmt: skip
