"""Right data are right, and mistakes that separate code has put into them are found.

Some cells of docs/diagnosis.md's table are computed again here, `tests.injected.matrix` makes all.
"""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from tensordict import TensorDict

pytest.importorskip("cv2", reason="recordings need OpenCV")

from flowrep import diagnose, diagnosis, geometry, transforms
from flowrep.diagnosis import Examination
from flowrep.diagnosis.rivals import rivals_of
from flowrep.geometry.pose import rotation_from_vector
from tests.injected import matrix, mistakes
from tests.injected.sources import (
    CAMERA,
    ENVS,
    RECORDINGS,
    crowd,
    euler,
    filmed,
    hand_held,
    realsense,
    rigid,
    room,
    street,
)


def only(source, mistake):
    (cell,) = matrix.cells([source], [mistake])
    return cell


@pytest.mark.parametrize("source", ["room", "room, env"])
def test_right_data_are_right_to_rounding(source):
    cell = only(source, "right")
    assert cell.found.is_right
    assert cell.found.error_px < 1e-3 < cell.found.raw_px


@pytest.mark.slow_after_first
@pytest.mark.parametrize("seed", range(3))
def test_noise_holes_and_movers_are_no_mistake(seed):
    found = matrix.of_recording(realsense(seed))
    assert found.is_right, found
    # The poses' own noise is of a millimetre and 0.04 degrees: some 0.2 px in all.
    assert 0.05 < found.error_px < 0.4


@pytest.mark.slow_after_first
@pytest.mark.parametrize(
    ("seed", "people", "noise_px", "is_common", "share"),
    [
        (0, 4, 0.15, False, 0.53), (5, 4, 0.15, True, 0.57), (0, 4, 0.0, False, 0.53),
        (4, 4, 0.15, True, 0.50), (0, 6, 0.3, False, 0.60), (1, 6, 0.15, True, 0.61),
    ],
)  # fmt: skip
def test_a_crowd_that_another_motion_fits_better_is_no_mistake(
    seed, people, noise_px, is_common, share
):
    taken = crowd(seed, people, noise_px, is_common)
    assert (taken.ids > 0).mean() == pytest.approx(share, abs=0.005)
    found = matrix.of_recording(taken)
    assert found.is_right, found
    assert any("move" in note for note in found.notes)


def behind_a_box(side):
    """The room from a camera that drives straight on, behind a box that is as fast."""
    poses = np.array([
        rigid(euler(0, 0.06, 0) @ CAMERA, (-1.5 + 0.12 * t, 0, 1.2)) for t in range(8)
    ])  # fmt: skip
    box = np.array([1.2, 0, side]), np.array([0.12, 0, 0]), np.array([0.5, side, side])
    return filmed(0, poses, [box]).with_(rgb=None)


def test_a_vehicle_ahead_that_fills_most_of_the_picture_is_no_mistake():
    taken = behind_a_box(0.75)
    assert (taken.ids > 0).mean() == pytest.approx(0.59, abs=0.005)
    noise = 0.1 * np.random.default_rng(0).normal(size=taken.flow.shape)
    found = matrix.of_recording(taken.with_(flow=taken.flow + noise))
    assert found.is_right, found


def test_depth_that_a_camera_leaves_unseen_as_it_backs_out_is_no_mistake():
    pytest.importorskip("pybullet", reason="the streets are PyBullet's")
    ahead = street(0, 24, (48, 48), "straight_road", 25)
    depth, poses = (getattr(ahead, name)[::-1].copy() for name in ("depth", "poses"))
    assert matrix.of_env(ahead.with_(depth=depth, poses=poses, ids=None, moved=None)).is_right


def test_noise_of_depth_is_no_mistake_of_a_camera_that_hardly_moves():
    taken, random = filmed(3, hand_held(3, 0.08 * np.arange(10)), []), np.random.default_rng(0)
    noise = 0.008 * taken.depth**2 * random.normal(size=taken.depth.shape)
    found = matrix.of_env(taken.with_(depth=taken.depth + noise))
    assert found.pairs > 0
    assert not found.is_wrong, found


