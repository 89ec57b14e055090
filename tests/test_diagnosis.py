"""Right data are right, and mistakes that separate code has put into them are found.

benchmarks/diagnosis.py draws the data and has rates; a few of its cells are computed here.
"""

from __future__ import annotations

import dataclasses
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from tensordict import TensorDict

from benchmarks.diagnosis import ADMITTED, examined, found_of, outcome, tensordict_of
from benchmarks.mistakes import FLU, LISTED, OPENGL, UNLISTED
from benchmarks.mistakes import drawn as mistaken
from benchmarks.shots import draw, frames_of
from flowrep import diagnose, diagnosis, geometry, transforms
from flowrep.diagnosis import Examination
from flowrep.diagnosis.explanation import agreed
from flowrep.diagnosis.mistakes import mistakes_of

drawn = cache(draw)
ROOM, NOISY, STREET_ENV, BODIES_ENV = 39, 45, 0, 3  # hand-held or hovering; the first is exact


def with_mistake(name, seed=ROOM):
    mistake = LISTED[name][0] if name in LISTED else UNLISTED[name]
    return mistake(drawn(seed), np.random.default_rng(seed))


RIGHT = {
    "hand-held": ROOM, "noisy": NOISY, "an env's street": STREET_ENV, "bodies": BODIES_ENV,
    # where flow "divided by the size" fits better: bodies fill 60 % of the pictures
    "at rest, so that flow says nothing of its conventions": 75095,
    "bodies whose motions leave little, though others leave less": 75116,
    "bodies beside a straight drive over terrain": 79014,
    "by flow, a motion of few pixels": 83427,
}  # fmt: skip


@pytest.mark.slow_after_first
@pytest.mark.parametrize("seed", RIGHT.values(), ids=RIGHT)
def test_right_data_are_right(seed):
    found = found_of(drawn(seed))
    assert found.is_right, found
    assert found.error_px < 0.15 * found.raw_px


# Backing out between bodies; over a level floor; with rough poses, of bodies too; flow shows rest.
@pytest.mark.slow_after_first
@pytest.mark.parametrize("seed", [48, 79123, 81001, 79186])
def test_noise_shows_no_mistake_in_right_data(seed):
    assert not found_of(drawn(seed)).is_wrong


def test_a_camera_at_rest_with_rough_poses_is_right_since_flow_is_noise():
    assert found_of(drawn(119)).is_right


def test_the_recorded_motion_may_be_that_of_fewer_than_half_of_the_pixels():
    found = found_of(drawn(30046))
    assert found.is_right
    (share,) = [int(x.split("%")[0]) for x in found.notes if "of pixels don't fit" in x]
    assert share > 55


def test_pairs_in_which_a_body_fills_the_picture_are_no_mistake():
    found = found_of(drawn(53))
    assert found.verdict == "can't tell"
    assert "6, 7, 8, or a body fills the picture" in found.words


def test_only_nats_on_which_pairs_agree_count():
    # The sum of twelve fours is 48; twelve of 14 and -6 have it too, but a deviation of 10 each,
    # clamped to 10 and -6: 24 less 2 √12 8.
    assert agreed(torch.full((12,), 4.0)) == pytest.approx(48)
    assert agreed(torch.tensor([14.0, -6.0] * 6)) == pytest.approx(24 - 2 * 12**0.5 * 8)
    assert agreed(torch.tensor([100.0])) == 50  # a single pair may decide


def test_noise_of_poses_cancels_over_successive_pairs_and_a_drift_does_not():
    random, right = np.random.default_rng(1), drawn(ROOM)
    noise = random.normal(0, 0.004, (len(right.poses), 3))
    rough, drifting = right.poses.copy(), right.poses.copy()
    rough[:, :3, 3] += noise
    drifting[:, :3, 3] += noise.cumsum(0)
    of_poses, of_motions = (examined(right.with_(poses=poses)) for poses in (rough, drifting))
    assert of_poses.is_right
    assert of_poses.error_px < 0.5 * of_motions.error_px


def test_flow_that_mostly_follows_no_motion_is_not_called_right():
    right, random = drawn(ROOM), np.random.default_rng(0)
    flow, is_lost = right.flow.copy(), random.random(right.flow.shape[-2:]) < 0.7
    flow[:, :, is_lost] = random.uniform(-15, 15, flow[:, :, is_lost].shape)
    found = examined(right.with_(flow=flow))
    assert (found.verdict, "follow no motion" in found.words) == ("can't tell", True)


