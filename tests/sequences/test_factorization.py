"""Estimated flow of recordings, its consistency, and what is said of it."""

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from flowrep import sequences
from flowrep.sequences.factorization import consistent
from flowrep.sequences.job import Job
from flowrep.sequences.output import score, shown, video_frame
from flowrep.transforms import DIS

K = np.array([[30.0, 0, 30.5], [0, 28.0, 21.0], [0, 0, 1]])


def frame(name="b", **changes):
    plain = {
        "name": name,
        "source": Path(f"{name}.png"),
        "world_from_cam": np.eye(4),
        "K": K,
        "depth": np.full((40, 60), 4.0, np.float32),
        "rgb": np.zeros((40, 60, 3), np.uint8),
    }
    return sequences.Frame(**(plain | changes))


def moved(x_m):
    pose = np.eye(4)
    pose[0, 3] = x_m
    return pose


def texture():
    noise = torch.rand(1, 3, 10, 15, generator=torch.Generator().manual_seed(0))
    large = torch.nn.functional.interpolate(255 * noise, scale_factor=4.0, mode="bilinear")
    return large[0].permute(1, 2, 0).to(torch.uint8).numpy()


def test_pixels_that_do_not_come_home_are_unknown():
    # All goes 2 px to the right and back, but for a column that goes and stays.
    back = np.zeros((2, 5, 12), np.float32)
    back[0] = 2.0
    forth = -back
    forth[0, :, 7] = 3.0
    came_home = consistent(back, forth)
    assert came_home[:, :5].all()
    assert not came_home[:, 5].any()  # it went to column 7
    assert not came_home[:, 10:].any()  # they left the picture


def test_after_a_repeated_picture_flow_spans_both_intervals():
    # 0.2 m a frame before a wall 4 m away; the second picture is the first again, so that in the
    # third the wall has streamed to the left since the picture was taken: by 30 * 0.4 / 4 = 3 px.
    frames = [
        frame(name, rgb=np.roll(texture(), -left_px, axis=1), world_from_cam=moved(x_m))
        for name, left_px, x_m in (("a", 0, 0.0), ("b", 0, 0.2), ("c", 3, 0.4), ("d", 4, 0.6))
    ]
    source = sequences.EstimatedFlowSource(DIS())
    first, repeated, after, then = sequences.factorize_frames(frames, source)
    assert first is None
    assert np.isnan(repeated.raw).all()
    assert (source(frames[0], frames[0]) == 0).all()  # a camera that did not move
    assert (after.previous.name, then.previous.name) == ("a", "c")
    np.testing.assert_allclose(after.ego[:, 20, 30], [-3.0, 0.0], atol=1e-5)
    assert after.valid[8:-8, 8:-8].mean() > 0.9
    assert np.median(np.abs(after.obj[:, after.valid])) < 0.1


def test_without_poses_the_motion_is_estimated():
    # The camera goes to the right by 0.4 m before a slope; a quarter of the picture moves too.
    depth = np.linspace(2.0, 6.0, 40, dtype=np.float32)[:, None].repeat(60, 1)
    raw = np.stack([-30.0 * 0.4 / depth, 0 * depth])
    raw[:, :20, :30] += np.float32([[[4.0]], [[-3.0]]])
    before = frame("a", world_from_cam=None)
    now = frame("b", world_from_cam=None, depth=depth, rgb=None)
    with pytest.raises(sequences.SequenceError, match="poses=estimated"):
        sequences.factorize_pair(before, now, raw)
    made = sequences.factorize_pair(before, now, raw, sequences.estimated_motion(before, now, raw))
    np.testing.assert_allclose(made.motion.prev_from_curr, moved(0.4), atol=2e-3)
    assert 0.7 < made.motion.inlier_share <= 0.8
    np.testing.assert_allclose(made.obj[:, 5, 5], [4.0, -3.0], atol=0.02)
    assert np.abs(made.obj[:, 30:]).max() < 0.02
    # Recorded poses that are off by 10 degrees and 0.2 m stand beside the estimate in the table.
    known = {"a": np.eye(4), "b": moved(0.6)}
    known["b"][:3, :3] = cv2.Rodrigues(np.array([0.0, np.radians(10), 0.0]))[0]
    pair = [dataclasses.replace(f, world_from_cam=known[f.name]) for f in (before, now)]
    row = score(1, dataclasses.replace(made, previous=pair[0], frame=pair[1]), moving_px=1.0)
    assert float(row["rotation_off_deg"]) == pytest.approx(10, abs=0.2)
    assert float(row["translation_off_m"]) == pytest.approx(0.2, abs=0.01)
    assert float(row["recorded_obj_median_px"]) > 1 > float(row["obj_median_px"])