@pytest.mark.slow_after_first
@pytest.mark.parametrize(
    ("mistake", "seed", "is_common"),
    [
        ("poses world-to-camera", 0, False), ("poses a frame late", 0, False),
        ("depth 10 cm off", 2, False), ("mirrored world", 4, True),
        ("poses' yaw times 1.2", 4, True),
    ],
)  # fmt: skip
def test_mistakes_are_noticed_beside_a_crowd(mistake, seed, is_common):
    spoilt = {name: change for name, (change, _) in mistakes.LISTED.items()} | mistakes.UNLISTED
    found = matrix.of_recording(spoilt[mistake](crowd(seed, is_common=is_common)))
    assert found.is_wrong, found


@pytest.mark.slow_after_first
@pytest.mark.parametrize(
    ("mistake", "mends"),
    [
        ("depth in mm", "depth times 0.001"),  # millimetres that were read as metres
        ("poses OpenGL, world-to-camera", "pose_direction=world_to_camera pose_axes=opengl"),
        ("mirrored world", "pose_axes=unity"),
        ("quaternion order", "pose_layout=xyz_wxyz"),
        ("poses a frame late", "pose_lag_frames=1"),
        ("poses of a marker", "marker_from_cam=["),
        ("flow backward", "flow_direction=backward"),
        ("flow to the next frame", "flow_to=next backwards=true"),
        ("flow of twice the size", "flow divided by 2"),
        ("depth in feet", "depth times 0.305"),
        ("depth along the ray", "depth_kind=ray_length"),
        ("depth buffer", "depth_kind=z_buffer near_m=0.2 far_m=60"),
        ("K of twice the size", "K times 0.5"),
        ("K before a crop", "cx and cy moved by (-24.0, -14.4) px"),  # 0.15 and 0.12 of 160 and 120
        ("K as fx, cx, fy, cy", "K's numbers in another order"),
        ("K that changes", "a K for each frame"),
        ("lens distortion", "distortion=[-0.23,0,0,0]"),  # -0.12 * 0.6 / 0.563**2
    ],
)
def test_a_listed_mistake_is_named_with_the_numbers_that_mend_it(mistake, mends):
    found = only("room", mistake).found
    assert found.suspects[0].startswith(mends)
    assert min(found.rivals_px.values()) < 0.05 * found.raw_px
    assert found.left_px > 0.01


@pytest.mark.slow_after_first
@pytest.mark.parametrize(
    "mistake",
    ["poses' yaw times 1.2", "depth 10 cm off", "flow shuffled", "poses late from the middle on"],
)
def test_a_mistake_that_nobody_listed_is_noticed(mistake):
    assert only("room", mistake).found.is_wrong


@pytest.mark.slow_after_first
@pytest.mark.parametrize("mistake", ["mirrored world", "depth in mm", "K before a resize"])
def test_an_env_whose_raw_flow_follows_its_mistake_is_told_by_depth(mistake):
    cell = only("room, env", mistake)
    assert cell.kind == "named", cell.found


def test_depth_of_another_time_is_noticed_though_flow_is_noisy():
    taken = realsense(0)
    found = matrix.of_recording(taken.with_(depth=np.roll(taken.depth, -5, 0)))
    assert found.verdict == "something is wrong"
    assert "depth" in found.words


def test_a_value_of_depth_that_fills_much_of_the_picture_is_named():
    depth = shots().depth.copy()
    depth[:, :40] = 65  # a third of 120 rows
    note = examined(shots().with_(depth=depth), {}).notes[0]
    assert "33%" in note
    assert "65 m" in note


def test_the_table_of_the_docs_has_every_mistake_and_none_that_passed():
    table = matrix.table_of(matrix.PAGE.read_text("utf-8"))
    assert [*table] == ["right", *mistakes.LISTED, *mistakes.UNLISTED]
    assert all([*row] == [*RECORDINGS, *ENVS] for row in table.values())
    kinds = {kind for row in table.values() for kind in row.values()}
    assert kinds <= {"", *matrix.KINDS} - {"passed", "false alarm"}


def shots(count=9, seed=3):
    """A part of the room's recording."""
    whole = room(seed)
    return whole.with_(
        **{n: getattr(whole, n)[:count] for n in ("depth", "poses", "K", "flow")}, rgb=None
    )


