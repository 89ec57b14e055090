"""Functions that numba compiles at their first call, with the machine code cached."""

from collections.abc import Callable
from typing import Any

from numba import njit


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Returns a decorator; `options` are those of `numba.njit`."""

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return njit(cache=True, nogil=True, **options)(function)
        except RuntimeError:  # no writable cache folder: each process compiles again
            return njit(nogil=True, **options)(function)

    return decorate
