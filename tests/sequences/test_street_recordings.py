"""A street that examples/make_recording.py records: its flow, and the doctor's advice about it."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

pytest.importorskip("cv2", reason="recordings need OpenCV")
pytest.importorskip("pybullet", reason="the streets are PyBullet's")

from examples.make_recording import make_recording
from flowrep.sequences import (
    Doctor,
    EstimatedFlowSource,
    Frames,
    factorize_frames,
    recorded_flow,
)
from flowrep.sequences.factorization import picture_of
from flowrep.transforms import DIS


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """Six frames of a drive through a turn."""
    folder = tmp_path_factory.mktemp("made") / "turn"
    make_recording(folder, scene="s_turn", frames=6, size=(120, 160), skipped=60)
    return folder


# Options that say what the recording is not, and what corrects them.
WRONG = {
    "right": ({}, None),
    "direction": ({"pose_direction": "world_to_camera"}, "pose_direction=camera_to_world"),
    "axes": ({"pose_axes": "opengl"}, "pose_axes=opencv"),
    "ned": ({"pose_axes": "ned"}, "pose_axes=opencv"),
    "flow": ({"flow_direction": "backward"}, "flow_direction=forward"),
    "channels": ({"flow_channels": "row_column"}, "flow_channels=uv"),
    "unit": ({"depth_unit_m": 0.001}, "depth_unit_m=1"),
    "1.5": ({"depth_unit_m": 1.5}, "depth_unit_m="),
    "ray": ({"depth_kind": "ray_length"}, "depth_kind=z"),
}


@pytest.mark.parametrize(
    ("name", "flow"),
    [(name, "exact") for name in WRONG]
    + [(name, "estimated") for name in ("right", "axes", "unit")],
)
def test_the_doctor_corrects_the_options_of_a_recorded_street(name, flow, recording):
    options, correction = WRONG[name]
    frames = list(read := Frames(recording, **options))
    source = recorded_flow if flow == "exact" else EstimatedFlowSource(DIS("medium"))
    doctor = Doctor(read.conventions, flow_is_recorded=flow == "exact")
    for previous, current in pairwise(frames):
        doctor.look(
            torch.from_numpy(source(previous, current)),
            torch.from_numpy(current.depth)[None],
            torch.from_numpy(current.K),
            torch.from_numpy(previous.world_from_cam),
            torch.from_numpy(current.world_from_cam),
            picture=None if flow == "exact" else picture_of(current),
        )
    found = doctor.diagnosis()
    assert bool(found.suspects) == bool(correction), found.words
    if correction is not None:
        assert any(suspect.startswith(correction) for suspect in found.suspects), found.words


def test_people_move_and_the_street_stands_still(tmp_path):
    make_recording(tmp_path / "street", frames=4, size=(60, 80), skipped=20, seed=3)
    first, *others = factorize_frames(Frames(tmp_path / "street"), recorded_flow)
    assert first is None
    assert len(others) == 3
    for made in others:
        obj_px = np.hypot(*made.obj)[made.valid]
        assert made.valid.mean() > 0.95
        # Depth, poses and flow are rounded to float32 alone.
        assert np.quantile(obj_px, 0.9) < 1e-3
        assert (obj_px > 0.3).sum() >= 10
        assert np.median(np.hypot(*made.ego)[made.valid]) > 1
