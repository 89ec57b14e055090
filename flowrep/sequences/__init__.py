"""Recorded RGB-D sequences with camera poses: readers, registration, factorisation, a doctor."""

from flowrep.sequences.calibration import Registration
from flowrep.sequences.doctor import Diagnosis, Doctor, diagnose
from flowrep.sequences.factorization import (
    EstimatedFlowSource,
    FactorizedFrame,
    factorize_frames,
    factorize_pair,
    recorded_flow,
)
from flowrep.sequences.files import (
    read_flo,
    read_kitti_flow,
    write_flo,
    write_kitti_flow,
)
from flowrep.sequences.frames import Frames
from flowrep.sequences.kitti import Kitti
from flowrep.sequences.recording import Frame, Recording, SequenceError, Stream
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

RECORDINGS: dict[str, type[Recording]] = {
    "frames": Frames,
    "kitti": Kitti,
    "sevenscenes": SevenScenes,
    "sintel": Sintel,
    "tartanair": TartanAir,
    "tum": Tum,
    "vkitti2": VKitti2,
    "zed": Zed,
}
STREAMS = {"video": StillVideo, "zed_live": ZedLive}
