"""What all benchmarks share: a table of results, a pool of processes, intervals, and their look."""