def test_a_unit_by_which_all_is_far_away_explains_nothing():
    # Depth looks the same wherever the camera is on this street, and of far things always.
    _, found, _ = outcome(drawn(74154), *mistaken(drawn(74154), 74154))
    assert "depth times 1.05e+03" in found.corrected_px
    assert not found.suspects


def test_depth_that_half_of_the_pictures_lack_can_be_examined_without_poses():
    right = drawn(ROOM)
    depth = right.depth.copy()
    depth[..., depth.shape[-1] // 2 :] = np.nan
    found = examined(right.with_(depth=depth, poses=np.full_like(right.poses, np.nan)))
    assert not found.is_wrong


@pytest.mark.slow_after_first
@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("poses world-to-camera", ROOM), ("poses OpenGL", NOISY), ("poses a frame late", ROOM),
        ("depth in mm", NOISY), ("flow backward", ROOM), ("K of another size", ROOM),
        ("poses NED", STREET_ENV), ("depth in mm", STREET_ENV),
        ("depth upside down", 70156),  # where it was turned back, a third of it is unknown
        ("flow to the next frame", ROOM),  # the last frame has no next one
    ],
)  # fmt: skip
def test_a_listed_mistake_is_named(name, seed):
    wrong = with_mistake(name, seed)
    kind, found, _ = outcome(drawn(seed), name, LISTED[name][1], wrong)
    assert kind == "named", found


@pytest.mark.parametrize(
    "name", ["poses that roll", "poses of another time", "flow of a flipped picture"]
)
def test_a_mistake_that_nobody_listed_is_noticed(name):
    assert found_of(with_mistake(name)).is_wrong


OF_BODIES = "on bodies, ids, instance_motion, depth and K don't fit"
DRAWN = {
    # half of depth plus 16 m, and depth is some 12 m: multiple and offset have to change together
    "an offset larger than depth": (76183, "noticed", "depth has an offset"),
    "bodies that are called at rest": (76276, "noticed", OF_BODIES),
    "motions of bodies, halved": (76424, "noticed", OF_BODIES),
    "a crop beside a body, of which pictures show a part too": (84232, "named", ""),
    "less than pictures of a street show": (84364, "can't tell", "would not show"),
    "less than pictures of terrain show": (84399, "can't tell", "would not show"),
    "poses that flow contradicts": (74166, "can't tell", "or flow was estimated wrongly"),
}


@pytest.mark.slow_after_first
@pytest.mark.parametrize(("seed", "kind", "words"), DRAWN.values(), ids=DRAWN)
def test_a_mistake_is_called_what_the_data_show_of_it(seed, kind, words):
    called, found, _ = outcome(drawn(seed), *mistaken(drawn(seed), seed))
    assert (called, words in found.words) == (kind, True), found


@pytest.mark.parametrize(("seed", "factor"), [(10, 57.3), (18, 1 / 57.3)])
def test_rotations_in_another_unit_are_no_listed_mistake_that_explains_a_part_of_them(seed, factor):
    right = drawn(seed)
    turns = Rotation.from_matrix(right.poses[:, :3, :3]).as_rotvec()
    wrong = right.poses.copy()
    wrong[:, :3, :3] = Rotation.from_rotvec(factor * turns).as_matrix()
    found = examined(right.with_(poses=wrong))
    assert found.verdict == "something is wrong"


def test_a_mistake_and_another_that_fits_as_well_are_told_together():
    kind, found, _ = outcome(drawn(73047), *mistaken(drawn(73047), 73047))
    assert kind == "named"
    assert any(name.startswith("marker_from_cam") for name in found.suspects)
    assert len(found.suspects) <= 3


def test_flow_to_the_next_frame_is_no_mistake_where_the_camera_moves_evenly():
    assert found_of(with_mistake("flow to the next frame", 93)).is_right


def test_every_mistake_changes_the_data():
    for name in [*LISTED, *UNLISTED]:
        if not name.startswith("bodies"):
            wrong, right = with_mistake(name), drawn(ROOM)
            same = [np.array_equal(getattr(wrong, n), getattr(right, n), equal_nan=True)
                    for n in ("depth", "poses", "K", "flow")]  # fmt: skip
            assert not all(same), name