def test_what_mends_it_is_relative_to_the_options_in_force():
    # The data's axes are x_forward_z_up, and opengl was given: its columns are right, up, back.
    poses = shots().poses @ mistakes.FLU @ mistakes.OPENGL
    given = {"pose_axes": "opengl", "depth_unit_m": "0.001"}
    found = examined(shots().with_(poses=poses), given)
    assert found.suspects == ("pose_axes=x_forward_z_up",)
    assert "format.pose_axes=x_forward_z_up" in found.words
    found = examined(shots().with_(depth=5 * shots().depth), {"depth_unit_m": "0.001"})
    assert "format.depth_unit_m=0.0002" in found.words
    K = shots().K * np.array([[2], [2], [1]])  # of twice the size
    found = examined(shots().with_(K=K), {"depth_unit_m": "0.001"})
    assert "format.intrinsics=[142,128,84,57] format.first_pixel_centre=0.5" in found.words
    # A left-handed world is turned over by the option in force, and back.
    unity = np.diag([1.0, -1.0, 1.0, 1.0])
    found = examined(shots().with_(poses=unity @ shots().poses @ unity), {"pose_axes": "unity"})
    assert found.suspects == ("pose_axes=opencv",)


def examined(taken, conventions, **options):
    frames, found = matrix.frames_of(taken, raw=True), Examination(conventions, **options)
    poses = [None, *(frame.world_from_cam for frame in frames), None]
    for t in range(1, len(frames)):
        found.add(frames[t - 1], frames[t], frames[t].raw, poses[t - 1], poses[t + 2])
    return found.diagnosis()


def test_straight_driving_leaves_two_conventions_that_it_cannot_tell_apart():
    # Ahead 0.2 m a frame: backwards is the same as with OpenGL's z.
    taken = shots()
    poses = np.tile(taken.poses[0], (9, 1, 1))
    poses[:, :3, 3] += 0.2 * np.arange(9)[:, None] * poses[0, :3, 2]
    flow = np.array([np.full_like(taken.flow[0], np.nan)] * 9)
    straight = taken.with_(poses=poses, depth=np.tile(taken.depth[:1], (9, 1, 1)))
    for t in range(1, 9):
        flow[t] = matrix.ego_flow(straight, t)
    found = examined(straight.with_(flow=flow, poses=poses @ mistakes.OPENGL), {})
    assert {"pose_axes=opengl", "motions inverted"} <= set(found.suspects)


def test_poses_that_stand_still_for_a_part_are_noticed():
    poses = room(3).poses.copy()
    poses[12:] = poses[11]  # four of fifteen pairs
    taken = room(3).with_(poses=poses)
    flow = room(3).flow.copy()
    flow[12:] = 0.0  # as if it was computed from these poses
    assert "12, 13, 14, 15" in matrix.of_recording(taken.with_(rgb=None)).words
    assert "poses of" in matrix.of_recording(taken.with_(flow=flow, rgb=None)).words
    assert "poses of" in matrix.of_env(taken).words
    # Where the camera stands, depth stands too, and that is no mistake.
    stands = taken.with_(
        **{n: np.concatenate([getattr(room(3), n)[:12], getattr(room(3), n)[[11] * 4]])
           for n in ("depth", "ids", "rgb", "moved")}, flow=flow,
    )  # fmt: skip
    for found in (matrix.of_recording(stands.with_(rgb=None)), matrix.of_env(stands)):
        assert found.is_right
        assert any("4 of 15 pairs are not tested" in note for note in found.notes)


def test_poses_that_are_a_little_off_in_a_third_of_the_pairs_are_noticed():
    poses = room(3).poses.copy()
    for t in range(1, 16, 3):  # each third step is a sixth too long: some 6 % of the flow
        poses[t:, :3, 3] += 0.16 * (room(3).poses[t, :3, 3] - room(3).poses[t - 1, :3, 3])
    found = matrix.of_recording(room(3).with_(poses=poses, rgb=None))
    assert found.is_wrong


