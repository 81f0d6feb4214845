"""Measurements: each module is one command, its results a CSV beside it."""