def test_the_option_that_corrects_is_relative_to_the_options_in_force():
    # The data's axes are x_forward_z_up, and opengl was given: its columns are right, up, back.
    right, given = drawn(ROOM), {"pose_axes": "opengl", "depth_unit_m": "0.001"}
    found = examined(right.with_(poses=right.poses @ FLU @ OPENGL), given)
    assert found.suspects == ("pose_axes=x_forward_z_up",)
    assert "format.pose_axes=x_forward_z_up" in found.words
    found = examined(right.with_(depth=5 * right.depth), given | {"pose_axes": "opencv"})
    assert "format.depth_unit_m=0.0002" in found.words
    found = examined(right.with_(K=right.K * [[0.8], [0.8], [1]]), given | {"pose_axes": "opencv"})
    assert found.suspects[0].startswith("K times 1.25")  # and none that changes
    assert "format.intrinsics=[" in found.words


def test_a_camera_that_is_turned_half_around_on_its_mount_is_named():
    right, turn = drawn(ROOM), np.eye(4)
    turn[:3, :3] = Rotation.from_euler("z", 195, degrees=True).as_matrix()
    found = examined(right.with_(poses=right.poses @ turn))
    assert any(name.startswith("marker_from_cam=[") for name in found.suspects), found
    assert "165.0 degrees" in found.words


def test_a_direction_that_depth_hardly_shows_is_no_right_motion():
    # A camera before a frontal wall: depth alone can't tell that it moves aside.
    z = torch.full((12, 1, 40, 60), 4.0)
    motion = torch.eye(4).repeat(12, 1, 1)
    motion[:, 0, 3] = 0.1
    frames = TensorDict({"sensor": {"depth": z, "prev_from_curr": motion}}, [12])
    K = torch.tensor([[50.0, 0, 30], [0, 50, 20], [0, 0, 1]])
    assert diagnose(frames, K).verdict == "can't tell"


def test_an_identity_among_the_poses_is_named_by_its_frame_and_does_not_decide():
    poses = drawn(NOISY).poses.copy()
    poses[7] = np.eye(4)
    found = examined(drawn(NOISY).with_(poses=poses))
    assert any(note.endswith(": 7, 8") for note in found.notes), found


def test_without_poses_flow_depth_and_K_are_judged_among_themselves():
    frames, (found, wrong) = frames_of(drawn(ROOM)), (Examination(), Examination())
    for previous, current in pairwise(frames):
        pair = [dataclasses.replace(frame, world_from_cam=None) for frame in (previous, current)]
        assert found.add(*pair, pair[1].raw)
        wrong.add(*pair, pair[1].raw[::-1].copy())
    right = found.diagnosis()
    assert right.is_right
    assert any("not tested" in note for note in right.notes)
    assert "flow_channels=row_column" in " ".join(wrong.diagnosis().suspects)


def test_a_frame_without_a_pose_does_not_hide_that_the_others_are_wrong():
    frames, found = frames_of(with_mistake("poses OpenGL")), Examination()
    frames[3] = dataclasses.replace(frames[3], world_from_cam=None)
    for previous, current in pairwise(frames):
        found.add(previous, current, current.raw)
    assert found.diagnosis().suspects == ("pose_axes=opengl",)


def test_three_pairs_that_move_are_not_outvoted_by_those_at_rest():
    frames, found = frames_of(with_mistake("poses OpenGL"))[:4], Examination()
    for previous, current in [*pairwise(frames), *[(frames[1], frames[1])] * 9]:
        found.add(previous, current, current.raw * (previous is not current))
    assert found.diagnosis().suspects == ("pose_axes=opengl",)


def test_what_hardly_moves_or_is_hardly_known_tells_nothing():
    right = drawn(ROOM)
    still = examined(right.with_(flow=0 * right.flow, poses=right.poses[[0] * 10],
                                 depth=right.depth[[0] * 10]))  # fmt: skip
    assert still.is_right  # there is no flow that could be wrong
    assert "9 of 9 pairs tell little: hardly anything moves" in still.notes
    assert any("no convention is tested" in note for note in still.notes)
    assert "poses ... frames later" in still.unseen
    assert len(set(still.unseen)) == len(still.unseen)
    unknown = right.depth.copy()
    unknown[:, 1:] = np.nan
    unknown[:, 0, 40:] = np.nan
    assert "too few" in examined(right.with_(depth=unknown)).words
    assert "too few" in examined(right.with_(depth=np.inf * right.depth)).words
    assert "no two" in Examination().diagnosis().words


