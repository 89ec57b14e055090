"""Policies that were made elsewhere, and agents that are to run elsewhere."""
