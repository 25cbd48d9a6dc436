"""Runs: what a training is apart from what it learns: its folder, limits, clock, terminal."""
