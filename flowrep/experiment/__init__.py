"""Runs: folder, training loop, evaluation and films; and the agents that they give."""
