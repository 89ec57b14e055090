"""What runs say: figures, tables and a page of folders of runs, and the page of results."""
