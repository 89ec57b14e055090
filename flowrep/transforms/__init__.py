"""TorchRL transforms that turn sensor maps into mid-level representations."""

from flowrep.transforms.adapt import AdaptDepth, AdaptFlow, AdaptPose
from flowrep.transforms.body_rows import BodyRows
from flowrep.transforms.depth import Depth
from flowrep.transforms.dis import DIS
from flowrep.transforms.estimated_flow import EstimatedFlow
from flowrep.transforms.flow_factorize import FlowFactorize
from flowrep.transforms.frame_stack import FrameStack
from flowrep.transforms.instance_ids import InstanceIds
from flowrep.transforms.mirror import Mirror
from flowrep.transforms.motion import CameraMotion, InstanceMotion
from flowrep.transforms.raft import RAFT
from flowrep.transforms.raw_flow import RawFlow
from flowrep.transforms.rgb import Rgb
from flowrep.transforms.segmentation import Segmentation
from flowrep.transforms.sensor_noise import SensorNoise
from flowrep.transforms.stack import (
    REPRESENTATIONS,
    representation_options,
    representation_stack,
)

__all__ = [
    "DIS",
    "RAFT",
    "REPRESENTATIONS",
    "AdaptDepth",
    "AdaptFlow",
    "AdaptPose",
    "BodyRows",
    "CameraMotion",
    "Depth",
    "EstimatedFlow",
    "FlowFactorize",
    "FrameStack",
    "InstanceIds",
    "InstanceMotion",
    "Mirror",
    "RawFlow",
    "Rgb",
    "Segmentation",
    "SensorNoise",
    "representation_options",
    "representation_stack",
]