def test_pixels_that_do_not_fit_are_told_with_their_share():
    depth, wrong = room(3).depth.copy(), np.zeros(room(3).depth.shape, bool)
    wrong[:, 20:60, 30:90] = True  # an eighth of the picture, as far again
    found = matrix.of_recording(room(3).with_(depth=np.where(wrong, 2 * depth, depth), rgb=None))
    (note,) = [note for note in found.notes if "don't fit" in note]
    assert abs(float(note.split("%")[0]) / 100 - wrong.mean()) < 0.03


@pytest.mark.parametrize(("source", "seed"), [(room, 0), (realsense, 0), (street, 0), (room, 3)])
def test_depth_that_wraps_around_in_a_part_of_the_picture_is_named(source, seed):
    taken = source(seed).with_(rgb=None)
    known = taken.depth[np.isfinite(taken.depth)]
    for share, is_many in ((0.05, False), (0.2, True)):
        most = float(f"{np.quantile(known, 1 - share):.3g}")
        wraps = np.where(np.isinf(taken.depth), np.inf, taken.depth % most)
        found = matrix.of_recording(taken.with_(depth=wraps))
        assert found.is_wrong == is_many
        (said,) = [text for text in (found.words, *found.notes) if "wraps around" in text]
        assert abs(float(said.split("%")[0]) / 100 - share) < 0.03
        assert float(said.split(" m are")[0].split()[-1]) == pytest.approx(most, rel=0.02)
    assert not any("wraps" in note for note in matrix.of_recording(taken).notes)


def test_an_identity_among_the_poses_is_named_by_its_frame_and_does_not_decide():
    poses = room(3).poses.copy()
    poses[7] = np.eye(4)
    found = matrix.of_recording(room(3).with_(poses=poses, rgb=None))
    assert found.is_right, found
    (note,) = found.notes
    assert note.endswith(": 7, 8")


def test_without_poses_flow_depth_and_K_are_judged_among_themselves():
    frames = matrix.frames_of(shots(), raw=True)
    K = np.array([[71.0, 0, 42], [0, 64, 28.5], [0, 0, 1]])  # of half the size
    found, wrong = Examination(), Examination()
    for previous, current in pairwise(frames):
        pair = [dataclasses.replace(frame, world_from_cam=None) for frame in (previous, current)]
        assert found.add(*pair, pair[1].raw)
        wrong.add(*(dataclasses.replace(frame, K=K) for frame in pair), pair[1].raw)
    assert found.diagnosis().is_right
    assert any("not tested" in note for note in found.diagnosis().notes)
    assert any(name.startswith("K times 2") for name in wrong.diagnosis().suspects)


def test_what_hardly_moves_or_is_hardly_known_tells_nothing():
    taken = shots(3)
    stands = taken.with_(flow=0 * taken.flow, poses=taken.poses[[0, 0, 0]])
    still = examined(stands.with_(depth=taken.depth[[0, 0, 0]]), {})
    assert (still.verdict, still.pairs) == ("can't tell", 0)
    assert "moves" in still.words
    unknown = taken.depth.copy()
    unknown[:, 1:] = np.nan
    unknown[:, 0, 40:] = np.nan
    assert "too few" in examined(taken.with_(depth=unknown), {}).words
    assert "no two" in Examination().diagnosis().words


def test_the_report_names_what_is_left_by_what():
    text = str(only("room", "poses OpenGL").found)
    assert text.startswith("wrong: ")
    assert "pose_axes=opengl" in text
    assert "as recorded" in text


# --- environments ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def frames():
    """An env's frames of a room in which two bodies move, and K."""
    return matrix.tensordict_of(room(3, movers=2))


def spoilt(frames, **changes):
    td, K = frames
    td = td.clone()
    for key, change in changes.items():
        where = key if key in ("raw", "ego", "obj") else ("sensor", key)
        td[where] = change(td[where])
    return diagnose(td, K)


def test_a_motion_that_is_inverted_beside_right_rows_is_named(frames):
    found = spoilt(frames, prev_from_curr=geometry.invert_rigid)
    assert found.is_wrong
    assert "row 0" in found.words
    assert "prev_from_curr" in found.words


