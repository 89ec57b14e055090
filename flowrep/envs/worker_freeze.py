"""Imported by the workers' server after all other modules, before it forks.

Whatever the server holds by then is exempt from garbage collection, which would write to every
object and so give each worker a copy of the memory that they share.
"""

import gc
from contextlib import suppress

with suppress(ImportError):  # without numba, PyBullet renders
    import flowrep.simulator.rasteriser  # noqa: F401

gc.collect()
gc.freeze()
