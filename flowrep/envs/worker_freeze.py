"""Imported by the workers' server after all other modules, before it forks.

It loads the rasteriser's machine code, which each worker would otherwise load for itself.

Whatever the server holds by then is exempt from garbage collection, which would write to every
object and so give each worker a copy of the memory that they share.
"""

import gc
from contextlib import suppress

import numpy as np

from flowrep.simulator.triangles import gather

with suppress(ImportError):  # without numba, PyBullet renders
    from flowrep.simulator.rasteriser import Rasteriser

    Rasteriser(gather([]), np.eye(3), (1, 1), (0.1, 1.0))

gc.collect()
gc.freeze()
