"""Reports on runs: statistics, figures, tables and an HTML page."""