def test_rows_and_ids_that_do_not_fit_the_bodies_are_told(frames):
    assert spoilt(frames).is_right
    rows = spoilt(frames, instance_motion=lambda rows: torch.cat(
        [rows[:, :1], geometry.invert_rigid(rows[:, 1:])], 1))  # fmt: skip
    assert rows.is_wrong
    assert "instance_motion" in rows.words
    world = spoilt(frames, instance_motion=lambda rows: torch.cat(
        [rows[:, :1], geometry.invert_rigid(rows[:, :1]) @ rows[:, 1:]], 1))  # fmt: skip
    assert "instance_motion" in world.words
    beyond = spoilt(frames, instance=lambda ids: 7 * ids)
    assert "ids 0 to 14" in beyond.words


@pytest.mark.parametrize("name", [name for name in mistakes.UNLISTED if name[:6] == "bodies"])
def test_motions_of_bodies_that_their_pixels_contradict_are_wrong(name):
    right = room(3, movers=2)
    assert matrix.bodies_px(right, mistakes.UNLISTED[name](right)) > 0.5
    found = matrix.of_env(mistakes.UNLISTED[name](right))
    assert found.is_wrong
    assert "instance_motion" in found.words


def test_motions_of_bodies_that_are_a_quarter_too_short_are_wrong():
    right, moved = room(3, movers=2), room(3, movers=2).moved.copy()
    for each in moved[1:].reshape(-1, 4, 4):
        half = mistakes.halved(each)
        each[:] = half @ mistakes.halved(half)
    wrong = right.with_(moved=moved)
    assert 0.5 < matrix.bodies_px(right, wrong) < 2
    assert "instance_motion" in matrix.of_env(wrong).words


def test_a_body_whose_motion_alone_is_wrong_is_named(frames):
    found = spoilt(frames, instance_motion=lambda rows: torch.cat(
        [rows[:, :2], rows[:, :1]], 1))  # fmt: skip
    assert "body 2:" in found.words


def test_ids_without_motions_of_bodies_say_what_is_the_static_world():
    taken = crowd(noise_px=0.0)  # half of the picture
    td, K = matrix.tensordict_of(taken)
    td["raw"] = torch.from_numpy(taken.flow).float()  # measured, with the bodies' motions
    del td["sensor", "instance_motion"]
    found = diagnose(td, K)
    assert found.is_right, found
    assert any("bodies are not tested" in note for note in found.notes)
    assert not any("don't fit" in note for note in found.notes)


def test_ids_that_are_no_bodys_are_not_called_right(frames):
    found = spoilt(frames, instance=lambda ids: 0 * ids)
    assert found.verdict == "can't tell"
    assert "bodies 1 to 2" in found.words


def test_what_transforms_wrote_is_computed_again(frames):
    ego = spoilt(frames, ego=lambda flow: -flow)
    assert ego.is_wrong
    assert ego.words.startswith("ego ")
    obj = spoilt(frames, obj=lambda flow: 0 * flow)
    assert obj.words.startswith("obj ")
    scaled = spoilt(frames, obj=lambda flow: 8 * flow)  # by its scale
    assert scaled.is_right
    assert "8 times" in scaled.notes[0]


def test_every_adapter_that_is_printed_for_an_env_can_be_made():
    adapters = (transforms.AdaptDepth, transforms.AdaptFlow, transforms.AdaptPose)
    names = {adapter.__name__: adapter for adapter in adapters} | {"K": torch.eye(3)}
    rivals = rivals_of({}, by_flow=True, of_flow=True, absolute=True)
    texts = [rival.texts(torch.tensor(rival.start[0]), width=64)[0] for rival in rivals]
    calls = {text: diagnosis.envs._adapter_call(text, None) for text in texts}
    made = [eval(call, names) for call in calls.values() if call.startswith("Adapt")]
    assert {*map(type, made)} == {*adapters}
    # two options of one pose are arguments of one transform, or it would be converted twice
    both = "pose_direction=world_to_camera pose_axes=opengl"
    assert calls[both] == 'AdaptPose(direction="world_to_camera", axes="opengl")'
    assert "near_m=0.2" in calls["depth_kind=z_buffer near_m=0.2 far_m=1e+06"]
    assert calls["pose_lag_frames=1"] == "pose_lag_frames=1"


