"""The name of a sweep's run, which depends only on its overrides."""

import re
from collections.abc import Iterable
from hashlib import sha1

_BY_VALUE = (
    "experiment", "preset", "debug", "scene", "representations", "flow", "algorithm", "speed",
)  # fmt: skip
OF_THE_MACHINE = ("device", "num_workers", "trust")  # keys that don't define a run
_LONGEST = 100


def run_of_sweep(overrides: Iterable[str]) -> str:
    """Returns a run's folder name, of characters that need no quotes in a shell or in Hydra.

    Overrides whose value is clear by itself are shortened to it; settings of the machine are left
    out.

    Args:
        overrides: the run's overrides, in any order.

    >>> run_of_sweep(["seed=0", "scene=s_turn", "representations=[ego,obj]", "device=cpu"])
    's_turn_ego+obj_s0'
    >>> run_of_sweep(["preset=laptop", "algorithm.tau=0.01", "seed=1"])
    'laptop_s1_algorithm.tau-0.01'
    """
    values = dict(sorted(override.partition("=")[::2] for override in overrides))
    for key in OF_THE_MACHINE:
        values.pop(key, None)
    seed = values.pop("seed", None)
    words = [_plain(values.pop(key)) for key in _BY_VALUE if key in values]
    words += [] if seed is None else [f"s{_plain(seed)}"]
    words += [_plain(f"{key}-{value}" if value else key) for key, value in values.items()]
    name = "_".join(words) or "run"
    if len(name) > _LONGEST:
        name = f"{name[:_LONGEST]}_{sha1(name.encode()).hexdigest()[:8]}"
    return name


def _plain(text: str) -> str:
    joined = re.sub(r"[\[\]{}()'\"\s]", "", text.lstrip("+")).replace(",", "+")
    return re.sub(r"[^A-Za-z0-9.+_-]", "_", joined)