# --- environments ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def frames():
    """An env's frames of a street in which bodies move, and K."""
    return tensordict_of(drawn(BODIES_ENV))


def spoilt(frames, **changes):
    td, K = frames
    td = td.clone()
    for key, change in changes.items():
        where = key if key in ("raw", "ego", "obj") else ("sensor", key)
        td[where] = change(td[where])
    return diagnose(td, K)


def bodies_inverted(rows):
    return torch.cat([rows[:, :1], geometry.invert_rigid(rows[:, 1:])], 1)


SPOILT = {
    "the motion, beside right rows": ("prev_from_curr", geometry.invert_rigid, True, "row 0"),
    "motions of bodies": ("instance_motion", bodies_inverted, True, "instance_motion"),
    "ids beyond the rows": ("instance", lambda ids: 70 * ids, True, "ids 0 to"),
    "depth of nan": ("depth", lambda z: torch.nan * z, False, "depth"),
    "depth of 0": ("depth", lambda z: 0 * z, False, "depth"),
    "depth behind the camera": ("depth", torch.neg, True, "depth"),
    "motions of nan": ("prev_from_curr", lambda motion: torch.nan * motion, False, ""),
}


@pytest.mark.parametrize(("key", "change", "is_wrong", "words"), SPOILT.values(), ids=SPOILT)
def test_what_an_env_gives_wrongly_is_named(frames, key, change, is_wrong, words):
    found = spoilt(frames, **{key: change})
    assert found.is_wrong if is_wrong else found.verdict == "can't tell", found
    assert words in found.words


def test_bodies_that_no_id_shows_are_told(frames):
    unseen = spoilt(frames, instance=lambda ids: 0 * ids)
    assert unseen.is_wrong or any("no pixel" in note for note in unseen.notes)


def test_half_a_picture_of_sky_is_no_noise_of_depth():
    # A floor 0.4 m below the camera, seen below its horizon, and a wall 0.6 m to the left.
    x, y = (torch.arange(60) - 29.5) / 50, (torch.arange(40)[:, None] - 19.5) / 50
    ahead = [(1 + x / 2) / (4 - 0.1 * t) for t in range(8)]
    inverse = [torch.where(y > 0.02, (y / 0.4).maximum(-x / 0.6).maximum(z), 0.0) for z in ahead]
    motion = torch.eye(4)
    motion[2, 3] = 0.1
    sensor = {"depth": torch.stack(inverse)[:, None].reciprocal()}
    sensor["prev_from_curr"] = motion.repeat(8, 1, 1)
    K = torch.tensor([[50.0, 0.0, 30.0], [0.0, 50.0, 20.0], [0.0, 0.0, 1.0]])
    found = diagnose(TensorDict({"sensor": sensor}, [8]), K)
    assert found.is_right
    assert found.error_px < 0.05
    assert any(ADMITTED["bodies"] in note for note in found.notes)  # as its rates count it


def test_what_transforms_wrote_is_computed_again(frames):
    both = spoilt(frames, ego=lambda flow: -flow, obj=lambda flow: 0 * flow)
    assert both.is_wrong
    assert [words.partition(" ")[0] for words in both.words.split("; ")] == ["ego", "obj"]
    scaled = spoilt(frames, obj=lambda flow: 8 * flow)  # by its scale
    assert scaled.is_right
    assert any("8 times" in note for note in scaled.notes)


def test_no_layout_is_advised_for_poses_that_are_matrices():
    mistakes = mistakes_of({"pose_layout": "matrix"}, by_flow=True, of_flow=True, absolute=True)
    assert {x.remedy for x in mistakes if x.description.startswith("quaternions")} == {
        "quaternions of wxyz", "quaternions of xyzw",
    }  # fmt: skip