def test_flow_that_was_measured_is_a_reference_of_its_own(frames):
    found = spoilt(frames, raw=lambda flow: -flow)
    assert "flow_direction=backward" in found.suspects
    assert "AdaptFlow" in found.words


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        (lambda z: torch.nan * z, "can't tell"), (lambda z: 0 * z, "can't tell"),
        (torch.neg, "wrong"),
    ],
)  # fmt: skip
def test_depth_that_is_none_is_told(frames, change, verdict):
    found = spoilt(frames, depth=change)
    assert found.verdict == verdict
    assert "depth" in found.words


def test_steps_with_their_next_are_pairs_in_any_order(frames):
    td, K = frames
    steps = td[:-1].clone()
    steps["next"] = td[1:].clone()
    order = torch.randperm(len(steps), generator=torch.Generator().manual_seed(0))
    for given in (steps, steps[order], steps.reshape(5, 3)):
        assert diagnose(given, K).is_right
    wrong = steps[order].clone()
    for where in ("sensor", ("next", "sensor")):
        wrong[where]["prev_from_curr"] = geometry.invert_rigid(wrong[where]["prev_from_curr"])
    assert diagnose(wrong, K).is_wrong


def test_the_end_of_an_episode_is_no_pair(frames):
    td, K = frames
    cut = td[[0, 1, 5, 6, 10, 11]].exclude(("sensor", "world_from_cam"))  # it jumps twice
    (note,) = diagnose(cut, K).notes
    assert note.endswith(": 1, 3")
    cut["done"] = torch.tensor([0, 1, 0, 1, 0, 1]).bool().unsqueeze(-1)
    assert diagnose(cut, K).is_right
    assert diagnose(cut, K).notes == ()


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
    with pytest.raises(ValueError, match=r"K\.T"):
        diagnose(td, K.T)


def test_the_street_and_its_transforms_are_right():
    pytest.importorskip("pybullet", reason="the streets are PyBullet's")
    from flowrep.envs import make_env

    env = make_env("s_turn", ["raw", "ego", "obj"], seed=3, keep_sensor=True)
    K = torch.from_numpy(env.base_env._env.envs[0].unwrapped.K).float()
    rollout = env.rollout(20, policy=lambda td: td.set("action", torch.tensor([1])))
    env.close()
    for frames in (rollout, rollout["next"]):
        found = diagnose(frames, K)
        assert found.is_right, found
        assert found.error_px < 1e-3
    twice = torch.diag(torch.tensor([2.0, 2.0, 1.0])) @ K
    assert any(name.startswith("K times 0.5") for name in diagnose(rollout, twice).suspects)


def test_a_recorded_street_is_read_under_its_options(tmp_path):
    pytest.importorskip("pybullet", reason="the streets are PyBullet's")
    from examples.make_recording import make_recording
    from flowrep import sequences
    from flowrep.sequences.job import Job

    folder = Path(tmp_path) / "turn"
    make_recording(folder, scene="s_turn", frames=5, size=(90, 120), skipped=60)
    for options, mends in (
        ({}, None),
        ({"pose_axes": "opengl"}, "pose_axes=opencv"),
        ({"flow_channels": "row_column"}, "flow_channels=uv"),
        ({"depth_kind": "ray_length"}, "depth_kind=z"),
    ):
        recording = sequences.open_recording(folder, "frames", **options)
        sources = sequences.recorded_flow, sequences.recorded_motion
        found = Job(recording, *sources, output=None).examine()
        assert found.is_right if mends is None else mends in " ".join(found.suspects), found


def test_every_mistake_changes_the_data():
    for name, (mistake, _) in mistakes.LISTED.items():
        wrong = mistake(room(0))
        same = [np.array_equal(getattr(wrong, n), getattr(room(0), n), equal_nan=True)
                for n in ("depth", "poses", "K", "flow")]  # fmt: skip
        assert not all(same), name


