"""Recorded RGB-D sequences with camera poses: readers, registration, factorisation, a doctor."""

from flowrep.sequences.doctor import Diagnosis, Doctor, diagnose
from flowrep.sequences.factorization import (
    EstimatedFlowSource,
    FactorizedFrame,
    factorize_frames,
    factorize_pair,
    recorded_flow,
)
from flowrep.sequences.flow_files import (
    read_flo,
    read_kitti_flow,
    write_flo,
    write_kitti_flow,
)
from flowrep.sequences.formats import RECORDINGS, STREAMS, Stream
from flowrep.sequences.frame import Frame, Recording, SequenceError
from flowrep.sequences.frames import Frames
from flowrep.sequences.kitti import Kitti
from flowrep.sequences.registration import Registration
from flowrep.sequences.sevenscenes import SevenScenes
from flowrep.sequences.sintel import Sintel
from flowrep.sequences.tartanair import TartanAir
from flowrep.sequences.tum import Tum
from flowrep.sequences.video import StillVideo
from flowrep.sequences.vkitti2 import VKitti2
from flowrep.sequences.zed import Zed
from flowrep.sequences.zed_live import ZedLive

__all__ = [
    "RECORDINGS",
    "STREAMS",
    "Diagnosis",
    "Doctor",
    "EstimatedFlowSource",
    "FactorizedFrame",
    "Frame",
    "Frames",
    "Kitti",
    "Recording",
    "Registration",
    "SequenceError",
    "SevenScenes",
    "Sintel",
    "StillVideo",
    "Stream",
    "TartanAir",
    "Tum",
    "VKitti2",
    "Zed",
    "ZedLive",
    "diagnose",
    "factorize_frames",
    "factorize_pair",
    "read_flo",
    "read_kitti_flow",
    "recorded_flow",
    "write_flo",
    "write_kitti_flow",
]
