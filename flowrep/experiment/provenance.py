"""What a run's numbers depend on: the keys that define it, and the machine that computes it."""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from flowrep import __version__

_DEFINING_KEYS = (
    "scene", "representations", "flow", "motion", "noise", "algorithm", "speed", "seed", "num_envs",
)  # fmt: skip
"""The parts of a config that determine the weights after some number of frames."""


def origin_of(config: Mapping[str, Any]) -> dict[str, Any]:
    """Returns the identity of a run: flowrep's version, and the config keys that define it."""
    # Tuples become lists, as they are in a checkpoint that was read.
    parts = json.loads(json.dumps({key: config[key] for key in _DEFINING_KEYS}))
    # It only selects `algorithm.mirror` in presets; the street is the same with and without it.
    parts["scene"].pop("symmetric", None)
    return {"flowrep": __version__, **parts}


def check_origin(saved: Mapping[str, Any], expected: Mapping[str, Any], path: Path) -> None:
    """Checks that a checkpoint belongs to a run; the error names the first difference."""
    from flowrep.agent import CheckpointError

    if saved.get("flowrep") != expected["flowrep"]:
        raise CheckpointError(
            f"{path} was written by flowrep {saved.get('flowrep')}, this is {expected['flowrep']}: "
            "install that version, or start a new run"
        )
    for key, was, now in differences(saved, expected):
        raise CheckpointError(
            f"{path} belongs to a run with {key}={was}, the config.yaml of its folder says "
            f"{key}={now}: restore the file that was there, or start a new run"
        )


def differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yields the dotted keys whose values differ, with both values."""
    there, here = flattened(old), flattened(new)
    for key in {**there, **here}:
        was, now = there.get(key, "absent"), here.get(key, "absent")
        if was != now:
            yield key, was, now


def flattened(config: Mapping[str, Any], section: str = "") -> dict[str, Any]:
    """Returns nested values by their dotted keys; an empty mapping is a value."""
    flat: dict[str, Any] = {}
    for key, value in config.items():
        nested = flattened(value, f"{section}{key}.") if isinstance(value, Mapping) else {}
        flat |= nested or {f"{section}{key}": value}
    return flat


def machine_of(precision: str) -> dict[str, Any]:
    """Returns versions, commit, processor and number format, which may change a run's numbers."""
    import torch

    home, commit = Path(__file__).parents[2], None
    if (home / ".git").exists() and shutil.which("git"):
        ask = ["git", "-C", str(home), "describe", "--always", "--dirty", "--abbrev=40"]
        # Without tags, which would take the place of the hash.
        answer = subprocess.run([*ask, "--exclude=*"], capture_output=True, text=True)
        commit = answer.stdout.strip() or None
    return {
        "flowrep": __version__,
        "commit": commit,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "precision": {"bf16": "bfloat16", "fp32": "float32"}[precision],
        "cpu": cpu_name(),
        "cores": os.cpu_count(),
        "gpu": torch.cuda.get_device_name() if torch.cuda.is_available() else None,
    }


def cpu_name() -> str:
    """Returns the processor's name."""
    info = Path("/proc/cpuinfo")  # of Linux, where platform.processor() is empty
    lines = info.read_text(encoding="utf-8").splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return next(iter(names), platform.processor() or platform.machine())
