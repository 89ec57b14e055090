"""Flow files: what is written is what OpenCV reads, and the other way round."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("cv2", reason="recordings need OpenCV")

import cv2

from flowrep.sequences import read_flo, read_kitti_flow, write_flo, write_kitti_flow


@pytest.fixture
def flow():
    return np.random.default_rng(0).normal(0, 30, (2, 5, 7)).astype(np.float32)


def test_flo_by_hand(tmp_path):
    # One row of two pixels, (u, v) interleaved: 202021.25, 2, 1, then 1.5 -2 and 3 4.
    write_flo(tmp_path / "a.flo", np.array([[[1.5, 3.0]], [[-2.0, 4.0]]], np.float32))
    data = (tmp_path / "a.flo").read_bytes()
    assert data[:4] == b"PIEH"
    assert np.frombuffer(data, "<i4", 2, 4).tolist() == [2, 1]
    assert np.frombuffer(data, "<f4", offset=12).tolist() == [1.5, -2.0, 3.0, 4.0]


def test_opencv_reads_the_flo_that_is_written(flow, tmp_path):
    write_flo(tmp_path / "a.flo", flow)
    np.testing.assert_array_equal(
        cv2.readOpticalFlow(str(tmp_path / "a.flo")).transpose(2, 0, 1), flow
    )


def test_the_flo_that_opencv_writes_is_read(flow, tmp_path):
    cv2.writeOpticalFlow(str(tmp_path / "a.flo"), np.ascontiguousarray(flow.transpose(1, 2, 0)))
    np.testing.assert_array_equal(read_flo(tmp_path / "a.flo"), flow)


def test_unknown_flow_is_marked_as_the_format_says_and_comes_back_as_nan(flow, tmp_path):
    flow[1, 2, 3] = np.nan
    valid = np.ones((5, 7), bool)
    valid[4, 0] = False
    write_flo(tmp_path / "a.flo", flow, valid)
    marked = cv2.readOpticalFlow(str(tmp_path / "a.flo"))
    assert marked[2, 3].tolist() == marked[4, 0].tolist() == [1e10, 1e10]
    back = read_flo(tmp_path / "a.flo")
    assert np.isnan(back).all(0).nonzero()[0].tolist() == [2, 4]
    assert np.isnan(back).sum() == 4


def test_kitti_png_by_hand(tmp_path):
    # u = 1.5 is 2^15 + 96, v = -2 is 2^15 - 128; the third channel says that it is known.
    write_kitti_flow(tmp_path / "a.png", np.array([[[1.5]], [[-2.0]]], np.float32))
    blue_green_red = cv2.imread(str(tmp_path / "a.png"), cv2.IMREAD_UNCHANGED)
    assert blue_green_red[0, 0, ::-1].tolist() == [32864, 32640, 1]


def test_kitti_png_round_trip_within_half_a_step(flow, tmp_path):
    flow[:, 1, 1] = np.nan
    flow[0, 3, 3] = 600.0  # more than the format can say
    write_kitti_flow(tmp_path / "a.png", flow)
    back = read_kitti_flow(tmp_path / "a.png")
    unknown = np.isnan(back).any(0)
    assert np.argwhere(unknown).tolist() == [[1, 1], [3, 3]]
    assert np.abs(back - flow)[:, ~unknown].max() <= 0.5 / 64
