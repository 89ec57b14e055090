"""Each wrong convention is found and named by what corrects it; right ones are left in peace."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("cv2", reason="recordings need OpenCV")

from flowrep.geometry import (
    adapt_pose,
    ego_flow,
    invert_rigid,
    relative_motion,
    rigid_flow,
)
from flowrep.sequences import (
    Doctor,
    EstimatedFlowSource,
    Frame,
    Frames,
    SevenScenes,
    diagnose,
    recorded_flow,
)
from flowrep.sequences.doctor import _sampled, mistakes
from flowrep.transforms import DIS
from tests.geometry.scenes import rigid
from tests.sequences.synthetic import SEVEN_SCENES, needs_7scenes

HEIGHT, WIDTH = 45, 64
K = torch.tensor([[40.0, 0.0, 30.5], [0.0, 37.0, 24.0], [0.0, 0.0, 1.0]])
BEFORE = rigid((0.4, -0.7, 1.1), (3.0, -2.0, 5.0))
NOW = BEFORE @ rigid((0.01, -0.02, 0.015), (0.15, -0.05, 0.2))
LATER = NOW @ rigid((-0.02, 0.01, 0.02), (-0.05, 0.2, 0.1))


@dataclasses.dataclass(frozen=True)
class Case:
    """What the doctor is shown."""

    raw: torch.Tensor
    depth: torch.Tensor
    before: torch.Tensor = BEFORE
    now: torch.Tensor = NOW
    K: torch.Tensor = K

    def frames(self):
        poses, z, camera = (self.before, self.now), self.depth[0].numpy(), self.K.double().numpy()
        return [Frame("", Path(), pose.numpy(), camera, z) for pose in poses]

    def diagnosis(self, conventions=None, *, flow_is_recorded=True):
        doctor = Doctor(conventions or {}, flow_is_recorded=flow_is_recorded)
        doctor.look(*self.frames(), self.raw.numpy())
        return doctor.diagnosis()


def case_of(before, now, seed=0):
    """A slope with a rough surface, a quarter of which moves by itself."""
    rough = torch.rand(1, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed))
    depth = torch.linspace(2, 9, HEIGHT)[None, :, None] + rough
    instance = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.uint8)
    instance[0, 20:42, 5:38] = 1
    camera = relative_motion(before, now)
    motions = torch.stack([camera, camera @ rigid((0.0, 0.0, 0.0), (0.3, 0.1, 0.0)).float()])
    return Case(rigid_flow(depth, instance, K, motions).flow, depth, before, now)


@pytest.fixture
def right():
    return case_of(BEFORE, NOW)


def poses(case, change):
    return dataclasses.replace(case, before=change(case.before), now=change(case.now))


def depth(case, change):
    return dataclasses.replace(case, depth=change(case.depth))


def turned(axes):
    """Returns what makes poses of a camera with OpenCV's axes those of one with others."""
    given_from_opencv = adapt_pose(torch.eye(4), axes=axes)
    return lambda pose: pose @ given_from_opencv.mT


def ray_length(z):
    v, u = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    x, y = (u - 30.5) / 40, (v - 24.0) / 37
    return z * (1 + x**2 + y**2).sqrt()


def transposed(pose):
    turned = pose.clone()
    turned[:3, :3] = pose[:3, :3].mT
    return turned


# What the data are, by what has to be given for them.
WRONG = {
    "pose_direction=world_to_camera": lambda case: poses(case, invert_rigid),
    "flow_direction=backward": lambda case: dataclasses.replace(case, raw=-case.raw),
    "flow_channels=row_column": lambda case: dataclasses.replace(case, raw=case.raw.flip(0)),
    "pose_axes=opengl": lambda case: poses(case, turned("opengl")),
    "pose_axes=x_forward_z_up": lambda case: poses(case, turned("x_forward_z_up")),
    "pose_direction=world_to_camera pose_axes=opengl": lambda case: poses(
        case, lambda pose: invert_rigid(turned("opengl")(pose))
    ),
    "rotations transposed": lambda case: poses(case, transposed),
    "intrinsics times 2": lambda case: dataclasses.replace(
        case, K=K * torch.tensor([[0.5], [0.5], [1.0]])
    ),
    "depth_kind=ray_length": lambda case: depth(case, ray_length),
    "depth times 0.001": lambda case: depth(case, lambda z: 1000 * z),
    "depth times 1000": lambda case: depth(case, lambda z: z / 1000),
    "depth times 0.67": lambda case: depth(case, lambda z: 1.5 * z),
}


def test_right_conventions_are_left_in_peace(right):
    right.raw[:, :, ::7] = torch.nan
    right.depth[:, ::5] = torch.nan
    found = right.diagnosis()
    assert found.suspects == ()
    assert found.residual_px < 1e-3 < found.raw_px
    assert found.words.startswith("conventions look right")
    assert found.depth_factors[0] < 1 < found.depth_factors[1] < 1.5


