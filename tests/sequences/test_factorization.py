"""Estimated flow of recordings, its consistency, and what is said of it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch

pytest.importorskip("cv2", reason="recordings need OpenCV")

from flowrep.sequences import (
    EstimatedFlowSource,
    Frame,
    SequenceError,
    factorize_frames,
    factorize_pair,
    recorded_flow,
)
from flowrep.sequences.factorization import consistent
from flowrep.sequences.output import _median_px, end_point_error, known, score
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
    return Frame(**(plain | changes))


def moved(x_m):
    pose = np.eye(4)
    pose[0, 3] = x_m
    return pose


def texture(seed=0):
    noise = torch.rand(1, 3, 10, 15, generator=torch.Generator().manual_seed(seed))
    large = torch.nn.functional.interpolate(255 * noise, scale_factor=4.0, mode="bilinear")
    return large[0].permute(1, 2, 0).to(torch.uint8).numpy()


def test_an_estimator_sees_what_went_by_while_the_camera_moved():
    # 0.4 m to the right, 4 m away: the wall streams by 30 * 0.4 / 4 = 3 px to the left.
    before = frame("a", rgb=texture())
    now = frame("b", rgb=np.roll(texture(), -3, axis=1), world_from_cam=moved(0.4))
    first, made = factorize_frames([before, now], EstimatedFlowSource(DIS()))
    assert first is None
    np.testing.assert_allclose(made.ego[:, 20, 30], [-3.0, 0.0], atol=1e-5)
    middle = made.valid[8:-8, 8:-8]
    assert middle.mean() > 0.9
    assert np.median(np.abs(made.obj[:, 8:-8, 8:-8][:, middle])) < 0.1


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


def test_a_repeated_picture_says_nothing_of_a_camera_that_moved():
    source = EstimatedFlowSource(DIS())
    same = texture()
    raw = source(frame("a", rgb=same), frame("b", rgb=same, world_from_cam=moved(0.1)))
    assert np.isnan(raw).all()
    assert (source(frame("a", rgb=same), frame("b", rgb=same)) == 0).all()


def test_a_new_clip_has_no_flow_since_the_last_one():
    source = EstimatedFlowSource(DIS(), check_consistency=False)
    frames = [frame("a"), frame("b"), frame("c", starts_clip=True), frame("d")]
    assert [made is None for made in factorize_frames(frames, source)] == [True, False, True, False]


def test_ego_flow_is_known_wherever_geometry_gives_it():
    # The previous camera was 2 m ahead, so a point 1 m away was behind it; raw is unknown there.
    depth = np.full((40, 60), 4.0, np.float32)
    depth[:20], depth[:, 40:] = 1.0, np.nan
    raw = np.zeros((2, 40, 60), np.float32)
    raw[:, :, :20] = np.nan
    ahead = np.eye(4)
    ahead[2, 3] = 2.0
    made = factorize_pair(frame("a", world_from_cam=ahead), frame("b", depth=depth), raw)
    assert known("ego", made).tolist() == (depth == 4.0).tolist()
    assert known("obj", made).tolist() == ((depth == 4.0) & np.isfinite(raw[0])).tolist()
    assert not made.obj[:, ~known("obj", made)].any()
    # twice as near then: u - cx was twice what it is now, for column 5 -25, so that p - p' is 25
    np.testing.assert_allclose(made.ego[0, 30, 5], 25.0)


def test_flow_of_ones_own_has_to_be_of_this_pair():
    raw = np.ones((2, 40, 60), np.float32)
    now = frame("c", raw=raw, raw_since="b")
    assert recorded_flow(frame("b"), now) is raw
    with pytest.raises(SequenceError, match=r"^c\.png: has flow since frame b, and here follows a"):
        recorded_flow(frame("a"), now)
    with pytest.raises(SequenceError, match=r"^b\.png: has no flow of its own"):
        recorded_flow(frame("a"), frame("b"))
    with pytest.raises(SequenceError, match="no picture to estimate flow from"):
        EstimatedFlowSource(DIS())(frame("a", rgb=None), frame("b"))


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
    row = score(7, factorize_pair(frame("a"), now, raw), moving_px=4.9)
    assert row["index"] == 7
    assert row["name"] == "b"
    assert row["timestamp_s"] == "1.500000"
    assert float(row["valid_share"]) == pytest.approx(1199 / 2400, abs=1e-6)
    assert float(row["moving_share"]) == pytest.approx(300 / 1199, abs=1e-6)
    assert float(row["raw_median_px"]) == float(row["obj_median_px"]) == 0.0
    assert float(row["epe_px"]) == pytest.approx(5 * 300 / (40 * 59), abs=1e-6)


@pytest.mark.parametrize(
    "lengths", [[0.0], [0.0, 0.0, 7.0], [3.0, 1.0], [2.0, 1e-20, 900.0, 5.0], [4.0] * 6]
)
def test_a_median_is_the_lower_of_the_middle_two(lengths):
    squares = np.square(np.array(lengths, np.float32))
    assert _median_px(squares) == pytest.approx(sorted(lengths)[(len(lengths) - 1) // 2])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_median_is_that_of_a_sort(scale):
    squares = (scale * np.random.default_rng(0).random(1001) ** 4).astype(np.float32)
    assert _median_px(squares) == np.sqrt(np.sort(squares)[500].astype(float))


def test_what_is_unknown_is_empty_in_the_row():
    nothing = np.full((2, 40, 60), np.nan, np.float32)
    row = score(1, factorize_pair(frame("a"), frame("b"), nothing), moving_px=1.0)
    assert float(row["valid_share"]) == 0.0
    empty = ["timestamp_s", "raw_median_px", "ego_median_px", "obj_median_px", "moving_share"]
    assert [row[name] for name in [*empty, "epe_px"]] == [""] * 6


def test_the_error_against_flow_of_another_pair_is_not_counted():
    now = frame("c", raw=np.ones((2, 40, 60), np.float32), raw_since="b")
    zero = np.zeros((2, 40, 60), np.float32)
    assert score(1, factorize_pair(frame("a"), now, zero), moving_px=1.0)["epe_px"] == ""
    of_b = dataclasses.replace(frame("b"), depth=now.depth)
    assert float(score(1, factorize_pair(of_b, now, zero), moving_px=1.0)["epe_px"]) == (
        pytest.approx(2**0.5, rel=1e-5)
    )
    assert np.isnan(end_point_error(zero, np.full_like(zero, np.nan)))