def test_round_bodies_between_whose_pixels_depth_is_not_exact_are_right():
    v, u = torch.meshgrid(torch.arange(36) + 0.5, torch.arange(52) + 0.5, indexing="ij")
    rays = torch.stack([(u - 24.5) / 44, (v - 17.2) / 46, torch.ones_like(u)], -1).double()
    balls = [((0.9, 0.4, 7.0), 2.5), ((-2.4, -0.9, 8.0), 2.2), ((-0.9, 1.3, 5.5), 1.2)]
    depths = []
    for t in range(20):
        ahead = 0.12 * t  # before a wall at 8 m, which the camera nears
        z = torch.full((36, 52), 8 - ahead, dtype=torch.float64)
        for (x, y, far), radius in balls:
            centre = torch.tensor([x, y, far - ahead], dtype=torch.float64)
            a, b = rays.square().sum(-1), rays @ centre
            root = b * b - a * (centre @ centre - radius**2)
            hit = (b - root.clamp(min=0).sqrt()) / a
            z = torch.where((root > 0) & (hit < z), hit, z)
        depths.append(z.float()[None])
    motion = torch.eye(4).repeat(20, 1, 1)
    motion[:, 2, 3] = 0.12
    sensor = {"depth": torch.stack(depths), "prev_from_curr": motion}
    K = torch.tensor([[44.0, 0, 24.5], [0, 46.0, 17.2], [0, 0, 1]])
    assert diagnose(TensorDict({"sensor": sensor}, [20]), K).is_right
    sensor["prev_from_curr"] = motion.clone()
    sensor["prev_from_curr"][:, 2, 3] = 0.156
    assert diagnose(TensorDict({"sensor": sensor}, [20]), K).verdict == "wrong"


@pytest.mark.parametrize(("step", "is_told"), [((0.1, 0.0, 0.0), True), ((0.0, 0.0, -0.2), False)])
def test_what_depth_cannot_tell_of_a_flat_bodys_motion_is_said(step, is_told):
    # a plate 4 m ahead, parallel to the picture, that moves aside or nears the camera; the wall is
    # tilted, so that the camera's motion shows
    v, u = torch.meshgrid(torch.arange(36) + 0.5, torch.arange(52) + 0.5, indexing="ij")
    x, y = (u - 24.5) / 44, (v - 17.2) / 46
    depths, ids, plate_motion = [], [], torch.eye(4)
    plate_motion[:3, 3] = -torch.tensor(step) + torch.tensor([0.0, 0.0, 0.12])
    for t in range(16):
        wall = (8 - 0.12 * t) / (1 + 0.2 * x + 0.1 * y)
        far, centre = 4 + t * (step[2] - 0.12), t * step[0] - 0.8
        is_plate = ((x * far - centre).abs() < 1.0) & ((y * far).abs() < 0.8)
        depths.append(torch.where(is_plate, torch.tensor(far), wall)[None])
        ids.append(is_plate.long()[None])
    motion = torch.eye(4)
    motion[2, 3] = 0.12
    rows = torch.stack([motion, plate_motion]).repeat(16, 1, 1, 1)
    sensor = {"depth": torch.stack(depths), "instance": torch.stack(ids)}
    sensor |= {"instance_motion": rows, "prev_from_curr": rows[:, 0]}
    K = torch.tensor([[44.0, 0, 24.5], [0, 46.0, 17.2], [0, 0, 1]])
    found = diagnose(TensorDict({"sensor": sensor}, [16]), K)
    assert found.is_right
    assert any("motions of bodies are not tested" in note for note in found.notes) == is_told


