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

from flowrep import geometry, sequences
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

    def shown_to(self, doctor):
        poses, z, camera = (self.before, self.now), self.depth[0].numpy(), self.K.double().numpy()
        frames = [sequences.Frame("", Path(), pose.numpy(), camera, z) for pose in poses]
        doctor.look(*frames, self.raw.numpy())
        return doctor

    def diagnosis(self, *conventions, flow_is_recorded=True):
        doctor = sequences.Doctor(*conventions, flow_is_recorded=flow_is_recorded)
        return self.shown_to(doctor).diagnosis()


def case_of(before, now, seed=0):
    """A slope with a rough surface, a quarter of which moves by itself."""
    rough = torch.rand(1, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(seed))
    depth = torch.linspace(2, 9, HEIGHT)[None, :, None] + rough
    instance = torch.zeros(1, HEIGHT, WIDTH, dtype=torch.uint8)
    instance[0, 20:42, 5:38] = 1
    camera = geometry.relative_motion(before, now)
    motions = torch.stack([camera, camera @ rigid((0.0, 0.0, 0.0), (0.3, 0.1, 0.0)).float()])
    return Case(geometry.rigid_flow(depth, instance, K, motions).flow, depth, before, now)


@pytest.fixture
def right():
    return case_of(BEFORE, NOW)


def changed(case, **changes):
    """Returns a case with each value, or both poses, put through a function."""
    if pose := changes.pop("pose", None):
        changes |= {"before": pose, "now": pose}
    values = {name: change(getattr(case, name)) for name, change in changes.items()}
    return dataclasses.replace(case, **values)


def turned(axes):
    """Returns what makes poses of a camera with OpenCV's axes those of one with others."""
    given_from_opencv = geometry.adapt_pose(torch.eye(4), axes=axes)
    return lambda pose: pose @ given_from_opencv.mT


def ray_length(z):
    v, u = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    x, y = (u - 30.5) / 40, (v - 24.0) / 37
    return z * (1 + x**2 + y**2).sqrt()


