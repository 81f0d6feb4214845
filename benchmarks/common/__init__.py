"""Shared by all benchmarks: a table of results, a pool of processes, intervals, figure style."""
