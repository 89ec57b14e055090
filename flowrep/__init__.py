"""Factorized optical flow (ego + object) as mid-level representations for visual RL."""

import warnings
from importlib import import_module
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


_LATER = {"Agent": "flowrep.experiment.agents", "diagnose": "flowrep.diagnosis"}


def __getattr__(name: str) -> Any:
    """Imports `diagnose` and `Agent`, and with them PyTorch, when they are first used."""
    if name in _LATER:
        return getattr(import_module(_LATER[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