@pytest.mark.parametrize("correction", WRONG)
def test_a_wrong_convention_is_named_by_what_corrects_it(correction, right):
    found = WRONG[correction](right).diagnosis()
    assert found.suspects[0] == correction
    assert found.rivals_px[correction] < 0.02
    assert found.residual_px > 0.1
    for option in correction.split():
        assert f"format.{option}" in found.words or "=" not in option


def test_the_correction_is_relative_to_the_options_in_force(right):
    # The data's axes are x_forward_z_up, and opengl was given.
    case = poses(right, lambda p: adapt_pose(turned("x_forward_z_up")(p), axes="opengl"))
    found = case.diagnosis({"pose_axes": "opengl"})
    assert found.suspects[0] == "pose_axes=x_forward_z_up"
    assert "format.pose_axes=x_forward_z_up" in found.words
    millimetres = depth(right, lambda z: 5 * z).diagnosis({"depth_unit_m": "0.001"})
    assert millimetres.suspects[0] == "depth_unit_m=0.0002"


def test_flow_that_was_estimated_here_has_no_options(right):
    # Only the order of the poses can turn it over.
    swapped = dataclasses.replace(right, before=NOW, now=BEFORE)
    found = swapped.diagnosis(flow_is_recorded=False)
    assert found.suspects[0] == "frames in reverse order"
    assert not [name for name in found.rivals_px if name.startswith("flow")]


def test_axes_that_have_no_name_are_found_from_the_motions():
    # A camera mounted 40 degrees off about two axes.
    mount = rigid((0.5, 0.0, -0.7), (0.0, 0.0, 0.0))
    doctor = Doctor()
    for case in (case_of(BEFORE, NOW), case_of(NOW, LATER, seed=1)):
        case = poses(case, lambda pose: pose @ mount)
        doctor.look(*case.frames(), case.raw.numpy())
    found = doctor.diagnosis()
    assert found.suspects[0] == "other axes"
    assert found.rivals_px["other axes"] < 0.05 < found.residual_px


def test_straight_driving_leaves_several_conventions_that_it_cannot_tell_apart():
    ahead = rigid((0.0, 0.0, 0.0), (0.0, 0.0, 0.5))
    case = WRONG["pose_direction=world_to_camera"](case_of(torch.eye(4).double(), ahead))
    found = case.diagnosis()
    assert {"pose_direction=world_to_camera", "pose_axes=opengl"} <= set(found.suspects)


def test_the_sky_is_at_infinity_as_either_kind_of_depth():
    sky = torch.full((1, HEIGHT, WIDTH), torch.inf)
    sky[0, 30, 50] = 2.0
    to_ray = mistakes({"depth_kind": "ray_length"})["depth_kind=z"]
    to_z = mistakes({})["depth_kind=ray_length"]
    case = Case(torch.zeros(2, HEIGHT, WIDTH), sky)
    pair = _sampled(*case.frames(), case.raw.numpy())
    for mistake, expected in (
        (to_z, 4.0 / float(ray_length(sky)[0, 30, 50])),
        (to_ray, float(ray_length(sky)[0, 30, 50])),
    ):
        corrected = mistake.correct(pair).depth
        assert corrected.isinf().sum() == HEIGHT * WIDTH - 1
        assert corrected[0, 30, 50].item() == pytest.approx(expected)


def test_it_is_found_in_noisy_flow_too(right):
    noise = torch.randn(right.raw.shape, generator=torch.Generator().manual_seed(1))
    noisy = dataclasses.replace(right, raw=right.raw + 0.3 * noise)
    assert noisy.diagnosis().suspects == ()
    assert WRONG["pose_axes=opengl"](noisy).diagnosis().suspects[0] == "pose_axes=opengl"
    factor = WRONG["depth times 0.67"](noisy).diagnosis().suspects[0]
    # Noise leaves the last digit of a factor open.
    assert float(factor.removeprefix("depth times ")) == pytest.approx(0.67, rel=0.1)


def test_where_most_moves_what_stands_still_can_be_told(right):
    moving = right.raw.clone()
    moving[:, :, :50] += torch.tensor([3.0, -2.0]).reshape(2, 1, 1)
    crowd = dataclasses.replace(right, raw=moving)
    static = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.bool)
    static[..., 52:] = True
    assert crowd.diagnosis().residual_px > 1
    found = diagnose(crowd.raw, crowd.depth, K, BEFORE, NOW, static=static)
    assert found.residual_px < 1e-3


def test_flow_that_no_motion_explains_and_poses_of_another_recording_are_no_convention(right):
    raw = 5 * torch.randn(right.raw.shape, generator=torch.Generator().manual_seed(2))
    noise = dataclasses.replace(right, raw=raw).diagnosis()
    other = dataclasses.replace(right, now=BEFORE @ rigid((0.1, 0.08, -0.2), (0.3, 0.5, -0.1)))
    others = other.diagnosis()
    for found in (noise, others):
        assert found.suspects == ()
        assert found.words.startswith("can't tell")
    assert others.estimated_px < 0.05 < others.residual_px