def test_a_change_of_focal_length_causes_no_object_flow():
    # fx from 1455.07 to 1459.04 within 33 ms, of a camera that stands still: pixel u was nearer to
    # the axis before, at (u - cx) 1455.07 / 1459.04 + cx. Pictures are smaller here by 1 / 20.
    before, now = (np.diag([f / 30, f / 30, 1]) @ K for f in (1455.07 / 20, 1459.04 / 20))
    before[:2, 2] = now[:2, 2] = 30.5, 21.0
    row, column = np.indices((40, 60)) + 0.5
    raw = np.stack([column - 30.5, row - 21.0]) * (1 - 1455.07 / 1459.04)
    pair = frame("a", K=before), frame("b", K=now, rgb=None)
    made = sequences.factorize_pair(*pair, raw.astype(np.float32))
    assert made.valid.all()
    assert np.abs(made.obj).max() < 1e-5 < np.abs(raw).max() / 1000
    motion = sequences.estimated_motion(*pair, raw.astype(np.float32))
    np.testing.assert_allclose(motion.prev_from_curr, np.eye(4), atol=1e-4)


class Walk(sequences.Recording):
    """41 frames, 0.1 m apart."""

    count = 41

    def _frame(self, index):
        return frame(str(index), world_from_cam=moved(0.1 * index), rgb=None)


def test_pairs_in_runs_spread_over_the_recording_are_examined():
    looked_at = []

    def flow_source(previous, current):
        looked_at.append(int(current.name))
        return np.full((2, 40, 60), 0.0 if current.name == "12" else 3.0, np.float32)

    diagnosis = Job(Walk(), flow_source, sequences.recorded_motion, output=None).examine()
    # Five pairs from each quarter of 41 frames; the one that does not move tells nothing, though
    # its pose does: a camera 0.1 m ahead each frame has ego flow.
    quarters = [1, 10, 20, 30]
    assert looked_at == [first + i for first in quarters for i in range(5)]
    assert diagnosis.pairs == 20


def test_moving_pixels_exceed_the_frames_own_error():
    # Errors of 2 px everywhere are not movers, 9 px are.
    raw = np.zeros((2, 40, 60), np.float32)
    raw[0] = 2.0
    raw[1, :10] = 9.0
    row = score(1, sequences.factorize_pair(frame("a"), frame("b"), raw), moving_px=1.0)
    assert float(row["moving_share"]) == 0.25


def test_ego_flow_is_known_wherever_geometry_gives_it():
    # The previous camera was 2 m ahead, so a point 1 m away was behind it; raw is unknown there.
    depth = np.full((40, 60), 4.0, np.float32)
    depth[:20], depth[:, 40:] = 1.0, np.nan
    raw = np.zeros((2, 40, 60), np.float32)
    raw[:, :, :20] = np.nan
    ahead = np.eye(4)
    ahead[2, 3] = 2.0
    made = sequences.factorize_pair(frame("a", world_from_cam=ahead), frame("b", depth=depth), raw)
    assert made.ego_valid.tolist() == (depth == 4.0).tolist()
    assert made.valid.tolist() == ((depth == 4.0) & np.isfinite(raw[0])).tolist()
    assert not made.obj[:, ~made.valid].any()
    for kind, known in (("raw", np.isfinite(raw[0])), ("ego", made.ego_valid), ("obj", made.valid)):
        np.testing.assert_array_equal(np.isfinite(shown(kind, made)), [known, known])
    # twice as near then: u - cx was twice what it is now, for column 5 -25, so that p - p' is 25
    np.testing.assert_allclose(made.ego[0, 30, 5], 25.0)