def test_noise_of_depth_is_no_mistake_of_the_focal_length():
    v, u = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    rays = torch.stack([(u - 32) / 47, (v - 24) / 47, torch.ones_like(u)]).double()
    generator, depths, poses = torch.Generator().manual_seed(0), [], []
    for t in range(20):  # someone walks through a room with a box in it
        pose = torch.eye(4).double()
        turn = [0.01 * math.sin(0.9 * t) - 0.1, 0.03 * math.sin(0.3 * t), 0.015 * math.sin(1.1 * t)]
        pose[:3, :3] = rotation_from_vector(torch.tensor(turn).double())
        pose[:3, 3] = torch.tensor([0.02 * math.sin(1.1 * t), 0.0, 0.06 * t])
        at, ahead = pose[:3, 3, None, None], torch.einsum("ij,jhw->ihw", pose[:3, :3], rays)
        walls = torch.tensor([[-5.0, 5.0], [-1.7, 1.5], [-2.0, 10.0]])[:, :, None, None]
        z = ((walls - at[:, None]) / ahead[:, None]).amax(1).amin(0)
        near = (6.0 - at[2]) / ahead[2]
        z = torch.where(((at + near * ahead)[:2] - 0.6).abs().lt(0.8).all(0), near, z)
        noise = torch.randn(z.shape, generator=generator, dtype=torch.float64)
        depths.append((z + 0.0006 * z.square() * noise).float()[None])
        poses.append(pose)
    motion = torch.stack([before.inverse() @ now for before, now in pairwise(poses)]).float()
    motion = torch.cat([torch.eye(4)[None], motion])
    sensor = {"depth": torch.stack(depths), "prev_from_curr": motion}
    K = torch.tensor([[47.0, 0, 32], [0, 47, 24], [0, 0, 1]])
    assert diagnose(TensorDict({"sensor": sensor}, [20]), K).is_right
    sensor["prev_from_curr"] = motion.clone()
    sensor["prev_from_curr"][:, 2, 3] *= 2
    assert diagnose(TensorDict({"sensor": sensor}, [20]), K).is_wrong


def test_noise_of_depth_is_no_mistake_of_the_poses():
    whole, random = room(3, movers=2), np.random.default_rng(0)
    depth, K = whole.depth[:, 1::3, 1::3], whole.K / [[3], [3], [1]]  # every third pixel
    small = whole.with_(depth=depth, K=K, ids=whole.ids[:, 1::3, 1::3])
    for _ in range(3):  # twice that of a Kinect, 12 cm at 5 m
        noise = 0.005 * depth**2 * random.normal(size=depth.shape)
        assert matrix.of_env(small.with_(depth=depth + noise)).is_right


def test_a_straight_street_whose_depth_hardly_changes_is_right():
    pytest.importorskip("pybullet", reason="the streets are PyBullet's")
    straight = street(0, 30, (48, 48), "straight_road", 25)
    assert matrix.of_env(straight).is_right


def test_depth_of_a_floor_that_agrees_with_poses_is_of_one_time():
    v, u = torch.meshgrid(torch.arange(48) + 0.5, torch.arange(64) + 0.5, indexing="ij")
    K, generator = (
        np.array([[46.0, 0, 32], [0, 46, 24], [0, 0, 1]]),
        torch.Generator().manual_seed(0),
    )
    pixel = torch.stack([u, v]).double()
    rays = torch.stack([(u - 32) / 46, (v - 24) / 46, 0 * u + 1])
    # A camera 1.5 m above a floor, tilted down by 0.25 rad, moves 0.12 m along it.
    along = torch.tensor([0, -math.sin(0.25), math.cos(0.25)]).double()
    down = rays[1].double() * math.cos(0.25) + math.sin(0.25)
    depth = torch.where(down > 0.01, 1.5 / down, math.inf)
    x, y, z = rays.double() + 0.12 * along[:, None, None] / depth
    c, s = math.cos(8e-4), math.sin(8e-4)  # flow is off by 0.04 px, and noisy
    y, z = c * y - s * z, s * y + c * z
    flow = pixel - torch.stack([46 * x / z + 32, 46 * y / z + 24])

    def found(longer):
        examination = Examination()
        for t in range(8):
            noise = 0.15 * torch.randn(flow.shape, generator=generator, dtype=torch.float64)
            poses = [np.eye(4) for _ in range(4)]
            for i, pose in enumerate(poses):
                pose[:3, 3] = 0.12 * (t + i) * along.numpy()
            previous, current = (
                SimpleNamespace(name=str(t + i), K=K, depth=z.numpy(), world_from_cam=poses[i + 1],
                                rgb=None, raw=None, timestamp_s=None)
                for i, z in enumerate((depth, depth * longer))
            )  # fmt: skip
            examination.add(previous, current, (flow + noise).numpy(), poses[0], poses[3])
        return examination.diagnosis()

    assert found(1.0).is_right
    assert found(1.05).is_wrong  # the floor of another time, when the camera was higher
