"""flowrep's configs, for others to compose: `hydra.searchpath=[pkg://flowrep.conf]`.

Hydra takes a folder for a package's configs only where this file is.
"""
