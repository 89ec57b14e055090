"""Factorises recorded video: `python -m flowrep.factorize input=... format=tum output=...`.

What needs PyTorch, which takes seconds to import, is imported when the config has passed.
"""

from __future__ import annotations

import os
import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from flowrep.extras import require

require(
    "factorising", "factorize", "cv2", "hydra", "imageio_ffmpeg", "pydantic", "tqdm",
    module=__name__,
)  # fmt: skip

from pydantic import ConfigDict, Field, model_validator

from flowrep.config.cli import EXIT_USAGE, run_command
from flowrep.config.options import (
    Command,
    Count,
    CountOrZero,
    Distinct,
    FlowOptions,
    Options,
    Positive,
    Text,
)
from flowrep.config.usage import UsageError

if TYPE_CHECKING:
    from flowrep import sequences
    from flowrep.sequences.factorization import FlowSource, MotionSource


class Reader(Options):
    """A reader of recordings, whose options are checked against its signature."""

    model_config = ConfigDict(extra="allow")
    target: str = Field(alias="_target_", pattern=r"^flowrep\.sequences\.\w+$")

    def options(self) -> dict[str, Any]:
        """Returns the options by name, without the class."""
        return dict(self.model_extra or {})


class FlowScale(Options):
    """Flow of full colour, pixels."""

    raw: Positive
    ego: Positive
    obj: Positive


class FactorizeConfig(Command):
    """The whole config of `flowrep.factorize`."""

    input: Text | int
    output: Text
    format: Reader
    flow: FlowOptions
    poses: Literal["recorded", "estimated"] | None
    check: Literal["error", "warn"]
    start: CountOrZero
    stop: CountOrZero | None
    stride: Count
    check_consistency: bool
    moving_px: Positive
    flow_files: Annotated[list[Literal["flo", "kitti", "npz"]], Distinct]
    masks: bool
    pictures_every: CountOrZero
    video: bool
    video_fps: Positive
    scale_px: FlowScale
    depth_range_m: Positive

    @model_validator(mode="after")
    def _has_a_pair(self) -> FactorizeConfig:
        if self.stop is not None and self.stop < self.start + self.stride + 1:
            least = self.start + self.stride + 1
            raise ValueError(f"stop={self.stop} leaves no pair of frames; give {least} or more")
        return self


def factorize_recording(config: FactorizeConfig) -> int:
    """Writes raw, ego and object flow of a recording; returns the exit code."""
    given = str(config.input)
    if not (given.isdecimal() or Path(given).exists()):
        raise UsageError(f"input={given}: no such file or folder")
    # OpenCV's messages about broken files would clutter the one-line error. It reads this as it is
    # imported, below; only newer versions can be silenced later.
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")
    from flowrep import sequences
    from flowrep.sequences.job import Job
    from flowrep.sequences.output import Output

    stream = open_stream(config)
    flow_source = open_flow_source(config, stream)
    motion_source = open_motion_source(config, stream)
    for note in stream.notes:
        print(f"note: {note}")
    output = Output(
        Path(config.output),
        config.plain(),
        flow_files=config.flow_files,
        pictures_every=config.pictures_every,
        scale_px=config.scale_px.model_dump(),
        depth_range_m=config.depth_range_m,
        moving_px=config.moving_px,
        masks=config.masks,
        video_fps=config.video_fps if config.video else None,
    )
    start, stop, stride = config.start, config.stop, config.stride
    with closing(output):
        job = Job(stream, flow_source, motion_source, output, start=start, stop=stop, stride=stride)
        diagnosis = job.examine()
        if diagnosis is not None:
            print(diagnosis)
            # It may be mistaken (docs/diagnosis.md has rates), so it stops nothing unasked.
            if diagnosis.verdict == "wrong" and config.check == "error":
                print("nothing is written; check=warn factorises all the same", file=sys.stderr)
                return EXIT_USAGE
        if stopped_by := job.run():
            print(f"stopped after {len(output.rows)} frames, which are in {output.partial}")
            return stopped_by
    if not output.rows:
        why = f"no two frames of start={start} stride={stride} follow each other in a clip"
        raise sequences.SequenceError(config.input, why)
    output.finish(job.summary(diagnosis))
    print(f"{len(output.rows)} frames in {output.path}; time: {job.clock.summary()}")
    return 0


def open_stream(config: FactorizeConfig) -> sequences.Stream:
    """Returns the recording or camera that `input` and `format` name."""
    from flowrep.sequences.formats import open_reader

    options = config.format.options()
    stream: sequences.Stream = open_reader(config.format.target, str(config.input), options)
    return stream


def open_flow_source(config: FactorizeConfig, stream: sequences.Stream) -> FlowSource:
    """Returns the source of raw flow."""
    from flowrep import sequences

    options = config.plain()["flow"]
    if options.pop("source") == "exact":
        if not stream.has_flow:
            why = stream.no_flow if isinstance(stream, sequences.Recording) else "a video has none"
            raise UsageError(f"flow=exact: {config.input} has no flow of its own; {why}")
        return sequences.recorded_flow
    # TorchRL takes as long to import as all others together, so mistakes above are reported first.
    from flowrep.transforms import EstimatedFlow

    estimator = EstimatedFlow(**options).estimator
    return sequences.EstimatedFlowSource(estimator, check_consistency=config.check_consistency)


def open_motion_source(config: FactorizeConfig, stream: sequences.Stream) -> MotionSource:
    """Returns the source of the camera's motion: the recorded poses, if there are any."""
    from flowrep import sequences

    if config.poses == "estimated":
        return sequences.estimated_motion
    if stream.has_poses:
        return sequences.recorded_motion
    if config.poses == "recorded":
        raise UsageError(f"poses=recorded: {config.input} has none; use poses=estimated")
    print("note: there are no poses, so the camera's motion is estimated from flow and depth")
    return sequences.estimated_motion


def main() -> None:
    """Entry point."""
    run_command("factorize", lambda config: sys.exit(factorize_recording(config)), FactorizeConfig)


if __name__ == "__main__":
    main()