def test_flow_of_ones_own_has_to_be_of_this_pair():
    raw = np.ones((2, 40, 60), np.float32)
    now = frame("c", raw=raw, raw_since="b")
    assert sequences.recorded_flow(frame("b"), now) is raw
    with pytest.raises(sequences.SequenceError, match=r"^c\.png: .*frame b"):
        sequences.recorded_flow(frame("a"), now)
    with pytest.raises(sequences.SequenceError, match=r"^b\.png: has no flow of its own"):
        sequences.recorded_flow(frame("a"), frame("b"))
    with pytest.raises(sequences.SequenceError, match="no picture to estimate flow from"):
        sequences.EstimatedFlowSource(DIS())(frame("a", rgb=None), frame("b"))


def test_a_row_says_medians_shares_and_the_error():
    # Half of the pixels lack depth; of the rest a quarter moves by (3, 4) px by itself.
    depth = np.full((40, 60), 4.0, np.float32)
    depth[:20] = np.nan
    raw = np.zeros((2, 40, 60), np.float32)
    raw[:, 30:, :30] = np.array([3.0, 4.0]).reshape(2, 1, 1)
    raw[:, 39, 59] = np.nan
    truth = np.zeros_like(raw)
    truth[:, :, 59] = np.nan
    now = frame("b", depth=depth, raw=truth, raw_since="a", timestamp_s=1.5)
    row = score(7, sequences.factorize_pair(frame("a"), now, raw), moving_px=4.9)
    assert (row["index"], row["name"], row["timestamp_s"], row["gap"]) == (7, "b", "1.500000", "")
    assert row["raw_median_px_per_s"] == ""  # the frame before has no time
    assert float(row["valid_share"]) == pytest.approx(1199 / 2400, abs=1e-6)
    assert float(row["moving_share"]) == pytest.approx(300 / 1199, abs=1e-6)
    assert float(row["raw_median_px"]) == float(row["obj_median_px"]) == 0.0
    assert float(row["epe_px"]) == pytest.approx(5 * 300 / (40 * 59), abs=1e-6)


def test_dropped_frames_and_seconds_stand_in_the_row():
    # Two frames are missing between a and b, which are 0.1 s apart; all moves by 5 px.
    raw = np.zeros((2, 40, 60), np.float32)
    raw[:] = np.float32([3.0, -4.0]).reshape(2, 1, 1)
    before = frame("a", position=4, timestamp_s=2.0)
    now = frame("b", position=7, timestamp_s=2.1, world_from_cam=moved(0.5))
    row = score(7, sequences.factorize_pair(before, now, raw), moving_px=1.0)
    assert row["gap"] == 2
    assert float(row["raw_median_px_per_s"]) == pytest.approx(50.0)
    # Half a metre to the right before a wall 4 m away: -30 * 0.5 / 4 = -3.75 px.
    assert float(row["ego_median_px_per_s"]) == pytest.approx(37.5, rel=1e-4)
    assert float(row["obj_median_px_per_s"]) == pytest.approx(10 * np.hypot(6.75, 4), rel=1e-4)
    # Played backwards, the later frame comes first.
    assert score(7, sequences.factorize_pair(now, before, raw), moving_px=1.0)["gap"] == 2


def test_without_known_flow_all_is_unknown_and_unknown_numbers_are_empty_cells():
    nothing = np.full((2, 40, 60), np.nan, np.float32)
    motion = sequences.estimated_motion(frame("a"), frame("b"), nothing)
    assert not motion.known
    assert not sequences.factorize_pair(frame("a"), frame("b"), nothing, motion).ego_valid.any()
    of_b = frame("c", raw=np.ones((2, 40, 60), np.float32), raw_since="b")  # not of a
    row = score(1, sequences.factorize_pair(frame("a"), of_b, nothing), moving_px=1.0)
    assert float(row["valid_share"]) == 0.0
    assert [name for name, value in row.items() if value != ""] == ["index", "name", "valid_share"]


def test_a_video_frame_has_two_rows_of_three_that_fit_a_screen():
    now = frame(depth=np.ones((480, 640), np.float32), rgb=np.full((480, 640, 3), 7, np.uint8))
    image = video_frame(sequences.factorize_pair(now, now, np.zeros((2, 480, 640), np.float32)))
    assert 2 * 360 < image.shape[0] < 900
    assert 3 * 480 <= image.shape[1] < 1500
    assert (image[60:400, :480] == 7).all()
