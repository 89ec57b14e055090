"""Raises a one-line error with the remedy if the simulator's packages are missing."""

from importlib.util import find_spec

if find_spec("pybullet") is None:
    raise ImportError(
        "flowrep.envs needs pybullet, which has wheels for CPython 3.10 and 3.11 only: "
        "use such a Python and run: pip install 'flowrep[sim]'"
    )
for _package in ("gymnasium", "shapely", "yaml"):
    if find_spec(_package) is None:
        raise ImportError(f"flowrep.envs needs {_package}; run: pip install 'flowrep[sim]'")
