"""Runs: folder and lock, training loop, evaluation, films and sweeps; and the agents they give."""
