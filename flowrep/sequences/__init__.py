"""Recorded RGB-D sequences: readers, registration, factorisation."""

from flowrep.extras import require

require("flowrep.sequences", "factorize", "cv2", "pydantic")

from flowrep.sequences.calibration import Registration
from flowrep.sequences.declared import DeclaredRecording
from flowrep.sequences.factorization import (
    EstimatedFlowSource,
    FactorizedFrame,
    Motion,
    estimated_motion,
    factorize_frames,
    factorize_pair,
    recorded_flow,
    recorded_motion,
)
from flowrep.sequences.files import read_flow, write_flo, write_kitti_flow
from flowrep.sequences.formats import open_recording
from flowrep.sequences.kitti import Kitti
from flowrep.sequences.recording import Frame, Recording, SequenceError, Stream
from flowrep.sequences.rosbag import RosBag
from flowrep.sequences.video import StillVideo

__all__ = [
    "DeclaredRecording", "EstimatedFlowSource", "FactorizedFrame", "Frame", "Kitti", "Motion",
    "Recording", "Registration", "RosBag", "SequenceError", "StillVideo", "Stream",
    "estimated_motion", "factorize_frames", "factorize_pair", "open_recording", "read_flow",
    "recorded_flow", "recorded_motion", "write_flo", "write_kitti_flow",
]  # fmt: skip
