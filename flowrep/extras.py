"""Optional packages: which are installed, the error for a missing one, and numba's compiler."""

import sys
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def is_installed(package: str) -> bool:
    """Returns whether a package or submodule can be imported, without importing it."""
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:  # not even the package that it is in
        return False


def require(what: str, extra: str, *packages: str, module: str = "") -> None:
    """Checks that packages are installed, before a module imports them.

    `what` needs them, e.g. "training", and an extra of flowrep installs them. If `module`, its
    `__name__`, runs as a command, the process ends in one line.
    """
    for package in packages:
        if not is_installed(package):
            message = f"{what} needs {package}; {_remedy(package, extra)}"
            if module == "__main__" or Path(sys.argv[0]).name.startswith("flowrep-"):
                print(f"error: {message}", file=sys.stderr)
                sys.exit(2)
            raise ModuleNotFoundError(message, name=package)


def _remedy(package: str, extra: str) -> str:
    if package == "pybullet" and sys.version_info >= (3, 14):  # where the extra leaves it out
        return (
            "it has no wheels for Python 3.14 yet: use Python 3.13, or compile it with "
            "`pip install pybullet-arm64`, which needs a C++ compiler and about ten minutes"
        )
    return f"run: pip install 'flowrep-rl[{extra}]'"


@cache
def numba_is_installed() -> bool:
    """Returns whether numba can be imported, without importing it."""
    return is_installed("numba")


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Returns `numba.njit` of these options as a decorator, which caches the machine code."""
    from numba import njit  # here, as it takes half a second and is an extra

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return njit(cache=True, nogil=True, **options)(function)
        except RuntimeError:  # no writable cache folder: each process compiles again
            return njit(nogil=True, **options)(function)

    return decorate
