"""Object flow of a live ZED camera, or of an SVO file, through Stereolabs' SDK (`pyzed`).

`python examples/zed_live.py live out` factorises until Ctrl-C, and `python examples/zed_live.py
walk.svo2 out` factorises a file. A folder that was exported from an SVO needs no SDK:
`flowrep.factorize format=zed`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from flowrep.sequences import EstimatedFlowSource, Frame, SequenceError, recorded_motion
from flowrep.sequences.calibration import camera_matrix
from flowrep.sequences.job import Job
from flowrep.sequences.output import Output
from flowrep.transforms import DIS


class ZedLive:
    """Frames of a ZED as they arrive, with depth and poses from the SDK (`pyzed`).

    Frames without tracking are left out, and the next frame starts a new clip.

    Args:
        source: `"live"` for a connected camera, or an .svo or .svo2 file.

    Raises:
        SequenceError: the camera or file can't be opened.
    """

    has_flow, has_poses = False, True
    notes: tuple[str, ...] = ()

    def __init__(self, source: str | Path) -> None:
        from pyzed import sl  # comes with the ZED SDK

        self._sl, self.source, self._is_live = sl, Path(source), str(source) == "live"
        if not self._is_live and not self.source.is_file():
            raise SequenceError(source, "no such file; give an .svo file, or live for the camera")

    def __iter__(self) -> Iterator[Frame]:
        sl = self._sl
        camera = sl.Camera()
        options = sl.InitParameters()
        options.coordinate_system = sl.COORDINATE_SYSTEM.IMAGE
        options.coordinate_units = sl.UNIT.METER
        if not self._is_live:
            options.set_from_svo_file(str(self.source))
            options.svo_real_time_mode = False
        self._check(camera.open(options), "can't be opened")
        try:
            self._check(
                camera.enable_positional_tracking(sl.PositionalTrackingParameters()),
                "has no positional tracking",
            )
            yield from self._grab(camera)
        finally:
            camera.close()

    def _grab(self, camera: Any) -> Iterator[Frame]:
        sl = self._sl
        runtime, picture, depth, pose = sl.RuntimeParameters(), sl.Mat(), sl.Mat(), sl.Pose()
        left = camera.get_camera_information().camera_configuration.calibration_parameters.left_cam
        K = camera_matrix([left.fx, left.fy, left.cx, left.cy], (0, 0), first_pixel_centre=0.0)
        number, clip = 0, 0
        while True:
            error = camera.grab(runtime)
            if error == sl.ERROR_CODE.END_OF_SVOFILE_REACHED:
                return
            self._check(error, "stopped giving pictures")
            state = camera.get_position(pose, sl.REFERENCE_FRAME.WORLD)
            if state != sl.POSITIONAL_TRACKING_STATE.OK:
                clip += 1
                continue
            camera.retrieve_image(picture, sl.VIEW.LEFT)
            camera.retrieve_measure(depth, sl.MEASURE.DEPTH)
            z = np.asarray(depth.get_data(), dtype=np.float32)
            yield Frame(
                name=f"{number:06d}",
                source=self.source,
                world_from_cam=np.array(pose.pose_data(sl.Transform()).m, dtype=np.float64),
                K=K,
                depth=np.where(np.isfinite(z), z, np.float32(np.nan)),  # inf is too far, not sky
                rgb=cv2.cvtColor(picture.get_data(), cv2.COLOR_BGRA2RGB).astype(
                    np.uint8, copy=False
                ),
                timestamp_s=camera.get_timestamp(sl.TIME_REFERENCE.IMAGE).get_nanoseconds() / 1e9,
                clip=clip,
            )
            number += 1

    def _check(self, error: Any, what: str) -> None:
        if error != self._sl.ERROR_CODE.SUCCESS:
            raise SequenceError(self.source, f"{what}: the ZED SDK says {error}")


def main(source: str, folder: str) -> None:
    stream = ZedLive(source)
    with closing(Output(Path(folder), {"input": source}, flow_files=(), video_fps=15)) as output:
        job = Job(stream, EstimatedFlowSource(DIS("fast")), recorded_motion, output)
        job.run()
    output.finish(job.summary(None))


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except (SequenceError, ImportError) as error:
        sys.exit(f"error: {error}")
