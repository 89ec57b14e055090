"""Functions that numba compiles at their first call, with the machine code cached."""

from collections.abc import Callable
from functools import cache
from typing import Any

from flowrep.extras import is_installed


@cache
def numba_is_installed() -> bool:
    """Returns whether numba can be imported, without importing it."""
    return is_installed("numba")


def compiled(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Returns a decorator; `options` are those of `numba.njit`.

    Raises:
        ImportError: numba is not installed.
    """
    from numba import njit  # here, as it takes half a second and is an extra

    def decorate(function: Callable[..., Any]) -> Any:
        try:
            return njit(cache=True, nogil=True, **options)(function)
        except RuntimeError:  # no writable cache folder: each process compiles again
            return njit(nogil=True, **options)(function)

    return decorate
