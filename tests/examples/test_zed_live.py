"""The live ZED, by a stand-in for Stereolabs' SDK that gives what its documentation says."""

from __future__ import annotations

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from examples.zed_live import ZedLive
from flowrep.sequences import SequenceError

OK, END, FAILED = "SUCCESS", "END_OF_SVOFILE_REACHED", "CAMERA_NOT_DETECTED"


class Camera:
    """Gives three pictures; before the second one tracking is lost."""

    opens, number = OK, -1
    states = ("OK", "SEARCHING", "OK", "OK")

    def open(self, options):
        assert options.coordinate_system == "IMAGE"
        assert options.coordinate_units == "METER"
        return self.opens

    def enable_positional_tracking(self, options):
        return OK

    def get_camera_information(self):
        left = SimpleNamespace(fx=7.0, fy=8.0, cx=1.0, cy=2.0)
        calibration = SimpleNamespace(left_cam=left)
        configuration = SimpleNamespace(calibration_parameters=calibration)
        return SimpleNamespace(camera_configuration=configuration)

    def grab(self, options):
        self.number += 1
        return OK if self.number < len(self.states) else END

    def get_position(self, pose, frame):
        assert frame == "WORLD"
        matrix = np.eye(4)
        matrix[0, 3] = 0.5 * self.number
        pose.pose_data = lambda transform: SimpleNamespace(m=matrix)
        return self.states[self.number]

    def retrieve_image(self, mat, view):
        bgra = np.full((2, 3, 4), [10, 20, 30, 255], np.uint8)
        mat.get_data = lambda: bgra

    def retrieve_measure(self, mat, measure):
        depth = np.array([[1.0, np.nan, np.inf], [2.0, 3.0, -np.inf]], np.float32)
        mat.get_data = lambda: depth

    def get_timestamp(self, reference):
        return SimpleNamespace(get_nanoseconds=lambda: 2_500_000_000)

    def close(self):
        self.number = None


@pytest.fixture(autouse=True)
def sdk(monkeypatch):
    objects = "Pose", "Mat", "Transform", "InitParameters", "RuntimeParameters"
    names = {
        "COORDINATE_SYSTEM": ("IMAGE",), "UNIT": ("METER",), "VIEW": ("LEFT",),
        "MEASURE": ("DEPTH",), "REFERENCE_FRAME": ("WORLD",), "TIME_REFERENCE": ("IMAGE",),
        "POSITIONAL_TRACKING_STATE": ("OK",), "ERROR_CODE": (OK, END),
    }  # fmt: skip
    sl = SimpleNamespace(
        Camera=Camera,
        **dict.fromkeys((*objects, "PositionalTrackingParameters"), SimpleNamespace),
        **{key: SimpleNamespace(**dict(zip(each, each))) for key, each in names.items()},
    )
    monkeypatch.setitem(sys.modules, "pyzed", SimpleNamespace(sl=sl))


def test_frames_come_in_flowreps_conventions_and_lost_tracking_starts_a_clip():
    frames = list(ZedLive("live"))
    assert [frame.name for frame in frames] == ["000000", "000001", "000002"]
    assert [frame.clip for frame in frames] == [0, 1, 1]
    assert [frame.world_from_cam[0, 3] for frame in frames] == [0.0, 1.0, 1.5]
    frame = frames[0]
    assert frame.rgb[0, 0].tolist() == [30, 20, 10]
    assert frame.K.tolist() == [[7.0, 0, 1.5], [0, 8.0, 2.5], [0, 0, 1]]
    np.testing.assert_array_equal(frame.depth, [[1, np.nan, np.nan], [2, 3, np.nan]])
    assert frame.timestamp_s == 2.5


def test_a_missing_camera_recording_or_sdk_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(Camera, "opens", FAILED)
    with pytest.raises(SequenceError, match=r"^live: can't be opened: the ZED SDK says CAMERA_NOT"):
        list(ZedLive("live"))
    with pytest.raises(SequenceError, match=r"a\.svo: no such file"):
        ZedLive(tmp_path / "a.svo")
    monkeypatch.setitem(sys.modules, "pyzed", None)
    with pytest.raises(ImportError, match="pyzed"):
        ZedLive("live")
