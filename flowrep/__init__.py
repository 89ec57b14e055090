"""Factorized optical flow (ego + object) as mid-level representations for visual RL."""

import warnings
from importlib.metadata import PackageNotFoundError, version
from typing import Any

__version__ = "0.2.0"

try:
    _other = version("flowrep")
except PackageNotFoundError:
    pass
else:
    # Two distributions with one import name overwrite each other's files.
    warnings.warn(
        f"'flowrep' {_other} is installed beside 'flowrep-rl' {__version__}, and both are imported "
        "as flowrep. Run: pip uninstall flowrep flowrep-rl, then install flowrep-rl again",
        stacklevel=2,
    )


def __getattr__(name: str) -> Any:
    """Imports `diagnose` and `Agent`, and with them PyTorch, when they are first used."""
    if name == "diagnose":
        from flowrep.diagnosis import diagnose

        return diagnose
    if name == "Agent":
        from flowrep.experiment.agents import Agent

        return Agent
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
