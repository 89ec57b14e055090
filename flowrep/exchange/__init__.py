"""Runs external policies in flowrep and exports trained agents to run without it."""
