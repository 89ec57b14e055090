"""The parts of a run: folder, training loop, cadences, evaluation and interruption."""