def test_a_camera_that_only_turns_leaves_the_unit_of_depth_open():
    turn = case_of(BEFORE, BEFORE @ rigid((0.05, -0.07, 0.02), (0.0, 0.0, 0.0)))
    found = depth(turn, lambda z: 1000 * z).diagnosis()
    assert found.suspects == ()
    assert math.log10(found.depth_factors[1] / found.depth_factors[0]) > 6
    assert "unit of depth" in found.words


def test_a_camera_that_stands_still_tells_nothing(right):
    still = dataclasses.replace(right, raw=torch.zeros_like(right.raw), now=BEFORE)
    assert still.diagnosis().pairs == 0
    assert still.diagnosis().suspects == ()


def test_several_pairs_are_weighed_together(right):
    doctor = Doctor()
    for mistake in ("flow_direction=backward", "flow_direction=backward", "pose_axes=opengl"):
        case = WRONG[mistake](right)
        doctor.look(*case.frames(), case.raw.numpy())
    rivals_px = doctor.diagnosis().rivals_px
    assert min(rivals_px, key=rivals_px.get) == "flow_direction=backward"


def test_large_pictures_are_sampled_without_a_shift():
    # A coarse grid with K off by half a step would leave pixels over.
    height, width = 480, 639
    camera = torch.tensor([[500.0, 0, 310.0], [0, 480.0, 250.0], [0, 0, 1]])
    rows, columns = torch.arange(height)[:, None], torch.arange(width)
    z = (1.5 + 0.01 * rows + 0.004 * columns)[None]
    raw, _ = ego_flow(z, camera, relative_motion(BEFORE, NOW))
    found = diagnose(raw, z, camera, BEFORE, NOW)
    assert found.raw_px == pytest.approx(float(raw.norm(dim=0).median()), rel=0.02)
    assert found.residual_px < 1e-3


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    """Three frames of a drive through a turn."""
    pytest.importorskip("pybullet", reason="the streets are PyBullet's")
    from examples.make_recording import make_recording

    folder = tmp_path_factory.mktemp("made") / "turn"
    make_recording(folder, scene="s_turn", frames=3, size=(90, 120), skipped=60)
    return folder


# Options that say what the recording is not, and what corrects them.
GIVEN = [
    ({}, None),
    ({"pose_direction": "world_to_camera"}, "pose_direction=camera_to_world"),
    ({"pose_axes": "opengl"}, "pose_axes=opencv"),
    ({"flow_direction": "backward"}, "flow_direction=forward"),
    ({"flow_channels": "row_column"}, "flow_channels=uv"),
    ({"depth_unit_m": 1.5}, "depth_unit_m="),
    ({"depth_kind": "ray_length"}, "depth_kind=z"),
]


@pytest.mark.parametrize(("options", "correction"), GIVEN, ids=str)
def test_the_doctor_corrects_the_options_of_a_recorded_street(options, correction, street):
    read = Frames(street, **options)
    doctor = Doctor(read.conventions)
    for previous, current in pairwise(read):
        doctor.look(previous, current, recorded_flow(previous, current))
    found = doctor.diagnosis()
    assert bool(found.suspects) == bool(correction), found.words
    if correction is not None:
        assert any(suspect.startswith(correction) for suspect in found.suspects), found.words


OPENGL = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
REAL = {
    "": (1.0, lambda pose: pose),
    "depth times 0.001": (1000.0, lambda pose: pose),
    "depth times 0.5": (2.0, lambda pose: pose),
    "pose_direction=world_to_camera": (1.0, invert_rigid),
    "pose_axes=opengl": (1.0, lambda pose: pose @ OPENGL),
}


@pytest.fixture(scope="module")
def real_pairs():
    """Pairs of frames of a real room, and their estimated flow."""
    recording = SevenScenes(SEVEN_SCENES)
    pairs = [(recording[before], recording[now]) for before, now in ((0, 1), (1, 2))]
    source = EstimatedFlowSource(DIS("fast"))
    return [(*pair, source(*pair)) for pair in pairs]


@needs_7scenes
@pytest.mark.parametrize("correction", REAL)
def test_mistakes_about_a_real_recording_are_named(correction, real_pairs):
    factor, change = REAL[correction]
    doctor = Doctor(flow_is_recorded=False)
    for *pair, raw in real_pairs:
        wrong = [
            dataclasses.replace(
                frame,
                depth=np.float32(factor) * frame.depth,
                world_from_cam=change(torch.from_numpy(frame.world_from_cam)).numpy(),
            )
            for frame in pair
        ]
        doctor.look(*wrong, raw)
    assert doctor.diagnosis().suspects[:1] == ((correction,) if correction else ())
