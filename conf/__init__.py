"""flowrep's configs; other projects compose them with `hydra.searchpath=[pkg://flowrep.conf]`.

Hydra takes a folder for a package's configs only where this file is.
"""
