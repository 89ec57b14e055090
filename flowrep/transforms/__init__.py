"""TorchRL transforms that turn sensor maps into mid-level representations.

`*B` is any leading batch. Every transform takes `in_keys` and `out_keys`: as in TorchRL, one key (a
string, or a tuple of strings if nested) or a list of keys. The defaults are in its table.

A constructor raises ValueError for an invalid argument, and names it. A call raises ValueError for
an input of the wrong layout, and `MissingKey`, a KeyError, for a missing input.
"""

from flowrep.transforms.adapt import AdaptDepth, AdaptFlow, AdaptPose, BodyRows
from flowrep.transforms.estimated_flow import DIS, RAFT, EstimatedFlow
from flowrep.transforms.flow import FlowFactorize, RawFlow
from flowrep.transforms.frame_stack import FrameStack
from flowrep.transforms.maps import Depth, InstanceIds, Rgb, Segmentation
from flowrep.transforms.mirror import Mirror
from flowrep.transforms.motion import (
    CameraMotion,
    EstimateCameraMotion,
    InstanceMotion,
    PreviousIntrinsics,
)
from flowrep.transforms.noise import SensorNoise
from flowrep.transforms.representations import (
    REPRESENTATIONS,
    representation_options,
    representation_stack,
)
from flowrep.transforms.simulators import CONVENTIONS, Convention, sensors_from

__all__ = [
    "CONVENTIONS", "DIS", "RAFT", "REPRESENTATIONS", "AdaptDepth", "AdaptFlow", "AdaptPose",
    "BodyRows", "CameraMotion", "Convention", "Depth", "EstimateCameraMotion", "EstimatedFlow",
    "FlowFactorize", "FrameStack", "InstanceIds", "InstanceMotion", "Mirror",
    "PreviousIntrinsics", "RawFlow", "Rgb", "Segmentation", "SensorNoise", "representation_options",
    "representation_stack", "sensors_from",
]  # fmt: skip
