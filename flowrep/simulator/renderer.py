"""Who draws depth, classes and ids: numba's machine code where numba is, or PyBullet."""

import warnings
from importlib.util import find_spec

RENDERERS = ("auto", "rasteriser", "pybullet")
_REMEDY = "run: pip install 'flowrep[sim]'"


def choose_renderer(name: str) -> str:
    """Returns "rasteriser" or "pybullet"; "auto" is the first where numba is installed.

    Raises:
        ValueError: there is no such renderer.
        ImportError: the rasteriser is asked for where numba is missing.
    """
    if name not in RENDERERS:
        raise ValueError(f"unknown renderer {name!r}; choose one of {', '.join(RENDERERS)}")
    if name != "pybullet" and find_spec("numba") is None:
        if name == "rasteriser":
            raise ImportError(f"renderer 'rasteriser' needs numba; {_REMEDY}")
        warnings.warn(
            "numba is not installed, so that PyBullet draws depth and ids: a picture of 84 x 84 "
            f"pixels then takes about 2 ms instead of 0.2; {_REMEDY}",
            stacklevel=2,
        )
        return "pybullet"
    return "rasteriser" if name == "auto" else name
