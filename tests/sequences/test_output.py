"""The video is readable; a rerun recording holds the camera, its pictures and the flow."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="recordings need OpenCV")

from flowrep.sequences import Frame, Frames, factorize_frames, factorize_pair, recorded_flow
from flowrep.sequences.output import OutputOptions, RerunExport, video_frame
from tests.sequences import synthetic


def test_every_frame_is_logged(tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    synthetic.write_frames(tmp_path / "in")
    export = RerunExport("a", {"raw": 20.0, "obj": 20.0})
    export.save(tmp_path / "a.rrd")
    for index, made in enumerate(factorize_frames(Frames(tmp_path / "in"), recorded_flow)):
        if made is not None:
            export.append(index, made)
    export.close()
    data = (tmp_path / "a.rrd").read_bytes()
    assert data.startswith(b"RRF")
    for place in (b"/world/camera/image/depth", b"/flow/raw", b"/flow/obj"):
        assert place in data
    assert b"/flow/ego" not in data


def test_without_rerun_the_package_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(ImportError, match=r"rerun.*pip install"):
        RerunExport("a", {})


@pytest.mark.parametrize(
    ("height", "width", "tile"), [(480, 640, (360, 480)), (90, 300, (90, 300))]
)
def test_a_video_frame_has_two_rows_that_fit_a_screen(height, width, tile):
    frame = Frame(
        name="b",
        source=Path("b.png"),
        world_from_cam=np.eye(4),
        K=np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]]),
        depth=np.ones((height, width), np.float32),
        rgb=np.full((height, width, 3), 7, np.uint8),
    )
    raw = np.zeros((2, height, width), np.float32)
    image = video_frame(factorize_pair(frame, frame, raw), OutputOptions())
    rows = 2 * (28 + 20 + tile[0]) + 4  # bars for label and note, a gap
    assert image.shape == (rows, 3 * tile[1] + 2 * 4, 3)
    assert (image[48 : 48 + tile[0], : tile[1]] == 7).all()
