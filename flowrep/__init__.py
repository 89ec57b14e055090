"""Factorized optical flow (ego + object) as mid-level representations for visual RL."""

import warnings
from importlib.metadata import PackageNotFoundError, version

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
