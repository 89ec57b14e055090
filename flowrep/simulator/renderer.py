"""Choice of renderer for depth, classes and ids: the numba rasteriser or PyBullet."""

import warnings

from flowrep.jit import numba_is_installed

RENDERERS = ("auto", "rasteriser", "pybullet")
_REMEDY = "run: pip install 'flowrep[sim]'"


def choose_renderer(name: str) -> str:
    """Returns "rasteriser" or "pybullet"; "auto" is the rasteriser if numba is installed.

    Raises:
        ValueError: the renderer is unknown.
        ImportError: the rasteriser is requested and numba is missing.
    """
    if name not in RENDERERS:
        raise ValueError(f"unknown renderer {name!r}; choose one of {', '.join(RENDERERS)}")
    if name != "pybullet" and not numba_is_installed():
        if name == "rasteriser":
            raise ImportError(f"renderer 'rasteriser' needs numba; {_REMEDY}")
        warnings.warn(
            "numba is not installed, so PyBullet draws depth and ids: a picture of 84 x 84 "
            f"pixels then takes about 2 ms instead of 0.2; {_REMEDY}",
            stacklevel=2,
        )
        return "pybullet"
    return "rasteriser" if name == "auto" else name
