"""Recorded RGB-D sequences: readers, registration, factorisation, a doctor."""

from flowrep.extras import require

require("flowrep.sequences", "factorize", "cv2", "pydantic")

from flowrep.sequences.calibration import Registration
from flowrep.sequences.doctor import Diagnosis, Doctor, diagnose
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
from flowrep.sequences.files import read_flo, read_kitti_flow, write_flo, write_kitti_flow
from flowrep.sequences.frames import Frames, Zed
from flowrep.sequences.kitti import Kitti
from flowrep.sequences.recording import Frame, Recording, SequenceError, Stream
from flowrep.sequences.rendered import Sintel, TartanAir, VKitti2
from flowrep.sequences.sevenscenes import SevenScenes
from flowrep.sequences.tum import Tum
from flowrep.sequences.video import StillVideo

__all__ = [
    "Diagnosis", "Doctor", "EstimatedFlowSource", "FactorizedFrame", "Frame", "Frames", "Kitti",
    "Motion", "Recording", "Registration", "SequenceError", "SevenScenes", "Sintel", "StillVideo",
    "Stream", "TartanAir", "Tum", "VKitti2", "Zed", "diagnose", "estimated_motion",
    "factorize_frames", "factorize_pair", "read_flo", "read_kitti_flow", "recorded_flow",
    "recorded_motion", "write_flo", "write_kitti_flow",
]  # fmt: skip