ROTATION = torch.arange(4) < torch.tensor([3, 3, 3, 0])[:, None]  # of a pose
# What the data are, by what has to be given for them.
WRONG = {
    "pose_direction=world_to_camera": {"pose": geometry.invert_rigid},
    "flow_direction=backward": {"raw": torch.neg},
    "flow_channels=row_column": {"raw": lambda raw: raw.flip(0)},
    "pose_axes=opengl": {"pose": turned("opengl")},
    "pose_axes=x_forward_z_up": {"pose": turned("x_forward_z_up")},
    "pose_direction=world_to_camera pose_axes=opengl": {
        "pose": lambda pose: geometry.invert_rigid(turned("opengl")(pose))
    },
    "rotations transposed": {"pose": lambda pose: torch.where(ROTATION, pose.mT, pose)},
    "intrinsics times 2": {"K": lambda K: K * torch.tensor([[0.5], [0.5], [1.0]])},
    "depth_kind=ray_length": {"depth": ray_length},
    "depth times 0.001": {"depth": lambda z: 1000 * z},
    "depth times 1000": {"depth": lambda z: z / 1000},
    "depth times 0.67": {"depth": lambda z: 1.5 * z},
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
    found = changed(right, **WRONG[correction]).diagnosis()
    assert found.suspects[0] == correction
    assert found.rivals_px[correction] < 0.02
    assert found.residual_px > 0.1
    for option in correction.split():
        assert f"format.{option}" in found.words or "=" not in option


def test_the_correction_is_relative_to_the_options_in_force(right):
    # The data's axes are x_forward_z_up, and opengl was given.
    wrong = turned("x_forward_z_up")
    case = changed(right, pose=lambda pose: geometry.adapt_pose(wrong(pose), axes="opengl"))
    found = case.diagnosis({"pose_axes": "opengl"})
    assert found.suspects[0] == "pose_axes=x_forward_z_up"
    assert "format.pose_axes=x_forward_z_up" in found.words
    millimetres = changed(right, depth=lambda z: 5 * z).diagnosis({"depth_unit_m": "0.001"})
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
    doctor = sequences.Doctor()
    for case in (case_of(BEFORE, NOW), case_of(NOW, LATER, seed=1)):
        changed(case, pose=lambda pose: pose @ mount).shown_to(doctor)
    found = doctor.diagnosis()
    assert found.suspects[0] == "other axes"
    assert found.rivals_px["other axes"] < 0.05 < found.residual_px


def test_straight_driving_leaves_several_conventions_that_it_cannot_tell_apart():
    ahead = rigid((0.0, 0.0, 0.0), (0.0, 0.0, 0.5))
    found = changed(case_of(torch.eye(4).double(), ahead), pose=geometry.invert_rigid).diagnosis()
    assert {"pose_direction=world_to_camera", "pose_axes=opengl"} <= set(found.suspects)


def test_the_sky_is_at_infinity_as_either_kind_of_depth(right):
    # Were it nan once corrected, nothing would explain the flow of most of the picture.
    right.depth[:, :30] = torch.inf
    ego = geometry.ego_flow(right.depth, K, geometry.relative_motion(BEFORE, NOW)).flow
    right.raw[:, :30] = ego[:, :30]
    ray = changed(right, depth=ray_length).diagnosis()
    assert ray.rivals_px["depth_kind=ray_length"] < 0.02
    corrected_twice = changed(right, depth=lambda z: z / ray_length(torch.ones_like(z)))
    found = corrected_twice.diagnosis({"depth_kind": "ray_length"})
    assert found.rivals_px["depth_kind=z"] < 0.02


def test_it_is_found_in_noisy_flow_too(right):
    noise = torch.randn(right.raw.shape, generator=torch.Generator().manual_seed(1))
    noisy = changed(right, raw=lambda raw: raw + 0.3 * noise)
    assert noisy.diagnosis().suspects == ()
    turned_over = changed(noisy, pose=turned("opengl")).diagnosis()
    assert turned_over.suspects[0] == "pose_axes=opengl"
    factor = changed(noisy, depth=lambda z: 1.5 * z).diagnosis().suspects[0]
    # Noise leaves the last digit of a factor open.
    assert float(factor.removeprefix("depth times ")) == pytest.approx(0.67, rel=0.1)


def test_where_most_moves_what_stands_still_can_be_told(right):
    right.raw[:, :, :50] += torch.tensor([3.0, -2.0]).reshape(2, 1, 1)
    assert right.diagnosis().residual_px > 1
    static = (torch.arange(WIDTH) >= 52).expand(1, HEIGHT, WIDTH)
    found = sequences.diagnose(right.raw, right.depth, K, BEFORE, NOW, static=static)
    assert found.residual_px < 1e-3


def test_flow_that_no_motion_explains_and_poses_of_another_recording_are_no_convention(right):
    random = torch.Generator().manual_seed(2)
    noise = changed(right, raw=lambda raw: 5 * torch.randn(raw.shape, generator=random)).diagnosis()
    other = dataclasses.replace(right, now=BEFORE @ rigid((0.1, 0.08, -0.2), (0.3, 0.5, -0.1)))
    others = other.diagnosis()
    for found in (noise, others):
        assert found.suspects == ()
        assert found.words.startswith("can't tell")
    assert others.estimated_px < 0.05 < others.residual_px


def test_a_camera_that_only_turns_leaves_the_unit_of_depth_open():
    turn = case_of(BEFORE, BEFORE @ rigid((0.05, -0.07, 0.02), (0.0, 0.0, 0.0)))
    found = changed(turn, depth=lambda z: 1000 * z).diagnosis()
    assert found.suspects == ()
    assert math.log10(found.depth_factors[1] / found.depth_factors[0]) > 6
    assert "unit of depth" in found.words


def test_a_camera_that_stands_still_tells_nothing(right):
    found = dataclasses.replace(right, raw=0 * right.raw, now=BEFORE).diagnosis()
    assert (found.pairs, found.suspects) == (0, ())


def test_several_pairs_are_weighed_together(right):
    doctor = sequences.Doctor()
    for mistake in ("flow_direction=backward", "flow_direction=backward", "pose_axes=opengl"):
        changed(right, **WRONG[mistake]).shown_to(doctor)
    rivals_px = doctor.diagnosis().rivals_px
    assert min(rivals_px, key=rivals_px.get) == "flow_direction=backward"


def test_large_pictures_are_sampled_without_a_shift():
    # A coarse grid with K off by half a step would leave pixels over.
    height, width = 480, 639
    camera = torch.tensor([[500.0, 0, 310.0], [0, 480.0, 250.0], [0, 0, 1]])
    rows, columns = torch.arange(height)[:, None], torch.arange(width)
    z = (1.5 + 0.01 * rows + 0.004 * columns)[None]
    raw, _ = geometry.ego_flow(z, camera, geometry.relative_motion(BEFORE, NOW))
    found = sequences.diagnose(raw, z, camera, BEFORE, NOW)
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
    read = sequences.open_recording(street, "frames", **options)
    doctor = sequences.Doctor(read.conventions)
    for previous, current in pairwise(read):
        doctor.look(previous, current, sequences.recorded_flow(previous, current))
    found = doctor.diagnosis()
    if correction is None:  # depth, poses and flow are rounded to float32 alone
        assert (found.suspects, found.residual_px < 1e-3) == ((), True), found.words
    else:
        assert any(suspect.startswith(correction) for suspect in found.suspects), found.words


@needs_7scenes
def test_mistakes_about_a_real_recording_are_named():
    recording = sequences.open_recording(SEVEN_SCENES, "sevenscenes")
    estimate = sequences.EstimatedFlowSource(DIS("fast"))
    real = [(*pair, estimate(*pair)) for pair in pairwise(recording[i] for i in range(3))]
    wrong = {
        None: lambda frame: {},
        "depth times 0.001": lambda frame: {"depth": 1000 * frame.depth},
        "pose_direction=world_to_camera": lambda frame: {
            "world_from_cam": np.linalg.inv(frame.world_from_cam)
        },
    }
    for correction, changes in wrong.items():
        doctor = sequences.Doctor(flow_is_recorded=False)
        for *pair, raw in real:
            doctor.look(*(dataclasses.replace(frame, **changes(frame)) for frame in pair), raw)
        assert doctor.diagnosis().suspects[:1] == ((correction,) if correction else ())
