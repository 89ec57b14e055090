"""Cameras, rigid motions and the flow they cause: pure batched functions that need torch alone."""

from flowrep.geometry.camera import project, unproject
from flowrep.geometry.flow import Factors, Flow, ego_flow, factorize, rigid_flow
from flowrep.geometry.rigid import invert_rigid, relative_motion, transform_points

__all__ = [
    "Factors",
    "Flow",
    "ego_flow",
    "factorize",
    "invert_rigid",
    "project",
    "relative_motion",
    "rigid_flow",
    "transform_points",
    "unproject",
]
