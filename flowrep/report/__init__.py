"""What a folder of runs says: figures, tables and a page, from their config, tables and metrics."""
