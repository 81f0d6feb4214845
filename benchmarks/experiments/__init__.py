"""Experiments on second order: each module is one command, with its CSV and its figure."""