def test_every_adapter_that_is_printed_for_an_env_can_be_made():
    adapters = (transforms.AdaptDepth, transforms.AdaptFlow, transforms.AdaptPose)
    names = {adapter.__name__: adapter for adapter in adapters} | {"K": torch.eye(3)}
    mistakes = mistakes_of({}, by_flow=True, of_flow=True, absolute=True)
    texts = [mistake.texts(torch.tensor(mistake.start[0]), width=64)[0] for mistake in mistakes]
    calls = {text: diagnosis.envs._adapter_call(text, None) for text in texts}
    made = [eval(call, names) for call in calls.values() if call.startswith("Adapt")]
    assert {*map(type, made)} == {*adapters}
    # two options of one pose are arguments of one transform, or it would be converted twice
    both = "pose_direction=world_to_camera pose_axes=opengl"
    assert calls[both] == 'AdaptPose(direction="world_to_camera", axes="opengl")'
    assert calls["pose_lag_frames=1"] == "pose_lag_frames=1"


def test_flow_that_was_measured_is_judged_although_most_of_its_pixels_are_right(frames):
    found = spoilt(frames, raw=torch.neg)
    assert "flow_direction=backward" in found.suspects
    assert "AdaptFlow" in found.words
    td, K = frames
    td = td.exclude("obj").clone()
    td["raw"] += 3.0 * (torch.arange(td["raw"].shape[-1]) % 3 == 0)
    assert diagnose(td, K).words.startswith("raw flow")


def test_steps_with_their_next_are_pairs_in_any_order(frames):
    td, K = frames
    steps = td[:-1].clone()
    steps["next"] = td[1:].clone()
    order = torch.randperm(len(steps), generator=torch.Generator().manual_seed(0))
    assert diagnose(steps[order].reshape(-1, 2), K).is_right
    wrong = steps[order].clone()
    for where in ("sensor", ("next", "sensor")):
        wrong[where]["prev_from_curr"] = geometry.invert_rigid(wrong[where]["prev_from_curr"])
    assert diagnose(wrong, K).is_wrong


def test_the_end_of_an_episode_is_no_pair(frames):
    td, K = frames
    cut = td[[0, 1, 5, 6, 10, 11]].exclude(("sensor", "world_from_cam"))  # it jumps twice
    cut["done"] = torch.tensor([0, 1, 0, 1, 0, 1]).bool().unsqueeze(-1)
    assert diagnose(cut, K).pairs == 3


def test_each_frame_may_have_its_own_K(frames):
    td, K = frames
    td = td.clone()
    td["sensor", "K"] = K.expand(len(td), 3, 3)
    assert diagnose(td).is_right


def test_what_is_no_rollout_is_refused(frames):
    td, K = frames
    with pytest.raises(ValueError, match="successive"):
        diagnose(td[0], K)
    with pytest.raises(ValueError, match="depth"):
        diagnose(td.exclude(("sensor", "depth")), K)
    with pytest.raises(ValueError, match="successive"):
        diagnose(td.expand(0, *td.shape), K)
    with pytest.raises(ValueError, match=r"K\.T"):
        diagnose(td, K.T)
    for other in (K.expand(len(td), 3, 3), [50.0, 50.0, 30.0, 20.0], None):
        with pytest.raises(ValueError, match="K must be"):
            diagnose(td, other)


def test_the_street_and_its_transforms_are_right():
    from flowrep.envs import make_env

    env = make_env("s_turn", ["raw", "ego", "obj"], seed=3, keep_sensor=True)
    K = torch.from_numpy(env.base_env._env.envs[0].unwrapped.K).float()
    rollout = env.rollout(20, policy=lambda td: td.set("action", torch.tensor([1])))
    env.close()
    for frames in (rollout, rollout["next"]):
        found = diagnose(frames, K)
        assert found.is_right, found
    twice = torch.diag(torch.tensor([2.0, 2.0, 1.0])) @ K
    assert any(name.startswith("K times 0.5") for name in diagnose(rollout, twice).suspects)


def test_a_recorded_street_is_read_under_its_options(tmp_path):
    from examples.make_recording import make_recording
    from flowrep import sequences
    from flowrep.sequences.job import Job

    folder = Path(tmp_path) / "turn"
    make_recording(folder, scene="s_turn", frames=5, size=(90, 120), skipped=60)
    for options, mends in (
        ({}, None),
        ({"pose_axes": "opengl"}, "pose_axes=opencv"),
        ({"flow_channels": "row_column"}, "flow_channels=uv"),
    ):
        recording = sequences.open_recording(folder, "frames", **options)
        sources = sequences.recorded_flow, sequences.recorded_motion
        found = Job(recording, *sources, output=None).examine()
        assert found.is_right if mends is None else mends in " ".join(found.suspects), found
