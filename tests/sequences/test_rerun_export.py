"""A rerun recording holds the camera, its pictures and the flow of each frame."""

from __future__ import annotations

import sys

import pytest

pytest.importorskip("cv2", reason="recordings need OpenCV")

from flowrep.sequences import Frames, SequenceError, factorize_frames, recorded_flow
from flowrep.sequences.output import RerunExport
from tests.sequences import synthetic


def test_every_frame_is_logged(tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    synthetic.write_frames(tmp_path / "in")
    export = RerunExport(tmp_path / "a.rrd", "a", {"raw": 20.0, "obj": 20.0})
    for index, made in enumerate(factorize_frames(Frames(tmp_path / "in"), recorded_flow)):
        if made is not None:
            export.append(index, made)
    export.close()
    data = (tmp_path / "a.rrd").read_bytes()
    assert data.startswith(b"RRF")
    for place in (b"/world/camera/image/depth", b"/flow/raw", b"/flow/obj"):
        assert place in data
    assert b"/flow/ego" not in data


def test_without_rerun_the_package_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    with pytest.raises(SequenceError, match=r"^rerun=true: needs the package rerun-sdk: pip"):
        RerunExport(tmp_path / "a.rrd", "a", {})
    assert list(tmp_path.iterdir()) == []
