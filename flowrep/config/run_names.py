"""The names of folders of runs, which conf/run_folder.yaml asks for."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from hashlib import sha1
from typing import Any

from omegaconf import OmegaConf

OF_THE_MACHINE = ("device", "num_workers", "threads")
"""Keys that don't define a run and may change when it is resumed."""


def register_resolvers() -> None:
    """Registers the functions that conf/ calls to name folders, such as `${run_name:scene,...}`."""
    for resolver in (run_name, folder_name, sweep_run_name, unless_resumed):
        OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)


def run_name(
    scene: str, representations: Iterable[str], flow: str, noise: Mapping[str, float], seed: int
) -> str:
    """Returns the name of a run's folder."""
    source = "" if flow == "exact" else f"_{flow}"
    source += "_noisy" if any(noise.values()) else ""
    return folder_name(f"{scene}_{'+'.join(representations)}{source}_s{seed}")


def settings_of(choices: Mapping[str, Any]) -> str:
    """Returns which file a run's settings come from: `debug` if it is chosen, else `preset`."""
    return next(f"{key}={choices[key]}" for key in ("debug", "preset") if choices.get(key))


def unless_resumed(resume: str | None, folder: str) -> str:
    """Returns a new run's folder; for a resumed run the current one, so that Hydra creates none."""
    return folder if resume is None else "."


def folder_name(text: str) -> str:
    """Returns a text as the name of a single folder, without path separators, not hidden.

    >>> folder_name("s_turn"), folder_name("../../etc"), folder_name("..")
    ('s_turn', '_.._etc', '_')
    """
    name = "".join(c if c.isprintable() and c not in "/\\" else "_" for c in str(text))
    # File systems allow 255 bytes.
    return name.encode()[:200].decode(errors="ignore").lstrip(".") or "_"


def sweep_run_name(overrides: Iterable[str]) -> str:
    """Returns the name of a sweep's run's folder, which needs no quotes in a shell or in Hydra.

    Settings of the machine are left out.

    >>> sweep_run_name(["seed=0", "scene=s_turn", "representations=[ego,obj]", "device=cpu"])
    's_turn_ego+obj_s0'
    >>> sweep_run_name(["preset=laptop", "algorithm.tau=0.01", "seed=5", "seed=1"])
    'laptop_s1_algorithm.tau-0.01'
    """

    def plain(text: str) -> str:
        joined = re.sub(r"[\[\]{}()'\"\s]", "", text).replace(",", "+")
        return re.sub(r"[^A-Za-z0-9.+_-]", "_", joined)

    last = dict(text.lstrip("+").partition("=")[::2] for text in overrides)
    values = dict(sorted(last.items()))
    for key in OF_THE_MACHINE:
        values.pop(key, None)
    by_value = (
        "experiment", "preset", "debug", "scene", "representations", "flow", "algorithm", "speed",
    )  # fmt: skip
    words = [values.pop(key) for key in by_value if key in values]
    words += [f"s{values.pop('seed')}"] if "seed" in values else []
    words += [f"{key}-{value}" if value else key for key, value in values.items()]
    name = "_".join(map(plain, words)) or "run"
    return name if len(name) <= 100 else f"{name[:100]}_{sha1(name.encode()).hexdigest()[:8]}"
