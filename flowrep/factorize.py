"""Factorises recorded video: `python -m flowrep.factorize input=... format=tum output=...`."""

from __future__ import annotations

import sys
from contextlib import closing
from pathlib import Path
from typing import Any

from flowrep.extras import require

require("factorising", "factorize", "cv2", "hydra", "imageio", "pydantic", "tqdm", module=__name__)

import cv2
from hydra.utils import get_class

from flowrep.config import UsageError
from flowrep.config.cli import exit_with, run_command
from flowrep.config.schema import FactorizeConfig, check_options
from flowrep.sequences import (
    EstimatedFlowSource,
    Recording,
    SequenceError,
    Stream,
    estimated_motion,
    recorded_flow,
    recorded_motion,
)
from flowrep.sequences.factorization import FlowSource, MotionSource
from flowrep.sequences.job import Job
from flowrep.sequences.output import Output, OutputOptions
from flowrep.transforms import EstimatedFlow

MISTAKES = (SequenceError, ValueError, ImportError, OSError)


def run(config: FactorizeConfig) -> None:
    """Writes raw, ego and object flow of a recording."""
    # OpenCV's messages about broken files would clutter the one-line error.
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)
    try:
        code = factorize_recording(config.plain())
    except MISTAKES as error:
        exit_with(" ".join(str(error).split()))
    sys.exit(code)


def factorize_recording(settings: dict[str, Any]) -> int:
    """Runs the job that a config asks for; returns the exit code.

    Raises:
        UsageError: a value is invalid.
        SequenceError: a file can't be read.
    """
    stream = open_stream(settings)
    flow_source = open_flow_source(settings, stream)
    motion_source = open_motion_source(settings, stream)
    for note in stream.notes:
        print(f"note: {note}")
    chosen = {key: settings[key] for key in ("start", "stop", "stride")}
    output = Output(settings["output"], output_options(settings), settings)
    job = Job(stream, flow_source, motion_source, output, **chosen)
    with closing(output):
        diagnosis = job.examine()
        if diagnosis is not None:
            print(f"{'warning: ' if diagnosis.suspects else ''}{diagnosis.words}")
        if not job.run():
            print(f"stopped after {len(output.rows)} frames, which are in {output.partial}")
            return 130
    if not output.rows:
        given = " ".join(f"{key}={value}" for key, value in chosen.items() if value is not None)
        raise SequenceError(
            settings["input"],
            f"has no two consecutive frames of one clip with {given}: choose others",
        )
    output.finish(job.summary(diagnosis))
    print(f"{len(output.rows)} frames in {output.path}; time: {job.clock.summary()}")
    return 0


def output_options(settings: dict[str, Any]) -> OutputOptions:
    """Returns what is written."""
    return OutputOptions(
        flow_files=settings["flow_files"],
        pictures_every=settings["pictures_every"],
        scale_px=settings["scale_px"],
        depth_range_m=settings["depth_range_m"],
        moving_px=settings["moving_px"],
        video_fps=settings["video_fps"] if settings["video"] else None,
        rerun=settings["rerun"],
    )


def open_stream(settings: dict[str, Any]) -> Stream:
    """Returns the recording or camera that `input` and `format` name."""
    format_options = dict(settings["format"])
    target = get_class(format_options.pop("_target_"))
    source = str(settings["input"])
    check_options(target, format_options, "format")
    if issubclass(target, Recording) and not Path(source).is_dir():
        raise SequenceError(source, "no such folder")
    return target(source, **format_options)


def open_flow_source(settings: dict[str, Any], stream: Stream) -> FlowSource:
    """Returns the source of raw flow."""
    options = dict(settings["flow"])
    if options.pop("source") == "exact":
        if not stream.has_flow:
            why = stream.no_flow if isinstance(stream, Recording) else "a video has none"
            raise UsageError(f"flow=exact: {settings['input']} has no flow of its own; {why}")
        return recorded_flow
    estimator = EstimatedFlow(**options).estimator
    return EstimatedFlowSource(estimator, check_consistency=settings["check_consistency"])


def open_motion_source(settings: dict[str, Any], stream: Stream) -> MotionSource:
    """Returns the source of the camera's motion: the recorded poses, if there are any."""
    if settings["poses"] == "estimated":
        return estimated_motion
    if stream.has_poses:
        return recorded_motion
    if settings["poses"] == "recorded":
        raise UsageError(f"poses=recorded: {settings['input']} has none; use poses=estimated")
    print("note: there are no poses, so the camera's motion is estimated from flow and depth")
    return estimated_motion


def main() -> None:
    """Entry point; a mistake on the command line ends in one line that lists the choices."""
    run_command("factorize", run, FactorizeConfig)


if __name__ == "__main__":
    main()
