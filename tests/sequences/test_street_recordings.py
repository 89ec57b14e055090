"""The project's own streets, recorded in each format, come back with the simulator's object flow.

TartanAir fixes its camera and KITTI's scene flow has GPS and disparity: neither can hold a street's
camera, and tests/sequences/test_readers.py writes both with cameras of theirs.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

pytest.importorskip("cv2", reason="recordings need OpenCV")
pytest.importorskip("pybullet", reason="the streets are PyBullet's")

from examples.make_recording import make_recording
from flowrep.envs import StreetEnv
from flowrep.envs.sensing import SENSORS, CameraPose
from flowrep.geometry import factorize, rigid_flow
from flowrep.scenes import load_scene
from flowrep.sequences import (
    Doctor,
    EstimatedFlowSource,
    Frames,
    SevenScenes,
    Sintel,
    Tum,
    VKitti2,
    Zed,
    factorize_frames,
    recorded_flow,
)
from flowrep.sequences.factorization import picture_of
from flowrep.simulator.camera import vehicle_from_camera
from flowrep.transforms import DIS
from tests.sequences import synthetic
from tests.sequences.synthetic import Moment, from_first_pixel

HEIGHT, WIDTH = 48, 64
ROUNDING_PX = 5e-4


@pytest.fixture(scope="module")
def street():
    """K, and what the simulator says of five steps: the vehicle turns, people walk before it."""
    scene = load_scene("straight_road")
    camera = replace(scene.camera, height_px=HEIGHT, width_px=WIDTH)
    env = StreetEnv(replace(scene, camera=camera), sensors=SENSORS)
    mount = vehicle_from_camera(camera)
    moments = []
    try:
        env.reset(seed=3)
        for _ in range(21):
            env.drive(0)
        for action in (1, 1, 1, 2, 2):
            observation, *_ = env.step(action)
            x_m, y_m, yaw_rad, _ = env.episode.now.vehicle
            pose = CameraPose(x_m, y_m, yaw_rad, mount).world_from_cam
            moments.append(moment_of(observation, env.K, pose))
    finally:
        env.close()
    return np.asarray(env.K, dtype=np.float64), moments


def moment_of(observation, K, world_from_cam) -> Moment:
    sensor = {name: torch.from_numpy(values) for name, values in observation.items()}
    camera = torch.as_tensor(K).float()
    raw = rigid_flow(sensor["depth"], sensor["instance"], camera, sensor["instance_motion"]).flow
    obj = factorize(raw, sensor["depth"], camera, sensor["prev_from_curr"]).obj
    rgb = observation["rgb"].transpose(1, 2, 0)
    return Moment(rgb, observation["depth"][0], world_from_cam, raw.numpy(), obj.numpy())


def off_by(moment, previous, K, unit_m):
    """Returns how far object flow goes if depth is off by half a unit, [2, H, W]."""
    motion = torch.from_numpy(np.linalg.inv(previous.world_from_cam) @ moment.world_from_cam)
    raw, camera = torch.from_numpy(moment.raw), torch.from_numpy(K).float()
    nearer, right, farther = (
        factorize(raw, torch.from_numpy(moment.depth + by)[None], camera, motion).obj.numpy()
        for by in (-unit_m / 2, 0, unit_m / 2)
    )
    return np.maximum(np.abs(nearer - right), np.abs(farther - right))


# Format: how it is written, how it is opened, whether it has flow of its own, whether its files run
# against time, the metres that 1 stands for in its depth, and how many pixels are near enough.
FORMATS = {
    "frames": (synthetic.write_frames, lambda f, K: Frames(f), True, False, 0.001, 0.5),
    "tum": (
        lambda f, moments, K: synthetic.write_tum(f, moments),
        lambda f, K: Tum(f, intrinsics=from_first_pixel(K)),
        False, False, 1 / 5000, 0.3,
    ),
    "sevenscenes": (
        lambda f, moments, K: synthetic.write_sevenscenes(f, moments),
        lambda f, K: SevenScenes(
            f, depth_intrinsics=entries(K), colour_intrinsics=entries(K)
        ),
        False, False, 0.001, 0.5,
    ),
    "vkitti2": (synthetic.write_vkitti2, lambda f, K: VKitti2(f), True, False, 0.01, 1.0),
    "sintel": (
        synthetic.write_sintel,
        lambda f, K: Sintel(f, scene="cave", backwards=True),
        True, True, 0, 0.5,
    ),
    "zed": (synthetic.write_zed, lambda f, K: Zed(f), False, False, 0.001, 0.5),
}  # fmt: skip


def entries(K):
    return tuple(float(value) for value in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))


@pytest.mark.slow_after_first
@pytest.mark.parametrize("name", FORMATS)
def test_a_recorded_street_has_the_simulators_object_flow(name, street, tmp_path):
    write, open_it, has_flow, against_time, unit_m, least_share = FORMATS[name]
    K, moments = street
    write(tmp_path, moments[::-1] if against_time else moments, K)
    recording = open_it(tmp_path, K)
    np.testing.assert_allclose(recording[0].K, K, atol=1e-6)
    truth = iter(moments[1:])
    source = recorded_flow if has_flow else lambda previous, current: next(truth).raw
    first, *others = factorize_frames(recording, source)
    assert first is None
    assert len(others) == 4
    flow_step_px = (WIDTH - 1) / 65535 if name == "vkitti2" else 0
    for made, moment, previous in zip(others, moments[1:], moments):
        measured = made.valid
        assert measured.mean() >= least_share
        # What has depth is valid, but for what the format can't hold.
        np.testing.assert_array_equal(measured, ~np.isnan(made.frame.depth))
        slack_px = off_by(moment, previous, K, unit_m) + flow_step_px + ROUNDING_PX
        assert (np.abs(made.obj - moment.obj) <= slack_px)[:, measured].all()
        # The bound is narrow: far below the flow of those who walk, and of the camera.
        walks = np.hypot(*moment.obj) > 0.3
        assert (walks & measured).sum() >= 10
        assert slack_px[:, walks & measured].max() < 0.1
        assert np.median(np.hypot(*made.ego)[measured]) > 50 * np.median(slack_px[:, measured])


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


def test_the_recording_is_one_that_the_simulator_would_confirm(recording):
    first, *others = factorize_frames(Frames(recording), recorded_flow)
    assert first is None
    assert len(others) == 5
    for made in others:
        assert made.valid.mean() > 0.9
        assert np.median(np.hypot(*made.obj)[made.valid]) < 1e-3
        assert np.median(np.hypot(*made.ego)[made.valid]) > 1
