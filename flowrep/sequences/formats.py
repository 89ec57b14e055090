"""The formats of conf/format/ by name, and their readers."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from flowrep.config import CONF_DIR, group_choices
from flowrep.config.options import check_reader_options
from flowrep.config.usage import UsageError, closest_first
from flowrep.sequences.declared import DeclaredRecording
from flowrep.sequences.kitti import Kitti
from flowrep.sequences.recording import Recording, SequenceError
from flowrep.sequences.rosbag import RosBag
from flowrep.sequences.video import StillVideo

READERS: dict[str, Any] = {
    reader.__name__: reader for reader in (DeclaredRecording, Kitti, RosBag, StillVideo)
}


@cache  # its YAML takes a tenth of a second
def declaration(format_name: str) -> dict[str, Any]:
    """Returns the keys of `conf/format/<name>.yaml` and of the formats from which it starts."""
    plain: Any = OmegaConf.to_container(OmegaConf.load(CONF_DIR / f"format/{format_name}.yaml"))
    keys: dict[str, Any] = {}
    for base in plain.pop("defaults", []):
        keys |= {} if base == "_self_" else declaration(base)
    return keys | plain


def open_recording(folder: str | Path, format: str, **options: Any) -> Recording:
    """Returns the recording in a folder, in a format of `conf/format/` with other options.

    >>> open_recording("rgbd_dataset_freiburg1_desk", "tum", tolerance_s=0.05)  # doctest: +SKIP
    """
    if format not in group_choices("format"):
        there = closest_first(format, group_choices("format"))
        raise SequenceError(f"format={format}", f"is unknown; there are: {there}")
    keys = declaration(format) | options
    recording: Recording = open_reader(keys.pop("_target_"), folder, keys)
    return recording


def open_reader(target: str, source: str | Path, options: dict[str, Any]) -> Any:
    """Returns what a reader opens."""
    if (name := target.rpartition(".")[2]) not in READERS:
        there = ", ".join(f"flowrep.sequences.{each}" for each in READERS)
        raise UsageError(f"format._target_={target}: is no reader; there are {there}")
    check_reader_options(READERS[name], options)
    return READERS[name](source, **options)
