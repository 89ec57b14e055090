"""Exports a recording and its flow as a rerun recording (.rrd), to scrub through in 3-D."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from flowrep.sequences.factorization import FactorizedFrame
from flowrep.sequences.frame import SequenceError
from flowrep.sequences.output import shown
from flowrep.viz import flow_to_rgb

_JPEG_QUALITY = 80


class RerunExport:
    """Writes the camera, picture, depth and flow of each frame.

    Args:
        path: the .rrd file. Several files of one recording open as one.
        recording: its name, the same for all files of it.
        scale_px: the flow of full colour by name, pixels.

    Raises:
        SequenceError: rerun is not installed.
    """

    def __init__(self, path: Path, recording: str, scale_px: dict[str, float]) -> None:
        try:
            import rerun
        except ImportError:
            raise SequenceError(
                "rerun=true", "needs the package rerun-sdk: pip install 'flowrep[rerun]'"
            ) from None
        self._rerun: Any = rerun
        self._stream = rerun.RecordingStream("flowrep", recording_id=recording)
        self._stream.save(str(path))
        self.scale_px = scale_px

    def append(self, index: int, factorized: FactorizedFrame) -> None:
        """Logs one frame."""
        rr, frame = self._rerun, factorized.frame
        self._stream.set_time("frame", sequence=index)
        if frame.timestamp_s is not None:
            self._stream.set_time("time", duration=frame.timestamp_s)
        pose = frame.world_from_cam
        self._log("world/camera", rr.Transform3D(translation=pose[:3, 3], mat3x3=pose[:3, :3]))
        height, width = frame.size
        self._log(
            "world/camera/image",
            rr.Pinhole(
                image_from_camera=frame.K,
                resolution=[width, height],
                camera_xyz=rr.ViewCoordinates.RDF,
            ),
        )
        if frame.rgb is not None:
            picture = rr.Image(frame.rgb).compress(jpeg_quality=_JPEG_QUALITY)
            self._log("world/camera/image/rgb", picture)
        depth = np.where(np.isfinite(frame.depth), frame.depth, 0.0).astype(np.float32)
        self._log("world/camera/image/depth", rr.DepthImage(depth, meter=1.0))
        for name, scale_px in self.scale_px.items():
            colours = flow_to_rgb(shown(name, factorized), scale_px)
            self._log(f"flow/{name}", rr.Image(colours).compress(jpeg_quality=_JPEG_QUALITY))

    def close(self) -> None:
        """Writes what is left."""
        self._stream.flush()
        self._stream.disconnect()

    def _log(self, place: str, what: Any) -> None:
        self._stream.log(place, what)
