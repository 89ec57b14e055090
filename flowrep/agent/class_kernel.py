"""The loop of `flowrep.agent.class_convolution`, compiled by numba at its first call."""

from flowrep.jit import compiled


@compiled()
def add_rows(rows, values, table):
    """Adds `values[i]` to the row `rows[i, j]` of the table, for all i and j.

    Arrays: rows `[M, C]`, int32; values `[M, F]` and table `[R, F]`, float32.
    """
    count, channels = rows.shape
    width = table.shape[1]
    for i in range(count):
        value = values[i]
        for j in range(channels):
            row = table[rows[i, j]]
            for k in range(width):
                row[k] += value[k]
